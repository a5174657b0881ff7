"""A force that is no longer one of an equilibrium is let go."""

from __future__ import annotations

import math

from haptics.safety.watchdog import Watchdog, WatchdogState
from tissue_sim.errors import InputError
from tissue_sim.tool_force import ForceStatus, ToolForce

#: Time without an equilibrium, s, after which force and stiffness fade, and how long that takes; they return as long.
PATIENCE, RAMP = 0.050, 0.050
#: A first force up to this, N, is given as it is; one above it means that a tool was put into the tissue.
ENGAGES = 0.1
#: Longer than anything runs, s.
_NEVER = 1e300


class ForceRelease:
    """Between a tissue and whatever gives its force to a hand, a page or a client.

    An answer that is not CONVERGED carries on the last equilibrium. After `patience` without one force and stiffness
    go to zero together within `ramp` (FADING), so that a client which extrapolates does not go past the force that it
    was given; with the next equilibrium they come back as they went (RETURNING). A hand that begins inside the tissue
    (the first force is above `ENGAGES`) begins without a force in the same way. A pose that was refused stays REFUSED,
    with what the last force has faded to.

    Args:
        patience: s; infinite for local models of a solver that is slow by design and has an age of its own.
        ramp: s; see `Watchdog`.

    Raises:
        InputError: times that are not above zero; a ramp without end.
    """

    def __init__(self, patience: float = PATIENCE, ramp: float = RAMP):
        if not patience > 0.0:
            raise InputError(f"{patience:g} s is too short; give a time above zero", field="patience")
        self._watchdog = Watchdog(min(patience, _NEVER), ramp)
        self.reset()

    @property
    def gain(self) -> float:
        """Share of the force that was given in the last step, 0 to 1."""
        return self._watchdog.gain

    def reset(self) -> None:
        """The next answer is the first one."""
        self._watchdog.reset()
        self._last: float | None = None

    def step(self, answer: ToolForce, now: float) -> ToolForce:
        """What to give of an answer.

        Args:
            answer: of the tissue.
            now: s on a clock that never stands still, whatever a client says of its own time.
        """
        watchdog, last, self._last = self._watchdog, self._last, now
        if last is None and math.hypot(*answer.wrench[:3]) > ENGAGES:
            watchdog.withdraw()
        found = answer.status is ForceStatus.CONVERGED
        gain = watchdog.step(found, 0.0 if last is None else max(0.0, now - last))
        if gain == 1.0:
            return answer
        status = answer.status
        if found:
            status = ForceStatus.RETURNING
        elif status in (ForceStatus.LATE, ForceStatus.STOPPED) and watchdog.state is not WatchdogState.MISSING:
            status = ForceStatus.FADING
        return answer.scaled(gain, status)
