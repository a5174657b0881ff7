"""A simulated force sensor: samples a function of time with quantisation, a finite range and a finite buffer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from haptics.devices.contracts import SAMPLE_BUFFER, DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.settings import parse_number_settings
from tissue_sim.errors import InputError


class VirtualForceSensor(ForceSensor):
    """Sample a load, a function of time with one or more channels, as a force sensor with counts and a finite range.

    Args:
        load: Function of the time on `clock`, s, that returns the load of each channel, N or N m.
        channels: Names of the channels.
        rate: Sampling rate, Hz.
        resolution: Force, N, or torque, N m, of one count.
        reach: Largest magnitude of a channel, N or N m; larger loads are clipped and the sample is `SATURATED`.
        clock: Monotonic clock, s.
        silent_after: Time since the start after which no samples arrive, s.

    Raises:
        InputError: `rate`, `resolution` or `reach` is not positive, or there is no channel.
    """

    def __init__(self, load: Callable[[float], tuple[float, ...]], channels: tuple[str, ...] = ("Fz",),
                 rate: float = 1000.0, resolution: float = 1e-3, reach: float = 50.0,
                 clock: Callable[[], float] = time.monotonic, silent_after: float = math.inf):
        for value, unit, field in ((rate, "Hz", "rate"), (resolution, "N", "resolution"), (reach, "N", "reach")):
            if not 0 < value < math.inf:
                raise InputError(f"rate, resolution and range must be above 0; got {value:g} {unit}", field=field)
        if not channels:
            raise InputError("the sensor must have at least one channel; got none", field="channels")
        self.channels, self.rate, self._load, self._clock = channels, rate, load, clock
        self._resolution, self._largest_count = resolution, math.floor(reach / resolution)
        self._zero, self._silent_after = (0,) * len(channels), silent_after
        #: Time of the start, s on the clock; None: stopped.
        self._began: float | None = None
        #: Number of samples returned or lost since the start.
        self._passed = 0

    def start(self) -> None:
        """Start sampling; the first sample is one period from now."""
        if self._began is None:
            self._began, self._passed = self._clock(), 0

    def read(self) -> tuple[ForceSample, ...]:
        """Return the samples that have become due since the last call; a gap is marked if the buffer was full."""
        now, began = self._get_present_and_start_time()
        due = math.floor(min(now - began, self._silent_after) * self.rate)
        first = max(self._passed, due - SAMPLE_BUFFER)
        lost, self._passed = first > self._passed, due
        samples = []
        for number in range(first, due):
            counts, status = self._sample_counts_and_status(began + (number + 1) / self.rate)
            if lost and number == first:
                status |= SampleStatus.GAP
            values = tuple(self._resolution * (count - zero) for count, zero in zip(counts, self._zero, strict=True))
            samples.append(ForceSample(counts, values, number, int(status), now))
        return tuple(samples)

    def tare(self) -> None:
        """Set the present counts as zero of later values."""
        now, _ = self._get_present_and_start_time()
        self._zero, _ = self._sample_counts_and_status(now)

    def stop(self) -> None:
        """End sampling."""
        self._began = None

    def describe(self) -> dict[str, Any]:
        """Return channels, rate, resolution and range; keys carry units."""
        return {"sensor": "virtual", "channels": list(self.channels), "rate_Hz": self.rate,
                "resolution_N": self._resolution, "range_N": self._largest_count * self._resolution}

    def _get_present_and_start_time(self) -> tuple[float, float]:
        """Return the present time and the time of the start, s on the clock; DeviceError if not started."""
        if self._began is None:
            raise DeviceError("the virtual force sensor is not started; start it first")
        return self._clock(), self._began

    def _sample_counts_and_status(self, at: float) -> tuple[tuple[int, ...], SampleStatus]:
        """Return the counts of all channels, clipped to the range, and their status at a time on the clock, s."""
        unclipped = [round(value / self._resolution) for value in self._load(at)]
        counts = tuple(min(max(count, -self._largest_count), self._largest_count) for count in unclipped)
        return counts, SampleStatus.GOOD if list(counts) == unclipped else SampleStatus.SATURATED


def make_constant_load_sensor(text: str) -> VirtualForceSensor:
    """Make a sensor with one constant load from ``rate_hz=1000,resolution_N=0.001,range_N=50,load_N=0``."""
    given = parse_number_settings(text, rate_hz=1000.0, resolution_N=1e-3, range_N=50.0, load_N=0.0)
    return VirtualForceSensor(_ConstantLoadFunction(given["load_N"]), rate=given["rate_hz"],
                              resolution=given["resolution_N"], reach=given["range_N"])


class _ConstantLoadFunction:
    """A function of time that returns a constant load, N; a class, so that the sensor can be pickled."""

    def __init__(self, load: float):
        self._load = (load,)

    def __call__(self, time: float) -> tuple[float, ...]:
        """Return the load, N, one channel, at any time."""
        return self._load
