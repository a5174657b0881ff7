"""The few points of a tool's motion at which a test is simulated, and the samples of its recordings between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tissue_sim.protocol import Protocol

#: Steps of a way as long as the largest depth; of a pointed tool they grow with the power of the depth.
LOADING_STEPS, POINTED_POWER = 20, 1.5
#: A recorded motion is made of straight lines within this part of its travel.
STRAIGHT = 3e-3
#: Of a hold: the first step as a part of it, and how much longer each step is than the one before.
_HOLD_FIRST, _HOLD_GROWTH = 0.01, 1.6


@dataclass(frozen=True, eq=False)
class Loading:
    """A test in which force depends on depth alone: one way in, at any speed.

    Attributes:
        depth: of the knots, from 0, m, shape (k,). speed: m/s, typical of the recordings.
    """

    depth: np.ndarray
    speed: float

    @classmethod
    def to(cls, depth: float, speed: float, *, pointed: bool, steps: int = LOADING_STEPS) -> Loading:
        """Knots from rest to `depth`, m; closer at the touch for a tool that is `pointed`."""
        share = np.linspace(0.0, 1.0, steps + 1)
        return cls(depth * (share**POINTED_POWER if pointed else share), speed)

    @property
    def protocol(self) -> Protocol:
        return Protocol(self.depth / self.speed, self.depth)

    @property
    def coarse(self) -> np.ndarray:
        """Every other knot, the last included: enough for a difference of two meshes."""
        return np.unique([*range(0, self.depth.size, 2), self.depth.size - 1])

    def spread(self, values: np.ndarray, knots: np.ndarray) -> np.ndarray:
        """Values at some knots, shape (j, ...), interpolated to all, shape (k, ...)."""
        return _spline(self.depth[knots], values)(self.depth)

    def evaluate(self, columns: np.ndarray, time: np.ndarray | None, displacement: np.ndarray,
                 offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Columns at samples when the tool touches at `offset`, and the derivative of the first with the offset.

        Args:
            columns: force and what else belongs to it at the knots, shape (k, m).
            time: not needed. displacement: of the samples, m, shape (n,). offset: m.

        Returns:
            Shapes (n, m) and (n,); nothing is felt before the touch.
        """
        depth = displacement - offset
        spline = _spline(self.depth, columns)
        touched = (depth > 0.0)[:, None]
        inside = np.maximum(depth, 0.0)
        slope = spline(inside, 1)[:, 0]
        return np.where(touched, spline(inside), 0.0), -np.where(touched[:, 0], slope, 0.0)


