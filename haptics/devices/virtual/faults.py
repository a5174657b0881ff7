"""Faults on request: what goes wrong on the line, in the sensor and in the motor, and when."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from haptics.devices.settings import read_settings
from tissue_sim.errors import InputError

#: s; a setting is a finite number.
_NEVER = 1e30


@dataclass(frozen=True)
class Faults:
    """What goes wrong; `Faults()` is nothing. Times count from the start of the device.

    Attributes:
        loss, duplicate, reorder, garble: share of the messages that are lost, come twice, come after the next one, have
            a wrong byte.
        delay: by how much every message is late, s.
        disconnect_after: when the line falls silent, s.
        saturate_after: when the sensor reads the end of its range, s.
        stall_after: when the motor stands although it is driven, s.
        drift: of the sensor's zero, N/s.
        seed: of what is drawn; the same seed, the same faults.

    Raises:
        InputError: a share outside of 0 to 1, or a time below zero.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    garble: float = 0.0
    delay: float = 0.0
    disconnect_after: float = math.inf
    saturate_after: float = math.inf
    stall_after: float = math.inf
    drift: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for field in ("loss", "duplicate", "reorder", "garble"):
            if not 0.0 <= getattr(self, field) <= 1.0:
                raise InputError(f"{getattr(self, field):g} is no share; give 0 to 1", field=field)
        for field in ("delay", "disconnect_after", "saturate_after", "stall_after"):
            if not getattr(self, field) >= 0.0:
                raise InputError(f"{getattr(self, field):g} s; give zero or more", field=field)
        if not math.isfinite(self.delay) or not math.isfinite(self.drift):
            raise InputError("give finite numbers", field="delay, drift")


def read_faults(text: str) -> Faults:
    """Faults from ``loss=0.02,disconnect_after_s=5``; the empty text is none.

    Args:
        text: of ``loss``, ``duplicate``, ``reorder``, ``garble``, ``delay_ms``, ``disconnect_after_s``,
            ``saturate_after_s``, ``stall_after_s``, ``drift_N_per_s``, ``seed``.

    Raises:
        InputError: a name that is not among them, or a number out of its range.
    """
    given = read_settings(text, loss=0.0, duplicate=0.0, reorder=0.0, garble=0.0, delay_ms=0.0,
                          disconnect_after_s=_NEVER, saturate_after_s=_NEVER, stall_after_s=_NEVER,
                          drift_N_per_s=0.0, seed=0)
    return Faults(given["loss"], given["duplicate"], given["reorder"], given["garble"], given["delay_ms"] * 1e-3,
                  given["disconnect_after_s"], given["saturate_after_s"], given["stall_after_s"],
                  given["drift_N_per_s"], int(given["seed"]))


class FaultyLine:
    """What becomes of messages on a line with faults.

    Args:
        faults: on it.
        began: when the device was started, s on the clock of the calls.
    """

    def __init__(self, faults: Faults, began: float):
        self._faults, self._began, self._random = faults, began, random.Random(faults.seed)
        #: (when it leaves, message), in the order in which they leave.
        self._waiting: list[tuple[float, bytes]] = []
        self._kept_back: bytes | None = None

    def is_silent(self, now: float) -> bool:
        """Whether the device has fallen off the line."""
        return now - self._began >= self._faults.disconnect_after

    def put(self, message: bytes, now: float) -> None:
        """One message of the device."""
        faults, draw = self._faults, self._random.random
        if self.is_silent(now) or draw() < faults.loss:
            return
        if message and draw() < faults.garble:
            at = self._random.randrange(len(message))
            message = message[:at] + bytes([message[at] ^ self._random.randrange(1, 256)]) + message[at + 1:]
        if self._kept_back is None and draw() < faults.reorder:
            self._kept_back = message
            return
        for each in (message, *([message] if draw() < faults.duplicate else []), *self._late()):
            self._waiting.append((now + faults.delay, each))

    def _late(self) -> list[bytes]:
        late, self._kept_back = self._kept_back, None
        return [] if late is None else [late]

    def take(self, now: float) -> list[bytes]:
        """The messages that leave by now, in their order; none of a device that fell off the line."""
        if self.is_silent(now):
            self._waiting.clear()
        count = next((number for number, (leaves, _) in enumerate(self._waiting) if leaves > now), len(self._waiting))
        leaving, self._waiting = self._waiting[:count], self._waiting[count:]
        return [message for _, message in leaving]
