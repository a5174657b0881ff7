"""An element from one file, for each of the two finite element solvers: shape functions, patch test, force, uses."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import ELEMENTS, Q9P1
from tissue_sim.mesh.solid import (
    SOLID_ELEMENTS,
    add_face_and_free_node_sets,
    create_block_mesh_from_boundaries,
    create_cylinder_mesh_under_needle,
)
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.mesh.solid_file import convert_to_element_type
from tissue_sim.parameters import get_parameter_value

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
RADIUS = 8e-3


def needle(points=3):
    return ts.Model(NEEDLE.experiment(specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(4e-3, points),
                                      tool=ts.Tool("flat", radius=RADIUS)), MATERIAL)


@pytest.fixture
def quadrilateral(plugin, registers):
    return registers(ELEMENTS, plugin("serendipity_quadrilateral").Q8P0)


@pytest.fixture
def hexahedron(plugin, registers):
    return registers(SOLID_ELEMENTS, plugin("face_bubble_hexahedron").H14P0)


@pytest.mark.parametrize("name", ["quadrilateral", "hexahedron"])
def test_shape_functions(name, request):
    """One at their own node, zero at others; their sum is one; the gradients are those of differences."""
    element = request.getfixturevalue(name)
    at_nodes, _ = element.evaluate_shape_functions_and_gradients(element.reference_nodes)
    np.testing.assert_allclose(at_nodes, np.eye(element.node_count), atol=1e-14)
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (20, element.reference_nodes.shape[1]))
    values, slopes = element.evaluate_shape_functions_and_gradients(points)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-14)
    for axis, offset in enumerate(1e-5 * np.eye(points.shape[1])):
        more, less = (element.evaluate_shape_functions_and_gradients(points + sign * offset)[0] for sign in (1, -1))
        np.testing.assert_allclose(slopes[..., axis], (more - less) / 2e-5, atol=1e-9)


def compressed_plates():
    return ts.Model(ts.Experiment(ts.Specimen(0.03, 0.03), ts.Protocol.ramp(6e-3, 3), friction="frictionless",
                                  friction_base="frictionless"), MATERIAL)


@pytest.mark.slow
def test_quadrilateral_passes_the_patch_test(quadrilateral):
    """Uniform compression is a solution on distorted elements, with the stress that all elements have."""
    mesh = cylinder_mesh(0.03, 0.03, (3, 3), quadrilateral)
    corners = np.unique(mesh.connectivity[:, :4])
    inside = corners[(mesh.nodes[corners] > [1e-9, -0.03 + 1e-9]).all(axis=1)
                     & (mesh.nodes[corners] < [0.03 - 1e-9, -1e-9]).all(axis=1)]
    assert inside.size == 4
    mesh.nodes[inside] += np.random.default_rng(2).uniform(-2e-3, 2e-3, (4, 2))
    mesh.nodes[mesh.connectivity[:, 4:]] = 0.5 * (mesh.nodes[mesh.connectivity[:, :4]]
                                                  + mesh.nodes[np.roll(mesh.connectivity[:, :4], -1, axis=1)])
    recording = ts.simulate(compressed_plates(), mesh=mesh, fields=True)
    expected = ts.simulate(compressed_plates(), mesh=cylinder_mesh(0.03, 0.03, (3, 3), Q9P1), fields=True)
    np.testing.assert_allclose(recording.force, expected.force, rtol=1e-8)
    for name in ("cauchy_zz", "von_mises"):
        stress = recording.fields.at_points(name)
        np.testing.assert_allclose(stress, expected.fields.at_points(name).mean(), rtol=1e-7)
    used = np.unique(mesh.connectivity)
    moved = recording.fields.displacement()[used]
    lateral, axial = moved[-1, 0] / mesh.nodes[used[-1], 0], -6e-3 / 0.03
    np.testing.assert_allclose(moved, mesh.nodes[used] * [lateral, axial] + [0.0, axial * 0.03], atol=1e-10)


def test_quadrilateral_has_the_force_of_the_built_in_one(quadrilateral):
    """On the same elements; the difference decreases with their size."""
    model, differences = needle(), []
    for resolution in ("fast", "accurate"):
        own, built_in = (ts.simulate(model, mesh=build_mesh(model.experiment, resolution, element)).force[-1]
                         for element in (quadrilateral, Q9P1))
        differences.append(abs(own / built_in - 1.0))
    assert differences[0] < 0.03 and differences[1] < 0.7 * differences[0]


@pytest.mark.slow
def test_quadrilateral_has_exact_derivatives_and_a_picture(quadrilateral):
    model = needle()
    mesh = build_mesh(model.experiment, "fast", quadrilateral)
    derivatives = ts.sensitivities(model, ["C10"], mesh=mesh)
    width = 1e-4 * get_parameter_value(model, "material.C10")
    more, less = (ts.simulate(ts.with_values(model, {"material.C10": 1500.0 + sign * width}), mesh=mesh).force
                  for sign in (1, -1))
    assert derivatives.exact.all()
    np.testing.assert_allclose(derivatives.values[:, 0], (more - less) / (2 * width), rtol=1e-5,
                               atol=1e-6 * abs(derivatives.values).max())
    fields = ts.simulate(model, mesh=mesh, fields=True).fields
    section = fields.geometry()
    points = section.interpolate_at_points(section.nodes)
    a, b, c = np.moveaxis(points[section.triangles], 1, 0)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (area > 0.0).all() and area.sum() == pytest.approx(0.04 * 0.07)


@pytest.mark.slow
def test_quadrilateral_in_real_time_with_inertia(quadrilateral):
    model = replace(needle(), material=replace(MATERIAL, density=1040.0))
    forces = []
    for element in (quadrilateral, Q9P1):
        simulator = ts.Simulator(model, mesh=build_mesh(model.experiment, "fast", element), inertia="on")
        answers = [simulator.step(1e-5 * k, 1e-3) for k in range(1, 101)]
        assert {answer.status for answer in answers} == {ts.ForceStatus.CONVERGED}
        forces.append([answer.force for answer in answers])
    np.testing.assert_allclose(forces[0], forces[1], rtol=0, atol=0.05 * max(forces[1]))


@pytest.mark.slow
def test_hexahedron_passes_the_patch_test(hexahedron):
    """Uniform compression of a block on distorted elements, with the stress of the axisymmetric solver."""
    line = np.array([-0.01, 0.0, 0.01])
    straight = create_block_mesh_from_boundaries(line, line, 1.5 * line - 0.015, HEX8P0)
    straight.nodes[np.linalg.norm(straight.nodes - [0.0, 0.0, -0.015], axis=1) < 1e-9] += [1.5e-3, -1e-3, 2e-3]
    mesh = convert_to_element_type(straight, hexahedron)
    assert len(mesh.nodes) == 27 + 36
    fields = ts.simulate(compressed_plates(), solver="solid", mesh=mesh, fields=True).fields
    expected = ts.simulate(compressed_plates(), mesh=cylinder_mesh(0.03, 0.03, (3, 3), Q9P1), fields=True).fields
    for name in ("cauchy_zz", "von_mises", "J"):
        np.testing.assert_allclose(fields.at_points(name), expected.at_points(name).mean(), rtol=1e-6)
    assert abs(fields.at_points("cauchy_xz")).max() < 1e-6 * abs(fields.at_points("cauchy_zz")).max()


@pytest.fixture
def needle_mesh(hexahedron):
    """Returns the same cells under a needle in another element."""
    cells = create_cylinder_mesh_under_needle(0.04, 0.07, RADIUS, HEX27P1, smallest=3e-3, growth=2.2, largest=20e-3,
                                              around=2)

    def convert(element):
        return add_face_and_free_node_sets(convert_to_element_type(cells, element), RADIUS, (0.0, 0.0))

    return convert


@pytest.mark.slow
def test_hexahedron_has_the_force_of_the_built_in_one(hexahedron, needle_mesh):
    model = needle()
    own = ts.simulate(model, solver="solid", mesh=needle_mesh(hexahedron), fields=True)
    linear, quadratic = (ts.simulate(model, solver="solid", mesh=needle_mesh(element)).force
                         for element in (HEX8P0, HEX27P1))
    assert abs(own.force - quadratic).max() < 0.8 * abs(linear - quadratic).max() < 0.06 * quadratic.max()
    assert own.metadata["solver"]["element"] == "H14/P0"
    geometry = own.fields.geometry()
    corners = geometry.nodes[geometry.list_tetrahedra()]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert volumes.sum() == pytest.approx(4 * np.sqrt(0.5) * 0.04**2 * 0.07), "an octagonal prism"
    a, b, c = np.moveaxis(geometry.nodes[geometry.surface_triangles], 1, 0)
    assert np.einsum("ti,ti->", np.cross(a, b), c) / 6.0 == pytest.approx(volumes.sum())


@pytest.mark.slow
def test_hexahedron_in_contact_with_inertia(hexahedron, needle_mesh):
    """A ball with friction pressed into heavy tissue: contact at the nodes of the element."""
    model = ts.Model(replace(needle().experiment, tool=ts.Tool("round", radius=RADIUS), friction=0.3),
                     replace(MATERIAL, density=1040.0))
    forces = []
    for element in (hexahedron, HEX8P0):
        simulator = ts.Simulator(model, solver="solid", mesh=needle_mesh(element), inertia="on")
        answers = [simulator.step(min(1e-4 * k, 1.5e-3), 5e-3) for k in range(1, 31)]
        assert {answer.status for answer in answers[-5:]} == {ts.ForceStatus.CONVERGED}
        forces.append(answers[-1].force)
    assert forces[0] == pytest.approx(forces[1], rel=0.1)


def test_what_cannot_be_used_is_refused(plugin, registers):
    quadrilateral, hexahedron = plugin("serendipity_quadrilateral"), plugin("face_bubble_hexahedron")
    model = needle()
    with pytest.raises(InputError, match=r"unknown quadrilateral element 'Q8/P0'"):
        ts.simulate(model, mesh=build_mesh(model.experiment, "fast", quadrilateral.Q8P0))
    with pytest.raises(InputError, match=r"unknown solid element 'H14/P0'"):
        line = [-0.01, 0.0, 0.01]
        mesh = convert_to_element_type(create_block_mesh_from_boundaries(line, line, line, HEX8P0), hexahedron.H14P0)
        ts.simulate(compressed_plates(), solver="solid", mesh=mesh)
    with pytest.raises(InputError, match="at most one interior node"):
        ELEMENTS.register(replace(quadrilateral.Q8P0, name="Q8/P-1", boundary_nodes=4))
    with pytest.raises(InputError, match="1 or 4 pressure modes"):
        SOLID_ELEMENTS.register(replace(hexahedron.H14P0, name="H14/P-2", pressure_modes=10))
    with pytest.raises(InputError, match="is taken by another quadrilateral element"):
        ELEMENTS.register(replace(quadrilateral.Q8P0, name="Q9/P-1"))
