"""Collect the samples of one motion, and convert them to a recording and a contact point.

The sampling times of the sensor are reconstructed from sequence numbers and arrival times. The path of the stage
between its polls is interpolated with a bound on the error of the position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from haptics.devices.contracts import ForceSample, SampleStatus, StageSample
from haptics.recorder.guarded_motion import StoppedError
from haptics.recorder.plan import BenchTestPlan
from haptics.safety.motion_guard import StopReason
from tissue_sim import Recording
from tissue_sim.recording.contact import find_contact


@dataclass(frozen=True)
class SampleClockSettings:
    """Tolerances of the fit of a `SampleClock`, and number of intervals of a long run.

    Attributes:
        rate_tolerance: largest relative error that is assumed for the clock of a device, 1. A larger value lets late
            arrivals at the ends of a short run change the period.
        late_arrival: largest difference over a whole run that late arrivals explain, s. Above this value the rate that
            the device states is rejected and the rate of the arrivals is used.
        stretches: number of intervals that a long run is divided into; the convex hull uses the earliest sample of
            each. A larger value costs time and changes the line little.
    """

    rate_tolerance: float = 1e-3
    late_arrival: float = 0.1
    stretches: int = 2000


#: Settings of every fit.
_CLOCK = SampleClockSettings()


@dataclass(frozen=True)
class SampleClock:
    """Linear model of the sampling times: time = first + period * number, up to a latency common to all samples.

    A sample arrives after its sampling time: some samples arrive at once, many arrive late. The line is therefore a
    lower bound of the arrivals, and among the lower bounds the one with the smallest mean distance: the edge of the
    lower convex hull over the mean sample number.

    Attributes:
        first: time of sample number 0, s.
        period: time between two samples, s.
        jitter: median delay of the arrivals behind the line, s.
        fits: whether the rate stated by the device agrees with the arrivals. If not, `period` is measured from the
            arrivals.
    """

    first: float
    period: float
    jitter: float
    fits: bool

    @classmethod
    def fit_to_arrivals(cls, numbers: Sequence[int] | np.ndarray, received: Sequence[float] | np.ndarray,
                        period: float) -> SampleClock:
        """Fit the line to the arrivals of a run.

        Args:
            numbers: increasing sequence numbers of the samples, shape (n,).
            received: arrival times, s, shape (n,).
            period: sampling period that the device states, s. The fit changes this period by at most 0.1 %, unless the
                difference adds up to more than 0.1 s over the run; then the period of the arrivals is used.

        Returns:
            The fitted line. Without samples: first = 0 and the stated period.
        """
        fits = True
        number, arrival = np.asarray(numbers, dtype=float), np.asarray(received, dtype=float)
        if number.size == 0:
            return cls(0.0, period, 0.0, True)
        hull: list[int] = []
        for index in _preselect_hull_candidates(arrival - period * number):
            while len(hull) > 1 and _is_above_chord(number, arrival, hull[-2], hull[-1], index):
                hull.pop()
            hull.append(index)
        middle = number.mean()
        edges = [(a, b) for a, b in pairwise(hull) if number[a] <= middle <= number[b]]
        if edges:
            a, b = edges[0]
            slope = float((arrival[b] - arrival[a]) / (number[b] - number[a]))
            tolerance = _CLOCK.rate_tolerance
            nearest = min(max(slope, (1 - tolerance) * period), (1 + tolerance) * period)
            # Late arrivals explain a bounded difference; a wrong rate gives a difference that grows with the run.
            fits = abs(slope - nearest) * (number[-1] - number[0]) <= _CLOCK.late_arrival
            period = nearest if fits else slope
        first = float((arrival - period * number).min())
        return cls(first, period, float(np.median(arrival - first - period * number)), fits)

    def compute_times(self, numbers: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the sampling times, s, shape (n,), of samples by their sequence numbers.

        Args:
            numbers: sequence numbers, shape (n,).
        """
        return self.first + self.period * np.asarray(numbers, dtype=float)


def _preselect_hull_candidates(delay: np.ndarray) -> list[int]:
    """Return increasing indices of the samples from which the lower convex hull is made; thins out a long run.

    Args:
        delay: arrival time less period * number, s, shape (n,).

    Returns:
        All indices of a short run; of a long run the earliest sample of each stretch.
    """
    stretches = _CLOCK.stretches
    if delay.size <= 2 * stretches:
        return list(range(delay.size))
    edges = np.linspace(0, delay.size, stretches + 1).astype(int)
    return [int(start + np.argmin(delay[start:end])) for start, end in pairwise(edges)]


def _is_above_chord(x: np.ndarray, y: np.ndarray, a: int, b: int, c: int) -> bool:
    """Return whether point b lies on or above the chord from point a to point c."""
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))


