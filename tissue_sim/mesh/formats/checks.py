"""Content of a mesh file in any format, and its checks.

The elements must be of one kind with positive volumes, and must form one connected body.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError

#: Corners of the faces of a tetrahedron and a hexahedron: node order of VTK, counter-clockwise viewed from outside;
#: face order of Abaqus.
SIDES = {"tetra": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
         "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (0, 4, 7, 3))}
#: Name of a volume element in meshio -> number of nodes.
SOLIDS = {"tetra": 4, "tetra10": 10, "hexahedron": 8, "hexahedron20": 20, "hexahedron27": 27}
#: Name of a surface element in meshio -> number of nodes.
FACES = {"triangle": 3, "triangle6": 6, "triangle7": 7, "quad": 4, "quad8": 8, "quad9": 9}
#: Prefixes of volume elements; those that are not in `SOLIDS` are rejected.
OTHER_SOLIDS = ("wedge", "pyramid", "tetra", "hexahedron", "voxel", "polyhedron")


class CellBlock(NamedTuple):
    """Elements of one kind in a mesh file.

    Attributes:
        kind: name in meshio, such as ``tetra10``.
        nodes: indices in the points of the file, in the order of VTK, shape (m, nodes).
        numbers: numbers of the elements in the file, shape (m,).
    """

    kind: str
    nodes: np.ndarray
    numbers: np.ndarray

    @property
    def cell_shape(self) -> str:
        """Shape of the elements, for volume elements ``tetra`` or ``hexahedron``."""
        return self.kind.rstrip("0123456789")

    @property
    def corner_nodes(self) -> np.ndarray:
        """Corners of each element in the order of VTK, shape (m, corners)."""
        count = {"tetra": 4, "hexahedron": 8, "triangle": 3, "quad": 4}[self.cell_shape]
        return self.nodes[:, :count]


@dataclass(frozen=True, eq=False)
class MeshContent:
    """Content of a mesh file in the unit of the file.

    Attributes:
        points: coordinates, shape (n, 3).
        point_numbers: numbers of the points in the file, shape (n,).
        cells: blocks of elements in the order of the file, each of one kind.
        point_sets: named sets of points as indices in `points`.
        cell_sets: named sets of elements as indices in each block of `cells`.
        side_sets: named sets of faces as rows (index of the block, index of the element in it, number of the face from
            0), shape (m, 3).
    """

    points: np.ndarray
    point_numbers: np.ndarray
    cells: list[CellBlock]
    point_sets: dict[str, np.ndarray] = field(default_factory=dict)
    cell_sets: dict[str, list[np.ndarray]] = field(default_factory=dict)
    side_sets: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class MeshLimits:
    """Limits of the meshes that are accepted from files.

    Attributes:
        smallest_extent: smallest extent of a specimen, m.
        largest_extent: largest extent of a specimen, m.
        most_elements: maximum number of elements.
        most_nodes: maximum number of nodes; the product of three node numbers must fit into 64 bits.
        flat: volume of an element, as a fraction of the cube of its largest extent, up to which it is degenerate, 1.
        same: distance up to which nodes are coincident, as a fraction of the size of the mesh, 1.
    """

    smallest_extent: float = 1e-4
    largest_extent: float = 1.0
    most_elements: int = 300_000
    most_nodes: int = 2_000_000
    flat: float = 1e-6
    same: float = 1e-9


#: Limits of every file.
LIMITS = MeshLimits()


def get_volume_cells_of_one_kind(content: MeshContent) -> CellBlock:
    """Return all volume elements of a file as one block, after checking that they are of one supported kind.

    Raises:
        InputError: there are no elements, too many elements, several kinds or an unsupported kind; a coordinate is not
            finite, or a node is missing.
    """
    solids = [block for block in content.cells if block.kind in SOLIDS and len(block.nodes)]
    for block in content.cells:
        if block.kind.startswith(OTHER_SOLIDS) and block.kind not in SOLIDS and len(block.nodes):
            raise InputError(f"element {block.numbers[0]} is a {block.kind}; the solid takes {', '.join(SOLIDS)}, "
                             "all of one kind")
    if not solids:
        kinds = sorted({block.kind for block in content.cells if len(block.nodes)})
        has = f"it has only {', '.join(kinds)}" if kinds else "it has no elements"
        raise InputError(f"contains no volume elements, {has}; export tetrahedra or hexahedra")
    other = next((block for block in solids if block.kind != solids[0].kind), None)
    if other is not None:
        raise InputError(f"mixes kinds of elements: element {solids[0].numbers[0]} is a {solids[0].kind}, element "
                         f"{other.numbers[0]} a {other.kind}; export elements of one kind")
    cells = CellBlock(solids[0].kind, np.concatenate([block.nodes for block in solids]),
                      np.concatenate([block.numbers for block in solids]))
    if len(cells.nodes) > LIMITS.most_elements or len(content.points) > LIMITS.most_nodes:
        raise InputError(f"must have at most {LIMITS.most_elements} elements and {LIMITS.most_nodes} nodes; got "
                         f"{len(cells.nodes)} and {len(content.points)}. Use a coarser mesh")
    if (~np.isfinite(content.points)).any():
        worst = int(np.flatnonzero(~np.isfinite(content.points).all(axis=1))[0])
        raise InputError(f"node {content.point_numbers[worst]} has a coordinate that is not finite")
    for block in (cells, *(block for block in content.cells if block.kind in FACES)):
        outside = (block.nodes < 0) | (block.nodes >= len(content.points))
        if outside.any():
            row = int(np.flatnonzero(outside.any(axis=1))[0])
            raise InputError(f"element {block.numbers[row]} has a node that is not in the file")
    return cells


def require_specimen_size(points: np.ndarray, unit: str) -> None:
    """Require a mesh of the size of a specimen.

    Args:
        points: coordinates, m, shape (n, 3).
        unit: unit of the coordinates in the file, for the message.

    Raises:
        InputError: the extent is outside the range.
    """
    extent = float(np.ptp(points, axis=0).max())
    if not LIMITS.smallest_extent <= extent <= LIMITS.largest_extent:
        raise InputError(f"the extent must be {LIMITS.smallest_extent:g} m to {LIMITS.largest_extent:g} m; got "
                         f"{extent:g} m with the unit {unit}. State the unit of the coordinates (mesh_unit, "
                         "--mesh-unit)")


def require_valid_mesh(cells: CellBlock, points: np.ndarray, point_numbers: np.ndarray) -> None:
    """Require a valid mesh: no degenerate, inverted or duplicate elements, no unused nodes, one connected body.

    Args:
        cells: volume elements.
        points: coordinates, m, shape (n, 3).
        point_numbers: numbers of the points in the file, shape (n,).

    Raises:
        InputError: the mesh is invalid; the error states the first fault with the number of an element or node in the
            file.
    """
    numbers, corners = cells.numbers, np.sort(cells.corner_nodes, axis=1)
    everything = np.sort(cells.nodes, axis=1)
    if (twice := (np.diff(everything, axis=1) == 0).any(axis=1)).any():
        raise InputError(f"element {numbers[np.argmax(twice)]} is degenerate: it has a node twice; remove this element")
    _, first, inverse, times = np.unique(corners, axis=0, return_index=True, return_inverse=True, return_counts=True)
    if (times > 1).any():
        again = int(np.flatnonzero(first[inverse.ravel()] != np.arange(len(corners)))[0])
        raise InputError(f"elements {numbers[first[inverse.ravel()[again]]]} and {numbers[again]} have the same "
                         "corners; remove one of them")
    used = np.zeros(len(points), dtype=bool)
    used[cells.nodes] = True
    if not used.all():
        raise InputError(f"node {point_numbers[np.argmin(used)]} belongs to no element of the volume; export only "
                         "nodes of elements")
    _require_no_coincident_nodes(points, point_numbers)
    _require_positive_volumes(cells, points)
    _require_connected_manifold_body(cells)


def _require_no_coincident_nodes(points: np.ndarray, point_numbers: np.ndarray) -> None:
    """Require that no two nodes have the same position; `point_numbers` are their numbers in the file."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    distance, other = tree.query(points, k=2)
    same = distance[:, 1] <= LIMITS.same * float(np.ptp(points, axis=0).max())
    if same.any():
        one = int(np.argmax(same))
        # The tree returns the node itself and the coincident node in any order.
        a, b = point_numbers[[one, int(other[one][other[one] != one][0])]]
        raise InputError(f"nodes {a} and {b} have the same position, so the mesh is not connected there; merge "
                         "coincident nodes")


