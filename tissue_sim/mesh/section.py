"""Plane meshes of quadrilaterals made of rectangles, discs and rings, which are extruded to solid meshes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Distance below which nodes are merged, as a fraction of the size of the section.
_SAME = 1e-9
#: Roundness of the sides of the core of a disc: 0 for a square, 1 for a circle.
_ROUNDNESS = 0.4
#: Map of two coordinates in [0, 1] to (x, y), m.
_Map = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: Coordinates (x, y), m.
Point = tuple[float, float] | np.ndarray
#: Map of one coordinate in [0, 1] to (x, y), m.
Curve = Callable[[np.ndarray], np.ndarray]


class PlanarMesh:
    """Plane mesh of quadrilaterals, assembled from patches; coincident nodes are merged.

    Args:
        order: polynomial order of the elements.
    """

    def __init__(self, order: int):
        self._order = order
        self._nodes: list[np.ndarray] = []
        self._quads: list[np.ndarray] = []
        self._count = 0

    def add_patch(self, mapping: _Map, first: np.ndarray, second: np.ndarray) -> None:
        """Add a patch of quadrilaterals that is the image of a rectangular grid.

        Args:
            mapping: map of the unit square to the plane.
            first: element boundaries along the first coordinate, from 0 to 1.
            second: element boundaries along the second coordinate, from 0 to 1.
        """
        s, t = (self._insert_midpoints(line) for line in (first, second))
        grid = mapping(*np.meshgrid(s, t))  # [t, s]
        numbers = np.arange(s.size * t.size).reshape(t.size, s.size) + self._count
        order = self._order
        self._quads += [numbers[j : j + order + 1, i : i + order + 1].ravel()
                        for j in range(0, t.size - 1, order) for i in range(0, s.size - 1, order)]
        self._nodes.append(grid.reshape(-1, 2))
        self._count += numbers.size

    def add_rectangle(self, x: np.ndarray, y: np.ndarray) -> None:
        """Add a rectangle with these element boundaries along x and y, ascending, m."""
        self.add_patch(lambda s,
                       t: np.stack([_interpolate_piecewise_linearly(x, s), _interpolate_piecewise_linearly(y, t)],
                                   axis=-1),
                       np.linspace(0, 1, x.size), np.linspace(0, 1, y.size))

    def add_disc(self, centre: Point, radius: float, rings: np.ndarray, around: int,
                 through: Callable[[np.ndarray], np.ndarray] = lambda points: points) -> None:
        """Add a disc as an O-grid: a core with round sides, surrounded by rings.

        Args:
            centre: centre of the disc, m.
            radius: radius of the disc, m.
            rings: radii of the ring boundaries from the core to 1, ascending, as fractions of the radius of the disc.
            around: number of elements along a quarter.
            through: map applied to all points, shape (..., 2).
        """
        core, origin, line = rings[0] * radius, np.asarray(centre), np.linspace(0, 1, around + 1)

        def map_core(s: np.ndarray, t: np.ndarray) -> np.ndarray:
            """Map the unit square to the core of the disc, a square with round sides."""
            # Uniform angles along the sides of the core.
            return through(origin + core * _map_to_rounded_square(*(
                np.sqrt(2.0) * np.sin(0.25 * np.pi * (2.0 * each - 1.0)) for each in (s, t))))

        self.add_patch(map_core, line, line)
        for quarter in range(4):
            self.add_elements_between_curves(_make_core_side(quarter, core, origin),
                                             make_quarter_circle(quarter, radius, centre),
                                             (rings - rings[0]) / (1.0 - rings[0]), around, through)

    def add_elements_between_curves(self, near: Curve, far: Curve, fractions: np.ndarray, around: int,
                                    through: Callable[[np.ndarray], np.ndarray] = lambda points: points) -> None:
        """Add the elements between an inner and an outer curve, such as a quarter of a ring.

        Args:
            near: inner curve.
            far: outer curve.
            fractions: element boundaries from the inner (0) to the outer curve (1).
            around: number of elements along the curves.
            through: map applied to all points, shape (..., 2).
        """
        def interpolate_between_curves(s: np.ndarray, t: np.ndarray) -> np.ndarray:
            """Return the point at the fraction s of the straight line from the inner to the outer curve at t."""
            fraction = s[..., None]
            return through((1.0 - fraction) * near(t) + fraction * far(t))

        self.add_patch(interpolate_between_curves, fractions, np.linspace(0, 1, around + 1))

    def extrude_to_hexahedra(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Extrude the plane mesh along z to hexahedra.

        Args:
            z: heights of the element boundaries, base first, m.

        Returns:
            Nodes, m, shape (n, 3), and node numbers of the hexahedra.
        """
        plane, quads = _merge_points_and_renumber(np.concatenate(self._nodes), np.array(self._quads))
        heights = self._insert_midpoints(z)
        count, order = len(plane), self._order
        nodes = np.concatenate([np.column_stack([plane, np.full(count, height)]) for height in heights])
        connectivity = np.concatenate([np.concatenate([quads + (k + m) * count for m in range(order + 1)], axis=1)
                                       for k in range(0, heights.size - 1, order)])
        return nodes, connectivity

    def _insert_midpoints(self, line: np.ndarray) -> np.ndarray:
        """Return element boundaries with their midpoints added for elements of order 2; unchanged for order 1."""
        if self._order == 1:
            return line
        return np.sort(np.concatenate([line, 0.5 * (line[1:] + line[:-1])]))


