"""Elements divided into tetrahedra and triangles, and these cut by planes: exact sizes and values."""

import numpy as np
import pytest
from solid_meshes import block as solid_block

from tissue_sim.mesh.sections import (
    find_outline_edges_of_face,
    intersect_tetrahedra_at_zero_level,
    intersect_triangles_at_zero_level,
    split_triangles_below_and_above,
    subdivide_face_into_triangles,
    subdivide_into_tetrahedra,
    triangulate_surface_faces,
)
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, TET8P0, TET15P1

SIZES = np.array([0.05, 0.03, 0.02])
every_element = pytest.mark.parametrize("element", (HEX8P0, HEX27P1), ids=lambda element: element.name)


class Tetrahedron:
    """Ten nodes: the corners, then the middles of the edges."""

    reference_nodes = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (.5, 0, 0), (.5, .5, 0), (0, .5, 0),
                                (0, 0, .5), (.5, 0, .5), (0, .5, .5)])
    local_face_node_indices = np.array([(0, 2, 1, 6, 5, 4), (0, 1, 3, 4, 8, 7), (1, 2, 3, 5, 9, 8), (2, 0, 3, 6, 7, 9)])


def block(element):
    return create_block_mesh_from_boundaries(*(np.linspace(-0.5 * size, 0.5 * size, 4) for size in SIZES), element)


def cells_of(mesh):
    return mesh.connectivity[:, subdivide_into_tetrahedra(mesh.element)].reshape(-1, 4)


