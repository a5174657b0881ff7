"""Picture of an axisymmetric solid: closed surface, volume, normals, and bands."""

import numpy as np
import pytest

import tissue_sim as ts
from scenes.viewer.revolution import (
    TriangulatedHalfSection,
    TriangulatedSurface,
    WedgeOpening,
    concatenate_surfaces,
    revolve_polyline_by_band,
)
from tissue_sim.fem.axisymmetric.fields import build_half_section
from tissue_sim.mesh import cylinder_mesh, cylinder_mesh_refined_under_needle
from tissue_sim.mesh.elements import Q4P0, Q9P1

#: Radius, m.
RADIUS = 0.04
#: Height, m.
HEIGHT = 0.07
#: Of the height; none at a node.
LEVELS = np.linspace(-0.0613, -0.0011, 11)
CUTS = (0.0, 60.0, 120.0, 180.0)


def half_section(mesh, divisions=None):
    return TriangulatedHalfSection(build_half_section(mesh, divisions))


def volume(surface):
    """Volume of a closed surface by the divergence theorem."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces].astype(float), 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


def area_vectors(surface):
    a, b, c = np.moveaxis(surface.vertices[surface.faces].astype(float), 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def faceted(volume_of_revolution, opening):
    """Volume of a body of revolution whose circles are replaced by polygons."""
    turn = 2.0 * np.pi - opening.cut
    count = len(opening.segment_half_plane_azimuths) - (0 if opening.removes_nothing else 1)
    return volume_of_revolution * count * np.sin(turn / count) / (2.0 * np.pi)


def bulged(mesh):
    """Deformed node positions of a bulged cylinder with an uneven top."""
    r, z = mesh.nodes.T
    return np.stack([r * (1.0 - 100.0 * z * (HEIGHT + z)), z * (1.0 - z - 50.0 * r**2)], axis=-1)


def volume_by_quadrature(mesh, place):
    """Volume: integral of 2 pi r over the curved elements; exact with three points per direction."""
    points, weights = mesh.element.quadrature
    shapes, slopes = mesh.element.evaluate_shape_functions_and_gradients(points)
    of_elements = place[mesh.connectivity]
    r = np.einsum("qa,ea->eq", shapes, of_elements[..., 0])
    return 2.0 * np.pi * float(np.sum(r * np.linalg.det(np.einsum("eai,qaj->eqij", of_elements, slopes)) * weights))


def edge_uses(surface):
    """Count the uses of each directed edge after merging vertices with the same position."""
    places = np.round(surface.vertices.astype(float) / 1e-8).astype(np.int64)
    _, number = np.unique(places, axis=0, return_inverse=True)
    faces = number.ravel()[surface.faces]
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return {tuple(edge): int(uses) for edge, uses in zip(*np.unique(directed, axis=0, return_counts=True), strict=True)}


@pytest.fixture(params=[Q4P0, Q9P1], ids=["Q4", "Q9"])
def mesh(request):
    return cylinder_mesh(RADIUS, HEIGHT, (4, 5), request.param, grading=(3.0, 4.0))


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("divisions", [1, 2, 3, 4])
def test_bands_together_enclose_the_volume_of_the_cylinder(mesh, cut, divisions):
    opening = WedgeOpening(np.radians(cut))
    bands = half_section(mesh, divisions).compute_band_surfaces(mesh.nodes, mesh.nodes[:, 1],
                                                                                     LEVELS, opening)
    assert len(bands) == 10 and all(len(surface.faces) for surface in bands)
    expected = faceted(np.pi * RADIUS**2 * HEIGHT, opening)
    assert volume(concatenate_surfaces(*bands)) == pytest.approx(expected, rel=1e-6)


def test_the_volume_of_a_curved_body_converges_with_the_divisions():
    mesh = cylinder_mesh(RADIUS, HEIGHT, (3, 3), Q9P1)
    place, opening = bulged(mesh), WedgeOpening(np.radians(90.0))
    exact = faceted(volume_by_quadrature(mesh, place), opening)
    errors = np.array(
        [volume(concatenate_surfaces(*half_section(mesh, divisions).compute_band_surfaces(
        place, mesh.nodes[:, 1], LEVELS, opening))) / exact - 1.0 for divisions in (2, 4, 8)])
    # Second order: chords of a parabola.
    assert errors[:-1] / errors[1:] == pytest.approx(4.0, rel=0.05) and abs(errors[0]) < 0.01


def test_a_closed_solid_is_watertight_and_consistently_oriented(mesh):
    section, opening = half_section(mesh), WedgeOpening(0.0)
    solid = concatenate_surfaces(*section.compute_band_surfaces(bulged(mesh), mesh.nodes[:, 1], LEVELS, opening))
    uses = edge_uses(solid)
    assert set(uses.values()) == {1}
    assert all((b, a) in uses for a, b in uses)


@pytest.mark.parametrize("cut", [60.0, 180.0])
def test_cut_solid_is_watertight_away_from_the_axis(mesh, cut):
    """The test excludes the axis, where both faces share a line with additional points."""
    section, opening = half_section(mesh), WedgeOpening(np.radians(cut))
    solid = concatenate_surfaces(*section.compute_band_surfaces(bulged(mesh), mesh.nodes[:, 1], LEVELS, opening))
    uses = edge_uses(solid)
    assert set(uses.values()) <= {1, 2}
    unmatched = [edge for edge, count in uses.items() if uses.get(edge[::-1], 0) != count]
    assert not unmatched


def test_normals_point_outwards():
    mesh = cylinder_mesh(RADIUS, HEIGHT, (4, 5), Q9P1)
    opening = WedgeOpening(np.radians(120.0))
    section = half_section(mesh)
    surface = concatenate_surfaces(*section.compute_band_surfaces(mesh.nodes, mesh.nodes[:, 1], LEVELS, opening))
    normals, middles = area_vectors(surface), surface.vertices[surface.faces].mean(axis=1)
    for way, outward in opening.section_face_vectors:
        on_face = (np.abs(middles[:, :2] @ outward) < 1e-6) & (middles[:, :2] @ way > 0)
        assert (normals[on_face, :2] @ outward > 0).all()
        assert normals[on_face].sum(axis=0) == pytest.approx([*(RADIUS * HEIGHT * outward), 0.0], rel=1e-5, abs=1e-9)
    top, base = middles[:, 2] > -1e-6, middles[:, 2] < -HEIGHT + 1e-6
    assert (normals[top, 2] > 0).all() and (normals[base, 2] < 0).all()
    # Two thirds of the faceted disc, and as much below.
    assert normals[top, 2].sum() == pytest.approx(faceted(np.pi * RADIUS**2, opening), rel=1e-5)
    side = np.linalg.norm(middles[:, :2], axis=1) > 0.99 * RADIUS
    outwards = np.einsum("fi,fi->f", normals[:, :2], middles[:, :2])
    assert side.any() and (outwards[side & ~top & ~base] > -1e-12).all()


def test_each_vertex_lies_in_its_band():
    mesh = cylinder_mesh(RADIUS, HEIGHT, (4, 5), Q9P1, grading=(3.0, 4.0))
    for k, surface in enumerate(half_section(mesh).compute_band_surfaces(mesh.nodes,
                                                                                              mesh.nodes[:, 1], LEVELS,
                                                                                              WedgeOpening())):
        z = surface.vertices[:, 2]
        assert (z > (LEVELS[k] if k else -HEIGHT) - 1e-7).all() and (z < (LEVELS[k + 1] if k < 9 else 0.0) + 1e-7).all()
        used = np.zeros(len(z), dtype=bool)
        used[surface.faces] = True
        assert used[np.linalg.norm(surface.vertices[:, :2], axis=1) > 0].all()
        assert surface.vertices.dtype == np.float32 and surface.faces.dtype == np.uint32


def test_a_band_without_tissue_is_empty():
    mesh = cylinder_mesh(RADIUS, HEIGHT, (4, 5), Q9P1)
    for cut in CUTS:
        constant = np.full(len(mesh.nodes), -0.02)
        bands = half_section(mesh).compute_band_surfaces(mesh.nodes, constant, LEVELS,
                                                                              WedgeOpening(np.radians(cut)))
        assert [len(surface.faces) > 0 for surface in bands] == [k == 6 for k in range(10)]
        assert all(surface.vertices.shape == surface.faces.shape == (0, 3) for k, surface in enumerate(bands) if k != 6)


def test_faces_share_no_vertices_with_the_outside_and_edges_stay_sharp():
    """The triangles at a vertex have similar normals, so averaged normals are accurate."""
    mesh = cylinder_mesh(RADIUS, HEIGHT, (4, 5), Q9P1)
    for surface in half_section(mesh).compute_band_surfaces(mesh.nodes, mesh.nodes[:, 1], LEVELS,
                                                                                 WedgeOpening(np.radians(90.0))):
        normals = area_vectors(surface)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        sums = np.zeros((len(surface.vertices), 3))
        np.add.at(sums, surface.faces, np.repeat(normals[:, None], 3, axis=1))
        at_vertex = sums[surface.faces]
        at_vertex /= np.linalg.norm(at_vertex, axis=-1, keepdims=True)
        assert (np.einsum("fci,fi->fc", at_vertex, normals) > np.cos(np.radians(10.0))).all()


def test_the_opening_has_the_stated_azimuth():
    for facing in (-np.pi / 2, 0.3, 2.0):
        opening = WedgeOpening(np.radians(100.0), facing)
        away = (opening.segment_half_plane_azimuths - facing + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(away).min() == pytest.approx(np.radians(50.0))
        toward = np.array([np.cos(facing), np.sin(facing)])
        # Whoever looks from there sees both faces.
        assert [outward @ toward > 0 for _, outward in opening.section_face_vectors] == [True, True]
    closed = WedgeOpening(0.0)
    assert len(closed.segment_half_plane_azimuths) == 48 and closed.section_face_vectors == []
    assert len(WedgeOpening(np.pi).segment_half_plane_azimuths) == 25


@pytest.mark.parametrize("cut", [-0.1, 3.5, np.nan])
def test_a_cut_angle_outside_its_range_is_refused(cut):
    with pytest.raises(ts.InputError, match=r"between 0 \(closed\) and 180"):
        WedgeOpening(cut)


def test_mesh_lines_are_the_element_edges_in_front_of_both_faces():
    mesh = cylinder_mesh_refined_under_needle(RADIUS, HEIGHT, 0.008, Q9P1, smallest=0.002, growth=1.8, largest=0.02)
    section, opening = half_section(mesh), WedgeOpening(np.radians(120.0))
    lines = section.compute_element_edge_lines(mesh.nodes, opening)
    rows, columns = np.unique(mesh.nodes[:, 1]).size // 2, np.unique(mesh.nodes[:, 0]).size // 2
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * ((rows + 1) * RADIUS + (columns + 1) * HEIGHT), rel=1e-9)
    halves = np.split(lines.reshape(-1, 3), 2)
    for points, (_, outward) in zip(halves, opening.section_face_vectors, strict=True):
        assert points[:, :2] @ outward == pytest.approx(1e-3 * RADIUS)
    assert section.compute_element_edge_lines(mesh.nodes, WedgeOpening(0.0)).shape == (0, 2, 3)


def test_undeformed_outline_is_dashed_and_stays_on_the_cylinder():
    section = half_section(cylinder_mesh(RADIUS, HEIGHT, (4, 5), Q9P1))
    for cut in CUTS:
        lines = section.make_undeformed_outline(WedgeOpening(np.radians(cut)))
        r, z = np.linalg.norm(lines[..., :2], axis=-1), lines[..., 2]
        assert (r < RADIUS * 1.001).all() and z.min() == pytest.approx(-HEIGHT) and z.max() == pytest.approx(0.0)
        sides = 4 * HEIGHT if cut == 0.0 else 3 * HEIGHT + 4 * RADIUS
        whole = 2 * (2 * np.pi - np.radians(cut)) * RADIUS + sides
        assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() == pytest.approx(0.5 * whole, rel=0.05)


def test_no_outline_crosses_the_tool():
    section = half_section(cylinder_mesh(RADIUS, HEIGHT, (4, 5), Q9P1))
    opening = WedgeOpening(np.radians(120.0))
    tool, deepest = 0.3 * RADIUS, 0.2 * HEIGHT
    lines = section.make_undeformed_outline(opening, tool=(tool, deepest))
    r, z = np.linalg.norm(lines[..., :2], axis=-1), lines[..., 2]
    assert not ((r < 0.99 * tool) & (z > -0.99 * deepest)).any() and z.max() == pytest.approx(0.0)
    under_a_plate = section.make_undeformed_outline(opening, tool=(RADIUS, deepest))
    assert under_a_plate[..., 2].max() == pytest.approx(-deepest)
    for outline in (lines, under_a_plate):
        assert outline[..., 2].min() == pytest.approx(-HEIGHT)


def test_elements_of_coarse_meshes_are_divided_more_finely():
    for cells, parts in (((2, 2), 5), ((4, 5), 4), ((6, 6), 3), ((20, 20), 2)):
        mesh = cylinder_mesh(RADIUS, HEIGHT, cells, Q9P1)
        assert len(half_section(mesh).triangulation.triangles) \
            == 2 * parts**2 * len(mesh.connectivity)


def test_gauss_points_lie_on_the_edges_of_a_curved_surface(mesh):
    """The edges of quadratic elements are parabolas, and the Gauss points lie on them."""
    place = mesh.nodes + np.stack([0.0 * mesh.nodes[:, 0], 5.0 * mesh.nodes[:, 0] ** 2], axis=-1)
    line = half_section(mesh).compute_possible_contact_boundary(place)
    order = mesh.element.order
    assert len(line.gauss_points) == len(line.points) - 1 == 9 * order
    r, z = line.gauss_points[: 4 * order].T
    inner, outer = line.points[: 4 * order, 0], line.points[1 : 4 * order + 1, 0]
    assert ((r > inner) & (r < outer)).all()
    if order == 2:
        assert z == pytest.approx(5.0 * r**2, rel=1e-9)
    assert line.points[0] == pytest.approx([0.0, 0.0]) and line.points[-1, 1] < -HEIGHT + 0.01


def test_revolved_line_on_both_ends_of_the_axis_closes():
    """Volume of a faceted sphere from one line that starts and ends on the axis."""
    angle = np.linspace(0.5 * np.pi, -0.5 * np.pi, 61)
    line = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    line[[0, -1], 0] = 0.0
    ball, = revolve_polyline_by_band(line, np.zeros(60, dtype=int), 1, WedgeOpening(0.0, segments=120))
    assert volume(ball) == pytest.approx(4.0 / 3.0 * np.pi, rel=2e-3)
    assert set(edge_uses(ball).values()) == {1}


def test_joined_surfaces_keep_their_triangles():
    one = TriangulatedSurface(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.uint32))
    both = concatenate_surfaces(one, TriangulatedSurface(one.vertices + 5, one.faces))
    assert both.faces.tolist() == [[0, 1, 2], [3, 4, 5]] and both.vertices[3].tolist() == [6.0, 5.0, 5.0]
    assert both.faces.dtype == np.uint32
