"""Graded structured meshes of a cylinder's half section."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.elements import Element


@dataclass(frozen=True, eq=False)
class Mesh:
    """Quadrilaterals in the (r, z) half plane; the axis is r = 0, the undeformed top face z = 0, the base z = -height.

    Attributes:
        element: element type.
        nodes: coordinates, m, shape (n, 2), numbered row by row from base to top.
        connectivity: node numbers in the element's order, shape (elements, nodes of the element).
        sets: named node numbers: ``axis``, ``base``, ``top``, ``side``; where a needle comes down also ``face``, the
            part of the top under its flat face, and ``free``, the rest, both with the node at its edge.
    """

    element: Element
    nodes: np.ndarray
    connectivity: np.ndarray
    sets: dict[str, np.ndarray] = field(default_factory=dict)

    def edges(self, name: str) -> np.ndarray:
        """Element edges all of whose nodes are in a set, as node numbers, ends outside, shape (m, nodes of an edge)."""
        sides = self.connectivity[:, np.array(self.element.edges)].reshape(-1, self.element.order + 1)
        return sides[np.isin(sides, self.sets[name]).all(axis=1)]

    def stretched(self, factor: float) -> Mesh:
        """The same mesh, this many times as high."""
        return replace(self, nodes=self.nodes * [1.0, factor])

    def moved(self, r: tuple[np.ndarray, np.ndarray], z: tuple[np.ndarray, np.ndarray]) -> Mesh:
        """The same mesh with its lines elsewhere.

        Args:
            r, z: where some lines are and where they shall be, m, each ascending; those between move in proportion.
        """
        if np.array_equal(*r) and np.array_equal(*z):
            return self
        return replace(self, nodes=np.stack([np.interp(self.nodes[:, 0], *r), np.interp(self.nodes[:, 1], *z)], axis=1))


def graded_line(length: float, count: int, grading: float = 1.0, ends: str = "last") -> np.ndarray:
    """Break points of a line divided geometrically.

    Args:
        length: m.
        count: number of intervals.
        grading: largest over smallest interval; 1 is uniform.
        ends: where it is fine: ``first``, ``last`` or ``both``.

    Returns:
        count + 1 coordinates from 0 to length.
    """
    if count < 1:
        raise InputError(f"{count} intervals cannot divide a line; give at least 1", field="count")
    if grading < 1:
        raise InputError(f"grading {grading:g} is the largest over the smallest interval; give at least 1",
                         field="grading")
    index = np.arange(count)
    match ends:
        case "first":
            power = index
        case "last":
            power = count - 1 - index
        case "both":
            power = np.minimum(index, count - 1 - index)
        case _:
            raise InputError(f"{ends!r} is not an end; use first, last or both", field="ends")
    steps = grading ** (power / max(1, power.max()))
    points = np.concatenate([[0.0], np.cumsum(steps)]) * (length / steps.sum())
    points[-1] = length
    return points


def growing_line(length: float, smallest: float, growth: float, largest: float) -> np.ndarray:
    """Break points of a line whose first interval is about `smallest`, each next one `growth` times as long up to
    `largest`; all are shortened alike to fit.

    Args:
        length, smallest, largest: m.
        growth: at least 1.

    Returns:
        Coordinates from 0 to length.
    """
    steps = [min(smallest, length)]
    while sum(steps) < length * (1 - 1e-9):
        steps.append(min(steps[-1] * growth, largest))
    points = np.concatenate([[0.0], np.cumsum(steps)]) * (length / sum(steps))
    points[-1] = length
    return points


def structured_mesh(r: np.ndarray, z: np.ndarray, element: Element) -> Mesh:
    """A mesh from element boundaries.

    Args:
        r: radii of the element boundaries, ascending from 0, m.
        z: heights of the element boundaries, ascending (base first), m.
        element: element type; mid-side and centre nodes are placed half way.

    Raises:
        InputError: the first radius is not the axis.
    """
    if r[0] != 0:
        raise InputError(f"the first radius is {r[0]:g}; the mesh starts at the axis, r = 0", field="mesh.r")
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


def cylinder_mesh(radius: float, height: float, elements: tuple[int, int], element: Element, *,
                  grading: tuple[float, float] = (1.0, 1.0)) -> Mesh:
    """A cylinder, fine towards the side face and towards both end faces, where bonded corners are singular.

    Args:
        radius, height: m.
        elements: number along r and along z.
        element: element type.
        grading: largest over smallest element along r and along z; 1 is uniform.
    """
    r = graded_line(radius, elements[0], grading[0], "last")
    z = graded_line(height, elements[1], grading[1], "both") - height
    return structured_mesh(r, z, element)


def needle_mesh(radius: float, height: float, face_radius: float, element: Element, *, smallest: float, growth: float,
                largest: float) -> Mesh:
    """A cylinder under a flat-faced needle, fine towards the edge of the face, where the tissue folds.

    Args:
        radius, height, face_radius: m.
        element: element type.
        smallest, growth, largest: of the intervals that lead away from the edge, see `growing_line`.
    """
    inward = growing_line(face_radius, smallest, growth, largest)
    outward = growing_line(radius - face_radius, smallest, growth, largest)
    r = np.concatenate([face_radius - inward[::-1], face_radius + outward[1:]])
    r[0], r[-1] = 0.0, radius
    mesh = structured_mesh(r, -growing_line(height, smallest, growth, largest)[::-1], element)
    top = mesh.sets["top"]
    beside = mesh.nodes[top, 0] - face_radius
    slack = 1e-9 * radius
    return replace(mesh, sets={**mesh.sets, "face": top[beside <= slack], "free": top[beside >= -slack]})


def tip_mesh(radius: float, height: float, contact_radius: float, element: Element, *, smallest: float, growth: float,
             largest: float) -> Mesh:
    """A cylinder under a pointed or rounded tip: even elements under the contact, which grow away from it.

    Args:
        radius, height: m.
        contact_radius: m; elements are even up to one and a half of it.
        element: element type.
        smallest, growth, largest: of the intervals, m; see `growing_line`.
    """
    even = min(1.5 * contact_radius, 0.8 * radius)
    inner = np.linspace(0.0, even, max(2, round(even / smallest)) + 1)
    outer = even + growing_line(radius - even, smallest * growth, growth, largest)
    r = np.concatenate([inner, outer[1:]])
    r[-1] = radius
    mesh = structured_mesh(r, -growing_line(height, smallest, growth, largest)[::-1], element)
    top = mesh.sets["top"]
    return replace(mesh, sets={**mesh.sets, "face": top[:1], "free": top})


def with_lines(z: np.ndarray, interfaces: list[float], least: int) -> np.ndarray:
    """Element boundaries that meet interfaces, each layer between them at least so many elements thick.

    Args:
        z: ascending, m.
        interfaces: inside, m.
        least: elements between the top and the first interface, and between interfaces.

    Returns:
        Ascending boundaries. A boundary near an interface moves onto it, others are added.
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
