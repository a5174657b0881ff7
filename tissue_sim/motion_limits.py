"""Limits of the poses and time steps that a scene accepts."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.public_names import OldName, rename_old_members_of_subclass


class LimitError(InputError):
    """A pose or a time step that a scene refuses: not finite, or beyond its limits."""


def convert_to_pose(pose: float | Pose) -> Pose:
    """Return a pose unchanged, or the upright pose on the axis at a depth, m; numbers may be NaN or infinite.

    Raises:
        InputError: something else than a pose of numbers, or than one real number.
    """
    if isinstance(pose, Pose):
        return pose
    if type(pose) is float:
        return Pose((0.0, 0.0, -pose))
    if isinstance(pose, str | bytes):
        raise _make_pose_error(pose)
    try:
        return Pose.at_depth(float(pose))
    except (TypeError, ValueError, OverflowError):
        raise _make_pose_error(pose) from None


def _make_pose_error(pose: object) -> InputError:
    """Make the error that an object is neither a pose nor a depth."""
    return InputError(f"must be a Pose, or a depth in m; got {pose!r}. Write Pose((x, y, z), (w, x, y, z)).",
                      field="pose")


@dataclass(frozen=True)
class MotionLimits:
    """Limits of poses and time steps, the same for a `Simulator` and for a server.

    Attributes:
        deepest: m below the undeformed top; deeper poses are refused.
        reach: m from the origin along each axis; poses farther away are refused.
        speed: m/s within the tissue; faster steps are refused. After a jump the tool is accepted again as soon as
            enough time has passed. A step of zero length has no speed. Above the tissue every speed is accepted.
        longest: s; longer time steps are refused.

    Raises:
        InputError: a limit that is not positive.
    """

    deepest: float = math.inf
    reach: float = 10.0
    speed: float = 100.0
    longest: float = 86400.0

    def __post_init__(self):
        for each in fields(self):
            number = getattr(self, each.name)
            if not number > 0.0:
                raise InputError(f"must be positive; got {number:g}.", field=each.name)

    require = OldName("require_valid_step")

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, {"require": "require_valid_step"})

    def require_valid_step(self, pose: Pose, before: Pose | None, dt: float) -> None:
        """Raise a `LimitError` for a pose or time step beyond the limits, before the step changes the tissue.

        Args:
            pose: of the tool at the end of the step.
            before: pose in the last accepted step; None before the first one.
            dt: length of the step, s.

        Raises:
            LimitError: a number that is not finite, or beyond a limit.
            InputError: a pose or a time that does not consist of numbers.
        """
        try:
            x, y, z = pose.position
            q, a, b, c = pose.orientation
            is_finite = math.isfinite(x + y + z + q + a + b + c)
            reach = self.reach
            is_near = -reach <= x <= reach and -reach <= y <= reach and -reach <= z <= reach
        except (TypeError, ValueError):
            raise InputError(f"must consist of numbers; got {pose!r}.", field="pose") from None
        if not is_finite:
            raise LimitError(f"position and orientation must be finite; got {pose!r}.", field="pose")
        if not is_near:
            raise LimitError(f"must be within {self.reach:g} m of the origin; got {pose.position}.",
                             field="position")
        if -z > self.deepest:
            raise LimitError(f"depth must be at most {self.deepest:g} m; got {-z:g} m.", field="position")
        try:
            is_possible = 0.0 <= dt <= self.longest
        except TypeError:
            raise InputError(f"dt must be a number of seconds; got {dt!r}.", field="time") from None
        if not is_possible:
            raise LimitError(f"dt must be 0 to {self.longest:g} s; got {dt:g} s.", field="time")
        if before is not None and dt > 0.0:
            u, v, w = before.position
            is_inside = z < 0.0 and w < 0.0
            length = math.hypot(x - u, y - v, z - w) if is_inside else abs(min(z, 0.0) - min(w, 0.0))
            if length > self.speed * dt:
                raise LimitError(f"speed within the tissue must be at most {self.speed:g} m/s; got {length:g} m in "
                                 f"{dt:g} s.", field="position")
