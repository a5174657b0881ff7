"""A simulated hand behind a transmission delay with jitter and losses."""

from __future__ import annotations

import math
import random
from collections import deque
from typing import Any

from haptics.devices.contracts import HapticDevice
from haptics.devices.virtual.hand import VirtualHand
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Approach
from tissue_sim.pose import Pose, Screw


class DelayedHand(HapticDevice):
    """A `VirtualHand` that receives each force late and keeps it until the next one; poses are not delayed.

    The stability of a loop depends on the total delay around the loop only, so the force carries all of it; the delay
    need not be a multiple of the tick. Messages keep their order, as on a TCP connection.

    Args:
        hand: Hand that receives the delayed forces.
        delay: Delay of every force, s.
        jitter: Largest additional delay, uniformly distributed, s.
        loss: Fraction of the forces that are lost and of the poses that are unknown, 0 to 1.
        seed: Seed of the random numbers.

    Raises:
        InputError: A time is negative, or `loss` is outside 0 to 1.
    """

    def __init__(self, hand: VirtualHand, delay: float, jitter: float = 0.0, loss: float = 0.0, seed: int = 0):
        for value, field in ((delay, "delay"), (jitter, "jitter")):
            if not 0 <= value < math.inf:
                raise InputError(f"delay and jitter must be 0 s or more; got {value:g} s", field=field)
        if not 0 <= loss <= 1:
            raise InputError(f"the fraction of lost messages must be 0 to 1; got {loss:g}", field="loss")
        self._hand, self._delay, self._jitter, self._loss, self._seed = hand, delay, jitter, loss, seed
        self._restart_clock_and_discard_forces()

    def _restart_clock_and_discard_forces(self) -> None:
        """Restart the clock and the random numbers, and discard all forces that have not yet arrived at the hand."""
        self._random = random.Random(self._seed)
        self._time = 0.0
        #: Forces in transit: time of arrival, s, and wrench.
        self._in_transit: deque[tuple[float, Screw]] = deque()

    def start(self) -> None:
        """Start the hand without forces in transit."""
        self._hand.start()
        self._restart_clock_and_discard_forces()

    def pose(self, time: float) -> Pose | None:
        """Deliver the forces that have arrived by `time`, s, and return the pose of the hand; None if it is lost."""
        if time < self._time:
            self._in_transit.clear()
        while self._in_transit and self._in_transit[0][0] <= time:
            arrives, wrench = self._in_transit.popleft()
            self._hand.pose(arrives)
            self._hand.render(wrench)
        self._time = time
        pose = self._hand.pose(time)
        return None if self._draw_message_loss() else pose

    def render(self, wrench: Screw) -> None:
        """Send a wrench, which arrives after the delay and a random part of the jitter, unless it is lost."""
        if self._draw_message_loss():
            return
        arrives = self._time + self._delay + self._jitter * self._random.random()
        if self._in_transit:
            arrives = max(arrives, self._in_transit[-1][0])
        if arrives <= self._time:
            self._hand.render(wrench)
        else:
            self._in_transit.append((arrives, wrench))

    def _draw_message_loss(self) -> bool:
        """Return True with the probability `loss`: the message of this call is then lost. Uses one random number."""
        return self._loss > 0.0 and self._random.random() < self._loss

    def stop(self) -> None:
        """Discard the forces in transit and stop the hand."""
        self._in_transit.clear()
        self._hand.stop()

    def set_approach(self, approach: Approach | None) -> None:
        """Set the straight path of the tool by which the motion of the hand converts depths to poses.

        Args:
            approach: Offset and tilt of the path; None: along the axis of the specimen.
        """
        self._hand.set_approach(approach)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Set the target of the hand's motion, depth and position across, m; see `HapticDevice.aim`."""
        self._hand.aim(depth, across)

    def describe(self) -> dict[str, Any]:
        """Return the description of the hand with delay, jitter and loss; keys carry units."""
        return {**self._hand.describe(), "device": "virtual hand behind a late line", "delay_ms": self._delay * 1e3,
                "jitter_ms": self._jitter * 1e3, "loss": self._loss}