def _require_positive_volumes(cells: CellBlock, points: np.ndarray) -> None:
    """Require positive volumes of the straight elements between the corners; curved elements are checked later."""
    corners = points[cells.corner_nodes]
    if cells.cell_shape == "tetra":
        volumes = np.linalg.det(corners[:, 1:] - corners[:, :1])[:, None] / 6.0
    else:
        # The determinant of the three edges at each corner.
        edges = [(1, 3, 4), (2, 0, 5), (3, 1, 6), (0, 2, 7), (7, 5, 0), (4, 6, 1), (5, 7, 2), (6, 4, 3)]
        volumes = np.stack([np.linalg.det(corners[:, list(ends)] - corners[:, [corner]])
                            for corner, ends in enumerate(edges)], axis=-1)
    least, size = volumes.min(axis=1), np.ptp(corners, axis=1).max(axis=1) ** 3
    flat = np.abs(volumes).min(axis=1) <= LIMITS.flat * size
    if flat.any():
        raise InputError(f"element {cells.numbers[np.argmax(flat)]} is degenerate: it has no volume; "
                         "remove this element, or correct its nodes")
    if (least < 0.0).all():
        raise InputError(f"all elements are turned inside out, element {cells.numbers[0]} the first; the mesh is "
                         "mirrored, or its nodes are numbered in the wrong orientation")
    if (least < 0.0).any():
        raise InputError(f"element {cells.numbers[np.argmin(least)]} is turned inside out")


