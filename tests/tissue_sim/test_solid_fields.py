"""Fields of the solid in space against closed forms, and against the axisymmetric fields of the same problem."""

import math
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.elements.fields import FIELD_UNITS
from tissue_sim.fem.solid.fields import SOLID_UNITS, compute_stretches_of_cauchy_green_tensors
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import SharedFields
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

C10 = 1500.0
MU = 2.0 * C10
NEO_HOOKE = ts.Material("neo_hooke", {"C10": C10}, ts.Bulk("bulk_ratio", 1e4))
SPECIMEN = ts.Specimen(0.04, 0.07)
every_element = pytest.mark.parametrize("element", (HEX8P0, HEX27P1), ids=lambda element: element.name)


def uniform(element, F, mean_stress):
    """Fields of a block of crooked elements that is deformed evenly, under a mean stress, Pa."""
    line = np.linspace(0.0, 0.01, 3)
    mesh = create_block_mesh_from_boundaries(line, line * 1.5, line - 0.01, element)
    inside = np.ones(len(mesh.nodes), dtype=bool)
    inside[np.unique(np.concatenate(list(mesh.sets.values())))] = False
    mesh.nodes[inside] += np.random.default_rng(2).uniform(-4e-4, 4e-4, (inside.sum(), 3))
    solver = SolidSolver(mesh, NEO_HOOKE, {"base": "xyz"}, mesh.sets["top"], start=Pose.at_depth(0.0))
    fields = solver.fields([solver.field_sample()])
    volumes = fields.weights.sum(axis=1)
    pressures = np.zeros_like(fields.pressures)
    pressures[0, :, 0] = mean_stress * np.sqrt(volumes)  # of the orthonormal constant mode
    return fields.with_arrays(((mesh.nodes @ (np.asarray(F) - np.eye(3)).T)[None], pressures))


def everywhere(fields, name, expected, atol=0.0):
    for values in (fields.at_points(name), fields.at_nodes(name),
                   fields.with_one_mean_point_per_element().at_points(name)):
        np.testing.assert_allclose(values, expected, rtol=1e-7, atol=atol, err_msg=name)


@every_element
def test_uniaxial_stretch_is_the_closed_form(element):
    """Along x: s = mu (l^2 - 1/l), and nothing across; however it is turned."""
    stretch = 1.35
    stress = MU * (stretch**2 - 1.0 / stretch)
    mean = MU * (stretch**2 + 2.0 / stretch) / 3.0
    F = np.diag([stretch, stretch**-0.5, stretch**-0.5])
    p = mean - MU / stretch  # so that the sides are free
    fields = uniform(element, F, p)
    energy = C10 * (stretch**2 + 2.0 / stretch - 3.0) + p**2 / (2.0 * fields.bulk_modulus[0])
    for name, expected in {"von_mises": stress, "cauchy_xx": stress, "cauchy_yy": 0.0, "cauchy_zz": 0.0,
                           "cauchy_xy": 0.0, "pressure": -stress / 3.0, "stretch": stretch, "J": 1.0,
                           "energy": energy}.items():
        everywhere(fields, name, expected, atol=1e-6 * MU)
    assert fields.stretch_range() == pytest.approx((stretch**-0.5, stretch), rel=1e-7)
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    turned = uniform(element, turn @ F, p)
    for name, expected in {"von_mises": stress, "pressure": -stress / 3.0, "stretch": stretch}.items():
        everywhere(turned, name, expected)
    everywhere(turned, "cauchy_xz", stress * turn[0, 0] * turn[2, 0], atol=1e-6 * MU)


@every_element
def test_simple_shear_is_the_closed_form(element):
    """s_xz = mu g, von Mises mu sqrt(3 g^2 + g^4), largest stretch g/2 + sqrt(1 + g^2/4) (Ogden 1997, 2.2)."""
    g = 0.6
    F = np.eye(3)
    F[0, 2] = g
    fields = uniform(element, F, 0.0)
    for name, expected in {"von_mises": MU * math.sqrt(3 * g**2 + g**4), "cauchy_xz": MU * g, "energy": C10 * g**2,
                           "cauchy_xx": MU * 2 * g**2 / 3, "pressure": 0.0, "J": 1.0,
                           "stretch": g / 2 + math.sqrt(1 + g**2 / 4)}.items():
        everywhere(fields, name, expected, atol=1e-9 * MU)
    place = fields.mesh.nodes
    np.testing.assert_allclose(fields.at_nodes("displacement"), g * abs(place[:, 2]), atol=1e-15)


def test_components_by_r_and_z_turn_with_the_point():
    """Uniaxial stress s along x gives rr = s cos(a)^2 and hoop = s sin(a)^2 at the angle a about z."""
    stretch = 1.2
    stress = MU * (stretch**2 - 1.0 / stretch)
    p = MU * (stretch**2 + 2.0 / stretch) / 3.0 - MU / stretch
    fields = uniform(HEX8P0, np.diag([stretch, stretch**-0.5, stretch**-0.5]), p)
    values, _ = HEX8P0.evaluate_shape_functions_and_gradients(HEX8P0.quadrature[0])
    place = np.einsum("qa,eai->eqi", values, (fields.mesh.nodes + fields.displacement())[fields.mesh.connectivity])
    angle = np.arctan2(place[..., 1], place[..., 0])
    for name, expected in {"cauchy_rr": stress * np.cos(angle)**2, "cauchy_hoop": stress * np.sin(angle)**2,
                           "cauchy_zz": 0.0, "cauchy_rz": 0.0}.items():
        np.testing.assert_allclose(fields.at_points(name), expected, rtol=1e-7, atol=1e-7 * MU)


