"""A force/torque sensor of ATI on a data acquisition board: six voltages and a calibration file.

Reads any board by a function of the user's. Only run with functions that made voltages up: unverified on hardware.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from haptics.devices.contracts import DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.settings import read_choices, read_settings, split_target
from haptics.protocols.ati_calibration import LARGEST, AtiCalibration, read_calibration
from haptics.protocols.ati_serial import CHANNELS
from tissue_sim.errors import InputError
from tissue_sim.files import read_bytes

#: Samples that wait to be read; older ones are lost.
BUFFER = 4096
#: A board that gives no sample for so long is lost, s; or for so many periods, where that is longer.
_SILENCE, _SILENT_PERIODS = 1.0, 5
#: Time of which a tare takes the mean, s.
_TARED = 0.1
#: Counts are of a converter with so many steps over the range.
_STEPS = 65536
_EXAMPLE = "ati-daq:FT01234.cal,volts=my_board:read_volts"


class AtiDaqSensor(ForceSensor):
    """Six channels: wrench = matrix (volts - volts at the tare).

    A sensor has volts without a load: tare it, or the values are off by those. A count is 1/65536 of the range of
    volts, as of a converter with 16 bits. Samples are numbered as they come: a function that leaves some out is not
    noticed.

    Args:
        calibration: of the sensor.
        read_volts: gives the samples that are new since its last call, an array (n, 6) of V, gages G0 to G5 in the
            order of the calibration file, n from 0 on; it does not wait for more. Or where it is,
            ``"package.module:function"``, which `start` imports. None: `start` says how to give one.
        rate: of the samples, as the board is set, Hz.
        volts: lowest and highest that the board reads, V; None: as the calibration says.

    Raises:
        InputError: a rate that is not positive, a range without a width, or a place that is not ``module:function``.
    """

    channels = CHANNELS

    def __init__(self, calibration: AtiCalibration, read_volts: Callable[[], Any] | str | None = None,
                 rate: float = 1000.0, volts: tuple[float, float] | None = None):
        if not 0 < rate < math.inf:
            raise InputError(f"{rate:g} Hz; give the rate that the board is set to", field="rate_hz")
        lowest, highest = calibration.volts if volts is None else volts
        if not -math.inf < lowest < highest < math.inf:
            raise InputError(f"{lowest:g} to {highest:g} V is no range; give volts as in range_V=10", field="range_V")
        if isinstance(read_volts, str) and not all(part.strip() for part in read_volts.partition(":")):
            raise InputError(f"{read_volts!r} is no function; give package.module:function, as in {_EXAMPLE}",
                             field="volts")
        self.calibration, self.rate = calibration, rate
        self._given, self._lowest, self._highest = read_volts, lowest, highest
        self._matrix = np.array(calibration.matrix)
        self._reach = np.array(calibration.reach)
        self._zero = np.zeros(6)
        self._read_volts: Callable[[], Any] | None = None
        self._waiting: deque[_Kept] = deque(maxlen=BUFFER)
        self._recent: deque[_Kept] = deque(maxlen=BUFFER)
        self._number = self._next = 0
        self._heard = 0.0

    def start(self) -> None:
        if self._read_volts is not None:
            return
        read_volts = _function(self._given) if isinstance(self._given, str) else self._given
        if read_volts is None:
            raise DeviceError(f"the ATI sensor {self.calibration.serial} has nothing that reads its voltages; give a "
                              f"function that returns the new samples, an array (n, 6) of volts, as in {_EXAMPLE}")
        self._read_volts = read_volts
        self._waiting.clear()
        self._recent.clear()
        self._number = self._next = 0
        self._heard = time.monotonic()

    def read(self) -> tuple[ForceSample, ...]:
        self._fetch()
        found = []
        while self._waiting:
            kept = self._waiting.popleft()
            found.append(self._sample(kept, gap=kept.sequence != self._next))
            self._next = kept.sequence + 1
        return tuple(found)

    def _fetch(self) -> None:
        """Take the samples that are new."""
        if self._read_volts is None:
            raise DeviceError(f"the ATI sensor {self.calibration.serial} is not started; start it first")
        name = getattr(self._read_volts, "__name__", "read_volts")
        try:
            given = self._read_volts()
        except Exception as error:
            raise DeviceError(f"{name}, which reads the voltages, failed ({type(error).__name__}: {error}); check the "
                              "board, and start it again") from error
        now = time.monotonic()
        try:
            volts = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            volts = np.full(0, np.nan)
        if volts.ndim != 2 or volts.shape[1] != 6:
            raise DeviceError(f"{name} returned {_named(given)}, not an array (n, 6) of volts; return the samples "
                              "since its last call, one row each, and an array (0, 6) where there is none")
        if not np.isfinite(volts).all():
            raise DeviceError(f"{name} returned a voltage that is not finite; check the board, and leave such samples "
                              "out")
        for row in volts:
            kept = _Kept(row, self._number, now)
            self._waiting.append(kept)
            self._recent.append(kept)
            self._number += 1
        if len(volts):
            self._heard = now
        elif now - self._heard > max(_SILENCE, _SILENT_PERIODS / self.rate):
            raise DeviceError(f"{name} has returned no sample for {now - self._heard:.1f} s; check that the board is "
                              "sampling, and start it again")

    def _sample(self, kept: _Kept, gap: bool) -> ForceSample:
        steps = np.rint(kept.volts * (_STEPS / (self._highest - self._lowest)))
        least, most = (math.ceil(self._lowest / (self._highest - self._lowest) * _STEPS),
                       math.floor(self._highest / (self._highest - self._lowest) * _STEPS) - 1)
        counts = tuple(int(min(max(step, least), most)) for step in steps)
        wrench = self._matrix @ (kept.volts - self._zero)
        status = SampleStatus.GAP if gap else SampleStatus.GOOD
        if min(counts) <= least < 0 or max(counts) >= most or (np.abs(wrench) > self._reach).any():
            status |= SampleStatus.SATURATED
        return ForceSample(counts, tuple(wrench.tolist()), kept.sequence, int(status), kept.received)

    def tare(self) -> None:
        """The mean of the last tenth of a second counts as zero, or where that has none, the last sample."""
        self._fetch()
        while not self._recent:
            time.sleep(1e-3)
            self._fetch()
        count = min(max(round(_TARED * self.rate), 1), len(self._recent))
        self._zero = np.mean([kept.volts for kept in list(self._recent)[-count:]], axis=0)

    def stop(self) -> None:
        self._read_volts = None

    def describe(self) -> dict[str, Any]:
        calibration = self.calibration
        return {"sensor": "ATI on a data acquisition board", "serial": calibration.serial, "part": calibration.part,
                "calibrated": calibration.date, "calibration_rows": calibration.rows, "channels": list(self.channels),
                "rate_Hz": self.rate, "volts_V": [self._lowest, self._highest],
                "count_V": (self._highest - self._lowest) / _STEPS, "matrix_N_Nm_per_V": [list(row) for row in
                                                                                       calibration.matrix],
                "range_N": list(calibration.reach[:3]), "range_Nm": list(calibration.reach[3:]),
                "verified": "with made-up voltages only"}


class _Kept(NamedTuple):
    """A sample that waits to be read: six volts."""

    volts: np.ndarray
    sequence: int
    received: float


def _named(given: Any) -> str:
    shape = getattr(given, "shape", None)
    return f"shape {shape}" if shape is not None else f"a {type(given).__name__}"


def _function(place: str) -> Callable[[], Any]:
    """The function at ``package.module:function``."""
    module, _, attribute = place.partition(":")
    try:
        found = getattr(import_module(module), attribute)
    except Exception as error:
        raise DeviceError(f"{place}, which reads the voltages, cannot be imported ({error}); give "
                          "package.module:function of a module that Python finds") from error
    if not callable(found):
        raise DeviceError(f"{place} is a {type(found).__name__} and no function; give one that returns an array (n, 6) "
                          "of volts")
    return found


def open_ati_daq(text: str) -> AtiDaqSensor:
    """``ati-daq:FT01234.cal,volts=package.module:function,rate_hz=1000,range_V=0``.

    ``range_V`` is what the board reads at most, in both directions; 0: as the calibration file says.
    """
    file, rest = split_target(text, "the calibration file", _EXAMPLE)
    words, rest = read_choices(rest, volts=("",))
    given = read_settings(rest, rate_hz=1000.0, range_V=0.0)
    calibration = read_calibration(read_bytes(file, "the .cal file of an ATI sensor", LARGEST), file)
    reach = given["range_V"]
    return AtiDaqSensor(calibration, words["volts"] or None, given["rate_hz"], (-reach, reach) if reach else None)

