"""Limits of the poses, times and forces of a server's scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from tissue_sim.motion_limits import MotionLimits
from tissue_sim.tool_force import ToolForce, axial_stiffness

_NO_STIFFNESS = axial_stiffness(0.0)


@dataclass(frozen=True)
class SceneLimits(MotionLimits):
    """Limits of what a client may ask, as of a simulator, and of the force that it gets.

    Attributes:
        force: N; every reply has at most this force.

    Raises:
        InputError: a limit that is not positive.
    """

    force: float = 100.0

    def limited(self, answer: ToolForce) -> tuple[ToolForce, bool]:
        """An answer with no more force than allowed, and whether it was cut; direction kept, torque cut alike, and no
        stiffness: a client that goes on with it must not pass the limit."""
        force = math.hypot(*answer.wrench[:3])
        if force <= self.force:
            return answer, False
        cut = answer.scaled(self.force / force, answer.status)
        return replace(cut, stiffness_matrix=_NO_STIFFNESS, ahead=None, step_stiffness_matrix=None, stiffness_age=0.0,
                       force_error=None, error_age=0.0), True
