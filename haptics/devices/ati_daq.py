"""An ATI force/torque sensor on a data acquisition board: six voltages and a calibration file.

A function of the user reads the board. Checked with artificial voltages only; unverified on hardware.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from haptics.devices.contracts import SAMPLE_BUFFER, DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.devices.settings import (
    parse_number_settings,
    parse_word_settings_and_remaining_text,
    split_address_and_settings_text,
)
from haptics.protocols.ati_calibration import MAX_SIZE, AtiVoltageCalibration, parse_ati_calibration
from haptics.protocols.ati_serial import CHANNELS
from tissue_sim.errors import InputError
from tissue_sim.files import read_bytes

#: Counts over the range of voltages, as of a 16-bit converter.
_CONVERTER_STEPS = 65536
#: A complete name, for messages.
_EXAMPLE = "ati-daq:FT01234.cal,volts=my_board:read_volts"


@dataclass(frozen=True)
class AtiDaqWaitingTimes:
    """Waiting time for samples and averaging time of the tare of an `AtiDaqSensor`."""

    #: Time without a sample after which the board counts as lost, s; at least `silent_periods` sampling periods.
    silence: float = 1.0
    #: Smallest value of `silence`, in sampling periods.
    silent_periods: int = 5
    #: Time over which a tare averages, s.
    tare: float = 0.1


#: Settings of all sensors of this process.
TIMING = AtiDaqWaitingTimes()


class AtiDaqSensor(ForceSensor):
    """A six-axis sensor: wrench = matrix (volts - volts at the tare).

    The voltages of an unloaded sensor are not zero, so values are valid after a tare only. One count is 1/65536 of the
    voltage range, as of a 16-bit converter. Samples are numbered in order of receipt; a sample that the function leaves
    out is undetectable.

    Args:
        calibration: Calibration of the sensor.
        read_volts: Function that returns the samples since its last call without waiting: an array (n, 6) of voltages,
            V, of gages G0 to G5 in the order of the calibration file, n >= 0. Alternatively its import path
            ``"package.module:function"``, which `start` imports. None: `start` raises an error with instructions.
        rate: Sampling rate of the board, Hz.
        volts: Lowest and highest voltage of the board, V; None: from the calibration.

    Raises:
        InputError: The rate is not positive, the voltage range is empty, or the import path is malformed.
    """

    channels = CHANNELS

    def __init__(self, calibration: AtiVoltageCalibration, read_volts: Callable[[], Any] | str | None = None,
                 rate: float = 1000.0, volts: tuple[float, float] | None = None):
        if not 0 < rate < math.inf:
            raise InputError(f"the sampling rate must be above 0; got {rate:g} Hz. Give the sampling rate of the board",
                             field="rate_hz")
        lowest, highest = calibration.volts if volts is None else volts
        if not -math.inf < lowest < highest < math.inf:
            raise InputError(f"the lowest voltage must be below the highest; got {lowest:g} to {highest:g} V. Give "
                             "volts as in range_V=10", field="range_V")
        if isinstance(read_volts, str) and not all(part.strip() for part in read_volts.partition(":")):
            raise InputError(f"the function that reads the voltages must be package.module:function, as in {_EXAMPLE}; "
                             f"got {read_volts!r}", field="volts")
        self.calibration, self.rate = calibration, rate
        self._given, self._lowest, self._highest = read_volts, lowest, highest
        self._matrix = np.array(calibration.matrix)
        self._reach = np.array(calibration.reach)
        self._zero = np.zeros(6)
        self._read_volts: Callable[[], Any] | None = None
        self._waiting: deque[_ReceivedSample] = deque(maxlen=SAMPLE_BUFFER)
        self._recent: deque[_ReceivedSample] = deque(maxlen=SAMPLE_BUFFER)
        #: Number of the next sample to receive, and of the next one to be read.
        self._number = self._next = 0
        #: Time of the last sample, s.
        self._last_received = 0.0

    def start(self) -> None:
        """Import the function that reads the voltages if its import path was given, and discard old samples.

        No effect on a started sensor.

        Raises:
            DeviceError: There is no such function, or it cannot be imported.
        """
        if self._read_volts is not None:
            return
        read_volts = _import_user_function(self._given) if isinstance(self._given, str) else self._given
        if read_volts is None:
            raise DeviceError(f"the ATI sensor {self.calibration.serial} has no function that reads its voltages; give "
                              f"one that returns the new samples as an array (n, 6) of volts, as in {_EXAMPLE}")
        self._read_volts = read_volts
        self._waiting.clear()
        self._recent.clear()
        self._number = self._next = 0
        self._last_received = time.monotonic()

    def read(self) -> tuple[ForceSample, ...]:
        """Return all samples received since the last call, oldest first, forces in N and torques in N m."""
        self._store_new_voltages()
        found = []
        while self._waiting:
            received = self._waiting.popleft()
            found.append(self._convert_sample(received, gap=received.sequence != self._next))
            self._next = received.sequence + 1
        return tuple(found)

    def _store_new_voltages(self) -> None:
        """Call the function that reads the voltages, check its result, and store the new samples."""
        if self._read_volts is None:
            raise DeviceError(f"the ATI sensor {self.calibration.serial} is not started; start it first")
        name = getattr(self._read_volts, "__name__", "read_volts")
        try:
            result = self._read_volts()
        except Exception as error:
            raise DeviceError(f"{name}, which reads the voltages, failed ({type(error).__name__}: {error}); check the "
                              "board, and start it again") from error
        now = time.monotonic()
        try:
            volts = np.asarray(result, dtype=float)
        except (TypeError, ValueError):
            volts = np.full(0, np.nan)
        if volts.ndim != 2 or volts.shape[1] != 6:
            raise DeviceError(
                f"{name} must return an array (n, 6) of volts; got {_describe_shape_or_type(result)}. Return the "
                "samples since the last call, one per row, and an array (0, 6) if there are none")
        if not np.isfinite(volts).all():
            raise DeviceError(f"{name} must return finite voltages; got NaN or infinity. Check the board, and leave "
                              "such samples out")
        for row in volts:
            received = _ReceivedSample(row, self._number, now)
            self._waiting.append(received)
            self._recent.append(received)
            self._number += 1
        if len(volts):
            self._last_received = now
        elif now - self._last_received > max(TIMING.silence, TIMING.silent_periods / self.rate):
            raise DeviceError(f"{name} has returned no sample for {now - self._last_received:.1f} s; check that the "
                              "board is sampling, and start it again")

    def _convert_sample(self, received: _ReceivedSample, gap: bool) -> ForceSample:
        """Return the force sample of six voltages; `gap` tells whether samples before it were lost."""
        steps = np.rint(received.volts * (_CONVERTER_STEPS / (self._highest - self._lowest)))
        least, most = (math.ceil(self._lowest / (self._highest - self._lowest) * _CONVERTER_STEPS),
                       math.floor(self._highest / (self._highest - self._lowest) * _CONVERTER_STEPS) - 1)
        counts = tuple(int(min(max(step, least), most)) for step in steps)
        wrench = self._matrix @ (received.volts - self._zero)
        status = SampleStatus.GAP if gap else SampleStatus.GOOD
        if min(counts) <= least < 0 or max(counts) >= most or (np.abs(wrench) > self._reach).any():
            status |= SampleStatus.SATURATED
        return ForceSample(counts, tuple(wrench.tolist()), received.sequence, int(status), received.time)

    def tare(self) -> None:
        """Set the mean voltages of the last 0.1 s as zero; if that time has no sample, those of the last sample."""
        self._store_new_voltages()
        while not self._recent:
            time.sleep(1e-3)
            self._store_new_voltages()
        count = min(max(round(TIMING.tare * self.rate), 1), len(self._recent))
        self._zero = np.mean([each.volts for each in list(self._recent)[-count:]], axis=0)

    def stop(self) -> None:
        """Forget the function that reads the voltages; the board itself is not stopped."""
        self._read_volts = None

    def describe(self) -> dict[str, Any]:
        """Return a dictionary: sensor, calibration, channels, rate, voltage and force range; keys carry units."""
        calibration = self.calibration
        return {"sensor": "ATI on a data acquisition board", "serial": calibration.serial, "part": calibration.part,
                "calibrated": calibration.date, "calibration_rows": calibration.rows, "channels": list(self.channels),
                "rate_Hz": self.rate, "volts_V": [self._lowest, self._highest],
                "count_V": (self._highest - self._lowest) / _CONVERTER_STEPS,
                "matrix_N_Nm_per_V": [list(row) for row in calibration.matrix],
                "range_N": list(calibration.reach[:3]), "range_Nm": list(calibration.reach[3:]),
                "verified": "with made-up voltages only"}


class _ReceivedSample(NamedTuple):
    """Six voltages, V, with the number of the sample and its time of receipt, s on the clock of `time.monotonic`."""

    volts: np.ndarray
    sequence: int
    time: float


def _describe_shape_or_type(value: Any) -> str:
    """Return text for a message: the shape of an array, or the type of another value."""
    shape = getattr(value, "shape", None)
    return f"shape {shape}" if shape is not None else f"a {type(value).__name__}"


def _import_user_function(path: str) -> Callable[[], Any]:
    """Return the function at the import path ``package.module:function``.

    Raises:
        DeviceError: The module cannot be imported, or the object is not a function.
    """
    module, _, attribute = path.partition(":")
    try:
        function = getattr(import_module(module), attribute)
    except Exception as error:
        raise DeviceError(f"{path}, which reads the voltages, cannot be imported ({error}); give "
                          "package.module:function of a module that Python finds") from error
    if not callable(function):
        raise DeviceError(f"{path} must be a function; got a {type(function).__name__}. Give a function that returns "
                          "an array (n, 6) of volts")
    return function


def make_ati_daq_sensor(text: str) -> AtiDaqSensor:
    """Return a sensor that is not started, from ``FT01234.cal,volts=package.module:function,rate_hz=1000,range_V=0``.

    ``range_V`` is the largest voltage of the board, in both directions; 0: from the calibration file.
    """
    file, rest = split_address_and_settings_text(text, "the calibration file", _EXAMPLE)
    words, rest = parse_word_settings_and_remaining_text(rest, volts=("",))
    given = parse_number_settings(rest, rate_hz=1000.0, range_V=0.0)
    calibration = parse_ati_calibration(read_bytes(file, "the .cal file of an ATI sensor", MAX_SIZE), file)
    reach = given["range_V"]
    return AtiDaqSensor(calibration, words["volts"] or None, given["rate_hz"], (-reach, reach) if reach else None)

