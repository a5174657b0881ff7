"""Protocol: prescribed displacement of the tool, or prescribed force on the tool, against time.

See `tissue_sim.experiment.protocol_text` for the text of a protocol.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, require_positive_length
from tissue_sim.experiment.protocol_legs import (
    LoadingState,
    MotionLeg,
    iterate_segments_with_repeats,
    make_leg_or_none,
)
from tissue_sim.experiment.protocol_text import (
    ANGLE,
    DISPLACEMENT,
    FORCE,
    ProtocolSegment,
    make_protocol_error,
    parse_protocol,
)
from tissue_sim.public_names import OldName, make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {
    "iterate_motion_legs": "tissue_sim.experiment.protocol_legs:iterate_motion_legs",
    **{name: f"tissue_sim.experiment.protocol_text:{name}" for name in ("EXAMPLE", "KINDS", "ProtocolRepeat",
                                                                        "format_protocol")},
    "write_protocol": "tissue_sim.experiment.protocol_text:format_protocol"})

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


@dataclass(frozen=True)
class RemainingSegments:
    """Segments of a protocol after its last sample; the first one starts from the response of the specimen.

    Attributes:
        segments: in order, repeats expanded.
        state: state at the last sample.
        points: samples of each moving segment.
        step: time step of the last motion, s.
    """

    segments: tuple[ProtocolSegment, ...]
    state: LoadingState
    points: int
    step: float


@dataclass(frozen=True, eq=False)
class Protocol:
    """Displacement that the stage reports, or force that the load cell reads, against time, linear between samples.

    At each sample either the displacement or the force is prescribed. With an ideal rig the displacement is that of the
    tool; otherwise `Rig.compute_unloaded_tool_displacement` computes the displacement of the tool. The motion of a
    measured recording is ``Protocol(recording.time, recording.displacement)``.

    Attributes:
        time: s, strictly increasing, shape (n,).
        displacement: m, positive into the tissue, shape (n,); NaN where the force is prescribed. Negative values are
            above the touch, where a bonded plate pulls. None: the force is prescribed at every sample.
        segment: name of the segment that each sample belongs to, shape (n,), or None.
        cycle: number of the load cycle of each sample, shape (n,), or None.
        force: N, positive if the tissue pushes back, shape (n,); NaN where the displacement is prescribed. None: the
            displacement is prescribed at every sample.
        remaining: segments after the last sample whose start depends on the response of the specimen; see
            `append_remaining_segments`. None: no segments remain.
        prescribes_angle: whether `displacement` contains angles of a grip, rad; see
            `tissue_sim.experiment.grip.GripMotion`.
        expected_depth: displacement that force-controlled samples are expected to reach, m; the mesh under a rounded
            tool depends on this value. None: unknown; `tissue_sim.simulate` then finds the value.

    Raises:
        InputError: lists of different lengths, a value that is not finite, time that does not increase, a sample with
            both or none of displacement and force.

    Examples:
        >>> creep = Protocol([0.0, 1.0, 10.0], force=[0.0, 2.0, 2.0])
        >>> creep.uses_force_control, creep.is_force_controlled.tolist()
        (True, [True, True, True])
    """

    time: np.ndarray
    displacement: np.ndarray = None  # type: ignore[assignment]
    segment: np.ndarray | None = None
    cycle: np.ndarray | None = None
    force: np.ndarray = None  # type: ignore[assignment]
    remaining: RemainingSegments | None = None
    expected_depth: float | None = None
    prescribes_angle: bool = False

    def __post_init__(self):
        self._store_read_only_array("time", np.array(self.time, dtype=float))
        for name in (DISPLACEMENT, FORCE):
            values = getattr(self, name)
            self._store_read_only_array(name, np.full(self.time.shape, np.nan) if values is None
                                        else np.array(values, dtype=float))
        shapes = self.time.shape, self.displacement.shape, self.force.shape
        if self.time.ndim != 1 or self.time.size == 0 or len(set(shapes)) > 1:
            raise InputError("time, displacement and force must be lists of the same length; got "
                             f"{', '.join(map(str, shapes))}.", field="protocol")
        if not np.isfinite(self.time).all():
            raise InputError("time must be finite; remove samples that are not finite numbers", field="protocol")
        is_given = ~np.isnan([self.displacement, self.force])
        if np.isinf([self.displacement, self.force]).any() or (is_given.sum(axis=0) != 1).any():
            raise InputError("each sample must have one finite displacement or one finite force; remove samples that "
                             "are not finite numbers", field="protocol")
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

    @property
    def is_force_controlled(self) -> np.ndarray:
        """Whether the force is prescribed, for each sample, shape (n,)."""
        return ~np.isnan(self.force)

    @property
    def uses_force_control(self) -> bool:
        """Whether the force is prescribed at a sample or in a remaining segment."""
        return self.remaining is not None or bool(self.is_force_controlled.any())

    def require_displacement_control(self, purpose: str, field: str = "protocol") -> None:
        """Refuse a protocol that prescribes a force or an angle.

        Args:
            purpose: what requires prescribed displacements, for the message, such as ``the viewer``.
            field: name of the protocol in the message.

        Raises:
            InputError: a force or an angle is prescribed.
        """
        if self.uses_force_control or self.prescribes_angle:
            raise InputError(f"must prescribe displacements for {purpose}; got a prescribed "
                             f"{ANGLE if self.prescribes_angle else FORCE}. State lengths, such as ramp 10mm, or use "
                             "tissue_sim.simulate", field=field)

    def resample_at_fractional_samples(self, samples: np.ndarray) -> Protocol:
        """Return the displacement-controlled protocol interpolated at fractional sample numbers.

        Args:
            samples: fractional sample numbers, ascending, shape (m,). A sample between two has the labels of the later
                one.

        Raises:
            InputError: a force is prescribed.
        """
        replace(self, prescribes_angle=False).require_displacement_control("resampling")
        numbers, later = np.arange(self.time.size), np.ceil(samples).astype(int)
        segment, cycle = (None if each is None else each[later] for each in (self.segment, self.cycle))
        return Protocol(np.interp(samples, numbers, self.time), np.interp(samples, numbers, self.displacement), segment,
                        cycle, prescribes_angle=self.prescribes_angle)

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

        A moving segment has `points` samples at equal distances of displacement or force, with its start. A hold holds
        the quantity that the segment before it prescribes. The time steps of a hold grow by
        `HoldTimeStepSettings.growth`, from the last time step of the motion before (at most
        `HoldTimeStepSettings.largest_first` of the hold), and are scaled so that the last one ends the hold. A cycle of
        a sinusoid has at least `tissue_sim.experiment.protocol_waves.SAMPLES_PER_CYCLE` samples, or `points`, at equal
        steps of the phase. A sample where two segments meet belongs to the first of them.

        Args:
            text: segments; see `tissue_sim.experiment.protocol_text.parse_protocol`.
            points: samples of each moving segment.
            speed: m/s, for displacement-controlled segments before the first stated speed.

        Returns:
            Samples up to the first segment that starts from the response of the specimen, such as a ramp of the force
            after a ramp of the displacement; this and later segments are in `remaining`.

        Raises:
            InputError: an error in the text, with its position and an example.

        Examples:
            >>> protocol = Protocol.parse("ramp 2mm @1mm/s; hold 3s", points=3)
            >>> float(protocol.time[-1]), float(protocol.displacement.max())
            (5.0, 0.002)
            >>> creep = Protocol.parse("ramp 2N @1N/s; hold 3s", points=3)
            >>> creep.force[:3].tolist(), float(creep.force[-1])
            ([0.0, 1.0, 2.0], 2.0)
        """
        _require_valid_points_and_speed(points, speed)
        if points > MOST_SAMPLES:
            raise InputError(f"must be at most {MOST_SAMPLES}; got {points}.", field="protocol.points")
        state, segments = LoadingState({DISPLACEMENT: speed}), [*iterate_segments_with_repeats(parse_protocol(text))]
        controls = {segment.control for segment in segments if segment.control is not None}
        if ANGLE not in controls:
            return _sample_segments(None, iter(segments), state, points, math.inf)
        if len(controls) > 1:
            other = next(segment for segment in segments if segment.control not in (None, ANGLE))
            raise make_protocol_error(other.position, f"all segments must prescribe angles; got a {other.kind} that "
                                      f"prescribes a {other.control}. State an angle such as 30deg")
        return replace(_sample_segments(None, iter(segments), replace(state, control=ANGLE), points, math.inf),
                       prescribes_angle=True)

    def append_remaining_segments(self, displacement: np.ndarray, force: np.ndarray) -> Protocol:
        """Return the protocol with the samples of its remaining segments, up to the next change of control.

        Args:
            displacement: response of the specimen at all samples, reported by the stage, m, shape (n,).
            force: response of the specimen at all samples, read by the load cell, N, shape (n,).

        Raises:
            InputError: a remaining segment cannot start from this response, such as a ramp to a smaller force.
        """
        if self.remaining is None:
            return self
        left = self.remaining
        state = replace(left.state, here={DISPLACEMENT: float(displacement[-1]), FORCE: float(force[-1])},
                        largest={DISPLACEMENT: float(np.max(displacement)), FORCE: float(np.max(force))})
        return _sample_segments(self, iter(left.segments), state, left.points, left.step)

    @property
    def depth(self) -> float:
        """Largest displacement of the protocol, m: prescribed or expected; 0 if neither is known."""
        known = self.displacement[~np.isnan(self.displacement)].tolist()
        if self.expected_depth is not None:
            known.append(self.expected_depth)
        return max(known, default=0.0)

    @property
    def labels(self) -> dict[str, np.ndarray]:
        """``segment`` and ``cycle``, if known, as labels of a `Recording`."""
        return {name: values for name in ("segment", "cycle") if (values := getattr(self, name)) is not None}


