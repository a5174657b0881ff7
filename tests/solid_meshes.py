"""Meshes that tests of the solid share: blocks and cylinders in any element."""

import meshio
import numpy as np

from tissue_sim.mesh.solid import (
    add_face_and_free_node_sets,
    create_block_mesh_from_boundaries,
    create_cylinder_mesh_under_needle,
    create_mesh_with_surface_sets,
)
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, TET15P1, Hexahedron
from tissue_sim.mesh.solid_file import number_nodes_by_shared_corners, split_hexahedra


def block(x, y, z, element, move=None):
    """A block of hexahedra, or of tetrahedra in their place; `move` takes the corners, (n, 3), elsewhere."""
    mesh = create_block_mesh_from_boundaries(x, y, z, HEX8P0)
    if move is not None:
        mesh.nodes[:] = move(mesh.nodes)
    if not isinstance(element, Hexahedron):
        return split_hexahedra(mesh, element)
    places = np.einsum("nc,eci->eni", element.corner_functions_at_nodes, mesh.nodes[mesh.connectivity])
    return create_mesh_with_surface_sets(element, *number_nodes_by_shared_corners(element, mesh.connectivity, places))


def punched_cylinder(element, radius=8e-3, centre=(0.0, 0.0), **sizes):
    """The study's cylinder under a needle, with the node sets under its face and outside it."""
    made_of = element if isinstance(element, Hexahedron) else HEX27P1
    mesh = create_cylinder_mesh_under_needle(0.04, 0.07, radius, made_of, centre=centre, **sizes)
    if made_of is element:
        return mesh
    return add_face_and_free_node_sets(split_hexahedra(mesh, element), radius, centre)


#: Corners of a cell of VTK.
_CORNERS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1],
                     [-1, 1, 1]])


def write_tetrahedra(path, x, y, z, upper):
    """A file of a block in tetrahedra of four nodes, sizes in mm; ``part`` is 2 of those above a height, else 1."""
    mesh = block(x, y, z, TET15P1)
    used, cells = np.unique(mesh.connectivity[:, :4], return_inverse=True)
    points, cells = mesh.nodes[used], cells.reshape(-1, 4)
    above = points[cells].mean(axis=1)[:, 2] > upper
    meshio.Mesh(points, [("tetra", cells)], cell_data={"part": [above.astype(int) + 1]}).write(path)


def write_hexahedra(path, mesh, part=None, scale=1.0):
    """A file of a mesh of eight-node hexahedra as another program would write it, in mm; ``part`` is 2 of
    those that are chosen, and 1 of others."""
    order = [int(np.abs(HEX8P0.reference_nodes - corner).sum(axis=1).argmin()) for corner in _CORNERS]
    named = {} if part is None else {"part": [part.astype(int) + 1]}
    meshio.Mesh(1e3 * scale * mesh.nodes, [("hexahedron", mesh.connectivity[:, order])], cell_data=named).write(path)
