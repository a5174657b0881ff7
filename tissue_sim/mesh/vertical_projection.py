"""Vertical projection of a surface mesh: distance from the rim of its top, and thickness at a position (x, y)."""

from __future__ import annotations

import numpy as np

#: Tolerance of equal heights, as a fraction of the height of the body.
_FLAT = 1e-6


class VerticalProjection:
    """Vertical projection of the top and of the surface of a body with plane faces.

    Args:
        points: corners, m, shape (n, 3).
        top: faces of the top as numbers of their corners in circumferential order, shape (m, corners).
        base: faces of the base.
        surface: all faces of the surface.

    Attributes:
        is_flat: whether top and base are horizontal planes and the base is the lower one.
    """

    def __init__(self, points: np.ndarray, top: np.ndarray, base: np.ndarray, surface: np.ndarray):
        slack = _FLAT * float(np.ptp(points[:, 2]))
        self.is_flat = bool(np.ptp(points[top, 2]) <= slack and points[base, 2].max() <= points[:, 2].min() + slack)
        self._points = points
        self._top, self._surface = (_split_into_triangles(sides) for sides in (top, surface))
        edges = np.stack([top, np.roll(top, -1, axis=1)], axis=-1).reshape(-1, 2)
        _, first, times = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
        self._rim = edges[first[times == 1]]

    def compute_distance_inside_top_rim(self, x: float, y: float) -> float:
        """Return the horizontal distance from (x, y), m, to the rim of the top, m; negative outside of the top."""
        a, b = self._points[self._rim[:, 0], :2], self._points[self._rim[:, 1], :2]
        position, edge = np.array([x, y]), b - a
        length2 = np.einsum("ei,ei->e", edge, edge)
        fraction = np.clip(np.einsum("ei,ei->e", position - a, edge) / np.where(length2 > 0.0, length2, 1.0), 0.0, 1.0)
        distance = float(np.linalg.norm(a + fraction[:, None] * edge - position, axis=1).min())
        return distance if self._find_crossing_heights(self._top, x, y).size else -distance

    def vertical_thickness(self, x: float, y: float) -> float:
        """Return the height difference of the extreme surface points on the vertical line at (x, y), m; 0 outside."""
        heights = self._find_crossing_heights(self._surface, x, y)
        return float(np.ptp(heights)) if heights.size else 0.0

    @property
    def outer_radius(self) -> float:
        """Largest horizontal distance of the surface from the axis x = y = 0, m."""
        return float(np.hypot(*self._points[np.unique(self._surface), :2].T).max())

    def _find_crossing_heights(self, triangles: np.ndarray, x: float, y: float) -> np.ndarray:
        """Return the heights at which a vertical line meets triangles, m."""
        corners = self._points[triangles]
        a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        is_projected = np.abs(area) > 0.0
        a, u, v, area = a[is_projected], u[is_projected], v[is_projected], area[is_projected]
        dx, dy = x - a[:, 0], y - a[:, 1]
        s, t = (dx * v[:, 1] - dy * v[:, 0]) / area, (u[:, 0] * dy - u[:, 1] * dx) / area
        inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1.0 + 1e-9)
        return (a[:, 2] + s * u[:, 2] + t * v[:, 2])[inside]


def _split_into_triangles(sides: np.ndarray) -> np.ndarray:
    """Return triangles, shape (k, 3), from faces with three or four corners."""
    return sides if sides.shape[1] == 3 else np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
