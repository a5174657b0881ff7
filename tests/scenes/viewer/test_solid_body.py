"""Picture of a solid in 3D: the remaining surface is closed, has the exact volume, and is split into bands."""

import numpy as np
import pytest

import tissue_sim as ts
from scenes.viewer.revolution import WedgeOpening
from scenes.viewer.solid_body import SETTINGS, ThreeDimensionalMeshBody, Wedge
from tissue_sim.fem.solid.fields import SolidFields, build_solid_geometry
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

SIDE = 0.04
#: Height, m.
HEIGHT = 0.03
LEVELS = np.linspace(-0.5, 1.5, 7)
MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
every_element = pytest.mark.parametrize("element", (HEX8P0, HEX27P1), ids=lambda element: element.name)


def block(element, cells=4):
    line = np.linspace(-0.5 * SIDE, 0.5 * SIDE, cells + 1)
    return create_block_mesh_from_boundaries(line, line, np.linspace(-HEIGHT, 0.0, cells), element)


def body_of(mesh):
    return ThreeDimensionalMeshBody.from_geometry(build_solid_geometry(mesh))


def linear(place):
    return place @ [20.0, -11.0, 9.0] + 0.4


def flux(surfaces):
    """Volume of a closed surface by the divergence theorem, and the sum of its area vectors."""
    volume, total = 0.0, np.zeros(3)
    for surface in surfaces:
        a, b, c = np.moveaxis(surface.vertices.astype(float)[surface.faces], 1, 0)
        area = 0.5 * np.cross(b - a, c - a)
        volume += np.einsum("ti,ti->", area, (a + b + c) / 3.0) / 3.0
        total += area.sum(axis=0)
    return volume, total


def leaning(angle, x=0.0, y=0.0):
    return Pose((x, y, -1e-3), (np.cos(0.5 * angle), 0.0, -np.sin(0.5 * angle), 0.0))


@every_element
@pytest.mark.parametrize(("cut", "turn", "pose", "left"), [
    (0, 0, Pose((0.0, 0.0, 0.0)), 1.0), (90, 0, Pose((0.0, 0.0, 0.0)), 0.75), (180, 0, Pose((0.0, 0.0, -2e-3)), 0.5),
    (180, 0, Pose((3e-3, 5e-3, 0.0)), 0.375), (180, 90, Pose((-7e-3, 1e-3, 0.0)), 0.325), (90, 45, Pose(
        (0.0, 0.0, 0.0)), 0.75), (180, 0, leaning(0.4), 0.5), (180, 180, leaning(0.4, y=4e-3), 0.6)])
def test_the_remaining_body_has_the_exact_volume(element, cut, turn, pose, left):
    """A right-angled wedge removes a quarter of a square block; a half space removes the part on its side."""
    mesh = block(element)
    body = body_of(mesh)
    check_remaining_body(mesh, body, Wedge(WedgeOpening(np.radians(cut), np.radians(turn - 90.0)), pose), left)


@every_element
def test_a_moved_wedge_removes_less(element):
    mesh = block(element)
    for ahead, left in ((3e-3, 0.575), (-5e-3, 0.375)):
        check_remaining_body(mesh, body_of(mesh), Wedge(WedgeOpening(np.pi), leaning(0.3), ahead), left)
    # Of a right angle about the middle, moved by 5 mm to where it opens, the square of the rest of the way.
    wedge = Wedge(WedgeOpening(0.5 * np.pi), Pose((0.0, 0.0, 0.0)), 5e-3)
    check_remaining_body(mesh, body_of(mesh), wedge, 1.0 - (15.0 / 40.0) ** 2)


def check_remaining_body(mesh, body, wedge, left):
    """Check that the surface is closed, has a fraction `left` of the volume, and that its bands have their values."""
    surfaces = body.compute_band_surfaces(mesh.nodes, linear(mesh.nodes), LEVELS, wedge)
    volume, total = flux(surfaces)
    assert volume == pytest.approx(left * SIDE**2 * HEIGHT, rel=1e-5)  # vertices have single precision
    np.testing.assert_allclose(total, 0.0, atol=1e-6 * SIDE**2)
    for k, surface in enumerate(surfaces):
        if len(surface.faces):
            low = LEVELS[k] if k else -np.inf
            high = LEVELS[k + 1] if k < len(surfaces) - 1 else np.inf
            values = linear(surface.vertices.astype(float))
            assert low - 1e-5 <= values.min() and values.max() <= high + 1e-5
            middles = wedge.transform_scene_to_tool(surface.vertices.astype(float)[surface.faces].mean(axis=1))
            heights = [each for each, _ in wedge.compute_height_and_edge_distance_per_face(middles)]
            assert wedge.opening.removes_nothing or (np.min(heights, axis=0) < 1e-8).all()


def test_the_surface_is_split_at_sharp_edges():
    body = body_of(block(HEX27P1))
    assert len(body.nodes) == 6 * 9 * 9 - 4 * 2 * 9, "the sides of the block share no points"
    ends = body.geometry.nodes[body.nodes[body.sharp]]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    assert length == pytest.approx(8 * SIDE + 4 * HEIGHT)
    dashes = body.make_undeformed_outline(None, (0.0, 0.0))
    assert np.linalg.norm(dashes[:, 1] - dashes[:, 0], axis=1).sum() == pytest.approx(0.5 * length)


