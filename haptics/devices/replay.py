"""A force sensor that plays a recording."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from haptics.devices.contracts import DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.settings import read_settings, split_place
from haptics.protocols.ati_serial import CHANNELS
from tissue_sim.errors import InputError
from tissue_sim.recording.file import read_recording
from tissue_sim.recording.recording import Recording


class ReplaySensor(ForceSensor):
    """Plays the forces of a recording at its own times: the first sample comes with the start.

    Channels are those of ``Fx Fy Fz Tx Ty Tz`` that it has; where it has none, its force is ``Fz``, positive when the
    tissue pushes back. Values are those of the file; counts are the whole steps of `resolution` nearest to them. A
    sample is received when `read` gives it.

    At its end it is as a sensor that is lost: the first read that finds nothing left raises `DeviceError`. To start
    again plays it anew.

    Args:
        recording: with a time.
        speed: of the play; 2: in half of the time.
        resolution: of a count, N or N m.
        clock: s, never backwards.

    Raises:
        InputError: no time, no force, no two times, or a number that is not positive.
    """

    def __init__(self, recording: Recording, speed: float = 1.0, resolution: float = 1e-3,
                 clock: Callable[[], float] = time.monotonic):
        for value, field in ((speed, "speed"), (resolution, "resolution")):
            if not 0 < value < math.inf:
                raise InputError(f"{value:g}; give a number above zero", field=field)
        channels = tuple(name for name in CHANNELS if name in recording)
        columns = [recording.channel(name) for name in channels] if channels else [recording.force]
        if "time" not in recording:
            raise InputError("has no time, which a replay needs", file=recording.metadata.get("source"), field="time")
        times = recording.time
        if len(recording) < 2 or times[-1] <= times[0]:
            raise InputError("has no two times, which a replay needs", file=recording.metadata.get("source"),
                             field="time")
        self.channels = channels or ("Fz",)
        self._name, self._speed, self._resolution, self._clock = recording.name, speed, resolution, clock
        self._times = (times - times[0]) / speed
        self._values = np.column_stack(columns)
        self.rate = (len(recording) - 1) / float(self._times[-1])
        self._zero = np.zeros(len(columns))
        #: When it was started, s on the clock; None: it is stopped.
        self._began: float | None = None
        self._taken = 0

    def start(self) -> None:
        if self._began is None:
            self._began, self._taken = self._clock(), 0

    def read(self) -> tuple[ForceSample, ...]:
        now, due = self._due()
        first, self._taken = self._taken, due
        if first == len(self._times):
            raise DeviceError(f"the recording {self._name!r} is at its end, after {len(self._times)} samples in "
                              f"{self._times[-1]:g} s; start it again to play it anew")
        values = self._values[first:due]
        counts = np.rint(values / self._resolution).astype(np.int64)
        numbered = zip(range(first, due), counts.tolist(), (values - self._zero).tolist(), strict=True)
        return tuple(ForceSample(tuple(count), tuple(value), number, int(SampleStatus.GOOD), now)
                     for number, count, value in numbered)

    def tare(self) -> None:
        _, due = self._due()
        self._zero = self._values[due - 1]

    def stop(self) -> None:
        self._began = None

    def describe(self) -> dict[str, Any]:
        return {"sensor": "replay", "recording": self._name, "channels": list(self.channels), "rate_Hz": self.rate,
                "speed": self._speed, "resolution_N": self._resolution, "samples": len(self._times),
                "duration_s": float(self._times[-1])}

    def _due(self) -> tuple[float, int]:
        """Now, s on the clock, and how many samples have come; at least one."""
        if self._began is None:
            raise DeviceError(f"the replay of {self._name!r} is not started; start it first")
        now = self._clock()
        return now, max(int(np.searchsorted(self._times, now - self._began, side="right")), 1)


def open_replay(text: str) -> ReplaySensor:
    """``replay:FILE.csv,speed=1,resolution_N=0.001``: a recording with its time."""
    file, rest = split_place(text, "the recording", "replay:needle_1.csv")
    given = read_settings(rest, speed=1.0, resolution_N=1e-3)
    return ReplaySensor(read_recording(file), given["speed"], given["resolution_N"])