@dataclass(frozen=True)
class StagePositionTolerances:
    """Tolerances of the stage position: a force sample is recorded only if the error bound of its position is smaller.

    Attributes:
        tolerance: largest bound on the position error, as a fraction of the largest depth of the motion, 1. A larger
            value keeps samples whose position is wrong after a late answer of the stage; a smaller one leaves out
            samples at the reversals of fast motions.
        least_tolerance: smallest permitted bound, m: resolution and rounding of common stages.
    """

    tolerance: float = 0.01
    least_tolerance: float = 5e-6


#: Settings of every recording.
SETTINGS = StagePositionTolerances()


@dataclass(frozen=True)
class StagePoll:
    """Position of the stage from one poll, and the time interval in which the position was read.

    Attributes:
        earliest: earliest time at which the position can have been read, s.
        latest: latest time at which the position can have been read, s.
        position: m.
    """

    earliest: float
    latest: float
    position: float

    @property
    def middle_time(self) -> float:
        """Mean of the earliest and the latest time, s; the best estimate of the time of reading."""
        return 0.5 * (self.earliest + self.latest)


class StagePath:
    """Linear interpolation between the polls of a motion, and a bound on its error.

    The stage moves at most at the commanded speed v(t). With the travel s(t) = integral of v dt, a position p that was
    read between the times a and b bounds the position x(t) of a stage by

        |x(t) - p| <= s(t) - s(a)  for t >= b,    |x(t) - p| <= s(b) - s(t)  for t <= a.

    The intersection of these intervals over all polls contains x(t). The bound on the error is the larger distance of
    the interpolated position from the ends of the intersection. It is zero in uniform motion with exact times, and it
    is large where the stage may have rested or reversed between two polls, or where an answer was late.

    Args:
        polls: polls in the order of their times, at least one.
        changes: times at which the commanded speed changes, s, increasing, shape (n,).
        speeds: commanded speed before the first change and after each change, m/s, shape (n + 1,); 0 at rest.
    """

    def __init__(self, polls: Sequence[StagePoll], changes: Sequence[float], speeds: Sequence[float]):
        self._earliest = np.array([poll.earliest for poll in polls])
        self._latest = np.array([poll.latest for poll in polls])
        self._times = np.array([poll.middle_time for poll in polls])
        self._positions = np.array([poll.position for poll in polls])
        self._changes = np.array(changes, dtype=float)
        self._speeds = np.array(speeds, dtype=float)
        begun, ended = self._integrate_commanded_speed(self._earliest), self._integrate_commanded_speed(self._latest)
        position = self._positions
        # Row i holds the bounds of the first i polls (before), and of the polls from i on (after), without s(t).
        none = np.array([np.inf])
        self._upper_before = np.minimum.accumulate(np.concatenate([none, position - begun]))
        self._lower_before = np.maximum.accumulate(np.concatenate([-none, position + begun]))
        self._upper_after = np.minimum.accumulate(np.concatenate([none, (position + ended)[::-1]]))[::-1]
        self._lower_after = np.maximum.accumulate(np.concatenate([-none, (position - ended)[::-1]]))[::-1]

    def _integrate_commanded_speed(self, times: np.ndarray) -> np.ndarray:
        """Return the integral of the commanded speed from its first change to each time, m; negative before it."""
        if self._changes.size == 0:
            return self._speeds[0] * times
        knots = np.concatenate([[0.0], np.cumsum(self._speeds[1:-1] * np.diff(self._changes))])
        index = np.searchsorted(self._changes, times, side="right")
        start = np.maximum(index - 1, 0)
        return knots[start] + self._speeds[index] * (times - self._changes[start])

    def interpolate_position(self, times: np.ndarray) -> np.ndarray:
        """Return the position of the stage, m, shape (n,).

        Args:
            times: s, shape (n,); before the first and after the last poll the nearest position is returned.
        """
        return np.interp(times, self._times, self._positions)

    def compute_position_error_bound(self, times: np.ndarray) -> np.ndarray:
        """Return a bound on the error of `interpolate_position`, m, shape (n,); infinite before and after all polls.

        Args:
            times: s, shape (n,).
        """
        travel, position = self._integrate_commanded_speed(times), self.interpolate_position(times)
        before = np.searchsorted(self._latest, times, side="right")
        after = np.searchsorted(self._earliest, times, side="left")
        upper = np.minimum(self._upper_before[before] + travel, self._upper_after[after] - travel)
        lower = np.maximum(self._lower_before[before] - travel, self._lower_after[after] + travel)
        outside = (times < self._times[0]) | (times > self._times[-1])
        return np.where(outside, np.inf, np.maximum(np.abs(upper - position), np.abs(position - lower)))

    def find_known_position_mask(self, times: np.ndarray, depth: float) -> np.ndarray:
        """Return for each time whether the error bound of the position is within the tolerance, bool, shape (n,).

        Args:
            times: s, shape (n,).
            depth: largest depth of the motion, m.
        """
        return self.compute_position_error_bound(times) <= compute_position_tolerance_for_depth(depth)


