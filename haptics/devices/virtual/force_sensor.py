"""A force sensor that samples a function of time: quantised, with an end to its range and a buffer that overflows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from haptics.devices.contracts import DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.settings import read_settings
from tissue_sim.errors import InputError

#: Samples that wait to be read; older ones are lost.
BUFFER = 4096


class VirtualForceSensor(ForceSensor):
    """Samples a force along one axis, or several.

    Args:
        load: the force at a time on `clock`, s: one number for each channel, N or N m.
        channels: their names.
        rate: Hz.
        resolution: of a count, N or N m.
        reach: largest magnitude that a channel can tell, N or N m; a load beyond it is cut and the sample marked.
        clock: s, never backwards.
        silent_after: s after its start, from which on no sample comes.

    Raises:
        InputError: a rate, a resolution or a reach that is not positive, or no channel.
    """

    def __init__(self, load: Callable[[float], tuple[float, ...]], channels: tuple[str, ...] = ("Fz",),
                 rate: float = 1000.0, resolution: float = 1e-3, reach: float = 50.0,
                 clock: Callable[[], float] = time.monotonic, silent_after: float = math.inf):
        for value, unit, field in ((rate, "Hz", "rate"), (resolution, "N", "resolution"), (reach, "N", "reach")):
            if not 0 < value < math.inf:
                raise InputError(f"{value:g} {unit}; give a number above zero", field=field)
        if not channels:
            raise InputError("a sensor without channels measures nothing; name one", field="channels")
        self.channels, self.rate, self._load, self._clock = channels, rate, load, clock
        self._resolution, self._most = resolution, math.floor(reach / resolution)
        self._zero, self._silent_after = (0,) * len(channels), silent_after
        #: When it was started, s on the clock; None: it is stopped.
        self._began: float | None = None
        self._taken = 0

    def start(self) -> None:
        if self._began is None:
            self._began, self._taken = self._clock(), 0

    def read(self) -> tuple[ForceSample, ...]:
        now, began = self._times()
        due = math.floor(min(now - began, self._silent_after) * self.rate)
        first = max(self._taken, due - BUFFER)
        lost, self._taken = first > self._taken, due
        samples = []
        for number in range(first, due):
            counts, status = self._counts(began + (number + 1) / self.rate)
            if lost and number == first:
                status |= SampleStatus.GAP
            values = tuple(self._resolution * (count - zero) for count, zero in zip(counts, self._zero, strict=True))
            samples.append(ForceSample(counts, values, number, int(status), now))
        return tuple(samples)

    def tare(self) -> None:
        now, _ = self._times()
        self._zero, _ = self._counts(now)

    def stop(self) -> None:
        self._began = None

    def describe(self) -> dict[str, Any]:
        return {"sensor": "virtual", "channels": list(self.channels), "rate_Hz": self.rate,
                "resolution_N": self._resolution, "range_N": self._most * self._resolution}

    def _times(self) -> tuple[float, float]:
        """Now, and when it was started, s on the clock."""
        if self._began is None:
            raise DeviceError("the virtual force sensor is not started; start it first")
        return self._clock(), self._began

    def _counts(self, at: float) -> tuple[tuple[int, ...], SampleStatus]:
        wanted = [round(value / self._resolution) for value in self._load(at)]
        counts = tuple(min(max(count, -self._most), self._most) for count in wanted)
        return counts, SampleStatus.GOOD if list(counts) == wanted else SampleStatus.SATURATED


def open_virtual(text: str) -> VirtualForceSensor:
    """``virtual:rate_hz=1000,resolution_N=0.001,range_N=50,load_N=0``: one axis under a load that does not change."""
    given = read_settings(text, rate_hz=1000.0, resolution_N=1e-3, range_N=50.0, load_N=0.0)
    return VirtualForceSensor(_Constant(given["load_N"]), rate=given["rate_hz"], resolution=given["resolution_N"],
                              reach=given["range_N"])


class _Constant:
    """A load that does not change, N; can be sent to another process."""

    def __init__(self, load: float):
        self._load = (load,)

    def __call__(self, time: float) -> tuple[float, ...]:
        return self._load