def _require_connected_manifold_body(cells: CellBlock) -> None:
    """Require that elements are connected through sides, and that their surface is closed and meets itself nowhere."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    sides = np.array(SIDES[cells.cell_shape])
    keys = np.sort(cells.corner_nodes[:, sides], axis=-1).reshape(-1, sides.shape[1])
    owners = np.repeat(np.arange(len(cells.nodes)), len(sides))
    _, inverse, times = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.ravel()
    if (times > 2).any():
        shared = owners[inverse == np.argmax(times > 2)]
        named = ", ".join(map(str, cells.numbers[shared[:3]]))
        raise InputError(f"elements {named} share one side, but a side belongs to at most two elements; the mesh "
                         "overlaps itself")
    order = np.argsort(inverse, kind="stable")
    pairs = np.flatnonzero(np.diff(inverse[order]) == 0)
    a, b = owners[order[pairs]], owners[order[pairs + 1]]
    parts, label = connected_components(sparse.coo_array((np.ones(len(a)), (a, b)), shape=(len(cells.nodes),) * 2),
                                        directed=False)
    if parts > 1:
        raise InputError(f"is not one connected body: element {cells.numbers[0]} and element "
                         f"{cells.numbers[np.argmax(label != label[0])]} are not connected through sides; merge "
                         "coincident nodes, or export one part")
    outer_owners = owners[times[inverse] == 1]
    # Corners in circumferential order, which the sorted keys do not have.
    loops = cells.corner_nodes[:, sides].reshape(-1, sides.shape[1])[times[inverse] == 1]
    edges = np.sort(np.stack([loops, np.roll(loops, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
    _, edge, shared = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    wrong = shared[edge.ravel()] != 2
    if wrong.any():
        number = cells.numbers[outer_owners[np.argmax(wrong) // sides.shape[1]]]
        raise InputError(f"the surface does not close, or touches itself, at an edge of element {number}; each edge of "
                         "the surface must belong to two sides")
