"""A force sensor that replays a recording."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from haptics.devices.contracts import DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.settings import parse_number_settings, split_address_and_settings_text
from haptics.protocols.ati_serial import CHANNELS
from tissue_sim.errors import InputError
from tissue_sim.recording.file import read_recording
from tissue_sim.recording.recording import Recording


class ReplaySensor(ForceSensor):
    """Replay the forces of a recording at its own times; the first sample is due at the start.

    Channels are the recording's channels among ``Fx Fy Fz Tx Ty Tz``. A recording without them has one channel, ``Fz``,
    with the recorded force, positive when the tissue pushes the tool back. Values are the recorded ones; counts are
    values / `resolution`, rounded. The time of receipt of a sample is the time of the `read` that returns it.

    After the last sample, `read` raises `DeviceError`, as if the sensor were lost. A new start replays from the first
    sample.

    Args:
        recording: Recording with times.
        speed: Ratio of recorded time to replay time; 2 replays in half the time.
        resolution: Force, N, or torque, N m, of one count.
        clock: Monotonic clock, s.

    Raises:
        InputError: The recording has no times, no force or no two different times; `speed` or `resolution` is not
            positive.
    """

    def __init__(self, recording: Recording, speed: float = 1.0, resolution: float = 1e-3,
                 clock: Callable[[], float] = time.monotonic):
        for value, field in ((speed, "speed"), (resolution, "resolution")):
            if not 0 < value < math.inf:
                raise InputError(f"replay speed and resolution must be finite numbers above 0; got {value:g}",
                                 field=field)
        channels = tuple(name for name in CHANNELS if name in recording)
        columns = [recording.channel(name) for name in channels] if channels else [recording.force]
        if "time" not in recording:
            raise InputError("the times must be recorded for a replay; the recording has none. Give another recording",
                             file=recording.metadata.get("source"), field="time")
        times = recording.time
        if len(recording) < 2 or times[-1] <= times[0]:
            raise InputError("the recording must have two different times for a replay; give a longer recording",
                             file=recording.metadata.get("source"), field="time")
        self.channels = channels or ("Fz",)
        self._name, self._speed, self._resolution, self._clock = recording.name, speed, resolution, clock
        self._times = (times - times[0]) / speed
        self._values = np.column_stack(columns)
        self.rate = (len(recording) - 1) / float(self._times[-1])
        self._zero = np.zeros(len(columns))
        #: Time of the start, s on the clock; None: stopped.
        self._began: float | None = None
        #: Number of samples returned by `read` since the start.
        self._returned = 0

    def start(self) -> None:
        """Set the time of the first sample to now."""
        if self._began is None:
            self._began, self._returned = self._clock(), 0

    def read(self) -> tuple[ForceSample, ...]:
        """Return the recorded samples whose time has come since the last call; DeviceError after the last sample."""
        now, due = self._get_now_and_due_sample_count()
        first, self._returned = self._returned, due
        if first == len(self._times):
            raise DeviceError(f"the recording {self._name!r} is at its end, after {len(self._times)} samples in "
                              f"{self._times[-1]:g} s; start the sensor again to replay it")
        values = self._values[first:due]
        counts = np.rint(values / self._resolution).astype(np.int64)
        numbered = zip(range(first, due), counts.tolist(), (values - self._zero).tolist(), strict=True)
        return tuple(ForceSample(tuple(count), tuple(value), number, int(SampleStatus.GOOD), now)
                     for number, count, value in numbered)

    def tare(self) -> None:
        """Set the values of the newest sample that is due as zero, which is subtracted from later values."""
        _, due = self._get_now_and_due_sample_count()
        self._zero = self._values[due - 1]

    def stop(self) -> None:
        """End the replay; the next `start` begins with the first sample."""
        self._began = None

    def describe(self) -> dict[str, Any]:
        """Return recording, channels, rate, resolution and duration; keys carry units."""
        return {"sensor": "replay", "recording": self._name, "channels": list(self.channels), "rate_Hz": self.rate,
                "speed": self._speed, "resolution_N": self._resolution, "samples": len(self._times),
                "duration_s": float(self._times[-1])}

    def _get_now_and_due_sample_count(self) -> tuple[float, int]:
        """Return the present time, s on the clock, and the number of samples due since the start, at least 1."""
        if self._began is None:
            raise DeviceError(f"the replay of {self._name!r} is not started; start it first")
        now = self._clock()
        return now, max(int(np.searchsorted(self._times, now - self._began, side="right")), 1)


def make_replay_sensor(text: str) -> ReplaySensor:
    """Make a sensor from ``replay:FILE.csv,speed=1,resolution_N=0.001``; the recording must have times."""
    file, rest = split_address_and_settings_text(text, "the recording", "replay:needle_1.csv")
    given = parse_number_settings(rest, speed=1.0, resolution_N=1e-3)
    return ReplaySensor(read_recording(file), given["speed"], given["resolution_N"])
