"""Graded structured meshes of the half section of a cylinder."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.elements import QuadrilateralElement


@dataclass(frozen=True, eq=False)
class Mesh:
    """Mesh of quadrilaterals in the (r, z) half plane.

    The axis is r = 0, the undeformed top is z = 0 and the base is z = -height.

    Attributes:
        element: element type.
        nodes: coordinates, m, shape (n, 2), numbered row by row from base to top.
        connectivity: node numbers in the order of the element, shape (elements, nodes of the element).
        sets: named node numbers: ``axis``, ``base``, ``top``, ``side``. A mesh under a needle also has ``face``, the
            part of the top under the flat face of the needle, and ``free``, the rest of the top; both include the node
            at the edge.
    """

    element: QuadrilateralElement
    nodes: np.ndarray
    connectivity: np.ndarray
    sets: dict[str, np.ndarray] = field(default_factory=dict)

    def select_edges_in_node_set(self, name: str) -> np.ndarray:
        """Return the element edges with all nodes in the named node set, as node numbers, shape (m, nodes of an edge).

        The first and the last number of a row are the ends of the edge.
        """
        sides = self.connectivity[:, np.array(self.element.local_edge_node_indices)].reshape(-1, self.element.order + 1)
        return sides[np.isin(sides, self.sets[name]).all(axis=1)]

    def scale_height(self, factor: float) -> Mesh:
        """Return a copy of the mesh with all heights z multiplied by `factor`."""
        return replace(self, nodes=self.nodes * [1.0, factor])

    def with_moved_mesh_lines(self, r: tuple[np.ndarray, np.ndarray], z: tuple[np.ndarray, np.ndarray]) -> Mesh:
        """Return the mesh with moved mesh lines; positions between the stated lines are interpolated linearly.

        Args:
            r: old and new radii of some mesh lines, m, each ascending.
            z: old and new heights of some mesh lines, m, each ascending.
        """
        if np.array_equal(*r) and np.array_equal(*z):
            return self
        return replace(self, nodes=np.stack([np.interp(self.nodes[:, 0], *r), np.interp(self.nodes[:, 1], *z)], axis=1))


def divide_into_graded_intervals(length: float, count: int, grading: float = 1.0, ends: str = "last") -> np.ndarray:
    """Divide a line into intervals whose lengths form a geometric series.

    Args:
        length: length of the line, m.
        count: number of intervals.
        grading: ratio of the largest to the smallest interval; 1 is uniform.
        ends: ends with the smallest intervals: ``first``, ``last`` or ``both``.

    Returns:
        count + 1 coordinates from 0 to length, m.

    Raises:
        InputError: `count` or `grading` is below 1, or `ends` is unknown.

    Examples:
        >>> divide_into_graded_intervals(1.0, 4)
        array([0.  , 0.25, 0.5 , 0.75, 1.  ])
    """
    if count < 1:
        raise InputError(f"count must be at least 1; got {count}", field="count")
    if grading < 1:
        raise InputError(f"grading must be at least 1, the ratio of the largest to the smallest interval; got "
                         f"{grading:g}", field="grading")
    index = np.arange(count)
    match ends:
        case "first":
            power = index
        case "last":
            power = count - 1 - index
        case "both":
            power = np.minimum(index, count - 1 - index)
        case _:
            raise InputError(f"ends must be 'first', 'last' or 'both'; got {ends!r}", field="ends")
    steps = grading ** (power / max(1, power.max()))
    points = np.concatenate([[0.0], np.cumsum(steps)]) * (length / steps.sum())
    points[-1] = length
    return points


def divide_into_growing_intervals(length: float, smallest: float, growth: float, largest: float) -> np.ndarray:
    """Divide a line into growing intervals: each is `growth` times as long as the one before, up to `largest`.

    All intervals are scaled by a common factor to fit the length.

    Args:
        length: length of the line, m.
        smallest: approximate length of the first interval, m.
        growth: ratio of successive intervals, at least 1.
        largest: limit of the length of an interval, m.

    Returns:
        Coordinates from 0 to length, m.

    Examples:
        >>> divide_into_growing_intervals(1.0, smallest=0.1, growth=1.5, largest=0.4).round(2)
        array([0.  , 0.08, 0.21, 0.39, 0.67, 1.  ])
    """
    steps = [min(smallest, length)]
    while sum(steps) < length * (1 - 1e-9):
        steps.append(min(steps[-1] * growth, largest))
    points = np.concatenate([[0.0], np.cumsum(steps)]) * (length / sum(steps))
    points[-1] = length
    return points


def structured_mesh(r: np.ndarray, z: np.ndarray, element: QuadrilateralElement) -> Mesh:
    """Create a structured mesh from element boundaries.

    Args:
        r: radii of the element boundaries, ascending from 0, m.
        z: heights of the element boundaries, ascending (base first), m.
        element: element type; mid-side and centre nodes are placed half way.

    Raises:
        InputError: the first radius is not 0.
    """
    if r[0] != 0:
        raise InputError(f"the first radius must be 0, the axis; got {r[0]:g}", field="mesh.r")
    if element.order == 2:
        r, z = (np.insert(line, np.arange(1, line.size), 0.5 * (line[1:] + line[:-1])) for line in (r, z))
    columns, rows = r.size, z.size
    nodes = np.stack(np.meshgrid(r, z), axis=-1).reshape(-1, 2)
    number = np.arange(rows * columns).reshape(rows, columns)
    step = element.order
    i, j = (corners.ravel() for corners in np.meshgrid(np.arange(0, columns - 1, step), np.arange(0, rows - 1, step)))
    offsets = ((element.reference_nodes + 1) * step / 2).round().astype(int)
    connectivity = np.stack([number[j + dj, i + di] for di, dj in offsets], axis=-1)
    sets = {"axis": number[:, 0], "side": number[:, -1], "base": number[0], "top": number[-1]}
    return Mesh(element, nodes, connectivity, {name: members.copy() for name, members in sets.items()})


def cylinder_mesh(radius: float, height: float, elements: tuple[int, int], element: QuadrilateralElement, *,
                  grading: tuple[float, float] = (1.0, 1.0)) -> Mesh:
    """Create the mesh of a cylinder with small elements at the side and both ends, where bonded corners are singular.

    Args:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
        elements: number of elements along r and along z.
        element: element type.
        grading: ratio of the largest to the smallest element along r and along z; 1 is uniform.

    Examples:
        >>> from tissue_sim.mesh.elements import Q9P1
        >>> cylinder_mesh(0.040, 0.070, (2, 3), Q9P1).nodes.shape
        (35, 2)
    """
    r = divide_into_graded_intervals(radius, elements[0], grading[0], "last")
    z = divide_into_graded_intervals(height, elements[1], grading[1], "both") - height
    return structured_mesh(r, z, element)


def cylinder_mesh_refined_under_needle(radius: float, height: float, face_radius: float, element: QuadrilateralElement,
                                       *, smallest: float,
                                       growth: float,
                                       largest: float) -> Mesh:
    """Create the mesh of a cylinder under a flat needle with small elements at the edge of the needle's face.

    Args:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
        face_radius: radius of the face of the needle, m.
        element: element type.
        smallest: length of the intervals at the edge, m; see `divide_into_growing_intervals`.
        growth: ratio of successive intervals away from the edge.
        largest: limit of the length of an interval, m.
    """
    inward = divide_into_growing_intervals(face_radius, smallest, growth, largest)
    outward = divide_into_growing_intervals(radius - face_radius, smallest, growth, largest)
    r = np.concatenate([face_radius - inward[::-1], face_radius + outward[1:]])
    r[0], r[-1] = 0.0, radius
    mesh = structured_mesh(r, -divide_into_growing_intervals(height, smallest, growth, largest)[::-1], element)
    top = mesh.sets["top"]
    distance = mesh.nodes[top, 0] - face_radius
    slack = 1e-9 * radius
    return replace(mesh, sets={**mesh.sets, "face": top[distance <= slack], "free": top[distance >= -slack]})


def cylinder_mesh_refined_under_tip(radius: float, height: float, contact_radius: float, element: QuadrilateralElement,
                                    *, smallest: float, growth: float, largest: float) -> Mesh:
    """Create the mesh of a cylinder under a pointed or round tip: uniform elements in contact, growing ones outside.

    Args:
        radius: radius of the cylinder, m.
        height: height of the cylinder, m.
        contact_radius: expected radius of the contact, m; elements are uniform up to 1.5 times this radius.
        element: element type.
        smallest: length of the uniform intervals, m; see `divide_into_growing_intervals`.
        growth: ratio of successive intervals outside.
        largest: limit of the length of an interval, m.
    """
    even = min(1.5 * contact_radius, 0.8 * radius)
    inner = np.linspace(0.0, even, max(2, round(even / smallest)) + 1)
    outer = even + divide_into_growing_intervals(radius - even, smallest * growth, growth, largest)
    r = np.concatenate([inner, outer[1:]])
    r[-1] = radius
    mesh = structured_mesh(r, -divide_into_growing_intervals(height, smallest, growth, largest)[::-1], element)
    top = mesh.sets["top"]
    return replace(mesh, sets={**mesh.sets, "face": top[:1], "free": top})


def insert_interfaces_and_refine_layers(z: np.ndarray, interfaces: list[float], least: int) -> np.ndarray:
    """Return the heights of element boundaries with interfaces added, and with enough elements in each layer.

    Args:
        z: element boundaries, ascending, m.
        interfaces: heights of the interfaces, m.
        least: minimum number of elements between interfaces, and between the top interface and the top.

    Returns:
        Ascending boundaries, m. A boundary near an interface is moved onto it; otherwise a boundary is added.
    """
    for interface in interfaces:
        k = int(np.argmin(np.abs(z - interface)))
        step = min(z[k] - z[k - 1] if k else np.inf, z[k + 1] - z[k] if k + 1 < z.size else np.inf)
        if 0 < k < z.size - 1 and abs(z[k] - interface) < 0.4 * step:
            z = z.copy()
            z[k] = interface
        else:
            z = np.sort(np.append(z, interface))
    bounds = [*sorted(interfaces), z[-1]]
    for low, high in pairwise(bounds):
        while ((z >= low) & (z <= high)).sum() - 1 < least:
            inside = np.flatnonzero((z >= low) & (z < high))
            widest = inside[np.argmax(np.diff(z)[inside])]
            z = np.insert(z, widest + 1, 0.5 * (z[widest] + z[widest + 1]))
    return z