def _sample_segments(before: Protocol | None, segments: Iterator[ProtocolSegment], state: LoadingState, points: int,
                     step: float) -> Protocol:
    """Sample segments up to the first one that starts from the response of the specimen.

    Args:
        before: samples so far; None: no samples.
        segments: segments in order.
        state: state at the last sample.
        points: samples of each moving segment.
        step: time step of the last motion, s.

    Returns:
        The samples so far and the new samples.
    """
    columns: dict[str, list] = {name: [] if before is None else getattr(before, name).tolist()
                                for name in ("time", DISPLACEMENT, FORCE, "segment", "cycle")}

    def append_samples(leg: MotionLeg, values: np.ndarray, times: np.ndarray) -> None:
        """Append samples of a leg."""
        own, other = (FORCE, DISPLACEMENT) if leg.control == FORCE else (DISPLACEMENT, FORCE)
        count = 1 if leg.wave is None else leg.wave.cycles
        cycles = leg.cycle + np.arange(values.size) * count // values.size
        for name, new in ((own, values.tolist()), (other, [math.nan] * values.size), ("time", times.tolist()),
                          ("segment", [leg.segment.kind] * values.size), ("cycle", cycles.tolist())):
            columns[name] += new

    remaining = None
    for segment in segments:
        leg, following = make_leg_or_none(segment, state)
        if leg is None:
            remaining = RemainingSegments((segment, *segments), state, points, step)
            break
        if not columns["time"]:
            append_samples(leg, np.array([leg.start]), np.zeros(1))
        now, state = columns["time"][-1], following
        values, since = _sample_leg_values_and_times(leg, now, points, step)
        if len(columns["time"]) + since.size > MOST_SAMPLES:
            raise make_protocol_error(segment.position, f"the protocol has more than {MOST_SAMPLES} samples at this "
                                      "segment; shorten it or use fewer points")
        if leg.speed:
            step = float(since[-1] / since.size)
        append_samples(leg, values, now + since)
    arrays: dict[str, Any] = {name: np.array(values) for name, values in columns.items()}
    return Protocol(**arrays, remaining=remaining, expected_depth=None if before is None else before.expected_depth)


def _sample_leg_values_and_times(leg: MotionLeg, now: float, points: int,
                                 step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return displacements, forces or angles, and times, of the samples of a leg, without the sample at its start.

    Args:
        leg: displacement or force against time.
        now: time at the start of the leg, s.
        points: number of samples of a moving leg, with its start.
        step: time step of the motion before, s.

    Returns:
        Displacement, m, or force, N; and time since `now`, s; shapes (n,).
    """
    position = leg.segment.position
    if not math.isfinite(now + leg.duration):
        raise make_protocol_error(position, f"the end time of this {leg.segment.kind} is not finite; correct its speed")
    if leg.wave is not None:
        if leg.wave.compute_sample_count(points) > MOST_SAMPLES:
            raise make_protocol_error(position, f"this {leg.segment.kind} has more than {MOST_SAMPLES} samples; use "
                                      "fewer cycles or points")
        sine, since = leg.wave.compute_samples(points)
        samples = leg.start + leg.amplitude * sine
    elif leg.speed:
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
