"""A hand behind a line that is late: what it is told comes after a delay that varies, and some of it never."""

from __future__ import annotations

import math
import random
from collections import deque
from typing import Any

from haptics.devices.contracts import HapticDevice
from haptics.devices.virtual.hand import VirtualHand
from tissue_sim.errors import InputError
from tissue_sim.experiment.approach import Approach
from tissue_sim.pose import Pose, Screw


class DelayedHand(HapticDevice):
    """A `VirtualHand` that gets each force later than it was rendered, and holds the last one until then.

    Only the whole way round counts for the stability of a loop, so all of the delay is in the force; it need not be a
    whole number of ticks. Messages keep their order, as on a TCP connection. The same seed, the same line.

    Args:
        hand: at the other end.
        delay: of every force, s.
        jitter: by how much a delay may be longer, evenly drawn, s.
        loss: share of the forces that never arrive, and of the poses that are not known.
        seed: of what is drawn.

    Raises:
        InputError: a time below zero, or a share outside of 0 to 1.
    """

    def __init__(self, hand: VirtualHand, delay: float, jitter: float = 0.0, loss: float = 0.0, seed: int = 0):
        for value, field in ((delay, "delay"), (jitter, "jitter")):
            if not 0 <= value < math.inf:
                raise InputError(f"{value:g} s; give zero or more", field=field)
        if not 0 <= loss <= 1:
            raise InputError(f"{loss:g} is no share; give 0 to 1", field="loss")
        self._hand, self._delay, self._jitter, self._loss, self._seed = hand, delay, jitter, loss, seed
        self._forget()

    def _forget(self) -> None:
        self._random = random.Random(self._seed)
        self._time = 0.0
        #: When each force arrives, and the force.
        self._under_way: deque[tuple[float, Screw]] = deque()

    def start(self) -> None:
        self._hand.start()
        self._forget()

    def pose(self, time: float) -> Pose | None:
        if time < self._time:
            self._under_way.clear()
        while self._under_way and self._under_way[0][0] <= time:
            arrives, wrench = self._under_way.popleft()
            self._hand.pose(arrives)
            self._hand.render(wrench)
        self._time = time
        pose = self._hand.pose(time)
        return None if self._is_lost() else pose

    def render(self, wrench: Screw) -> None:
        if self._is_lost():
            return
        arrives = self._time + self._delay + self._jitter * self._random.random()
        if self._under_way:
            arrives = max(arrives, self._under_way[-1][0])
        if arrives <= self._time:
            self._hand.render(wrench)
        else:
            self._under_way.append((arrives, wrench))

    def _is_lost(self) -> bool:
        return self._loss > 0.0 and self._random.random() < self._loss

    def stop(self) -> None:
        self._under_way.clear()
        self._hand.stop()

    def go_along(self, approach: Approach | None) -> None:
        self._hand.go_along(approach)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        self._hand.aim(depth, across)

    def describe(self) -> dict[str, Any]:
        return {**self._hand.describe(), "device": "virtual hand behind a late line", "delay_ms": self._delay * 1e3,
                "jitter_ms": self._jitter * 1e3, "loss": self._loss}
