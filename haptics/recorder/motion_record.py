"""Collect the samples of one motion, and convert them to a recording and a contact point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from haptics.devices.contracts import ForceSample, SampleStatus, StageSample
from haptics.recorder.clock import SampleClock
from haptics.recorder.plan import BenchTestPlan
from haptics.recorder.stage_path import StagePath, StagePoll, compute_position_tolerance_for_depth
from haptics.recorder.stopped import StoppedError
from haptics.safety.motion_guard import StopReason
from tissue_sim import Recording
from tissue_sim.recording.contact import find_contact


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
_SETTINGS = ContactPointSettings()


@dataclass
class MotionRecord:
    """Force samples and stage positions of one motion, with the arrival times and without corrections.

    Attributes:
        numbers: sequence number of each force sample.
        received: arrival time of each force sample, s.
        wrenches: all channels of each force sample, N and N m.
        statuses: `SampleStatus` of each force sample.
        polls: answer of the stage to each poll.
        legs: start time, s, segment name and cycle number of each leg of the motion.
    """

    numbers: list[int] = field(default_factory=list)
    received: list[float] = field(default_factory=list)
    wrenches: list[tuple[float, ...]] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    polls: list[StagePoll] = field(default_factory=list)
    legs: list[tuple[float, str, int]] = field(default_factory=list)

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
                     [plan.approach_speed, *(leg.speed for leg in plan.legs[:len(record.legs)])])
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
    thinned = inside[:: max(1, inside.size // _SETTINGS.most_samples)]
    if thinned.size < _SETTINGS.fewest_samples:
        return halted, metadata
    force = plan.sign * np.array(record.wrenches)[thinned, list(channels).index(plan.axis)]
    position = path.interpolate_position(sampled_at[thinned])
    found = find_contact(position, force, sampled_at[thinned])
    if found.status not in ("found", "unclear") or not position[0] < found.displacement < halted:
        # Without noise the change point has no likelihood to compare; a straight line needs none.
        loaded = force > _SETTINGS.loaded * plan.contact_force
        noise_limit = _SETTINGS.signal_to_noise * np.std(force[~loaded])
        if np.count_nonzero(loaded) < _SETTINGS.fewest_samples or noise_limit > plan.contact_force:
            return halted, metadata
        slope, intercept = np.polyfit(position[loaded], force[loaded], 1)
        zero_crossing = float(-intercept / slope) if slope > 0 else np.nan
        if position[0] < zero_crossing < halted:
            return zero_crossing, {**metadata, "touch_by": "straight line"}
        return halted, metadata
    low, high = (1e3 * float(np.clip(bound, position[0], halted)) for bound in found.interval)
    return found.displacement, {**metadata, "touch_by": f"change point, {found.status}",
                                "touch_interval_mm": [low, high]}
