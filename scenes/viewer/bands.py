"""Iso-bands: cut triangles and lines where a field crosses given levels, so that each piece has one colour."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class TrianglesSortedByBand:
    """Triangles that result from cutting a triangulation at the levels; each triangle lies in one band.

    Attributes:
        points: Original points, then the points where edges cross levels, shape (m, 2) or (m, 3).
        triangles: Point numbers with the original orientation, sorted by band, shape (k, 3).
        band: Band of each triangle, ascending, shape (k,).
    """

    points: np.ndarray
    triangles: np.ndarray
    band: np.ndarray


@dataclass(frozen=True, eq=False)
class TriangleConnectivity:
    """Fixed connectivity of triangles whose points and nodal values change from frame to frame.

    Attributes:
        triangles: Point numbers, shape (t, 3).
    """

    triangles: np.ndarray

    @cached_property
    def _edges_and_triangle_edge_numbers(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges of the triangles, each edge listed once.

        Returns:
            End points of each edge, shape (e, 2), and edge numbers of each triangle in the order of its corners 0-1,
            1-2, 2-0, shape (t, 3).
        """
        ends = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
        points = int(ends.max(initial=0)) + 1
        keys, number = np.unique(ends[:, 0] * points + ends[:, 1], return_inverse=True)
        return np.stack([keys // points, keys % points], axis=-1), number.reshape(-1, 3)

    def cut_at_levels(self, points: np.ndarray, values: np.ndarray, levels: np.ndarray) -> TrianglesSortedByBand:
        """Cut the triangles where the linear interpolant of the values crosses the levels.

        Args:
            points: Coordinates, shape (n, 2) or (n, 3).
            values: Values at the points, shape (n,).
            levels: Ascending levels, shape (bands + 1,). Values below the first level belong to the first band, values
                above the last level to the last band.
        """
        inner = np.asarray(levels, dtype=float)[1:-1]
        edges, edges_of = self._edges_and_triangle_edge_numbers
        at_ends = values[edges]
        # For each point: the number of levels < value, and the number of levels <= value.
        below, reached = np.searchsorted(inner, values, "left"), np.searchsorted(inner, values, "right")
        first = reached[edges].min(axis=1)
        count = np.maximum(below[edges].max(axis=1) - first, 0)
        crossed = np.repeat(np.arange(len(edges)), count)
        start = np.cumsum(count) - count
        level = inner[first[crossed] + np.arange(crossed.size) - start[crossed]]
        fraction = (level - at_ends[crossed, 0]) / (at_ends[crossed, 1] - at_ends[crossed, 0])
        first_end, second_end = points[edges[crossed, 0]], points[edges[crossed, 1]]
        all_points = np.concatenate([points, first_end + fraction[:, None] * (second_end - first_end)])
        # The crossing of edge e with level l is point number `of_edge[e] + l`.
        of_edge = len(points) + start - first

        reached_at = reached[self.triangles]
        lowest = reached_at.min(axis=1)
        highest = np.maximum(below[self.triangles].max(axis=1), lowest)
        whole = lowest == highest
        split = np.flatnonzero(~whole)
        pieces, band = self._cut_triangles_into_band_pieces(split, values, below, reached, of_edge, edges_of,
                                                            lowest[split],
                                                            highest[split])
        triangles = np.concatenate([self.triangles[whole], pieces])
        band = np.concatenate([lowest[whole], band])
        order = np.argsort(band, kind="stable")
        return TrianglesSortedByBand(all_points, triangles[order], band[order])

    def _cut_triangles_into_band_pieces(self, split, values, below, reached, of_edge, edges_of, lowest, highest):
        """Cut the triangles numbered `split` into pieces.

        The long edge of a triangle connects the corners with the lowest and the highest value; the two short edges
        meet at the middle corner. The part of a triangle inside a band is a polygon with these corners: the crossing of
        the long edge with the lower level, the crossing of a short edge with the lower level, the middle corner if its
        value lies in the band, the crossing of a short edge with the upper level, and the crossing of the long edge
        with the upper level.

        Returns:
            Point numbers of the pieces, shape (k, 3), and their bands, shape (k,).
        """
        corners = self.triangles[split]
        order = np.argsort(values[corners], axis=1, kind="stable")
        rows = np.arange(split.size)[:, None]
        low, middle, high = corners[rows, order].T
        odd = (order[:, 1] - order[:, 0]) % 3 == 2
        # Edge (k + 1) % 3 lies opposite to corner k.
        short_high, long, short_low = edges_of[split][rows, (order + 1) % 3].T

        repeats = highest - lowest + 1
        of = np.repeat(np.arange(split.size), repeats)
        band = lowest[of] + np.arange(of.size) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        low, middle, high, odd = low[of], middle[of], high[of], odd[of]
        on_long, on_low, on_high = of_edge[long[of]], of_edge[short_low[of]], of_edge[short_high[of]]
        under, reach = below[middle], reached[middle]

        def find_level_crossings_on_short_edges(level):
            """Return point numbers: the crossing of a short edge, or the middle corner if it is on the level."""
            return np.where(level < under, on_low + level, np.where(level >= reach, on_high + level, middle))

        bottom, top = band == lowest[of], band == highest[of]
        long_below, long_above = np.where(bottom, low, on_long + band - 1), np.where(top, high, on_long + band)
        short_below = np.where(bottom, low, find_level_crossings_on_short_edges(band - 1))
        short_above = np.where(top, high, find_level_crossings_on_short_edges(band))
        inside = (bottom | (band - 1 < under)) & (top | (band >= reach))
        between = np.where(inside, middle, short_below)
        pieces = np.stack([np.stack([long_below, short_below, between], axis=-1),
                           np.stack([long_below, between, short_above], axis=-1),
                           np.stack([long_below, short_above, long_above], axis=-1)], axis=1)
        pieces[odd] = pieces[odd][..., ::-1]
        a, b, c = np.moveaxis(pieces, -1, 0)
        real = (a != b) & (b != c) & (c != a)
        return pieces[real], np.repeat(band, 3).reshape(-1, 3)[real]


def renumber_triangles_for_band_meshes(triangles: np.ndarray, band: np.ndarray, points: int,
                                       bands: int) -> tuple[np.ndarray, np.ndarray, list]:
    """Split triangles into one mesh per band, each with its own point numbers.

    Args:
        triangles: Point numbers, sorted by band, shape (k, 3).
        band: Band of each triangle, ascending, shape (k,).
        points: Number of points.
        bands: Number of bands.

    Returns:
        Original numbers of the points of all meshes, mesh after mesh; the triangles in point numbers that start at 0 in
        each mesh, shape (k, 3); and for each mesh the slice of its points and the slice of its triangles.
    """
    shifted = triangles + (band * points)[:, None]
    used = np.zeros(bands * points, dtype=bool)
    used[shifted] = True
    kept = np.flatnonzero(used)
    new = np.cumsum(used) - 1
    first_point = np.searchsorted(kept, np.arange(bands + 1) * points)
    first_triangle = np.searchsorted(band, np.arange(bands + 1))
    slices = [(slice(first_point[k], first_point[k + 1]), slice(first_triangle[k], first_triangle[k + 1]))
              for k in range(bands)]
    return kept % points, new[shifted] - first_point[band][:, None], slices


def insert_polyline_points_at_levels(points: np.ndarray, values: np.ndarray,
                                     levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert points into a polyline where its values, interpolated linearly along each line, cross a level.

    Args:
        points: Coordinates, shape (n, 2).
        values: Values at the points, shape (n,).
        levels: Ascending levels, shape (bands + 1,). Values below the first level belong to the first band, values
            above the last level to the last band.

    Returns:
        The points in order, shape (m, 2), and the band of each line between two neighbours, shape (m - 1,).
    """
    inner = np.asarray(levels, dtype=float)[1:-1]
    low, high = np.minimum(values[:-1], values[1:]), np.maximum(values[:-1], values[1:])
    first = np.searchsorted(inner, low, "right")
    count = np.maximum(np.searchsorted(inner, high, "left") - first, 0)
    line = np.repeat(np.arange(count.size), count)
    step = np.arange(line.size) - np.repeat(np.cumsum(count) - count, count)
    falls = values[1:] < values[:-1]
    crossed = first[line] + np.where(falls[line], count[line] - 1 - step, step)
    fraction = (inner[crossed] - values[line]) / (values[line + 1] - values[line])
    crossings = points[line] + fraction[:, None] * (points[line + 1] - points[line])
    all_points = np.insert(points, line + 1, crossings, axis=0)
    all_values = np.insert(values, line + 1, inner[crossed])
    return all_points, np.searchsorted(inner, np.minimum(all_values[:-1], all_values[1:]), "right")
