"""Where the tool first touches a solid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.solid.contact import Body, Nearest, nearest
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.mesh.side_points import SidePoints
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose

#: Steps of a tool on its way down to the tissue, which it has passed where it is so many heights of the mesh below.
_MOST_APPROACHES, _PASSED = 1000, 100.0
#: Each line of a side is looked at in so many points, then between the neighbours of the nearest of these, so often.
_LINE, _ROUNDS = 9, 14
#: How often the tool is lifted off what is still inside of it, or let down again.
_MOST_LIFTS = 30
#: A tool that is lifted goes away from the surface by at least this share of its way.
_LEAST_SLOPE = 1e-2
#: Shares of the height of the mesh: what is nearer touches, in one look and where several have found it. Away from what
#: it touches by the next share a tool whose outline bends by more than `_SHARP` over that height is sharp there.
_SLACK, _FOUND, _AWAY, _SHARP = 1e-12, 1e-10, 1e-6, 1e4


@dataclass(frozen=True)
class Touch:
    """Where a tool comes down on the top of a solid.

    Attributes:
        height: of the scene's origin in the frame of the mesh, m.
        side: number of a side of the top that is touched, -1 where the mesh states none; place: on its square, shape
            (2,). normal: along which they touch, shape (3,).
    """

    height: float
    side: int = -1
    place: np.ndarray | None = None
    normal: np.ndarray | None = None

    def rate(self, mesh: SolidMesh, ways: np.ndarray) -> float:
        """How the height follows the nodes, m per parameter, that go these ways, shape (nodes, 3), where a side is
        touched."""
        assert self.place is not None and self.normal is not None
        side = mesh.faces["top"][[self.side]]
        way = SidePoints(mesh.element, ways[side]).at(np.array([0]), self.place[None, None])[0, 0]
        return float(way @ self.normal / self.normal[2])


def touch(mesh: SolidMesh, places: np.ndarray, bodies: list[Body], start: Pose) -> Touch:
    """Where the tool comes down on the top.

    The surface between the nodes counts. Contact is at the nodes alone, but to measure depths from the first of them
    that a round tool meets would make its force depend on where it stands between them, by several percent.

    Args:
        mesh: of the solid. places: of its nodes, m, shape (nodes, 3).
        bodies: the tool and others. start: of the tool.

    Raises:
        InputError: the tool comes down beside the specimen.
        ConvergenceError: the place was not found.
    """
    moving = [body for body in bodies if body.moves]
    if not moving:
        return Touch(0.0)
    tool = _Tool(moving, start, float(np.ptp(mesh.nodes[:, 2])))
    top = places[mesh.sets["top"]]
    if "top" not in mesh.faces:
        return Touch(tool.met_by(top))
    sides = SidePoints(mesh.element, places[mesh.faces["top"]])
    datum = tool.met_by(np.concatenate([top, sides.middles]))
    # Others cannot be nearer than the first that was met.
    reaches = sides.radii + sides.bulges + _SLACK * tool.scale
    near = np.flatnonzero(tool.gaps(sides.middles, datum) <= reaches)
    heights = sides.lattice[near, :, 2]
    if np.ptp(heights) <= _SLACK * tool.scale:
        # A flat top is met by what is lowest of the tool.
        datum += float(heights.max()) - tool.lowest(datum)
    found = _Found(sides, near, tool, datum)
    if found.is_all:
        return found.touch(datum)
    missed, slope = found.gap, 1.0
    # A secant: over one flat side the distance is a linear function of the height.
    for _ in range(_MOST_LIFTS):
        if abs(missed) <= _FOUND * tool.scale:
            return found.touch(datum)
        lift = -missed / slope
        datum, before = datum + lift, missed
        found = _Found(sides, near, tool, datum)
        missed = found.gap
        slope = max((missed - before) / lift, _LEAST_SLOPE)
    raise ConvergenceError(f"the tool's first touch was not found to better than {abs(missed) * 1e3:.2g} mm; is the "
                           "top of the mesh folded?")


class _Tool:
    """A convex tool whose scene has its origin at a height, `datum`, in the frame of the mesh.

    Args:
        bodies: its parts. start: where it is in the scene. scale: height of the mesh, m.
    """

    def __init__(self, bodies: list[Body], start: Pose, scale: float):
        # Who may meet which part of it does not matter before it touches.
        whole = {id(body.profile): replace(body, first_line=0, closed=False) for body in bodies}
        self._bodies, self._start, self.scale = list(whole.values()), start, scale

    def nearest(self, points: np.ndarray, datum: float) -> list[Nearest]:
        """Of points, m, shape (n, 3), for each part."""
        at = Frame(self._start, datum).into(points)
        return [nearest(body, at, pressed_in=False) for body in self._bodies]

    def gaps(self, points: np.ndarray, datum: float) -> np.ndarray:
        """Distances of points, m, shape (..., 3), from it, shape (...)."""
        found = self.nearest(points.reshape(-1, 3), datum)
        return np.min([each.gap for each in found], axis=0).reshape(points.shape[:-1])

    def normals(self, points: np.ndarray, datum: float) -> np.ndarray:
        """Out of it, where it is nearest to points, shape (n, 3) each, in the frame of the mesh."""
        found = self.nearest(points, datum)
        part = np.argmin([each.gap for each in found], axis=0)
        return np.array([each.normal for each in found])[part, np.arange(len(points))] @ Frame(
            self._start, datum).rotation.T

    def lowest(self, datum: float) -> float:
        """Height of its lowest point in the frame of the mesh, m."""
        frame = Frame(self._start, datum)
        across, up = float(np.hypot(*frame.rotation[2, :2])), float(frame.rotation[2, 2])
        return float(frame.origin[2]) + min(float((body.profile.vertices @ [-across, up]).min()) - body.profile.rounding
                                            for body in self._bodies)

    def is_sharp_at(self, point: np.ndarray, datum: float) -> bool:
        """Whether it has an edge or a tip where it touches a point, shape (3,)."""
        away = datum + _AWAY * self.scale
        best = min(self.nearest(point[None], away), key=lambda each: each.gap[0])
        return float(np.abs(best.curvature[0]).max()) * self.scale > _SHARP

    def met_by(self, points: np.ndarray) -> float:
        """Where it comes down on the first of some points, m, shape (n, 3)."""
        if abs(self.gaps(points, 0.0).min()) < _SLACK * self.scale:
            return 0.0
        from scipy.optimize import brentq

        # A tool that comes down by no more than its distance from the tissue does not pass it.
        high = self.scale + float(points[:, 2].max())
        for _ in range(_MOST_APPROACHES):
            if high < -_PASSED * self.scale:
                break
            low = high - max(float(self.gaps(points, high).min()), 1e-5 * self.scale)
            if self.gaps(points, low).min() <= 0.0:
                return brentq(lambda height: float(self.gaps(points, height).min()), low, high, xtol=1e-15)
            high = low
        raise InputError("the tool comes down beside the specimen, or between all of its nodes; move it, or give a "
                         "finer mesh", field="approach")


class _Found:
    """The point of some sides that is nearest to a tool, or deepest in it.

    On a flat side the distance from a convex tool is a convex function. Where a side can be nearer than the nearest
    point of the lattices, by the plane in which its own nearest one sees the tool, it is searched.

    Args:
        sides: all. near: numbers of those that may be meant. tool, datum: where it is.

    Attributes:
        gap: distance, m. point: m, shape (3,). is_all: whether it touches, and a plane there keeps the tool apart from
            all of the sides: the one in which they touch, or a level one.
    """

    def __init__(self, sides: SidePoints, near: np.ndarray, tool: _Tool, datum: float):
        self._sides, self._tool = sides, tool
        points = sides.lattice[near]
        gaps = tool.gaps(points, datum)
        best = gaps.argmin(axis=1)
        least, rows = gaps.min(axis=1), np.arange(near.size)
        first = int(least.argmin())
        self.gap, self._side, self._place = float(least[first]), int(near[first]), sides.squares[best[first]]
        self.point = points[first, best[first]]
        normals = tool.normals(points[rows, best], datum)
        bounds = least + np.einsum("kqi,ki->kq", points - points[rows, best][:, None], normals).min(axis=1)
        bounds -= sides.bulges[near]
        slack, under = _SLACK * tool.scale, points - self.point
        beyond = (under @ normals[first]).min(axis=1) - sides.bulges[near]
        above = under[..., 2].max(axis=1) + sides.bulges[near]
        self.is_all = abs(self.gap) <= slack and bool(beyond.min() >= -slack or (
            above.max() <= slack and tool.lowest(datum) >= self.point[2] - slack))
        if self.is_all:
            return
        searched = near[bounds < self.gap - _SLACK * tool.scale]
        if searched.size:
            found, place = _least_gaps(sides, searched, tool, datum)
            first = int(found.argmin())
            if found[first] < self.gap:
                self.gap, self._side, self._place = float(found[first]), int(searched[first]), place[first]
                self.point = sides.at(searched[[first]], place[first][None, None])[0, 0]

    def touch(self, datum: float) -> Touch:
        """That it is where they touch. An edge of the tool lies on the surface, a side of it is pressed by what it
        meets."""
        sharp = self._tool.is_sharp_at(self.point, datum)
        normal = (self._sides.normal(self._side, self._place) if sharp
                  else -self._tool.normals(self.point[None], datum)[0])
        return Touch(datum, self._side, self._place, normal)


def _least_gaps(sides: SidePoints, numbers: np.ndarray, tool: _Tool, datum: float) -> tuple[np.ndarray, np.ndarray]:
    """The least distances of sides from the tool, m, shape (k,), and where on their squares they are, shape (k, 2).

    The least along lines of one direction is a convex function of the line, too: both are searched alike.
    """
    def distances(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        squares = np.stack([np.broadcast_to(u[..., None], v.shape), v], axis=-1)
        return tool.gaps(sides.at(numbers, squares.reshape(len(numbers), -1, 2)), datum).reshape(v.shape)

    def along(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _least(lambda v: distances(u, v), u.shape, end)

    end = _SLACK * tool.scale
    found, u = _least(lambda u: along(u)[0], numbers.shape, end)
    _, v = along(u[:, None])
    return found, np.stack([u, v[:, 0]], axis=-1)


def _least(values: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...], end: float
           ) -> tuple[np.ndarray, np.ndarray]:
    """Least values of convex functions between 0 and 1, and where they are, shape `shape`, which are asked for several
    places each, shape (*shape, q); it ends where these no longer differ by more than `end`."""
    low, high = np.zeros(shape), np.ones(shape)
    for _ in range(_ROUNDS):
        line = low[..., None] + (high - low)[..., None] * np.linspace(0.0, 1.0, _LINE)
        found = values(line)
        best = found.argmin(axis=-1)[..., None]
        if np.ptp(found, axis=-1).max() <= end:
            break
        low, high = (np.take_along_axis(line, np.clip(best + way, 0, _LINE - 1), -1)[..., 0] for way in (-1, 1))
    least, place = (np.take_along_axis(array, best, -1)[..., 0] for array in (found, line))
    return least, place
