"""Meshes that tests of the solid share: blocks and cylinders in any element."""

import numpy as np

from tissue_sim.mesh.hexahedra import HEX8P0, HEX27P1, Hexahedron
from tissue_sim.mesh.raising import joined_at_corners, split_hexahedra
from tissue_sim.mesh.solid import block_mesh, needle_solid, with_surface, with_tool_sets


def block(x, y, z, element, move=None):
    """A block of hexahedra, or of tetrahedra in their place; `move` takes the corners, (n, 3), elsewhere."""
    mesh = block_mesh(x, y, z, HEX8P0)
    if move is not None:
        mesh.nodes[:] = move(mesh.nodes)
    if not isinstance(element, Hexahedron):
        return split_hexahedra(mesh, element)
    places = np.einsum("nc,eci->eni", element.corner_shares, mesh.nodes[mesh.connectivity])
    return with_surface(element, *joined_at_corners(element, mesh.connectivity, places))


def punched_cylinder(element, radius=8e-3, centre=(0.0, 0.0), **sizes):
    """The study's cylinder under a needle, with the sets under its face and beside it."""
    made_of = element if isinstance(element, Hexahedron) else HEX27P1
    mesh = needle_solid(0.04, 0.07, radius, made_of, centre=centre, **sizes)
    if made_of is element:
        return mesh
    return with_tool_sets(split_hexahedra(mesh, element), radius, centre)