def compute_position_tolerance_for_depth(depth: float) -> float:
    """Return the largest permitted bound on the position error, m, for a motion with the largest depth `depth`, m."""
    return max(SETTINGS.tolerance * abs(depth), SETTINGS.least_tolerance)


@dataclass(frozen=True)
class ContactPointSettings:
    """Settings of the contact point estimate `estimate_contact_point_and_metadata`.

    Attributes:
        loaded: fraction of the contact force above which a sample belongs to the straight line, 1.
        signal_to_noise: smallest ratio of the contact force to the standard deviation of the unloaded samples, 1.
            Below this value the straight line is not used.
        most_samples: largest number of samples in the search; a longer approach is thinned out.
        fewest_samples: smallest number of samples of the search, and of the straight line.
    """

    loaded: float = 0.3
    signal_to_noise: float = 10.0
    most_samples: int = 1000
    fewest_samples: int = 12


#: Settings of every estimate.
_CONTACT_POINT = ContactPointSettings()


@dataclass
class MotionRecord:
    """Force samples and stage positions of one motion, with the arrival times and without corrections.

    Attributes:
        numbers: sequence number of each force sample.
        received: arrival time of each force sample, s.
        wrenches: all channels of each force sample, N and N m.
        statuses: `SampleStatus` of each force sample.
        polls: answer of the stage to each poll.
        legs: start time, s, segment name, cycle number and largest speed, m/s, of each leg of the motion.
    """

    numbers: list[int] = field(default_factory=list)
    received: list[float] = field(default_factory=list)
    wrenches: list[tuple[float, ...]] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    polls: list[StagePoll] = field(default_factory=list)
    legs: list[tuple[float, str, int, float]] = field(default_factory=list)

    def append_poll_and_interpolate_positions(self, samples: Sequence[ForceSample], stage: StageSample) -> list[float]:
        """Append the force samples and the stage sample of one poll; interpolate the stage position.

        Args:
            samples: new force samples.
            stage: new stage sample.

        Returns:
            Position of the stage at the arrival of each force sample, m, interpolated between the last two polls.
        """
        self.polls.append(StagePoll(stage.earliest_reading_time, stage.received, stage.position))
        before, now = self.polls[-2:] if len(self.polls) > 1 else (self.polls[-1], self.polls[-1])
        for sample in samples:
            self.numbers.append(sample.sequence)
            self.received.append(sample.received)
            self.wrenches.append(sample.values)
            self.statuses.append(sample.status)
        return [float(np.interp(sample.received, (before.middle_time, now.middle_time + 1e-9),
                                (before.position, now.position)))
                for sample in samples]

    @property
    def gap_count(self) -> int:
        """Number of gaps in the sequence numbers, in which force samples were lost."""
        return sum(bool(status & SampleStatus.GAP) for status in self.statuses)

    def fit_sample_clock(self, period: float) -> SampleClock:
        """Fit and return the clock that gives the sampling times of the force samples.

        Args:
            period: sampling period that the sensor states, s.
        """
        return SampleClock.fit_to_arrivals(self.numbers, self.received, period)