def make_quarter_circle(quarter: int, radius: float, centre: Point = (0.0, 0.0)) -> Curve:
    """Return a curve [0, 1] -> (x, y), m: a quarter of a circle, counter-clockwise; quarter 0 is centred on +x."""
    def evaluate_curve(t: np.ndarray) -> np.ndarray:
        """Return the points of the circle, m, shape (..., 2), at the positions t in [0, 1]."""
        angle = 0.25 * np.pi * (2.0 * t - 1.0) + 0.5 * np.pi * quarter
        return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    return evaluate_curve


def make_rectangle_side(quarter: int, low: Point, high: Point, centre: Point) -> Curve:
    """Return a side of a rectangle, counter-clockwise; the middle of the curve is at the coordinate of `centre`.

    Args:
        quarter: number of the side; 0 is the side at the largest x.
        low: corner with the smallest x and y, m.
        high: corner with the largest x and y, m.
        centre: centre of the tool, m.
    """
    across = quarter % 2  # index of the constant coordinate
    end = (high if quarter < 2 else low)[across]
    first, last = (low, high) if quarter in (0, 3) else (high, low)
    line = np.array([first[1 - across], centre[1 - across], last[1 - across]])

    def evaluate_curve(t: np.ndarray) -> np.ndarray:
        """Return the points of the side, m, shape (..., 2), at the positions t in [0, 1]."""
        along, fixed = np.interp(t, [0.0, 0.5, 1.0], line), np.full_like(t, end)
        return np.stack([along, fixed] if across else [fixed, along], axis=-1)

    return evaluate_curve


def _merge_points_and_renumber(points: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge coincident points; return the points that are kept, and `numbers` renumbered to these points."""
    from scipy.spatial import cKDTree

    first = np.arange(len(points))
    for a, b in sorted(cKDTree(points).query_pairs(_SAME * np.ptp(points))):
        first[b] = first[a]
    kept, inverse = np.unique(first, return_inverse=True)
    return points[kept], inverse[numbers]


def _interpolate_piecewise_linearly(line: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Return values of a piecewise linear function with equally spaced nodes `line`, at positions in [0, 1]."""
    return np.interp(fraction, np.linspace(0, 1, line.size), line)


def _map_to_rounded_square(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Map [-1, 1]^2 to a square with sides that bulge outwards and corners at a distance of 1 from the centre."""
    straight = np.stack([u, v], axis=-1) / np.sqrt(2.0)
    disc = np.stack([u * np.sqrt(1.0 - 0.5 * v**2), v * np.sqrt(1.0 - 0.5 * u**2)], axis=-1)
    weight = _ROUNDNESS * np.maximum(np.abs(u), np.abs(v))[..., None]
    return (1.0 - weight) * straight + weight * disc


def _make_core_side(quarter: int, core: float, centre: np.ndarray) -> Curve:
    """Return a curve [0, 1] -> (x, y), m: side `quarter` of the rounded square that is the core of a disc."""
    angle = 0.5 * np.pi * quarter

    def evaluate_curve(t: np.ndarray) -> np.ndarray:
        """Return the points of the side, m, shape (..., 2), at the positions t in [0, 1]."""
        side = _map_to_rounded_square(np.ones_like(t), np.sqrt(2.0) * np.sin(0.25 * np.pi * (2.0 * t - 1.0)))
        return centre + core * np.stack([np.cos(angle) * side[..., 0] - np.sin(angle) * side[..., 1],
                                         np.sin(angle) * side[..., 0] + np.cos(angle) * side[..., 1]], axis=-1)

    return evaluate_curve
