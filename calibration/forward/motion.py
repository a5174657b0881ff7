"""The few points of a tool's motion at which a test is simulated, and the samples of its recordings between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator, make_interp_spline

from tissue_sim.experiment.protocol import Protocol
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segmentation import STRAIGHT, corners_of
from tissue_sim.rig.rig import Rig

#: Where the force is smooth: fewest steps to the largest depth, and largest nominal strain of one. A cubic through them
#: errs by 7e-6 of the largest force between plates and by 9e-5 under a flat needle.
SMOOTH_STEPS, SMOOTH_STRAIN = 8, 0.018
#: Steps where tissue slides or rolls onto the tool, and how they grow: knots at shares^power of the depth. Friction
#: remembers its way, and its first part needs the shorter steps.
SLIDING_STEPS, SLIDING_POWER = 20, 1.5
#: Steps of a motion in several directions, to its travel.
TIMED_STEPS = 20
#: Straight parts shorter than this share of the travel are holds, which tremble and creep.
HELD = 0.01
#: Of a hold: the first step as a part of it, and how much longer each step is than the one before.
_HOLD_FIRST, _HOLD_GROWTH = 0.01, 1.6
#: Rounding of the corner of the force at the touch, as a part of the depth: it raises the force there by what it is
#: after a quarter of this.
_TOUCH_WIDTH = 1e-3
#: Width of a difference with the contact offset, as a part of the travel.
_OFFSET_WIDTH = 1e-3


@dataclass(frozen=True, eq=False)
class Loading:
    """A test in which force depends on depth alone: one way in, at any speed.

    Attributes:
        depth: of the knots, from 0, m, shape (k,). speed: m/s, typical of the recordings.
    """

    depth: np.ndarray
    speed: float

    @classmethod
    def to(cls, depth: float, speed: float, *, smooth: bool, strain: float = 0.0) -> Loading:
        """Knots from rest to `depth`, m; few where the force is `smooth`, closer at the touch where it is not.

        Args:
            depth: m. speed: m/s. strain: depth over the height of the specimen.
        """
        if smooth:
            steps = max(SMOOTH_STEPS, int(np.ceil(strain / SMOOTH_STRAIN)))
            return cls(np.linspace(0.0, depth, steps + 1), speed)
        return cls(depth * np.linspace(0.0, 1.0, SLIDING_STEPS + 1)**SLIDING_POWER, speed)

    @property
    def protocol(self) -> Protocol:
        return Protocol(self.depth / self.speed, self.depth)

    @property
    def even(self) -> Loading:
        """The same way in even steps."""
        return replace(self, depth=np.linspace(self.depth[0], self.depth[-1], self.depth.size))

    def with_fewer_steps(self) -> tuple[Loading, np.ndarray]:
        """The same way in about `SMOOTH_STEPS` steps, for what changes more slowly than the force, and the numbers of
        the knots that it keeps."""
        last = self.depth.size - 1
        kept = np.unique([*range(0, last, max(last // SMOOTH_STEPS, 1)), last])
        return replace(self, depth=self.depth[kept]), kept

    def at_knots(self, course: Course) -> np.ndarray:
        """A course at the knots, shape (k, m)."""
        # The rounded touch would leave something at rest.
        return course(None, self.depth, 0.0)[0] - course(None, self.depth[:1], 0.0)[0]

    def through(self, columns: np.ndarray) -> Course:
        """The course of force and what else belongs to it, given at the knots, shape (k, m)."""
        return _LoadingCourse(self.depth, columns)


class _LoadingCourse:
    """Force, and what else belongs to it, along a loading. Nothing is felt before the touch.

    The corner there is rounded, so that an offset which lets a sample pass it to and fro still has a best value.
    """

    def __init__(self, depth: np.ndarray, columns: np.ndarray):
        self._end, self._width = depth[-1], _TOUCH_WIDTH * depth[-1]
        self._spline = spline(depth, columns)
        self._slope = self._spline.derivative()
        self._force = spline(depth, columns[:, 0])

    def __call__(self, time: np.ndarray | None, displacement: np.ndarray,
                 offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Columns at samples, shape (n, m), and the derivative of the first with the contact offset, shape (n,).

        Args:
            time: s, displacement: m, of the samples, shape (n,). offset: m.
        """
        inside, known, share = self._inside(displacement - offset)
        rate = self._slope(known)
        # Beyond what was simulated the curve goes on straight.
        return self._spline(known) + rate * (inside - known)[:, None], -rate[:, 0] * share

    def forces(self, time: np.ndarray | None, displacement: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """The first column at these contact offsets, m, shape (n, offsets)."""
        inside, known, _ = self._inside(displacement[:, None] - offsets)
        return self._force(known) + self._force(self._end, 1) * (inside - known)

    def _inside(self, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth in the tissue, the part of it that was simulated, and its derivative with `depth`."""
        root = np.hypot(depth, self._width)
        inside = 0.5 * (depth + root)
        return inside, np.minimum(inside, self._end), inside / root


@dataclass(frozen=True, eq=False)
class Timed:
    """A motion in time, as it was recorded.

    Attributes:
        time, displacement: of the knots, s and m, shape (k,). legs: first and last knot of each straight part.
        sampled_from: time of the first sample of the recording whose motion it is, s.
    """

    time: np.ndarray
    displacement: np.ndarray
    legs: tuple[tuple[int, int], ...]
    sampled_from: float

    @classmethod
    def of(cls, time: np.ndarray, displacement: np.ndarray, *, steps: int = TIMED_STEPS) -> Timed:
        """Knots of a recorded motion, shapes (n,): its straight parts, in steps of 1/`steps` of the travel.

        The time of the touch is extrapolated where the recording starts below it.
        """
        travel = float(np.ptp(displacement))
        corners = corners_of(time, displacement, STRAIGHT * travel)
        corners = np.array(_without_trembling(displacement, corners, HELD * travel))
        t, d = time[corners].astype(float), displacement[corners].astype(float)
        if d[0] > STRAIGHT * travel and d.size > 1 and d[1] > d[0]:
            t, d = np.append(t[0] - d[0] * (t[1] - t[0]) / (d[1] - d[0]), t), np.append(0.0, d)
        knots_t, knots_d, legs = [t[:1]], [d[:1]], []
        for i in range(t.size - 1):
            way, duration = d[i + 1] - d[i], t[i + 1] - t[i]
            share: np.ndarray
            if abs(way) > HELD * travel:
                share = np.linspace(0.0, 1.0, int(np.ceil(steps * abs(way) / travel - 1e-9)) + 1)[1:]
                # From the touch as in `Loading`: friction remembers its first part.
                share = share**SLIDING_POWER if i == 0 else share
            else:
                count = int(np.ceil(np.log1p((_HOLD_GROWTH - 1) / _HOLD_FIRST) / np.log(_HOLD_GROWTH)))
                share = (_HOLD_GROWTH ** np.arange(1, count + 1) - 1) / (_HOLD_GROWTH**count - 1)
            first = sum(part.size for part in knots_t) - 1
            legs.append((first, first + share.size))
            knots_t.append(t[i] + share * duration)
            knots_d.append(d[i] + share * way)
        return cls(np.concatenate(knots_t), np.concatenate(knots_d), tuple(legs), float(time[0]))

    def moves(self, first: int, last: int) -> bool:
        """Whether the tool moves between two knots, and does not hold."""
        way = abs(self.displacement[last] - self.displacement[first])
        return bool(way > HELD * np.ptp(self.displacement))

    @cached_property
    def protocol(self) -> Protocol:
        return Protocol(self.time - self.time[0], self.displacement)

    @property
    def even(self) -> Timed:
        """The same motion with even steps from the touch."""
        first, last = self.legs[0]
        time, displacement = self.time.copy(), self.displacement.copy()
        for values in (time, displacement):
            values[first:last + 1] = np.linspace(values[first], values[last], last + 1 - first)
        return replace(self, time=time, displacement=displacement)

    def at_knots(self, course: Course) -> np.ndarray:
        """A course at the knots, shape (k, m)."""
        return course(self.time, self.displacement, 0.0)[0]

    def like(self, other: Timed) -> bool:
        """Whether it is the same motion, within what is straight."""
        if self.legs != other.legs:
            return False
        near = STRAIGHT * np.ptp(self.displacement)
        speed = np.abs(np.diff(self.displacement) / np.diff(self.time)).max()
        return bool(np.abs(self.displacement - other.displacement).max() <= near
                    and np.abs(self.time - self.time[0] - other.time + other.time[0]).max() <= near / speed)

    def through(self, columns: np.ndarray, *, place: np.ndarray | None = None, leaves: bool = False) -> Course:
        """As `Loading.through`; times are those of the clock of the recording whose motion it is.

        Args:
            columns: as there. place: of the tool at the knots, m, where a rig takes it elsewhere.
            leaves: whether a tool that goes back past its touch leaves the tissue; else it pulls.
        """
        # What creeps or trembles in a hold is no loading curve: the force falls there while the tool stays.
        labels = np.full(self.time.size, "ramp", dtype="<U4")
        for first, last in self.legs:
            if not self.moves(first, last):
                labels[first + 1:last + 1] = "hold"
        recording = Recording({"time": self.time, "displacement": self.displacement, "force": columns[:, 0]},
                              labels={"segment": labels})
        return _TimedCourse(self, np.column_stack([columns, offset_rate(recording)]),
                            self.displacement if place is None else place, leaves)


class _TimedCourse:
    """As `_LoadingCourse`, along a motion in time; the last column is the derivative of the force with the offset."""

    def __init__(self, motion: Timed, columns: np.ndarray, place: np.ndarray, leaves: bool):
        self._motion, self._size, self._leaves = motion, columns.shape[1], leaves
        self._away = place - motion.displacement
        self._parts = []
        for first, last in motion.legs:
            part = slice(first, last + 1)
            interpolate = spline if motion.moves(first, last) else PchipInterpolator
            self._parts.append(interpolate(motion.time[part], columns[part]))
        self._ends = motion.time[[last for _, last in motion.legs[:-1]]]

    def __call__(self, time, displacement, offset):
        motion, values = self._motion, np.empty((time.size, self._size))
        leg_of = np.searchsorted(self._ends, time, side="left")
        for number, ((first, last), interpolant) in enumerate(zip(motion.legs, self._parts, strict=True)):
            mine = leg_of == number
            values[mine] = interpolant(np.clip(time[mine], motion.time[first], motion.time[last]))
        rate = values[:, -1]
        # Where the tool was a little off the straight lines, it was as if the touch were elsewhere.
        values[:, 0] += (offset - displacement + np.interp(time, motion.time, motion.displacement)) * rate
        # Nothing is felt before the first touch, nor by a tool that has left.
        place = displacement + np.interp(time, motion.time, self._away)
        values[((leg_of == 0) | self._leaves) & (place < offset)] = 0.0
        return values[:, :-1], values[:, -1]

    def forces(self, time, displacement, offsets):
        return np.column_stack([self(time, displacement, offset)[0][:, 0] for offset in offsets])


Course = _LoadingCourse | _TimedCourse


def _without_trembling(displacement: np.ndarray, corners: np.ndarray, reach: float) -> list[int]:
    """Corners of a motion without those inside a hold: where neighbours on either side stay within `reach` of it."""
    kept = [int(corners[0])]
    for here, after in pairwise(corners[1:].tolist()):
        still = np.abs(displacement[[here, after]] - displacement[kept[-1]]).max() <= reach
        if not still:
            kept.append(here)
    return [*kept, int(corners[-1])]


def offset_rate(recording: Recording) -> np.ndarray:
    """d(force)/d(contact offset) of a simulated recording, N/m, shape (n,), by its loading curve and what history has
    made of it; into the tissue, because out of it there may be none at the touch."""
    width = _OFFSET_WIDTH * np.ptp(recording.displacement)
    near, far = (Rig(contact_offset=-offset).apply(recording).force for offset in (width, 2 * width))
    return (3 * recording.force - 4 * near + far) / (2 * width)


def spline(knots: np.ndarray, values: np.ndarray):
    """Through values at knots, shapes (k,) and (k, ...): a cubic, straight lines where there are few."""
    return CubicSpline(knots, values) if knots.size > 3 else make_interp_spline(knots, values, k=1)
