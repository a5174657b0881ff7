"""What is taken during one motion, and the recording and the touch that it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from haptics.devices.contracts import ForceSample, SampleStatus, StageSample
from haptics.recorder.clock import SequenceLine
from haptics.recorder.plan import Plan
from tissue_sim import Recording
from tissue_sim.recording.contact import find_contact

#: The line to the touch goes through samples with more than this share of the contact force, which must be so many
#: deviations of the others.
_LOADED, _NOISY = 0.3, 10.0
#: Samples in which the touch is sought, and the fewest.
_MOST_FOR_TOUCH, _FEWEST_FOR_TOUCH = 1000, 12


@dataclass
class Taken:
    """Samples and places of one motion, as they came.

    Attributes:
        numbers, received, wrenches, statuses: of the samples: number, when it came, s, all channels, status.
        places: of the stage: when it was asked, s, and where it was, m.
        legs: when each began, s, its name and its cycle.
    """

    numbers: list[int] = field(default_factory=list)
    received: list[float] = field(default_factory=list)
    wrenches: list[tuple[float, ...]] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    places: list[tuple[float, float]] = field(default_factory=list)
    legs: list[tuple[float, str, int]] = field(default_factory=list)

    def add(self, samples: Sequence[ForceSample], place: StageSample) -> list[float]:
        """Keep what came; returns where the stage was when each sample came, m, as well as it is known then."""
        self.places.append((place.received, place.position))
        before, now = self.places[-2:] if len(self.places) > 1 else (self.places[-1], self.places[-1])
        for sample in samples:
            self.numbers.append(sample.sequence)
            self.received.append(sample.received)
            self.wrenches.append(sample.values)
            self.statuses.append(sample.status)
        return [float(np.interp(sample.received, (before[0], now[0] + 1e-9), (before[1], now[1])))
                for sample in samples]

    @property
    def gaps(self) -> int:
        """How often samples were lost."""
        return sum(bool(status & SampleStatus.GAP) for status in self.statuses)

    def line(self, period: float) -> SequenceLine:
        """When the samples were taken; period: of the sensor, as it says, s."""
        return SequenceLine.of(self.numbers, self.received, period)


def as_recording(taken: Taken, plan: Plan, touch: float, zero: float, channels: Sequence[str],
                 period: float) -> Recording:
    """Force at the times at which it was measured, the stage's position interpolated there.

    Args:
        taken: during the legs of the plan. plan: of the test.
        touch: position of the stage, m. zero: what is left of the sensor's, N.
        channels: of the sensor. period: of it, s.

    Returns:
        From the beginning of the first leg to the last look at the stage; ``metadata["clock"]`` says how the times were
        found. Channels beside the force are as the sensor tells them.
    """
    line = taken.line(period)
    at = line.time(taken.numbers)
    when, where = np.array(taken.places).T
    inside = (at >= max(taken.legs[0][0], when[0])) & (at <= when[-1])
    time, wrench = at[inside], np.array(taken.wrenches)[inside]
    leg = np.clip(np.searchsorted([leg[0] for leg in taken.legs], time, side="right") - 1, 0, None)
    values = {"time": time - time[0], "displacement": np.interp(time, when, where) - touch,
              "force": plan.sign * wrench[:, list(channels).index(plan.axis)] - zero}
    if len(channels) > 1:
        values |= {name: wrench[:, number] for number, name in enumerate(channels)
                   if name in ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")}
    labels = {"segment": np.array([each[1] for each in taken.legs])[leg],
              "cycle": np.array([each[2] for each in taken.legs])[leg]}
    return Recording(values, labels, {"gaps": taken.gaps, "clock": {
        "from": "line through the numbers of the samples", "period_s": line.period, "jitter_s": line.jitter,
        "rate": "as the sensor says" if line.fits else "measured: what the sensor says does not fit",
        "stage": "interpolated", "lag": plan.lag or "unknown"}})


def refined_touch(taken: Taken, plan: Plan, halted: float, channels: Sequence[str],
                  period: float) -> tuple[float, dict[str, Any]]:
    """Where the tool touched on its slow way in, which is before the force that ended it was reached.

    Args:
        taken: on that way. plan: of the test. halted: where the force ended it, m. channels, period: of the sensor.

    Returns:
        Position of the stage, m, and what a sidecar says of it: the change point of
        `tissue_sim.recording.contact.find_contact` where there is one, though its interval be wide; else a straight
        line through the last forces; else where the force ended the way.
    """
    said: dict[str, Any] = {"contact_force_N": plan.contact_force, "touch_by": "force"}
    at = taken.line(period).time(taken.numbers)
    when, where = np.array(taken.places).T
    inside = np.flatnonzero((at >= when[0]) & (at <= when[-1]))
    thin = inside[:: max(1, inside.size // _MOST_FOR_TOUCH)]
    if thin.size < _FEWEST_FOR_TOUCH:
        return halted, said
    force = plan.sign * np.array(taken.wrenches)[thin, list(channels).index(plan.axis)]
    place = np.interp(at[thin], when, where)
    found = find_contact(place, force, at[thin])
    if found.status not in ("found", "unclear") or not place[0] < found.displacement < halted:
        # A sensor that does not even rustle leaves a change point nothing to weigh; a line does without.
        loaded = force > _LOADED * plan.contact_force
        if np.count_nonzero(loaded) < _FEWEST_FOR_TOUCH or _NOISY * np.std(force[~loaded]) > plan.contact_force:
            return halted, said
        slope, rest = np.polyfit(place[loaded], force[loaded], 1)
        touch = float(-rest / slope) if slope > 0 else np.nan
        return (touch, {**said, "touch_by": "straight line"}) if place[0] < touch < halted else (halted, said)
    low, high = (1e3 * float(np.clip(bound, place[0], halted)) for bound in found.interval)
    return found.displacement, {**said, "touch_by": f"change point, {found.status}", "touch_interval_mm": [low, high]}