def build_recording(record: MotionRecord, plan: BenchTestPlan, contact_point: float, zero: float,
                    channels: Sequence[str], period: float) -> Recording:
    """Build the recording of a motion: force at its sampling times, stage position interpolated to the same times.

    Args:
        record: samples of the legs of the plan.
        plan: plan of the test.
        contact_point: position of the stage at the contact point, m.
        zero: reading of the sensor after its tare, N; this reading is subtracted from the force.
        channels: names of the channels of the sensor.
        period: sampling period that the sensor states, s.

    Returns:
        Recording from the start of the first leg to the last stage sample, without the samples whose stage position is
        uncertain; ``metadata["left_out"]`` states their number and the reason. ``metadata["clock"]`` describes the
        reconstruction of the times. All channels except the force are the unchanged readings of the sensor.

    Raises:
        StoppedError: the stage position is uncertain in most samples.
    """
    clock = record.fit_sample_clock(period)
    sampled_at = clock.compute_times(record.numbers)
    path = StagePath(record.polls, [leg[0] for leg in record.legs],
                     [plan.approach_speed, *(leg[3] for leg in record.legs)])
    recorded = ((sampled_at >= max(record.legs[0][0], record.polls[0].middle_time))
                & (sampled_at <= record.polls[-1].middle_time))
    inside = recorded & path.find_known_position_mask(sampled_at, plan.largest_depth)
    left_out = _make_left_out_metadata(int(recorded.sum()), int(inside.sum()), plan.largest_depth)
    time, wrench = sampled_at[inside], np.array(record.wrenches)[inside]
    leg = np.clip(np.searchsorted([leg[0] for leg in record.legs], time, side="right") - 1, 0, None)
    values = {"time": time - time[0], "displacement": path.interpolate_position(time) - contact_point,
              "force": plan.sign * wrench[:, list(channels).index(plan.axis)] - zero}
    if len(channels) > 1:
        values |= {name: wrench[:, number] for number, name in enumerate(channels)
                   if name in ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")}
    labels = {"segment": np.array([each[1] for each in record.legs])[leg],
              "cycle": np.array([each[2] for each in record.legs])[leg]}
    return Recording(values, labels, {"gaps": record.gap_count, **left_out, "clock": {
        "from": "line through the sequence numbers of the samples", "period_s": clock.period, "jitter_s": clock.jitter,
        "rate": "stated by the sensor" if clock.fits else "measured: the rate stated by the sensor does not fit",
        "stage": "interpolated", "lag": plan.lag or "unknown"}})


def _make_left_out_metadata(recorded: int, kept: int, depth: float) -> dict[str, Any]:
    """Return metadata with number and reason of samples left out for an uncertain stage position; empty if none.

    Args:
        recorded: number of samples of the motion.
        kept: number of samples in the recording.
        depth: largest depth of the motion, m.

    Raises:
        StoppedError: fewer than half of the samples are kept.
    """
    if kept == recorded:
        return {}
    reason = ("answers of the stage were late, and its position was not known to within "
              f"{compute_position_tolerance_for_depth(depth) * 1e3:.3g} mm")
    if 2 * kept < recorded:
        raise StoppedError(StopReason("program late", f"in {recorded - kept} of {recorded} samples {reason}; close "
                                      "other programs on this computer, or move more slowly"))
    return {"left_out": {"samples": recorded - kept, "reason": reason}}


def estimate_contact_point_and_metadata(record: MotionRecord, plan: BenchTestPlan, halted: float,
                                        channels: Sequence[str],
                                        speed: float, period: float) -> tuple[float, dict[str, Any]]:
    """Estimate the contact point from the slow approach, which passes the contact point before the contact force.

    Three methods are tried in this order: the change point of `tissue_sim.recording.contact.find_contact`, also if its
    interval is wide; the zero of a straight line through the loaded samples; the position at the contact force.

    Args:
        record: samples of the slow approach.
        plan: plan of the test.
        halted: position of the stage at which the contact force was reached, m.
        channels: names of the channels of the sensor.
        speed: speed of the approach, m/s.
        period: sampling period that the sensor states, s.

    Returns:
        Position of the stage at the contact point, m, and metadata that names the method and its interval.
    """
    metadata: dict[str, Any] = {"contact_force_N": plan.contact_force, "touch_by": "force"}
    sampled_at = record.fit_sample_clock(period).compute_times(record.numbers)
    path = StagePath(record.polls, [], [speed])
    inside = np.flatnonzero(path.find_known_position_mask(sampled_at, plan.largest_depth))
    thinned = inside[:: max(1, inside.size // _CONTACT_POINT.most_samples)]
    if thinned.size < _CONTACT_POINT.fewest_samples:
        return halted, metadata
    force = plan.sign * np.array(record.wrenches)[thinned, list(channels).index(plan.axis)]
    position = path.interpolate_position(sampled_at[thinned])
    found = find_contact(position, force, sampled_at[thinned])
    if found.status not in ("found", "unclear") or not position[0] < found.displacement < halted:
        # Without noise the change point has no likelihood to compare; a straight line needs none.
        loaded = force > _CONTACT_POINT.loaded * plan.contact_force
        noise_limit = _CONTACT_POINT.signal_to_noise * np.std(force[~loaded])
        if np.count_nonzero(loaded) < _CONTACT_POINT.fewest_samples or noise_limit > plan.contact_force:
            return halted, metadata
        slope, intercept = np.polyfit(position[loaded], force[loaded], 1)
        zero_crossing = float(-intercept / slope) if slope > 0 else np.nan
        if position[0] < zero_crossing < halted:
            return zero_crossing, {**metadata, "touch_by": "straight line"}
        return halted, metadata
    low, high = (1e3 * float(np.clip(bound, position[0], halted)) for bound in found.interval)
    return found.displacement, {**metadata, "touch_by": f"change point, {found.status}",
                                "touch_interval_mm": [low, high]}
