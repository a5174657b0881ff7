"""What a scene can hold: poses, times and forces beyond are no matter of any tissue."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ToolForce, axial_stiffness

_NO_STIFFNESS = axial_stiffness(0.0)


@dataclass(frozen=True)
class SceneLimits:
    """Bounds of what a client may ask, and of what it is given.

    Attributes:
        deepest: m below the undeformed top face; deeper poses are refused.
        reach: m from the origin along each axis; further poses are refused.
        speed: m/s within the tissue; faster steps are refused, and a client that has jumped is heard again when enough
            time has passed. A step of no time is a sudden one and has no speed.
        longest: s; the longest time step.
        force: N; no reply has more.

    Raises:
        InputError: a limit that is not above zero.
    """

    deepest: float = math.inf
    reach: float = 10.0
    speed: float = 100.0
    longest: float = 86400.0
    force: float = 100.0

    def __post_init__(self):
        for each in fields(self):
            number = getattr(self, each.name)
            if not number > 0.0:
                raise InputError(f"{number:g} is no limit; give a number above zero", field=each.name)

    def require(self, pose: Pose, before: Pose | None, dt: float) -> None:
        """Look at a step before it touches the tissue.

        Args:
            pose: where the tool shall be.
            before: where it was in the last step; None where there was none.
            dt: time between them, s.

        Raises:
            InputError: what the scene cannot hold.
        """
        x, y, z = pose.position
        if not (pose.is_finite and max(abs(x), abs(y), abs(z)) <= self.reach):
            raise InputError(f"a tool more than {self.reach:g} m away", field="position")
        if -z > self.deepest:
            raise InputError(f"{-z:g} m is deeper than {self.deepest:g} m", field="position")
        if not 0.0 <= dt <= self.longest:
            raise InputError(f"a time step of {dt:g} s is not between 0 and {self.longest:g} s", field="time")
        if before is not None and dt > 0.0:
            u, v, w = before.position
            # Above the tissue a tool may move as it likes.
            way = abs(min(z, 0.0) - min(w, 0.0))
            if z < 0.0 and w < 0.0:
                way = math.hypot(x - u, y - v, way)
            if way > self.speed * dt:
                raise InputError(f"{way:g} m in {dt:g} s is faster than {self.speed:g} m/s", field="position")

    def limited(self, answer: ToolForce) -> tuple[ToolForce, bool]:
        """An answer with no more force than allowed, and whether it was cut; direction kept, torque cut alike, and no
        stiffness: a client that goes on with it must not pass the limit."""
        force = math.hypot(*answer.wrench[:3])
        if force <= self.force:
            return answer, False
        cut = answer.scaled(self.force / force, answer.status)
        return ToolForce(cut.wrench, _NO_STIFFNESS, cut.status, cut.iterations, cut.residual, cut.compute_time,
                         cut.inertial, cut.age, cut.pose), True