def normals(points, triangles):
    """Half the cross products: areas with directions, shape (t, 3)."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return 0.5 * np.cross(b - a, c - a)


@pytest.mark.parametrize("element", [HEX8P0, HEX27P1, TET8P0, TET15P1], ids=lambda element: element.name)
def test_neighbours_divide_their_common_side_alike(element):
    """However they are numbered, but for sides of four corners, which do on a lattice: else bent sides leave gaps."""
    mesh, rng = solid_block([0.0, 1.0, 2.0], [0.0, 1.5], [-1.0, 0.0], element), np.random.default_rng(0)
    cells = cells_of(mesh)
    if element.name.startswith("T"):
        # Each tetrahedron begins with another corner.
        turns = [_renumbered(element, order) for order in ([1, 2, 0, 3], [2, 0, 1, 3], [0, 2, 3, 1], [3, 1, 0, 2])]
        turned = np.array([each[turns[k]] for each, k in zip(mesh.connectivity, rng.integers(
            0, 4, len(mesh.connectivity)), strict=True)])
        cells = turned[:, subdivide_into_tetrahedra(element)].reshape(-1, 4)
    sides = np.sort(np.concatenate([np.delete(cells, k, axis=1) for k in range(4)]), axis=1)
    _, times = np.unique(sides, axis=0, return_counts=True)
    outside = sum(map(len, mesh.faces.values())) * len(subdivide_face_into_triangles(element))
    assert (times == 1).sum() == outside and times.max() == 2


def _renumbered(element, order):
    """Nodes of a tetrahedron that begins with other corners, by where they stand."""
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])[order]
    shares = np.column_stack([1.0 - element.reference_nodes.sum(axis=1), element.reference_nodes])
    return [int(np.abs(element.reference_nodes - place).sum(axis=1).argmin()) for place in shares @ corners]


@pytest.mark.parametrize(("element", "volume"), [*((each, 8.0) for each in (HEX8P0, HEX27P1)), (Tetrahedron(), 1 / 6)],
                         ids=[HEX8P0.name, HEX27P1.name, "tetrahedron of ten nodes"])
def test_tetrahedra_fill_an_element_and_triangles_its_sides(element, volume):
    places, cells = element.reference_nodes, subdivide_into_tetrahedra(element)
    sizes = np.linalg.det(places[cells[:, 1:]] - places[cells[:, :1]]) / 6.0
    assert (sizes > 0.0).all() and sizes.sum() == pytest.approx(volume)
    assert np.unique(cells).size == len(places), "every node is a corner"
    sides = triangulate_surface_faces(element, element.local_face_node_indices)
    flux = np.einsum("ti,ti->", normals(places, sides), places[sides].mean(axis=1)) / 3.0
    assert flux == pytest.approx(volume), "outward normals: the flux of the place through the sides"
    for side in element.local_face_node_indices:
        assert np.unique(side[subdivide_face_into_triangles(element)]).size == side.size
        assert len(find_outline_edges_of_face(element)) == (len(side) - (1 if len(side) == 9 else 0))


@every_element
def test_neighbours_on_one_lattice_divide_their_common_sides_alike(element):
    cells = cells_of(block(element))
    sides = np.sort(np.concatenate([cells[:, [1, 2, 3]], cells[:, [0, 2, 3]], cells[:, [0, 1, 3]],
                                    cells[:, [0, 1, 2]]]), axis=1)
    alone = np.unique(sides, axis=0, return_counts=True)[1] == 1
    mesh = block(element)
    outside = triangulate_surface_faces(element, np.concatenate(list(mesh.faces.values())))
    assert alone.sum() == len(outside), "only those of the surface are there once"


def area_of_box(normal, distance):
    """Of the section of the box |x_i| <= SIZES_i / 2 with the plane n x = d: the derivative of the volume below it, by
    the corners (Scardovelli and Zaleski, Journal of Computational Physics 164 (2000) 228)."""
    slopes = np.abs(normal) * SIZES
    start = distance + 0.5 * slopes.sum()
    total = sum((-1.0) ** sum(corner) * max(start - np.dot(corner, slopes), 0.0) ** 2
                for corner in np.ndindex(2, 2, 2))
    return SIZES.prod() * total / (2.0 * slopes.prod())


@every_element
@pytest.mark.parametrize("normal", [(1.0, 0.2, 0.3), (0.3, -1.0, 0.4), (0.2, 0.3, 1.0)])
@pytest.mark.parametrize("distance", [0.0, 0.004, -0.011])
def test_section_of_a_block_has_the_exact_area_and_linear_values(element, normal, distance):
    normal = np.array(normal) / np.linalg.norm(normal)
    mesh = block(element)
    middle = [0.0, 0.0, 0.5 * (mesh.nodes[:, 2].max() + mesh.nodes[:, 2].min())]
    nodes = mesh.nodes - middle
    crossings, triangles = intersect_tetrahedra_at_zero_level(cells_of(mesh), nodes @ normal - distance)
    points = crossings.interpolate_nodal_values(nodes)
    np.testing.assert_allclose(points @ normal, distance, atol=1e-15)
    pieces = normals(points, triangles)
    assert (pieces @ normal > -1e-18).all(), "all turn upwards"
    assert np.linalg.norm(pieces.sum(axis=0)) == pytest.approx(area_of_box(normal, distance), rel=1e-12)
    slope = np.array([3.0, -7.0, 11.0])
    np.testing.assert_allclose(crossings.interpolate_nodal_values(nodes @ slope + 2.0), points @ slope + 2.0,
                               rtol=1e-12)


@every_element
@pytest.mark.parametrize("axis", range(3))
def test_section_along_the_sides_of_elements_is_there_once(element, axis):
    """A plane on which nodes lie, inside and at the lower end; at the upper end there is nothing above."""
    mesh = block(element)
    lines = np.unique(mesh.nodes[:, axis].round(12))
    area = SIZES.prod() / SIZES[axis]
    for place, expected in ((lines[0], area), (lines[element.order], area), (lines[-1], 0.0)):
        heights = mesh.nodes[:, axis] - place
        heights[abs(heights) < 1e-12] = 0.0
        crossings, triangles = intersect_tetrahedra_at_zero_level(cells_of(mesh), heights)
        areas = np.linalg.norm(normals(crossings.interpolate_nodal_values(mesh.nodes), triangles), axis=1)
        assert areas.sum() == pytest.approx(expected)


@every_element
def test_a_clipped_surface_and_the_section_close_the_body(element):
    """Below the plane the outward areas of surface and section add up to nothing, and enclose the volume."""
    mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, element, smallest=3e-3, growth=2.2, largest=20e-3,
                                             around=2,
                                             centre=(6e-3, 0))
    normal = np.array([0.3, -0.9, 0.2]) / np.linalg.norm([0.3, -0.9, 0.2])
    heights = (mesh.nodes - [6e-3, 0.0, -0.02]) @ normal
    outside = triangulate_surface_faces(element, np.concatenate(list(mesh.faces.values())))
    crossings, below, above = split_triangles_below_and_above(outside, heights)
    points = crossings.append_interpolated_values(mesh.nodes)
    np.testing.assert_allclose(crossings.interpolate_nodal_values(heights), 0.0, atol=1e-16)
    both = normals(points, below).sum(axis=0) + normals(points, above).sum(axis=0)
    np.testing.assert_allclose(both, 0.0, atol=1e-15)
    ends, triangles = intersect_tetrahedra_at_zero_level(cells_of(mesh), heights)
    cut = normals(ends.interpolate_nodal_values(mesh.nodes), triangles)
    np.testing.assert_allclose(normals(points, below).sum(axis=0) + cut.sum(axis=0), 0.0, atol=1e-12)
    assert np.linalg.norm(cut.sum(axis=0)) == pytest.approx(np.linalg.norm(cut, axis=1).sum())
    # The line in which the surface meets the plane runs around the section.
    line = intersect_triangles_at_zero_level(outside, heights)
    segments = line.interpolate_nodal_values(mesh.nodes).reshape(-1, 2, 3)
    corners, counts = np.unique(segments.reshape(-1, 3).round(9), axis=0, return_counts=True)
    assert len(corners) > 10 and (counts == 2).all()


def test_clipping_at_nodes_leaves_no_slivers():
    mesh = create_block_mesh_from_boundaries(*(np.linspace(-1.0, 1.0, 3) for _ in range(3)), HEX8P0)
    outside = triangulate_surface_faces(HEX8P0, np.concatenate(list(mesh.faces.values())))
    _, below, above = split_triangles_below_and_above(outside, mesh.nodes[:, 0])
    assert len(below) == len(above) == len(outside) // 2
