"""Poses of the tool from step to step: in the air, at the first touch, in contact, after lift-off."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from tissue_sim.fem.solver import Solver
from tissue_sim.pose import (
    Pose,
    Quaternion,
    add_twist,
    compute_rigid_motion,
    find_axis_twist_quaternion_or_none,
    interpolate_pose,
    remove_twist,
    shift_pose_along_z,
)
from tissue_sim.tool_force import TouchState

#: Halvings in the search for the pose of a touch: the last part of the air is 1/4096 of the step.
_HALVINGS = 12


@dataclass(frozen=True)
class AxisTolerances:
    """Largest deviations of a tool that counts as on the axis of an axisymmetric scene.

    Attributes:
        offset: distance from the axis over the contact radius, 1.
        angle: angle between the axes of the tool and of the scene, rad.
    """

    offset: float = 0.01
    angle: float = 2e-3


#: Tolerances of every axisymmetric scene.
AXIS = AxisTolerances()


@dataclass(slots=True)
class ToolTrack:
    """Pose of the tool between two steps, and whether it has touched.

    For a body of revolution the rotation about its own axis at the touch has no influence. It is removed from the poses
    of solvers with `ToolInAirInterface.ignores_twist`.

    Attributes:
        touch: whether the tool has touched; see `TouchState`.
        pose: last pose that was not refused, as passed to the simulator; None before the first step.
        twist: rotation about its axis at the last touch, which is removed from the poses of the solver; None: none.
        is_refused: whether the tool entered the tissue at a pose at which the solver cannot place it, and has not left
            the tissue since.
    """

    touch: TouchState = field(default_factory=TouchState)
    twist: Quaternion | None = None
    pose: Pose | None = None
    is_refused: bool = False

    def copy(self) -> ToolTrack:
        """Return an independent copy, for saved states."""
        return replace(self, touch=self.touch.copy())

    def remove_twist_at_last_touch(self, pose: Pose) -> Pose:
        """Return a pose without the rotation about the tool's own axis at the last touch."""
        return pose if self.twist is None else remove_twist(pose, self.twist)

    def project_to_solver_pose_without_twist(self, solver: Solver, pose: Pose) -> Pose:
        """Return a pose projected to the motions of the solver, without the rotation about the tool's own axis."""
        return solver.project_pose(self.remove_twist_at_last_touch(pose))

    def add_twist_at_last_touch(self, pose: Pose) -> Pose:
        """Convert a pose of the solver to a pose as passed to the simulator.

        This is the inverse of `remove_twist_at_last_touch`.
        """
        return pose if self.twist is None else add_twist(pose, self.twist)

    def register_air_step_and_place_at_touch(self, solver: Solver, pose: Pose, dt: float) -> tuple[float | None, bool]:
        """Register a step before the first touch; if the tool touches, place the tool of the solver at the touch.

        Args:
            solver: solver whose tissue has not been touched.
            pose: pose at the end of the step, as passed to the simulator.
            dt: length of the step, s.

        Returns:
            Time of the step in contact, s, or None while the tool is in the air; and whether the solver can place the
            tool there. If it cannot, the tool has not touched, and cannot be placed until it has left the tissue,
            because tissue around it would belong to the position where it entered.
        """
        before = self.touch.height
        height = solver.height_above_tissue(pose)
        spent = self.touch.register_height_and_get_contact_duration(height, dt)
        if spent is None:
            self.is_refused = False
            return None, True
        if self.is_refused:
            self.touch = TouchState(False, height)
            return spent, False
        start = shift_pose_along_z(pose, -height)
        if before is not None and before > 0.0 and self.pose is not None:
            start = interpolate_pose(self.pose, pose, before / (before - height))
            start = shift_pose_along_z(start, -solver.height_above_tissue(start))
        twist = find_axis_twist_quaternion_or_none(start.orientation) if solver.ignores_twist else None
        if solver.place_tool_at_first_touch(remove_twist(start, twist)):
            self.twist = twist
            return spent, True
        self.touch, self.is_refused = TouchState(False, height), True
        return spent, False

    def place_at_next_touch_and_get_fraction(self, solver: Solver, pose: Pose) -> tuple[float, bool]:
        """Move a tool that has lifted off to the pose where it touches again on its straight path to a pose.

        Args:
            solver: solver whose tissue the tool has left.
            pose: pose at the end of the step, as passed to the simulator.

        Returns:
            Fraction of the step until the touch; and whether the touch begins as a first touch. If it does not, the
            tissue relaxes or oscillates until then.
        """
        assert self.pose is not None
        until = compute_fraction_in_air(solver, self.pose, pose)
        start = interpolate_pose(self.pose, pose, until)
        self.twist = find_axis_twist_quaternion_or_none(start.orientation) if solver.ignores_twist else None
        return until, solver.move_to_next_touch(self.project_to_solver_pose_without_twist(solver, start))


def compute_fraction_in_air(solver: Solver, before: Pose, pose: Pose) -> float:
    """Compute the fraction of a straight path at which a tool in the air touches the tissue in its present shape."""
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        clearance = solver.clearance(solver.project_pose(interpolate_pose(before, pose, middle)))
        low, high = (middle, high) if clearance is not None and clearance > 0.0 else (low, middle)
    return low


def is_pose_on_axis(pose: Pose, seen: Pose, radius: float) -> bool:
    """Return whether a pose agrees, within `AxisTolerances`, with its projection on the axis of symmetry.

    Args:
        pose: pose as passed to the simulator.
        seen: pose for the solver.
        radius: radius of the contact, m.
    """
    (x, y, _), (u, v, _) = pose.position, seen.position
    if abs(x - u) + abs(y - v) > 0.0 and math.hypot(x - u, y - v) > AXIS.offset * radius:
        return False
    if pose.orientation is seen.orientation:
        return True
    untwisted = remove_twist(pose, find_axis_twist_quaternion_or_none(pose.orientation))
    return math.hypot(*compute_rigid_motion(seen, untwisted)[3:]) <= AXIS.angle
