"""Elements of any order on the corners of a mesh, and tetrahedra in the place of hexahedra."""

from __future__ import annotations

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.solid import SolidMesh, with_surface
from tissue_sim.mesh.solid_element import SolidElement
from tissue_sim.mesh.tetrahedra import Tetrahedron

#: Elements that meet may state the middle of what they share so far apart, in sizes of the element.
_SAME = 1e-6
#: A corner's share in a node below this is none.
_NO_SHARE = 1e-9


def joined_at_corners(element: SolidElement, corners: np.ndarray,
                      places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and connectivity of elements that meet where they have the same corners.

    Args:
        element: element type.
        corners: numbers of the corners, in the order of `SolidElement.corners`, shape (elements, corners).
        places: of the nodes of each element, m, shape (elements, nodes of the element, 3).

    Returns:
        Coordinates, shape (n, 3), those of the corners first, in the order of their numbers; and node numbers, shape
        (elements, nodes of the element).

    Raises:
        InputError: elements that state the middle of an edge or a side that they share at different places.
    """
    # A node belongs to the corners that have a share in it: two of an edge, those of a side, all of an interior.
    shares = element.corner_shares > _NO_SHARE
    keys = np.sort(np.where(shares, corners[:, None], -1), axis=-1).reshape(-1, corners.shape[1])
    _, first, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    nodes, connectivity = places.reshape(-1, 3)[first], numbers.reshape(len(corners), -1)
    apart = np.abs(nodes[connectivity] - places).max(axis=(1, 2))
    torn = np.flatnonzero(apart > _SAME * np.ptp(places, axis=1).max(axis=1))
    if torn.size:
        raise InputError(f"element {torn[0]} does not fit its neighbour: they state the middle of what they share at "
                         "different places", field="mesh")
    return nodes, connectivity


def split_hexahedra(mesh: SolidMesh, element: Tetrahedron) -> SolidMesh:
    """The same solid in tetrahedra, six for each hexahedron, whose curved sides quadratic ones keep.

    From its corner of the lowest number each hexahedron is seen as six tetrahedra over the three sides that do not
    hold it; every side is cut from its lowest corner, so that neighbours fit (Dompierre et al., How to subdivide
    pyramids, prisms and hexahedra into tetrahedra, 8th International Meshing Roundtable, 1999).
    """
    given = mesh.element
    corners = mesh.connectivity[:, given.corners]
    sides = given.faces[:, given.face_corners]
    local = {node: place for place, node in enumerate(given.corners.tolist())}
    sides = np.vectorize(local.get)(sides)
    cut = np.array([_cut(each, sides) for each in corners])  # (elements, 6, 4), of the element's corners
    spots = given.reference_nodes[given.corners][cut]
    turned = np.linalg.det(spots[..., 1:, :] - spots[..., :1, :]) < 0.0
    cut[turned] = cut[turned][:, [0, 2, 1, 3]]
    spots = given.reference_nodes[given.corners][cut]
    inside = np.einsum("nc,etci->etni", element.corner_shares, spots)
    values, _ = given.shape_functions(inside.reshape(-1, 3))
    places = np.einsum("etng,egi->etni", values.reshape(*inside.shape[:-1], -1), mesh.nodes[mesh.connectivity])
    if element.order == 1:  # whose sides are straight
        places = np.einsum("nc,etci->etni", element.corner_shares, places[:, :, element.corners])
    numbers = np.take_along_axis(corners[:, None], cut, axis=2).reshape(-1, 4)
    return with_surface(element, *joined_at_corners(element, numbers, places.reshape(-1, element.nodes, 3)))


def _cut(corners: np.ndarray, sides: np.ndarray) -> list[list[int]]:
    """The six tetrahedra of a hexahedron with these corners, as places among them."""
    lowest = int(np.argmin(corners))
    found = []
    for side in sides:
        if lowest not in side:
            a, b, c, d = np.roll(side, -int(np.argmin(corners[side]))).tolist()
            found += [[lowest, a, b, c], [lowest, a, c, d]]
    return found
