"""Knots of a tool's motion at which a test is simulated, and interpolation of the force between the knots.

Also the steps of the finite differences of forward models.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator, make_interp_spline

from tissue_sim.experiment.protocol import Protocol
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segmentation import (
    MOTION_SETTINGS,
    compute_corner_tolerance_of_force,
    find_motion_corners,
)
from tissue_sim.rig.rig import Rig


@dataclass(frozen=True)
class RelativeFiniteDifferenceSteps:
    """Steps of finite differences: a smaller step increases rounding errors, a larger one truncation errors.

    Attributes:
        relative: step of closed forms and readouts, relative to the size of a parameter, to the height of the specimen
            for a contact offset, or to the largest true force for a readout.
        contact_offset: step of the contact offset of a simulated loading curve, as a fraction of the travel. Larger
            than `relative`, because the curve is a spline through few knots.
    """

    relative: float = 1e-6
    contact_offset: float = 1e-3


DIFFERENCES = RelativeFiniteDifferenceSteps()


@dataclass(frozen=True)
class MotionStepSettings:
    """Numbers and sizes of the steps in which a motion is simulated.

    Attributes:
        smooth_steps: smallest number of steps of a smooth force curve. With `smooth_strain` the error of the cubic
            spline is 7e-6 of the largest force between plates and 9e-5 under a flat needle.
        smooth_strain: largest nominal strain of one step of a smooth force curve. A larger value is faster and
            increases the error of the spline.
        sliding_steps: number of steps if tissue slides along the tool or rolls onto it.
        sliding_power: exponent p of the knots d (i/n)^p of a sliding contact: friction is path-dependent, and its first
            part needs shorter steps.
        timed_steps: number of steps per travel of a motion with reversals.
        hold_fraction: largest displacement of a hold as a fraction of the travel: recorded holds have noise and creep.
        first_hold_step: first time step of a hold as a fraction of its duration.
        hold_step_ratio: ratio of successive time steps of a hold.
        creep_step_ratio: ratio of successive time steps while the force is held.
        smooth_degree: degree of the polynomial that smooths a segment of a displacement under force control. A larger
            value follows faster changes and more noise.
        samples_per_degree: smallest number of samples per degree of that polynomial, except for a straight line.
        sudden_step: duration of the loading before a recording that begins under a held force, as a fraction of the
            first sampling interval.
    """

    smooth_steps: int = 8
    smooth_strain: float = 0.018
    sliding_steps: int = 20
    sliding_power: float = 1.5
    timed_steps: int = 20
    hold_fraction: float = 0.01
    first_hold_step: float = 0.01
    hold_step_ratio: float = 1.6
    creep_step_ratio: float = 1.3
    smooth_degree: int = 7
    samples_per_degree: int = 5
    sudden_step: float = 0.01


MOTION_STEPS = MotionStepSettings()
#: Width of the rounded corner of the force at first contact, as a fraction of the depth. The force at first contact is
#: that of a sharp corner at a quarter of this width.
_CORNER_WIDTH = 1e-3


@dataclass(frozen=True, eq=False)
class MonotonicLoading:
    """Monotonic loading of a test whose force depends on depth alone.

    Attributes:
        depth: depth of the knots from 0 on, m, shape (k,).
        speed: typical speed of the recordings, m/s.
    """

    depth: np.ndarray
    speed: float

    @classmethod
    def make_loading_to_depth(cls, depth: float, speed: float, *, smooth: bool,
                              strain: float = 0.0) -> MonotonicLoading:
        """Return a monotonic loading from zero depth to a depth.

        Args:
            depth: largest depth, m.
            speed: speed, m/s.
            smooth: whether the force is a smooth function of depth, so that few equal steps suffice; otherwise the
                steps are shorter near first contact.
            strain: depth divided by the specimen's height.
        """
        if smooth:
            steps = max(MOTION_STEPS.smooth_steps, int(np.ceil(strain / MOTION_STEPS.smooth_strain)))
            return cls(np.linspace(0.0, depth, steps + 1), speed)
        return cls(depth * np.linspace(0.0, 1.0, MOTION_STEPS.sliding_steps + 1)**MOTION_STEPS.sliding_power, speed)

    @property
    def tool_protocol(self) -> Protocol:
        """Motion of the tool: displacement in m at times in s."""
        return Protocol(self.depth / self.speed, self.depth)

    @property
    def counterpart_with_uniform_first_leg_steps(self) -> MonotonicLoading:
        """Copy of this loading with the same depth and the same number of steps, which are equal."""
        return replace(self, depth=np.linspace(self.depth[0], self.depth[-1], self.depth.size))

    def make_coarser_loading_and_kept_knots(self) -> tuple[MonotonicLoading, np.ndarray]:
        """Return a loading with about `MotionStepSettings.smooth_steps` steps.

        The loading serves for quantities that vary more slowly than the force.

        Returns:
            The loading, and the indices of the knots that it keeps.
        """
        last = self.depth.size - 1
        kept = np.unique([*range(0, last, max(last // MOTION_STEPS.smooth_steps, 1)), last])
        return replace(self, depth=self.depth[kept]), kept

    def evaluate_curve_at_knots(self, curve: ForceCurve) -> np.ndarray:
        """Return force and derivatives of a curve at the knots, minus their values at zero depth, shape (k, m)."""
        # The rounded corner makes the force at rest slightly positive; the difference removes this value.
        return curve(None, self.depth, 0.0)[0] - curve(None, self.depth[:1], 0.0)[0]

    def make_force_curve(self, columns: np.ndarray) -> ForceCurve:
        """Return the curve that interpolates values at the knots.

        Args:
            columns: force, N, and its derivatives by the fitted parameters, force first, shape (k, m).
        """
        return _LoadingCurve(self.depth, columns)


class _LoadingCurve:
    """Force and its derivatives as functions of depth; the force is zero before first contact.

    The corner of the force at first contact is rounded, so that the sum of squares is a differentiable function of the
    contact offset also if the offset moves a sample across first contact.

    Args:
        depth: depth of the knots, m, shape (k,).
        columns: force and derivatives at the knots, force first, shape (k, m).
    """

    def __init__(self, depth: np.ndarray, columns: np.ndarray):
        self._end, self._width = depth[-1], _CORNER_WIDTH * depth[-1]
        self._spline = build_cubic_or_linear_spline(depth, columns)
        self._slope = self._spline.derivative()
        self._force = build_cubic_or_linear_spline(depth, columns[:, 0])

    def __call__(self, time: np.ndarray | None, displacement: np.ndarray,
                 offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the curve at samples.

        Args:
            time: unused; the force depends on depth alone.
            displacement: displacement of the samples, m, shape (n,).
            offset: contact offset, m.

        Returns:
            Force and derivatives, shape (n, m), and the derivative of the force with respect to the contact offset,
            N/m, shape (n,).
        """
        inside, simulated, derivative = self._compute_smooth_and_clipped_depth_and_slope(displacement - offset)
        rate = self._slope(simulated)
        # The curve is extrapolated linearly beyond the simulated depth.
        return self._spline(simulated) + rate * (inside - simulated)[:, None], -rate[:, 0] * derivative

    def compute_force_at_contact_offsets(self, time: np.ndarray | None, displacement: np.ndarray,
                                         offsets: np.ndarray) -> np.ndarray:
        """Return the force at samples for several contact offsets, m; shape (n, offsets)."""
        inside, simulated, _ = self._compute_smooth_and_clipped_depth_and_slope(displacement[:, None] - offsets)
        return self._force(simulated) + self._force(self._end, 1) * (inside - simulated)

    def _compute_smooth_and_clipped_depth_and_slope(self,
                                                    depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rounded positive part of a depth, its value limited to the simulated depth, and its derivative.

        The positive part max(d, 0) is replaced by (d + sqrt(d^2 + w^2)) / 2 with the width w of the corner.
        """
        root = np.hypot(depth, self._width)
        inside = 0.5 * (depth + root)
        return inside, np.minimum(inside, self._end), inside / root


@dataclass(frozen=True, eq=False)
class TimedMotion:
    """Recorded motion, approximated by straight segments of displacement over time.

    Attributes:
        time: time of the knots, s, shape (k,).
        displacement: displacement of the knots, m, shape (k,).
        legs: indices of the first and last knot of each straight segment.
        sampled_from: time of the first sample of the recording, s.
        creeping: those of `legs` in which the force is held.
    """

    time: np.ndarray
    displacement: np.ndarray
    legs: tuple[tuple[int, int], ...]
    sampled_from: float
    creeping: tuple[tuple[int, int], ...] = ()

    @classmethod
    def from_recording(cls, time: np.ndarray, displacement: np.ndarray, *, force: np.ndarray | None = None,
                       steps: int = MOTION_STEPS.timed_steps) -> TimedMotion:
        """Return a recorded motion, approximated by straight segments of displacement over time.

        If a recording begins below the surface, its first segment is extrapolated to first contact. Under force control
        the segments are those of the force, and the displacement at the knots is that of a smooth curve through each
        segment, because straight lines through creep with noise have many corners. The first segment is then
        extrapolated to zero force; a recording that begins under a held force has a sudden step before.

        Args:
            time: time of the samples, s, shape (n,).
            displacement: displacement of the samples, m, shape (n,).
            force: force of the samples, N, shape (n,), if the force is controlled; None: the displacement is.
            steps: number of steps per travel.
        """
        travel = float(np.ptp(displacement))
        driven = displacement if force is None else force
        tolerance = MOTION_SETTINGS.straightness * travel if force is None else compute_corner_tolerance_of_force(force)
        held = max(MOTION_STEPS.hold_fraction * float(np.ptp(driven)), 2 * tolerance)
        corners = find_motion_corners(time, driven, tolerance)
        corners = np.array(_find_corners_outside_holds(driven, corners, held))
        is_held = np.abs(np.diff(driven[corners])) <= held
        if force is not None:
            displacement = _smooth_displacement_between_corners(time, displacement, corners, is_held)
        t, d = time[corners].astype(float), displacement[corners].astype(float)
        if d[0] > MOTION_SETTINGS.straightness * travel and d.size > 1 and (d[1] > d[0] or force is not None):
            start, end = driven[corners[:2]].astype(float)
            # A held force does not show the speed of the loading before it.
            shows_speed = force is None or (start > 0 and end - start > held)
            before = start * (t[1] - t[0]) / (end - start) if shows_speed else \
                MOTION_STEPS.sudden_step * float(time[1] - time[0])
            t, d = np.append(t[0] - before, t), np.append(0.0, d)
            is_held = np.append(False, is_held)
        knots_t, knots_d, legs, creeping = [t[:1]], [d[:1]], [], []
        for i in range(t.size - 1):
            change, duration = d[i + 1] - d[i], t[i + 1] - t[i]
            fraction: np.ndarray
            creeps = force is not None and bool(is_held[i])
            if abs(change) > MOTION_STEPS.hold_fraction * travel and not creeps:
                fraction = np.linspace(0.0, 1.0, int(np.ceil(steps * abs(change) / travel - 1e-9)) + 1)[1:]
                # Shorter steps at first contact, as in `MonotonicLoading`: friction is path-dependent.
                fraction = fraction**MOTION_STEPS.sliding_power if i == 0 else fraction
            else:
                ratio = MOTION_STEPS.creep_step_ratio if creeps else MOTION_STEPS.hold_step_ratio
                count = int(np.ceil(np.log1p((ratio - 1) / MOTION_STEPS.first_hold_step) / np.log(ratio)))
                fraction = (ratio ** np.arange(1, count + 1) - 1) / (ratio**count - 1)
            first = sum(part.size for part in knots_t) - 1
            legs.append((first, first + fraction.size))
            knots_t.append(t[i] + fraction * duration)
            knots_d.append(d[i] + fraction * change if force is None or t[i] < time[0] else
                           np.interp(knots_t[-1], time, displacement))
            creeping += [legs[-1]] if creeps else []
        return cls(np.concatenate(knots_t), np.concatenate(knots_d), tuple(legs), float(time[0]), tuple(creeping))

    def is_moving_between_knots(self, first: int, last: int) -> bool:
        """Return whether the tool moves between two knots, given by index; otherwise displacement or force is held."""
        if (first, last) in self.creeping:
            return False
        change = abs(self.displacement[last] - self.displacement[first])
        return bool(change > MOTION_STEPS.hold_fraction * np.ptp(self.displacement))

    def interpolate_displacement(self, time: np.ndarray) -> np.ndarray:
        """Return the displacement at times: straight between the knots, but a monotone cubic while the force is held.

        The force at the knots is interpolated likewise, so that it belongs to the curved motion.

        Args:
            time: s, shape (n,).

        Returns:
            m, shape (n,).
        """
        found = np.interp(time, self.time, self.displacement)
        for first, last in self.creeping:
            inside = (time >= self.time[first]) & (time <= self.time[last])
            part = slice(first, last + 1)
            found[inside] = PchipInterpolator(self.time[part], self.displacement[part])(time[inside])
        return found

    @cached_property
    def tool_protocol(self) -> Protocol:
        """Motion of the tool: displacement in m at times in s from 0 on."""
        return Protocol(self.time - self.time[0], self.displacement)

    @property
    def counterpart_with_uniform_first_leg_steps(self) -> TimedMotion:
        """Copy of this motion with equal steps in its first straight segment; other steps are unchanged."""
        first, last = self.legs[0]
        time, displacement = self.time.copy(), self.displacement.copy()
        for values in (time, displacement):
            values[first:last + 1] = np.linspace(values[first], values[last], last + 1 - first)
        return replace(self, time=time, displacement=displacement)

    def evaluate_curve_at_knots(self, curve: ForceCurve) -> np.ndarray:
        """Return force (first column) and its derivatives of a curve at the knots, shape (k, m)."""
        return curve(self.time, self.displacement, 0.0)[0]

    def has_equal_knots_within_tolerance(self, other: TimedMotion) -> bool:
        """Return whether times and displacements of two motions agree.

        The tolerance is relative, see `MotionSegmentationSettings.straightness`.
        """
        if self.legs != other.legs:
            return False
        tolerance = MOTION_SETTINGS.straightness * np.ptp(self.displacement)
        speed = np.abs(np.diff(self.displacement) / np.diff(self.time)).max()
        return bool(np.abs(self.displacement - other.displacement).max() <= tolerance
                    and np.abs(self.time - self.time[0] - other.time + other.time[0]).max() <= tolerance / speed)

    def make_force_curve(self, columns: np.ndarray, *, position: np.ndarray | None = None,
                         separates: bool = False) -> ForceCurve:
        """Return the curve that interpolates values at the knots, as a function of the recording's time.

        Args:
            columns: force, N, and its derivatives by the fitted parameters, force first, shape (k, m).
            position: true position of the tool at the knots, m, shape (k,); None: the reported displacement.
            separates: whether a tool that retracts past first contact separates from the tissue; otherwise the tissue
                pulls.
        """
        # Holds are no part of a loading curve: their force relaxes at constant displacement.
        labels = np.full(self.time.size, "ramp", dtype="<U4")
        for first, last in self.legs:
            if not self.is_moving_between_knots(first, last):
                labels[first + 1:last + 1] = "hold"
        recording = Recording({"time": self.time, "displacement": self.displacement, "force": columns[:, 0]},
                              labels={"segment": labels})
        return _TimedCurve(self, np.column_stack([columns, compute_force_derivative_by_offset(recording)]),
                           self.displacement if position is None else position, separates)


class _TimedCurve:
    """Force and its derivatives along a recorded motion.

    Args:
        motion: recorded motion with k knots.
        columns: force, its derivatives, and the derivative of the force by the contact offset as the last column,
            shape (k, m + 1).
        position: true position of the tool at the knots, m, shape (k,).
        separates: see `TimedMotion.make_force_curve`.
    """

    def __init__(self, motion: TimedMotion, columns: np.ndarray, position: np.ndarray, separates: bool):
        self._motion, self._size, self._separates = motion, columns.shape[1], separates
        self._position_error = position - motion.displacement
        self._parts = []
        for first, last in motion.legs:
            part = slice(first, last + 1)
            interpolate = build_cubic_or_linear_spline if motion.is_moving_between_knots(first, last) \
                else PchipInterpolator
            self._parts.append(interpolate(motion.time[part], columns[part]))
        self._ends = motion.time[[last for _, last in motion.legs[:-1]]]

    def __call__(self, time: Any, displacement: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the curve at samples.

        Args:
            time: time of the samples, s, shape (n,).
            displacement: displacement of the samples, m, shape (n,).
            offset: contact offset, m.

        Returns:
            Force and derivatives, shape (n, m), and the derivative of the force with respect to the contact offset,
            N/m, shape (n,).
        """
        motion, values = self._motion, np.empty((time.size, self._size))
        leg_of = np.searchsorted(self._ends, time, side="left")
        for number, ((first, last), interpolant) in enumerate(zip(motion.legs, self._parts, strict=True)):
            samples = leg_of == number
            values[samples] = interpolant(np.clip(time[samples], motion.time[first], motion.time[last]))
        rate = values[:, -1]
        # A deviation of the displacement from the motion acts as a contact offset, to first order.
        values[:, 0] += (offset - displacement + motion.interpolate_displacement(time)) * rate
        # The force is zero before first contact, and after separation.
        position = displacement + np.interp(time, motion.time, self._position_error)
        values[((leg_of == 0) | self._separates) & (position < offset)] = 0.0
        return values[:, :-1], values[:, -1]

    def compute_force_at_contact_offsets(self, time: Any, displacement: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Return the force at samples for several contact offsets, m; shape (n, offsets)."""
        return np.column_stack([self(time, displacement, offset)[0][:, 0] for offset in offsets])


#: Force and derivatives as functions of time, displacement and contact offset.
ForceCurve = _LoadingCurve | _TimedCurve


def _find_corners_outside_holds(displacement: np.ndarray, corners: np.ndarray, tolerance: float) -> list[int]:
    """Return the indices of the corners of a motion, without corners inside a hold.

    Args:
        displacement: displacement of the samples, m, shape (n,).
        corners: indices of the samples at corners.
        tolerance: a corner is inside a hold if it and the next corner are this close to the last kept corner, m.
    """
    kept = [int(corners[0])]
    for corner, following in pairwise(corners[1:].tolist()):
        is_hold = np.abs(displacement[[corner, following]] - displacement[kept[-1]]).max() <= tolerance
        if not is_hold:
            kept.append(corner)
    return [*kept, int(corners[-1])]


def _smooth_displacement_between_corners(time: np.ndarray, displacement: np.ndarray, corners: np.ndarray,
                                         is_held: np.ndarray) -> np.ndarray:
    """Return the displacement of a force-controlled recording without noise, m, shape (n,).

    A segment is a polynomial in time, or in the logarithm of time if the force is held.

    Args:
        time: s, shape (n,).
        displacement: m, shape (n,).
        corners: indices of the samples at the ends of the segments, shape (k + 1,).
        is_held: whether the force is held in each segment, shape (k,).
    """
    smooth = displacement.astype(float)
    for first, last, held in zip(corners[:-1].tolist(), corners[1:].tolist(), is_held.tolist(), strict=True):
        part = slice(first, last + 1)
        along = (time[part] - time[first]) / (time[last] - time[first])
        if held:
            along = np.log1p(along / MOTION_STEPS.first_hold_step) / np.log1p(1.0 / MOTION_STEPS.first_hold_step)
        degree = min(MOTION_STEPS.smooth_degree, max((last - first) // MOTION_STEPS.samples_per_degree, 1))
        fitted = np.polynomial.Chebyshev.fit(along, displacement[part], degree, domain=[0.0, 1.0])(along)
        # The first sample of a segment is the last one of the segment before.
        smooth[part] = fitted if first == corners[0] else np.append(0.5 * (smooth[first] + fitted[0]), fitted[1:])
    return smooth


def compute_force_derivative_by_offset(recording: Recording) -> np.ndarray:
    """Return the derivative of the force of a simulated recording with respect to the contact offset, N/m, (n,).

    The force at an offset follows from the loading curve of the recording, see `tissue_sim.rig.rig.Rig`. The one-sided
    second-order difference (3 F(0) - 4 F(-h) + F(-2h)) / (2 h) uses offsets that move the tool into the tissue, since
    the force outside may be zero.
    """
    step = DIFFERENCES.contact_offset * np.ptp(recording.displacement)
    near, far = (Rig(contact_offset=-offset).apply_motion_effects(recording).force for offset in (step, 2 * step))
    return (3 * recording.force - 4 * near + far) / (2 * step)


def build_cubic_or_linear_spline(knots: np.ndarray, values: np.ndarray):
    """Return the cubic spline through values at knots; a piecewise linear spline if there are fewer than four knots.

    Args:
        knots: abscissae, shape (k,).
        values: ordinates, shape (k, ...).
    """
    return CubicSpline(knots, values) if knots.size > 3 else make_interp_spline(knots, values, k=1)