@every_element
def test_mesh_lines_lie_in_front_of_the_remaining_body(element):
    mesh = block(element)
    body, wedge = body_of(mesh), Wedge(WedgeOpening(np.pi, -np.pi / 2), Pose((0.0, 3e-3, 0.0)))
    lines = body.compute_element_edge_lines(mesh.nodes, wedge)
    assert (lines[..., 1] >= 3e-3 - 2e-3 * body.longest_extent).all()
    on_cut = lines[np.abs(lines[..., 1] - 3e-3).max(axis=1) < 2e-3 * body.longest_extent]
    assert len(on_cut) > 20 and (on_cut[..., 1] < 3e-3).all()


@pytest.mark.parametrize("pose", [Pose((9e-3, 0.0, 0.0)), Pose((9e-3, 0.0, 0.0), leaning(0.0).orientation)])
def test_contact_is_the_rim_of_the_tool_and_a_line_across_the_cut(pose):
    """Undeformed cylinder under a flat tool that touches it away from the axis."""
    tool, mesh = ts.Tool("flat", radius=8e-3), create_cylinder_mesh_under_needle(
        0.04, 0.07, 8e-3, HEX27P1, smallest=2e-3, growth=2.2, largest=20e-3, around=4, centre=(9e-3, 0.0))
    body = body_of(mesh)
    closed = body.find_contact_lines_or_none(mesh.nodes, tool, Wedge(WedgeOpening(0.0), pose))
    away = np.hypot(closed[..., 0] - 9e-3, closed[..., 1])
    np.testing.assert_allclose(away, 8e-3, atol=0.3e-3)
    assert np.linalg.norm(closed[:, 1] - closed[:, 0], axis=1).sum() == pytest.approx(2 * np.pi * 8e-3, rel=0.03)
    half = body.find_contact_lines_or_none(mesh.nodes, tool, Wedge(WedgeOpening(np.pi), pose))
    across = half[np.abs(half[..., 1] - half[0, 0, 1]).max(axis=1) < 1.0]
    length = np.linalg.norm(across[:, 1] - across[:, 0], axis=1).sum()
    assert length == pytest.approx(np.pi * 8e-3 + 16e-3, rel=0.04)
    above = Pose((9e-3, 0.0, 1e-3))
    assert body.find_contact_lines_or_none(mesh.nodes, tool, Wedge(WedgeOpening(0.0), above)) is None


def fields_of(mesh, displacement):
    """Fields of given displacements without a solver and without pressure."""
    from tissue_sim.fem.solid.batches import ElementBatches

    batches = ElementBatches(mesh)
    count, modes = len(mesh.connectivity), mesh.element.pressure_modes
    return SolidFields(mesh, MATERIAL, 3e6, displacement[None], np.zeros((1, count, modes)),
                       *batches.point_gradients_and_modes, batches.weights, np.ones(count))


def bent(mesh):
    return mesh.nodes[:, [2, 0, 1]] ** 2 * [3.0, -2.0, 4.0]


def test_a_small_body_shows_the_values_of_its_fields():
    mesh = block(HEX27P1)
    fields, body = fields_of(mesh, bent(mesh)), body_of(mesh)
    for name in ("von_mises", "displacement", "cauchy_zz"):
        values, at_points, seen = body.evaluate_field_at_nodes_and_samples(fields, name, mesh.nodes + bent(mesh),
                                                                           Wedge(WedgeOpening(), leaning(0.3)))
        np.testing.assert_array_equal(values, fields.at_nodes(name))
        np.testing.assert_array_equal(at_points, fields.at_points(name))
        assert seen is fields


def test_a_large_body_shows_element_means_at_visible_nodes():
    mesh = block(HEX8P0, 19)
    fields, body = fields_of(mesh, bent(mesh)), body_of(mesh)
    assert fields.weights.size > SETTINGS.max_points
    place = mesh.nodes + bent(mesh)
    wedge = Wedge(WedgeOpening(np.radians(150.0)), leaning(0.3, x=4e-3))
    values, at_points, seen = body.evaluate_field_at_nodes_and_samples(fields, "von_mises", place, wedge)
    whole = fields.with_one_mean_point_per_element().at_nodes("von_mises")
    everywhere = body.compute_band_surfaces(place, whole, np.linspace(0, 400.0, 11), wedge)
    for one, other in zip(body.compute_band_surfaces(place, values, np.linspace(0, 400.0, 11), wedge), everywhere,
                          strict=True):
        np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-9)
        np.testing.assert_array_equal(one.faces, other.faces)
    assert at_points.shape == seen.weights.shape and len(at_points) < len(mesh.connectivity)
    assert np.average(at_points, weights=seen.weights) == pytest.approx(
        np.average(fields.at_points("von_mises"), weights=fields.weights), rel=0.05)