def test_stretches_are_singular_values():
    F = np.random.default_rng(1).normal(0.0, 0.3, (500, 3, 3)) + np.eye(3)
    F[:3] = [np.eye(3), np.diag([2.0, 2.0, 0.25]), np.diag([0.5, 0.5, 4.0])]
    np.testing.assert_allclose(compute_stretches_of_cauchy_green_tensors(F @ F.swapaxes(1, 2)), np.linalg.svd(F)[1],
                               rtol=1e-6, atol=1e-6)


def test_names_are_those_of_all_solvers_and_an_unknown_one_is_refused():
    fields = uniform(HEX8P0, np.eye(3), 0.0)
    assert set(FIELD_UNITS) < set(SOLID_UNITS) and isinstance(fields, SharedFields)
    for name in SOLID_UNITS:
        assert fields.at_points(name).shape == fields.weights.shape
        assert fields.at_nodes(name).shape == (len(fields.mesh.nodes),)
    with pytest.raises(ts.InputError, match="did you mean 'von_mises'"):
        fields.at_points("von_mise")


def test_a_part_of_the_elements_has_the_values_that_they_have_in_the_whole():
    fields = uniform(HEX27P1, np.diag([1.1, 1.0, 1.0 / 1.1]), 40.0)
    chosen = np.array([5, 0, 3])
    for name in ("von_mises", "displacement", "cauchy_rz", "energy"):
        np.testing.assert_array_equal(fields.with_selected_elements(chosen).at_points(name),
                                      fields.at_points(name)[chosen])


@pytest.fixture(scope="module")
def punched():
    """A bonded punch, 3 mm deep, in space and axisymmetric."""
    experiment = ts.Experiment(SPECIMEN, ts.Protocol.ramp(3e-3, 2), tool=ts.Tool("flat", radius=8e-3))
    model = ts.Model(experiment, ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4},
                                             ts.Bulk("bulk_ratio", 1e3)))
    mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX27P1, smallest=2e-3, growth=2.0, largest=15e-3,
                                             around=2)
    return (ts.simulate(model, solver="solid", mesh=mesh, fields=True),
            ts.simulate(model, fields=True))


@pytest.mark.slow
def test_fields_under_a_punch_are_those_of_the_axisymmetric_solid(punched):
    solid, plane = (recording.fields for recording in punched)
    assert bool(solid)
    for name, tolerance in {"energy": 0.01, "von_mises": 0.02, "displacement": 0.01, "J": 1e-6,
                            "stretch": 2e-3, "cauchy_zz": 0.03}.items():
        one, other = (np.average(fields.at_points(name), weights=fields.weights) for fields in (solid, plane))
        assert one == pytest.approx(other, rel=tolerance), name
    np.testing.assert_allclose(solid.stretch_range(), plane.stretch_range(), rtol=0.02)
    assert solid.displacement(0).any() == np.False_ and solid.at_points("von_mises", 0).max() < 1e-6 * MU


@pytest.mark.slow
@pytest.mark.parametrize("name", ["von_mises", "pressure", "cauchy_zz", "cauchy_rr", "displacement"])
def test_along_the_axis_the_fields_are_those_of_the_axisymmetric_solid(punched, name):
    solid, plane = (recording.fields for recording in punched)
    on_axis = np.hypot(*solid.mesh.nodes[:, :2].T) < 1e-9
    z, found = solid.mesh.nodes[on_axis, 2], solid.at_nodes(name)[on_axis]
    axis = plane.mesh.sets["axis"]
    order = np.argsort(plane.mesh.nodes[axis, 1])
    expected = np.interp(z, plane.mesh.nodes[axis, 1][order], plane.at_nodes(name)[axis][order])
    below = z < -8e-3  # nearer than its radius the elements of the solid are too coarse for the tool's edge
    assert below.sum() > 6
    np.testing.assert_allclose(found[below], expected[below], atol=0.04 * abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("past", [{"viscoelastic": ts.Prony((ts.PronyTerm(0.3, 2.0),))},
                                  {"softening": ts.Softening(0.3, 400.0, 0.2)}], ids=["relaxes", "softens"])
def test_stress_of_tissue_that_remembers_is_that_of_the_axisymmetric_solid(past):
    """Uniformly pressed between plates, held and released."""
    kind = ts.KINDS["lubricated_compression"]
    experiment = kind.experiment(specimen=SPECIMEN, protocol=ts.Protocol.parse(
        "ramp 6mm @3mm/s; hold 2s; unload 3mm @3mm/s", 3, 3e-3))
    model = ts.Model(experiment, replace(NEO_HOOKE, **past))
    solid, plane = (ts.simulate(model, solver=solver, fields=True, resolution=resolution).fields
                    for solver, resolution in (("solid", "realtime"), ("axisymmetric", "fast")))
    assert solid.stresses is not None
    for sample in (-1, -3):
        for name in ("von_mises", "cauchy_zz", "cauchy_rr", "pressure", "energy"):
            expected = float(plane.at_points(name, sample).mean())
            np.testing.assert_allclose(solid.at_points(name, sample), expected, rtol=1e-3, atol=1e-3 * MU)
            np.testing.assert_allclose(
                solid.with_selected_elements(np.arange(4)).with_one_mean_point_per_element().at_points(name,
                                                                                                       sample),
                expected, rtol=1e-3, atol=1e-3 * MU)
