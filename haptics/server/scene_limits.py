"""Limits of the poses, the time steps and the forces of a server."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.realtime.tissue import MotionLimits
from tissue_sim.tool_force import ToolForce, make_axial_stiffness_matrix

__getattr__ = make_getattr_for_old_names(__name__, {"SceneLimits": "ServerLimits"})

_NO_STIFFNESS = make_axial_stiffness_matrix(0.0)


@dataclass(frozen=True)
class ServerLimits(MotionLimits):
    """Limits of the requests of a client (the fields of the base class), and of the force in a reply.

    Attributes:
        force: largest magnitude of the force in a reply, N.

    Raises:
        InputError: a limit is not positive.
    """

    force: float = 100.0

    def limit_force_and_zero_stiffness(self, answer: ToolForce) -> tuple[ToolForce, bool]:
        """Scale an answer so that its force does not exceed the limit.

        Force and torque are scaled by the same factor. The stiffness of a scaled answer is zero, because a client that
        extrapolates with the stiffness must not exceed the limit.

        Args:
            answer: answer of the tissue.

        Returns:
            The answer or its scaled copy, and whether it was scaled.
        """
        force = math.hypot(*answer.wrench[:3])
        if force <= self.force:
            return answer, False
        scaled = answer.multiply_force_and_set_status(self.force / force, answer.status)
        return replace(scaled, stiffness_matrix=_NO_STIFFNESS, ahead=None, step_stiffness_matrix=None,
                       stiffness_age=0.0, force_error=None, error_age=0.0), True
