"""The motion of the tool."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, require_length
from tissue_sim.experiment.protocol_text import parse_protocol
from tissue_sim.experiment.segments import Leg, fault, legs

#: The study's, m/s.
STUDY_SPEED = 0.248e-3
MOST_SAMPLES = 100_000
#: In a hold each step is this much longer than the one before; the first is no larger a share of the hold than this.
HOLD_GROWTH, HOLD_FIRST = 1.25, 0.05


@dataclass(frozen=True, eq=False)
class Protocol:
    """Displacement that the stage reports, against time: straight lines between its points.

    An ideal rig moves the tool so; of another, `Rig.tool_motion` says where the tool truly is. The motion of a measured
    recording is ``Protocol(recording.time, recording.displacement)``.

    Attributes:
        time: s, strictly increasing, shape (n,).
        displacement: m, positive into the tissue, shape (n,). Below zero the tool is above the touch; a bonded plate
            pulls there.
        segment: name of the segment that each sample belongs to, shape (n,), or None.
        cycle: number of the load cycle of each sample, shape (n,), or None.

    Raises:
        InputError: lists that do not fit each other, a value that is not finite, time that does not increase.
    """

    time: np.ndarray
    displacement: np.ndarray
    segment: np.ndarray | None = None
    cycle: np.ndarray | None = None

    def __post_init__(self):
        for name in ("time", "displacement"):
            self._keep(name, np.array(getattr(self, name), dtype=float))
        if self.time.ndim != 1 or self.time.shape != self.displacement.shape or self.time.size == 0:
            raise InputError(f"time {self.time.shape} and displacement {self.displacement.shape} must be two lists of "
                             "the same length", field="protocol")
        if not (np.isfinite(self.time).all() and np.isfinite(self.displacement).all()):
            raise InputError("time and displacement must be finite", field="protocol")
        if (np.diff(self.time) <= 0).any():
            raise InputError("time must increase from point to point", field="protocol.time")
        for name, kind, words in (("segment", "U", "names"), ("cycle", "iu", "whole numbers")):
            if getattr(self, name) is None:
                continue
            labels = np.array(getattr(self, name))
            if labels.shape != self.time.shape or labels.dtype.kind not in kind:
                raise InputError(f"expected {self.time.size} {words}, one for each point", field=f"protocol.{name}")
            self._keep(name, labels)

    def _keep(self, name: str, array: np.ndarray) -> None:
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    def at(self, places: np.ndarray) -> Protocol:
        """The same motion with samples at these places, numbers of its own samples, whole or between two, ascending; a
        sample between two has the labels of the later one."""
        samples, later = np.arange(self.time.size), np.ceil(places).astype(int)
        segment, cycle = (None if each is None else each[later] for each in (self.segment, self.cycle))
        return Protocol(np.interp(places, samples, self.time), np.interp(places, samples, self.displacement), segment,
                        cycle)

    @classmethod
    def ramp(cls, depth: float, points: int = 21, speed: float = STUDY_SPEED) -> Protocol:
        """A ramp to `depth` (m) at `speed` (m/s), `points` samples with rest included; the study's speed by default."""
        require_length(depth, "protocol.depth")
        _require_sampling(points, speed)
        displacement = np.linspace(0.0, depth, points)
        return cls(displacement / speed, displacement)

    @classmethod
    def parse(cls, text: str, points: int = 21, speed: float = STUDY_SPEED) -> Protocol:
        """A protocol in segments, such as ``"ramp 10mm @0.248mm/s; hold 60s; unload"``.

        A segment that moves has `points` samples spread evenly over its way, the one that it starts from included. The
        steps of a hold grow by `HOLD_GROWTH` from the last step of the motion before it (or `HOLD_FIRST` of the hold,
        where that is less), all shortened alike so that the last one ends it. A sample where two segments meet belongs
        to the first of them.

        Args:
            text: segments; see `tissue_sim.experiment.protocol_text.parse_protocol`.
            points: samples of each segment that moves.
            speed: m/s, until a segment names one.

        Raises:
            InputError: with the place of the fault in the text and an example.
        """
        _require_sampling(points, speed)
        if points > MOST_SAMPLES:
            raise InputError(f"{points} points are too many; give at most {MOST_SAMPLES}", field="protocol.points")
        time: list[float] = []
        displacement: list[float] = []
        segment: list[str] = []
        cycle: list[int] = []
        now, step = 0.0, math.inf
        for leg in legs(parse_protocol(text), speed):
            if not time:
                time, displacement, segment, cycle = [now], [leg.start], [leg.segment.kind], [leg.cycle]
            samples, since = _sample(leg, now, points, step)
            if len(time) + since.size > MOST_SAMPLES:
                raise fault(leg.segment.place, f"the protocol has more than {MOST_SAMPLES} samples by here; shorten it "
                                               "or take fewer points")
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
        """Largest displacement, m."""
        return float(self.displacement.max())

    @property
    def labels(self) -> dict[str, np.ndarray]:
        """``segment`` and ``cycle`` where they are known, as a `Recording` takes them."""
        return {name: values for name in ("segment", "cycle") if (values := getattr(self, name)) is not None}


def _sample(leg: Leg, now: float, points: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement (m) and time since `now` (s) of the samples of a leg, its start left out.

    Args:
        now: time at which it starts, s.
        points: samples if it moves, its start included.
        step: time between two samples of the motion before, s.
    """
    place = leg.segment.place
    if not math.isfinite(now + leg.duration):
        raise fault(place, f"this {leg.segment.kind} would not end in a time that is a number; mend its speed")
    if leg.speed:
        samples = np.linspace(leg.start, leg.end, points)[1:]
        since = np.abs(samples - leg.start) / leg.speed
    else:
        since = _hold(leg.duration, step)
        samples = np.full(since.size, leg.end)
    if (np.diff(now + since, prepend=now) <= 0).any():
        raise fault(place, f"this {leg.segment.kind} is so short that its samples cannot be told apart at {now:g} s")
    return samples, since


def _hold(duration: float, step: float) -> np.ndarray:
    """Times of the samples of a hold, s, the last one `duration`; see `Protocol.parse`."""
    first = min(max(step / duration, 1e-9), HOLD_FIRST)
    count = math.ceil(math.log1p((HOLD_GROWTH - 1) / first) / math.log(HOLD_GROWTH))
    growth = HOLD_GROWTH ** np.arange(1, count + 1) - 1
    return duration * (growth / growth[-1])


def _require_sampling(points: int, speed: float) -> None:
    require_length(speed, "protocol.speed")
    if points < 2:
        raise InputError(f"{points} points cannot make a ramp; give at least 2", field="protocol.points")