@dataclass(frozen=True, eq=False)
class Timed:
    """A test whose force depends on how the tool came there.

    Attributes:
        time, displacement: of the knots, s and m, shape (k,). legs: first and last knot of each straight part.
        sampled_from: time of the first sample of the recording whose motion it is, s.
    """

    time: np.ndarray
    displacement: np.ndarray
    legs: tuple[tuple[int, int], ...]
    sampled_from: float

    @classmethod
    def of(cls, time: np.ndarray, displacement: np.ndarray, *, steps: int = LOADING_STEPS) -> Timed:
        """Knots of a recorded motion, shapes (n,): its straight parts, in steps of 1/`steps` of the travel.

        The time of the touch is extrapolated where the recording starts below it.
        """
        travel = float(np.ptp(displacement))
        corners = _corners(time, displacement, STRAIGHT * travel)
        t, d = time[corners].astype(float), displacement[corners].astype(float)
        if d[0] > STRAIGHT * travel and d.size > 1 and d[1] > d[0]:
            t, d = np.append(t[0] - d[0] * (t[1] - t[0]) / (d[1] - d[0]), t), np.append(0.0, d)
        knots_t, knots_d, legs = [t[:1]], [d[:1]], []
        for i in range(t.size - 1):
            way, duration = d[i + 1] - d[i], t[i + 1] - t[i]
            if abs(way) > 2 * STRAIGHT * travel:
                share = np.linspace(0.0, 1.0, int(np.ceil(steps * abs(way) / travel - 1e-9)) + 1)[1:]
            else:
                count = int(np.ceil(np.log1p((_HOLD_GROWTH - 1) / _HOLD_FIRST) / np.log(_HOLD_GROWTH)))
                share = (_HOLD_GROWTH ** np.arange(1, count + 1) - 1) / (_HOLD_GROWTH**count - 1)
            first = sum(part.size for part in knots_t) - 1
            legs.append((first, first + share.size))
            knots_t.append(t[i] + share * duration)
            knots_d.append(d[i] + share * way)
        return cls(np.concatenate(knots_t), np.concatenate(knots_d), tuple(legs), float(time[0]))

    @cached_property
    def protocol(self) -> Protocol:
        return Protocol(self.time - self.time[0], self.displacement)

    @property
    def coarse(self) -> np.ndarray:
        """All knots: the way between them matters."""
        return np.arange(self.time.size)

    def spread(self, values: np.ndarray, knots: np.ndarray) -> np.ndarray:
        """Values at all knots, as they are."""
        return values

    def like(self, other: Timed) -> bool:
        """Whether it is the same motion, within what is straight."""
        if self.legs != other.legs:
            return False
        near = STRAIGHT * np.ptp(self.displacement)
        return bool(np.abs(self.displacement - other.displacement).max() <= near
                    and np.abs(self.time - self.time[0] - other.time + other.time[0]).max()
                    <= STRAIGHT * np.ptp(self.time))

    def evaluate(self, columns: np.ndarray, time: np.ndarray, displacement: np.ndarray,
                 offset: float) -> tuple[np.ndarray, np.ndarray]:
        """As `Loading.evaluate`; the last column is the derivative of the force with the offset, and is taken away.

        Args:
            columns: shape (k, m + 1). time: s, since the start of the motion is that of the knots, shape (n,).
        """
        values = np.empty((time.size, columns.shape[1]))
        ends = self.time[[last for _, last in self.legs[:-1]]]
        leg_of = np.searchsorted(ends, time, side="left")
        travel = np.ptp(self.displacement)
        for number, (first, last) in enumerate(self.legs):
            mine, part = leg_of == number, slice(first, last + 1)
            moving = abs(self.displacement[last] - self.displacement[first]) > 2 * STRAIGHT * travel
            clipped = np.clip(time[mine], self.time[first], self.time[last])
            values[mine] = (_spline if moving else _monotone)(self.time[part], columns[part])(clipped)
        return values[:, :-1] + offset * np.eye(1, columns.shape[1] - 1) * values[:, -1:], values[:, -1]


def label_segments(time: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Names of the straight parts of a motion, one a sample: ``ramp``, ``hold``, ``unload``; shapes (n,)."""
    travel = np.ptp(displacement)
    corners = _corners(time, displacement, STRAIGHT * travel)
    way = np.diff(displacement[corners])
    names = np.where(np.abs(way) <= 2 * STRAIGHT * travel, "hold", np.where(way > 0, "ramp", "unload"))
    return names[np.clip(np.searchsorted(corners, np.arange(time.size), side="left") - 1, 0, names.size - 1)]


def _spline(knots: np.ndarray, values: np.ndarray):
    from scipy.interpolate import CubicSpline, make_interp_spline

    return CubicSpline(knots, values) if knots.size > 3 else make_interp_spline(knots, values, k=1)


def _monotone(knots: np.ndarray, values: np.ndarray):
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(knots, values)


def _corners(time: np.ndarray, displacement: np.ndarray, tolerance: float) -> np.ndarray:
    """Samples between which the motion is straight within `tolerance`, m.

    Source: Douglas and Peucker, Cartographica 10 (1973) 112.
    """
    keep = {0, time.size - 1}
    parts = [(0, time.size - 1)]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        inside = slice(first + 1, last)
        line = np.interp(time[inside], time[[first, last]], displacement[[first, last]])
        gap = np.abs(displacement[inside] - line)
        farthest = int(np.argmax(gap))
        if gap[farthest] > tolerance:
            middle = first + 1 + farthest
            keep.add(middle)
            parts += [(first, middle), (middle, last)]
    return np.array(sorted(keep))
