"""Meshes of a solid: volume, surface, names, and how circles are met."""

import numpy as np
import pytest
from solid_meshes import block, punched_cylinder

from tissue_sim.errors import InputError
from tissue_sim.mesh.solid import SOLID_ELEMENTS, create_cylinder_mesh, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, TET8P0, TET15P1
from tissue_sim.mesh.tetrahedral import make_tetrahedral_mesh

every_element = pytest.mark.parametrize("element", SOLID_ELEMENTS.values(), ids=lambda element: element.name)
NEEDLE = {"smallest": 1.3e-3, "growth": 1.8, "largest": 15e-3}


def volume(mesh):
    points, weights = mesh.element.quadrature
    _, slopes = mesh.element.evaluate_shape_functions_and_gradients(points)
    determinants = np.linalg.det(np.einsum("eai,qaj->eqij", mesh.nodes[mesh.connectivity], slopes))
    assert (determinants > 0.0).all()
    return (determinants * weights).sum()


def normals(mesh, name):
    """Return normals of the flat polygons through the corners of each side, times twice their area."""
    corners = mesh.nodes[mesh.faces[name][:, mesh.element.corner_indices_within_face]]
    return np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1), corners.mean(axis=1)


@every_element
def test_shape_functions_are_one_at_their_node_and_add_up_to_one(element):
    values, _ = element.evaluate_shape_functions_and_gradients(element.reference_nodes)
    np.testing.assert_allclose(values, np.eye(element.node_count), atol=1e-14)
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(element.evaluate_corner_functions(element.reference_nodes[element.local_corner_indices]),
                               np.eye(len(element.local_corner_indices)), atol=1e-14)
    values, slopes = element.evaluate_shape_functions_and_gradients(points)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(slopes.sum(axis=1), 0.0, atol=1e-13)
    h = 1e-6
    for axis, step in enumerate(np.eye(3) * h):
        ahead, behind = (element.evaluate_shape_functions_and_gradients(points + sign * step)[0] for sign in (1, -1))
        np.testing.assert_allclose(slopes[..., axis], (ahead - behind) / (2 * h), atol=1e-9)


@every_element
def test_a_block_has_its_volume_and_its_surface_points_outwards(element):
    mesh = block([0.0, 0.01, 0.03], [-0.01, 0.0, 0.02], [-0.02, -0.015, 0.0], element)
    assert volume(mesh) == pytest.approx(0.03 * 0.03 * 0.02, rel=1e-12)
    assert len(np.unique(mesh.nodes.round(12), axis=0)) == len(mesh.nodes), "a node twice"
    middle = mesh.nodes.mean(axis=0)
    for name in ("base", "top", "side"):
        outwards, places = normals(mesh, name)
        assert (np.einsum("fi,fi->f", outwards, places - middle) > 0.0).all()
    assert (mesh.nodes[mesh.sets["top"], 2] == 0.0).all() and (mesh.nodes[mesh.sets["base"], 2] == -0.02).all()


@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.015, -0.01)])
def test_a_cylinder_under_a_needle(centre):
    mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 0.008, HEX27P1, around=3, centre=centre, **NEEDLE)
    # Two points of a quadratic side lie on the circle next to each midpoint.
    assert volume(mesh) == pytest.approx(np.pi * 0.04**2 * 0.07, rel=3e-4)
    side = np.hypot(*mesh.nodes[mesh.sets["side"], :2].T)
    np.testing.assert_allclose(side, 0.04, rtol=1e-12)
    both = np.intersect1d(mesh.sets["face"], mesh.sets["free"])
    np.testing.assert_allclose(np.hypot(*(mesh.nodes[both, :2] - centre).T), 0.008, rtol=1e-12)
    assert both.size == 24 and (np.union1d(mesh.sets["face"], mesh.sets["free"]) == mesh.sets["top"]).all()
    outwards, places = normals(mesh, "side")
    assert (np.einsum("fi,fi->f", outwards[:, :2], places[:, :2]) > 0.0).all()


def test_finer_rings_of_linear_elements_come_to_the_volume_with_order_two():
    errors = []
    for around in (3, 6):
        mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 0.008, HEX8P0, around=around, **NEEDLE)
        errors.append(abs(volume(mesh) / (np.pi * 0.04**2 * 0.07) - 1.0))
    assert errors[1] == pytest.approx(errors[0] / 4.0, rel=0.05)


def test_a_circle_beyond_the_cylinder_is_refused():
    with pytest.raises(InputError, match=r"must be inside the cylinder of radius 0\.04 m") as caught:
        create_cylinder_mesh(0.04, 0.07, HEX8P0, around=2, inward=[0.5, 1.0], outward=[0.0, 1.0], z=[-0.07, 0.0],
                             face_radius=0.01, centre=(0.03, 0.01))
    assert caught.value.field == "centre"


@pytest.mark.parametrize("element", [HEX8P0, HEX27P1, TET8P0, TET15P1], ids=lambda element: element.name)
@pytest.mark.parametrize("shape", ["block", "cylinder"])
def test_linear_tetrahedra_share_faces_with_their_neighbours(shape, element):
    """Inner faces belong to two tetrahedra, the others have the area of the surface; other nodes are left out."""
    line = np.linspace(-0.01, 0.01, 4)
    mesh = block(line, line, line - 0.01, element) if shape == "block" else punched_cylinder(
        element, smallest=4e-3, growth=2.0, largest=20e-3, around=2)
    linear = make_tetrahedral_mesh(mesh)
    cells = linear.cells
    faces, counts = np.unique(np.sort(cells[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1),
                              axis=0, return_counts=True)
    corners = linear.nodes[faces[counts == 1]]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    volumes = np.linalg.det(linear.nodes[cells[:, 1:]] - linear.nodes[cells[:, :1]]) / 6.0
    assert counts.max() == 2 and volumes.min() > 0.0 and volumes.sum() == pytest.approx(linear.volume)
    used = np.unique(mesh.connectivity[:, element.local_corner_indices])
    np.testing.assert_array_equal(linear.nodes, mesh.nodes[used])
    np.testing.assert_array_equal(np.unique(cells), np.arange(len(used)))
    for name, numbers in mesh.sets.items():
        np.testing.assert_array_equal(used[linear.sets[name]], np.intersect1d(numbers, used))
    assert np.isin(np.unique(faces[counts == 1]), np.union1d(linear.surface, linear.sets["base"])).all()
    assert area == pytest.approx(mesh.surface_node_areas.sum(), rel=0.06 if shape == "cylinder" else 1e-9)
