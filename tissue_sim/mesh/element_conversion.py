"""Convert meshes: nodes of elements of any order from element corners, and hexahedra to tetrahedra."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.solid import SolidMesh, create_mesh_with_surface_sets
from tissue_sim.mesh.solid_element import SolidElement
from tissue_sim.mesh.tetrahedra import Tetrahedron


@dataclass(frozen=True)
class SharedNodeSettings:
    """Tolerances by which elements share nodes.

    Attributes:
        same: largest distance between the positions of a shared node in two elements, as a fraction of the element
            size, 1.
        min_weight: smallest weight of a corner on which a node depends, 1.
    """

    same: float = 1e-6
    min_weight: float = 1e-9


_SHARED = SharedNodeSettings()


def number_nodes_by_shared_corners(element: SolidElement, corners: np.ndarray,
                                   positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the nodes of elements so that elements with the same corners of an edge or face share the nodes there.

    Args:
        element: element type.
        corners: numbers of the corners in the order of `SolidElement.corner_nodes`, shape (elements, corners).
        positions: coordinates of the nodes of each element, m, shape (elements, nodes of the element, 3).

    Returns:
        Coordinates, shape (n, 3), corners first in the order of their numbers; and node numbers, shape (elements, nodes
        of the element).

    Raises:
        InputError: two elements have different positions of the middle of a shared edge or face.
    """
    # A node is identified by the corners on which it depends: two for an edge, those of a face, all for the interior.
    depends = element.corner_functions_at_nodes > _SHARED.min_weight
    keys = np.sort(np.where(depends, corners[:, None], -1), axis=-1).reshape(-1, corners.shape[1])
    _, first, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    nodes, connectivity = positions.reshape(-1, 3)[first], numbers.reshape(len(corners), -1)
    distance = np.abs(nodes[connectivity] - positions).max(axis=(1, 2))
    mismatched = np.flatnonzero(distance > _SHARED.same * np.ptp(positions, axis=1).max(axis=1))
    if mismatched.size:
        raise InputError(f"element {mismatched[0]} does not fit its neighbour: both have different positions of the "
                         "middle of a shared edge or face. Correct the mesh", field="mesh")
    return nodes, connectivity


def convert_to_element_type(mesh: SolidMesh, element: SolidElement) -> SolidMesh:
    """Return the mesh of the same cells with another element type; elements of order 2 keep curved edges and faces.

    Args:
        mesh: mesh of elements of the same shape.
        element: element type with the same reference coordinates and order of the corners.
    """
    given = mesh.element
    values, _ = given.evaluate_shape_functions_and_gradients(element.reference_nodes)
    positions = np.einsum("ng,egi->eni", values, mesh.nodes[mesh.connectivity])
    corners = mesh.connectivity[:, given.local_corner_indices]
    if element.order == 1:  # straight edges
        positions = np.einsum("nc,eci->eni", element.corner_functions_at_nodes, mesh.nodes[corners])
    return create_mesh_with_surface_sets(element, *number_nodes_by_shared_corners(element, corners, positions))


def split_hexahedra(mesh: SolidMesh, element: Tetrahedron) -> SolidMesh:
    """Return the mesh of tetrahedra, six for each hexahedron of a mesh; quadratic tetrahedra keep curved faces.

    The corner with the lowest number is joined to the three faces that do not contain it. Each face is cut at its
    lowest corner, so that neighbours match (Dompierre et al., How to subdivide pyramids, prisms and hexahedra into
    tetrahedra, 8th International Meshing Roundtable, 1999).

    Args:
        mesh: mesh of hexahedra.
        element: element type of the tetrahedra.
    """
    given = mesh.element
    corners = mesh.connectivity[:, given.local_corner_indices]
    sides = given.local_face_node_indices[:, given.corner_indices_within_face]
    local = {node: index for index, node in enumerate(given.local_corner_indices.tolist())}
    sides = np.vectorize(local.get)(sides)
    cut = np.array([_split_hexahedron(each, sides)
                    for each in corners])  # indices of the element's corners, (elements, 6, 4)
    vertices = given.reference_nodes[given.local_corner_indices][cut]
    is_inverted = np.linalg.det(vertices[..., 1:, :] - vertices[..., :1, :]) < 0.0
    cut[is_inverted] = cut[is_inverted][:, [0, 2, 1, 3]]
    vertices = given.reference_nodes[given.local_corner_indices][cut]
    inside = np.einsum("nc,etci->etni", element.corner_functions_at_nodes, vertices)
    values, _ = given.evaluate_shape_functions_and_gradients(inside.reshape(-1, 3))
    positions = np.einsum("etng,egi->etni", values.reshape(*inside.shape[:-1], -1), mesh.nodes[mesh.connectivity])
    if element.order == 1:  # straight edges
        positions = np.einsum("nc,etci->etni", element.corner_functions_at_nodes,
                              positions[:, :, element.local_corner_indices])
    numbers = np.take_along_axis(corners[:, None], cut, axis=2).reshape(-1, 4)
    nodes, connectivity = number_nodes_by_shared_corners(element, numbers, positions.reshape(-1, element.node_count, 3))
    return create_mesh_with_surface_sets(element, nodes, connectivity)


def _split_hexahedron(corners: np.ndarray, sides: np.ndarray) -> list[list[int]]:
    """Return the six tetrahedra of a hexahedron as indices of its corners; `corners` are their node numbers."""
    lowest = int(np.argmin(corners))
    found = []
    for side in sides:
        if lowest not in side:
            a, b, c, d = np.roll(side, -int(np.argmin(corners[side]))).tolist()
            found += [[lowest, a, b, c], [lowest, a, c, d]]
    return found
