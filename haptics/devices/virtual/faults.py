"""Simulated faults of the connection, the sensor and the motor of emulated and virtual devices."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from haptics.devices.settings import parse_number_settings
from tissue_sim.errors import InputError

#: Default of the times of faults, s: never. A setting must be a finite number.
_NEVER = 1e30


@dataclass(frozen=True)
class Faults:
    """Faults to simulate; the default has none. Times count from the start of the device.

    Attributes:
        loss: Fraction of the messages that are lost, 0 to 1.
        duplicate: Fraction of the messages that arrive twice, 0 to 1.
        reorder: Fraction of the messages that arrive after their successor, 0 to 1.
        garble: Fraction of the messages that have one wrong byte, 0 to 1.
        delay: Delay of every message, s.
        disconnect_after: Time after which no message arrives, s.
        saturate_after: Time after which the sensor reads the end of its range, s.
        stall_after: Time after which the driven motor no longer moves the tool, s.
        drift: Drift of the sensor's zero, N/s.
        seed: Seed of the random numbers; equal seeds give equal faults.

    Raises:
        InputError: A fraction is outside 0 to 1, a time is negative, or `delay` or `drift` is not finite.
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
                raise InputError(f"the probability of a message fault must be 0 to 1; got {getattr(self, field):g}",
                                 field=field)
        for field in ("delay", "disconnect_after", "saturate_after", "stall_after"):
            if not getattr(self, field) >= 0.0:
                raise InputError(f"the time of a fault must be 0 s or more; got {getattr(self, field):g} s",
                                 field=field)
        if not math.isfinite(self.delay) or not math.isfinite(self.drift):
            raise InputError(f"delay and drift must be finite; got {self.delay:g} s, {self.drift:g} N/s",
                             field="delay, drift")


def parse_faults(text: str) -> Faults:
    """Return the faults of a text such as ``loss=0.02,disconnect_after_s=5``; the empty text has none.

    Args:
        text: Values of ``loss``, ``duplicate``, ``reorder``, ``garble``, ``delay_ms``, ``disconnect_after_s``,
            ``saturate_after_s``, ``stall_after_s``, ``drift_N_per_s``, ``seed``.

    Raises:
        InputError: A name is unknown, or a value is outside its range.
    """
    given = parse_number_settings(text, loss=0.0, duplicate=0.0, reorder=0.0, garble=0.0, delay_ms=0.0,
                                  disconnect_after_s=_NEVER, saturate_after_s=_NEVER, stall_after_s=_NEVER,
                                  drift_N_per_s=0.0, seed=0)
    return Faults(given["loss"], given["duplicate"], given["reorder"], given["garble"], given["delay_ms"] * 1e-3,
                  given["disconnect_after_s"], given["saturate_after_s"], given["stall_after_s"],
                  given["drift_N_per_s"], int(given["seed"]))


class FaultyMessageQueue:
    """A queue of messages that applies the faults of a connection.

    Args:
        faults: Faults of the connection.
        began: Time of the device's start, s on the clock of the calls.
    """

    def __init__(self, faults: Faults, began: float):
        self._faults, self._began, self._random = faults, began, random.Random(faults.seed)
        #: Time of delivery, s, and message, in order of delivery.
        self._waiting: list[tuple[float, bytes]] = []
        #: A message that waits until its successor was queued; None: none.
        self._held_back: bytes | None = None

    def is_disconnected(self, now: float) -> bool:
        """Return True if the time `now`, s, is after the simulated disconnection."""
        return now - self._began >= self._faults.disconnect_after

    def put_message(self, message: bytes, now: float) -> None:
        """Queue a message to be due after the delay; at random it is lost, damaged, doubled or held back instead."""
        faults, draw = self._faults, self._random.random
        if self.is_disconnected(now) or draw() < faults.loss:
            return
        if message and draw() < faults.garble:
            at = self._random.randrange(len(message))
            message = message[:at] + bytes([message[at] ^ self._random.randrange(1, 256)]) + message[at + 1:]
        if self._held_back is None and draw() < faults.reorder:
            self._held_back = message
            return
        for each in (message, *([message] if draw() < faults.duplicate else []), *self._take_held_message_as_list()):
            self._waiting.append((now + faults.delay, each))

    def _take_held_message_as_list(self) -> list[bytes]:
        """Remove the message held back to change the order, and return it in a list; empty if there is none."""
        held_back, self._held_back = self._held_back, None
        return [] if held_back is None else [held_back]

    def take_due_messages(self, now: float) -> list[bytes]:
        """Remove and return the messages due until now, in order; none after the simulated disconnection."""
        if self.is_disconnected(now):
            self._waiting.clear()
        count = next((number for number, (leaves, _) in enumerate(self._waiting) if leaves > now), len(self._waiting))
        leaving, self._waiting = self._waiting[:count], self._waiting[count:]
        return [message for _, message in leaving]
