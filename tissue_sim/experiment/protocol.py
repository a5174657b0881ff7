"""Protocol: prescribed displacement of the tool against time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, require_positive_length
from tissue_sim.experiment.protocol_text import parse_protocol
from tissue_sim.experiment.segments import MotionLeg, iterate_motion_legs, make_protocol_error
from tissue_sim.public_names import OldName

#: Tool speed of the reference study, m/s.
STUDY_SPEED = 0.248e-3
#: Largest number of samples of a protocol.
MOST_SAMPLES = 100_000


@dataclass(frozen=True)
class HoldTimeStepSettings:
    """Distribution of the time steps of a hold.

    Attributes:
        growth: ratio of each time step to the step before, 1. A smaller ratio resolves the relaxation with more
            samples.
        largest_first: largest first time step over the duration of the hold, 1.
    """

    growth: float = 1.25
    largest_first: float = 0.05


#: Distribution of every hold.
HOLD_STEPS = HoldTimeStepSettings()


@dataclass(frozen=True, eq=False)
class Protocol:
    """Displacement that the stage reports against time, linear between samples.

    With an ideal rig this is the displacement of the tool; otherwise `Rig.compute_unloaded_tool_displacement` computes
    the displacement of the tool. The motion of a measured recording is ``Protocol(recording.time,
    recording.displacement)``.

    Attributes:
        time: s, strictly increasing, shape (n,).
        displacement: m, positive into the tissue, shape (n,). Negative values are above the touch, where a bonded plate
            pulls.
        segment: name of the segment that each sample belongs to, shape (n,), or None.
        cycle: number of the load cycle of each sample, shape (n,), or None.

    Raises:
        InputError: lists of different lengths, a value that is not finite, time that does not increase.
    """

    time: np.ndarray
    displacement: np.ndarray
    segment: np.ndarray | None = None
    cycle: np.ndarray | None = None

    def __post_init__(self):
        for name in ("time", "displacement"):
            self._store_read_only_array(name, np.array(getattr(self, name), dtype=float))
        if self.time.ndim != 1 or self.time.shape != self.displacement.shape or self.time.size == 0:
            raise InputError(f"time and displacement must be two lists of the same length; got {self.time.shape} and "
                             f"{self.displacement.shape}.", field="protocol")
        if not (np.isfinite(self.time).all() and np.isfinite(self.displacement).all()):
            raise InputError("time and displacement must be finite; remove samples that are not finite "
                             "numbers", field="protocol")
        if (np.diff(self.time) <= 0).any():
            raise InputError("must increase from sample to sample.", field="protocol.time")
        for name, kind, words in (("segment", "U", "names"), ("cycle", "iu", "whole numbers")):
            if getattr(self, name) is None:
                continue
            labels = np.array(getattr(self, name))
            if labels.shape != self.time.shape or labels.dtype.kind not in kind:
                raise InputError(f"expected {self.time.size} {words}, one for each sample", field=f"protocol.{name}")
            self._store_read_only_array(name, labels)

    def _store_read_only_array(self, name: str, array: np.ndarray) -> None:
        """Store an array as the attribute `name` of this frozen object, and make the array read-only."""
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    #: Old name.
    at = OldName("resample_at_fractional_samples")

    def resample_at_fractional_samples(self, samples: np.ndarray) -> Protocol:
        """Return the protocol interpolated at fractional sample numbers.

        Args:
            samples: fractional sample numbers, ascending, shape (m,). A sample between two has the labels of the later
                one.
        """
        numbers, later = np.arange(self.time.size), np.ceil(samples).astype(int)
        segment, cycle = (None if each is None else each[later] for each in (self.segment, self.cycle))
        return Protocol(np.interp(samples, numbers, self.time), np.interp(samples, numbers, self.displacement), segment,
                        cycle)

    @classmethod
    def ramp(cls, depth: float, points: int = 21, speed: float = STUDY_SPEED) -> Protocol:
        """Make a ramp to `depth`, m, at `speed`, m/s, with `points` samples, the first at rest.

        Examples:
            >>> ramp = Protocol.ramp(0.002, points=3, speed=1e-3)
            >>> ramp.time, ramp.displacement
            (array([0., 1., 2.]), array([0.   , 0.001, 0.002]))
        """
        require_positive_length(depth, "protocol.depth")
        _require_valid_points_and_speed(points, speed)
        displacement = np.linspace(0.0, depth, points)
        return cls(displacement / speed, displacement)

    @classmethod
    def parse(cls, text: str, points: int = 21, speed: float = STUDY_SPEED) -> Protocol:
        """Make a protocol from text, such as ``"ramp 10mm @0.248mm/s; hold 60s; unload"``.

        A moving segment has `points` samples at equal distances, with its start. The time steps of a hold grow by
        `HoldTimeStepSettings.growth`, from the last time step of the motion before (at most
        `HoldTimeStepSettings.largest_first` of the hold), and are scaled so that the last one ends the hold. A sample
        where two segments meet belongs to the first of them.

        Args:
            text: segments; see `tissue_sim.experiment.protocol_text.parse_protocol`.
            points: samples of each moving segment.
            speed: m/s, for segments before the first stated speed.

        Raises:
            InputError: an error in the text, with its position and an example.

        Examples:
            >>> protocol = Protocol.parse("ramp 2mm @1mm/s; hold 3s", points=3)
            >>> float(protocol.time[-1]), float(protocol.displacement.max())
            (5.0, 0.002)
        """
        _require_valid_points_and_speed(points, speed)
        if points > MOST_SAMPLES:
            raise InputError(f"must be at most {MOST_SAMPLES}; got {points}.", field="protocol.points")
        time: list[float] = []
        displacement: list[float] = []
        segment: list[str] = []
        cycle: list[int] = []
        now, step = 0.0, math.inf
        for leg in iterate_motion_legs(parse_protocol(text), speed):
            if not time:
                time, displacement, segment, cycle = [now], [leg.start], [leg.segment.kind], [leg.cycle]
            samples, since = _sample_leg_displacements_and_times(leg, now, points, step)
            if len(time) + since.size > MOST_SAMPLES:
                raise make_protocol_error(leg.segment.position,
                                          f"the protocol has more than {MOST_SAMPLES} samples at this "
                                          "segment; shorten it or use fewer points")
            if leg.speed:
                step = float(since[-1] / since.size)
            time += (now + since).tolist()
            displacement += samples.tolist()
            segment += [leg.segment.kind] * since.size
            cycle += [leg.cycle] * since.size
            now = time[-1]
        return cls(np.array(time), np.array(displacement), np.array(segment), np.array(cycle))

    @property
    def depth(self) -> float:
        """Largest displacement of the protocol, m."""
        return float(self.displacement.max())

    @property
    def labels(self) -> dict[str, np.ndarray]:
        """``segment`` and ``cycle``, if known, as labels of a `Recording`."""
        return {name: values for name in ("segment", "cycle") if (values := getattr(self, name)) is not None}


def _sample_leg_displacements_and_times(leg: MotionLeg, now: float, points: int,
                                        step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return displacements and times of the samples of a leg, without the sample at its start.

    Args:
        leg: straight line of displacement against time.
        now: time at the start of the leg, s.
        points: number of samples of a moving leg, with its start.
        step: time step of the motion before, s.

    Returns:
        Displacement, m, and time since `now`, s, shapes (n,).
    """
    position = leg.segment.position
    if not math.isfinite(now + leg.duration):
        raise make_protocol_error(position, f"the end time of this {leg.segment.kind} is not finite; correct its speed")
    if leg.speed:
        samples = np.linspace(leg.start, leg.end, points)[1:]
        since = np.abs(samples - leg.start) / leg.speed
    else:
        since = _compute_hold_sample_times(leg.duration, step)
        samples = np.full(since.size, leg.end)
    if (np.diff(now + since, prepend=now) <= 0).any():
        raise make_protocol_error(position, f"this {leg.segment.kind} is too short: its samples coincide at {now:g} s")
    return samples, since


def _compute_hold_sample_times(duration: float, step: float) -> np.ndarray:
    """Return the times of the samples of a hold, s, from its start; the last one equals `duration`."""
    first = min(max(step / duration, 1e-9), HOLD_STEPS.largest_first)
    count = math.ceil(math.log1p((HOLD_STEPS.growth - 1) / first) / math.log(HOLD_STEPS.growth))
    growth = HOLD_STEPS.growth ** np.arange(1, count + 1) - 1
    return duration * (growth / growth[-1])


def _require_valid_points_and_speed(points: int, speed: float) -> None:
    """Raise an `InputError` unless there are at least 2 points and the speed is positive and finite."""
    require_positive_length(speed, "protocol.speed")
    if points < 2:
        raise InputError(f"must be at least 2; got {points}.", field="protocol.points")
