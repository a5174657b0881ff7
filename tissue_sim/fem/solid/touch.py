"""Where the tool first touches a solid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.solid.contact import Body, nearest
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.mesh.side_points import SidePoints
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose

#: A tool that is so many heights of the mesh below it has passed it.
_PASSED = 100.0
#: Sides of elements that are looked at closely.
_SIDES = 4
#: There each line is looked at in so many points, then between the neighbours of the nearest of these, so often.
_LINE, _ROUNDS = 9, 14
#: How often the tool is lifted off what is still inside of it, or let down again.
_MOST_LIFTS = 20
#: A tool that is lifted goes away from the surface by at least this share of its way.
_LEAST_SLOPE = 1e-2
#: What is nearer than this share of the height of the mesh touches.
_SLACK = 1e-12


def touching_height(mesh: SolidMesh, places: np.ndarray, bodies: list[Body], start: Pose) -> float:
    """Height of the scene's origin in the frame of the mesh where the tool comes down on its top, m.

    The surface between the nodes counts. Contact is at the nodes alone, but to measure depths from the first of them
    that a round tool meets would make its force depend on where it stands between them, by several percent.

    Args:
        mesh: of the solid. places: of its nodes, m, shape (nodes, 3).
        bodies: the tool and others. start: of the tool.

    Raises:
        InputError: the tool comes down beside the specimen.
    """
    moving = [body for body in bodies if body.moves]
    if not moving:
        return 0.0
    tool = _Tool(moving, start, float(np.ptp(mesh.nodes[:, 2])))
    top = places[mesh.sets["top"]]
    datum = tool.met_by(top)
    if "top" not in mesh.faces:
        return datum
    sides = SidePoints(mesh.element, places[mesh.faces["top"]])
    if tool.is_behind_all(sides.lattice.reshape(-1, 3), top, datum):
        return datum

    def least(height: float) -> float:
        """Distance of the surface from the tool, m, below 0 where it is inside."""
        numbers = np.argsort(tool.gaps(sides.lattice, height).min(axis=1), kind="stable")[:_SIDES]
        return _least_gap(sides, numbers, tool, height)

    missed, slope = least(datum), 1.0
    if missed >= 0.0:
        return datum
    # A secant: over one flat side the distance is a linear function of the height.
    for _ in range(_MOST_LIFTS):
        if abs(missed) <= _SLACK * tool.scale:
            break
        lift = -missed / slope
        datum, before = datum + lift, missed
        missed = least(datum)
        slope = max((missed - before) / lift, _LEAST_SLOPE)
    return datum


class _Tool:
    """A convex tool whose scene has its origin at a height, `datum`, in the frame of the mesh.

    Args:
        bodies: its parts. start: where it is in the scene. scale: height of the mesh, m.
    """

    def __init__(self, bodies: list[Body], start: Pose, scale: float):
        self._bodies, self._start, self.scale = bodies, start, scale

    def gaps(self, points: np.ndarray, datum: float) -> np.ndarray:
        """Distances of points, m, shape (..., 3), from it, shape (...)."""
        at = Frame(self._start, datum).into(points.reshape(-1, 3))
        return np.min([nearest(body, at, pressed_in=False).gap for body in self._bodies],
                      axis=0).reshape(points.shape[:-1])

    def is_behind_all(self, surface: np.ndarray, points: np.ndarray, datum: float) -> bool:
        """Whether the plane in which it touches the nearest of some points, shape (n, 3), keeps it apart from all
        points of a surface, m, shape (m, 3)."""
        frame = Frame(self._start, datum)
        touched = points[[self.gaps(points, datum).argmin()]]
        found = [nearest(body, frame.into(touched), pressed_in=False) for body in self._bodies]
        normal = frame.rotation @ min(found, key=lambda each: each.gap[0]).normal[0]
        return bool(((surface - touched) @ normal).min() >= -_SLACK * self.scale)

    def met_by(self, points: np.ndarray) -> float:
        """Where it comes down on the first of some points, m, shape (n, 3)."""
        if abs(self.gaps(points, 0.0).min()) < _SLACK * self.scale:
            return 0.0
        # A tool that comes down by no more than its distance from the tissue does not pass it.
        high = self.scale + float(points[:, 2].max())
        while high > -_PASSED * self.scale:
            low = high - max(float(self.gaps(points, high).min()), 1e-5 * self.scale)
            if self.gaps(points, low).min() <= 0.0:
                return self._touching(points, low, high)
            high = low
        raise InputError("the tool comes down beside the specimen; move it", field="approach")

    def _touching(self, points: np.ndarray, low: float, high: float) -> float:
        from scipy.optimize import brentq

        return brentq(lambda height: float(self.gaps(points, height).min()), low, high, xtol=1e-15)


def _least_gap(sides: SidePoints, numbers: np.ndarray, tool: _Tool, datum: float) -> float:
    """The least distance of some sides from the tool, m.

    On a flat side the distance from a convex tool is a convex function, and so is its least along lines of one
    direction as a function of the line: both are searched alike.
    """
    def distances(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        squares = np.stack([np.broadcast_to(u[..., None], v.shape), v], axis=-1)
        return tool.gaps(sides.at(numbers, squares.reshape(len(numbers), -1, 2)), datum).reshape(v.shape)

    end = _SLACK * tool.scale
    return float(_least(lambda u: _least(lambda v: distances(u, v), u.shape, end), numbers.shape, end).min())


def _least(values: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...], end: float) -> np.ndarray:
    """Least values of convex functions between 0 and 1, shape `shape`, which are asked for several places each, shape
    (*shape, q); it ends where these no longer differ by more than `end`."""
    low, high = np.zeros(shape), np.ones(shape)
    for _ in range(_ROUNDS):
        line = low[..., None] + (high - low)[..., None] * np.linspace(0.0, 1.0, _LINE)
        found = values(line)
        best = found.argmin(axis=-1)[..., None]
        if np.ptp(found, axis=-1).max() <= end:
            break
        low, high = (np.take_along_axis(line, np.clip(best + way, 0, _LINE - 1), -1)[..., 0] for way in (-1, 1))
    return np.take_along_axis(found, best, -1)[..., 0]
