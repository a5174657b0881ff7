"""Quadrilaterals in the plane: rectangles, discs and rings, from which meshes in space are raised."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Nodes nearer to each other than this share of the section's size are one.
_SAME = 1e-9
#: How round the sides of the square in the middle of a disc are: 0 of a square, 1 of a circle.
_ROUND = 0.4
#: A map of two coordinates in [0, 1] to (x, y), m.
_Map = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: (x, y), m.
Place = tuple[float, float] | np.ndarray
#: A map of one coordinate in [0, 1] to (x, y), m.
Curve = Callable[[np.ndarray], np.ndarray]


class Section:
    """Quadrilaterals in the plane, patch by patch; nodes at one place are one.

    Args:
        order: of the elements.
    """

    def __init__(self, order: int):
        self._order = order
        self._nodes: list[np.ndarray] = []
        self._quads: list[np.ndarray] = []
        self._count = 0

    def add(self, place: _Map, first: np.ndarray, second: np.ndarray) -> None:
        """Add the elements between these boundaries, from 0 to 1, of a map."""
        s, t = (self._with_middles(line) for line in (first, second))
        grid = place(*np.meshgrid(s, t))  # [t, s]
        numbers = np.arange(s.size * t.size).reshape(t.size, s.size) + self._count
        order = self._order
        self._quads += [numbers[j : j + order + 1, i : i + order + 1].ravel()
                        for j in range(0, t.size - 1, order) for i in range(0, s.size - 1, order)]
        self._nodes.append(grid.reshape(-1, 2))
        self._count += numbers.size

    def add_rectangle(self, x: np.ndarray, y: np.ndarray) -> None:
        """Add the elements between these boundaries, ascending, m."""
        self.add(lambda s, t: np.stack([_between(x, s), _between(y, t)], axis=-1),
                 np.linspace(0, 1, x.size), np.linspace(0, 1, y.size))

    def add_disc(self, centre: Place, radius: float, rings: np.ndarray, around: int,
                 through: Callable[[np.ndarray], np.ndarray] = lambda places: places) -> None:
        """Add a square with round sides and rings about it.

        Args:
            centre, radius: of the disc, m.
            rings: radii from that of the square's end, ascending, to 1, over that of the disc.
            around: elements along a quarter.
            through: what becomes of places, shape (..., 2).
        """
        core, origin, line = rings[0] * radius, np.asarray(centre), np.linspace(0, 1, around + 1)

        def square(s: np.ndarray, t: np.ndarray) -> np.ndarray:
            # Even angles along the sides of the square.
            return through(origin + core * _rounded_square(*(
                np.sqrt(2.0) * np.sin(0.25 * np.pi * (2.0 * each - 1.0)) for each in (s, t))))

        self.add(square, line, line)
        for quarter in range(4):
            self.add_ring(_side_of_square(quarter, core, origin), arc(quarter, radius, centre),
                          (rings - rings[0]) / (1.0 - rings[0]), around, through)

    def add_ring(self, near: Curve, far: Curve, shares: np.ndarray, around: int,
                 through: Callable[[np.ndarray], np.ndarray] = lambda places: places) -> None:
        """Add the elements between two curves, at these shares of the way from one to the other."""
        def place(s: np.ndarray, t: np.ndarray) -> np.ndarray:
            share = s[..., None]
            return through((1.0 - share) * near(t) + share * far(t))

        self.add(place, shares, np.linspace(0, 1, around + 1))

    def raised(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes, (n, 3), m, and hexahedra over the section between these heights, base first, m."""
        plane, quads = _joined(np.concatenate(self._nodes), np.array(self._quads))
        heights = self._with_middles(z)
        count, order = len(plane), self._order
        nodes = np.concatenate([np.column_stack([plane, np.full(count, height)]) for height in heights])
        connectivity = np.concatenate([np.concatenate([quads + (k + m) * count for m in range(order + 1)], axis=1)
                                       for k in range(0, heights.size - 1, order)])
        return nodes, connectivity

    def _with_middles(self, line: np.ndarray) -> np.ndarray:
        if self._order == 1:
            return line
        return np.sort(np.concatenate([line, 0.5 * (line[1:] + line[:-1])]))


def arc(quarter: int, radius: float, centre: Place = (0.0, 0.0)) -> Curve:
    """A quarter of a circle, the first about +x, counter-clockwise, m."""
    def place(t: np.ndarray) -> np.ndarray:
        angle = 0.25 * np.pi * (2.0 * t - 1.0) + 0.5 * np.pi * quarter
        return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    return place


def side_of_box(quarter: int, low: Place, high: Place, centre: Place) -> Curve:
    """A side of a rectangle, counter-clockwise, the first at the largest x; half way it is beside `centre`.

    Args:
        quarter: number of the side.
        low, high: its corners with the least and the most x and y, m.
        centre: of the tool, m.
    """
    across = quarter % 2  # the coordinate that is the same all along
    end = (high if quarter < 2 else low)[across]
    first, last = (low, high) if quarter in (0, 3) else (high, low)
    line = np.array([first[1 - across], centre[1 - across], last[1 - across]])

    def place(t: np.ndarray) -> np.ndarray:
        along, fixed = np.interp(t, [0.0, 0.5, 1.0], line), np.full_like(t, end)
        return np.stack([along, fixed] if across else [fixed, along], axis=-1)

    return place


def _joined(places: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places without repetitions, and numbers of them."""
    from scipy.spatial import cKDTree

    first = np.arange(len(places))
    for a, b in sorted(cKDTree(places).query_pairs(_SAME * np.ptp(places))):
        first[b] = first[a]
    kept, inverse = np.unique(first, return_inverse=True)
    return places[kept], inverse[numbers]


def _between(line: np.ndarray, share: np.ndarray) -> np.ndarray:
    return np.interp(share, np.linspace(0, 1, line.size), line)


def _rounded_square(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[-1, 1]^2 as a square whose sides bulge outwards and whose corners are at a distance of 1 from the middle."""
    straight = np.stack([u, v], axis=-1) / np.sqrt(2.0)
    disc = np.stack([u * np.sqrt(1.0 - 0.5 * v**2), v * np.sqrt(1.0 - 0.5 * u**2)], axis=-1)
    share = _ROUND * np.maximum(np.abs(u), np.abs(v))[..., None]
    return (1.0 - share) * straight + share * disc


def _side_of_square(quarter: int, core: float, centre: np.ndarray) -> Curve:
    """A side of the square in the middle of a disc."""
    turn = 0.5 * np.pi * quarter

    def place(t: np.ndarray) -> np.ndarray:
        side = _rounded_square(np.ones_like(t), np.sqrt(2.0) * np.sin(0.25 * np.pi * (2.0 * t - 1.0)))
        return centre + core * np.stack([np.cos(turn) * side[..., 0] - np.sin(turn) * side[..., 1],
                                         np.sin(turn) * side[..., 0] + np.cos(turn) * side[..., 1]], axis=-1)

    return place
