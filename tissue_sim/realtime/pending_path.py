"""Path of the tool: its poses since the last equilibrium, unfinished iterations, first touch and lift-off.

A step that is late leaves its tick to the next steps. The force on tissue with mass, memory or friction depends on the
whole path: if one straight line replaced the late ticks, the force after a turn of the tool would be that of another
motion. Ticks are merged if the tool moves along one line (evenly, if the force depends on time). If more than
`MOST_TICKS` ticks are pending, the oldest ticks are merged as well, and `PendingPath.lost` is the time for which the
force may be wrong.

`ToolTrack` follows the tool in the air, at the first touch, in contact and after lift-off.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field, replace

from tissue_sim.fem.solver import Solver, Step
from tissue_sim.pose import (
    Pose,
    Quaternion,
    Screw,
    add_twist,
    compute_pose_distance,
    compute_rigid_motion,
    find_axis_twist_quaternion_or_none,
    interpolate_pose,
    remove_twist,
    scale_screw,
    shift_pose_along_z,
)
from tissue_sim.realtime.inertia_limits import UnresolvedWaveErrorEstimator
from tissue_sim.tool_force import Matrix, TouchState, make_axial_stiffness_matrix, make_axial_wrench, scale_matrix

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


#: Age of a stiffness that has not been computed yet.
NEVER = 1 << 30
#: Largest number of ticks that are followed one by one. The oldest ones beyond it are merged.
MOST_TICKS = 32


@dataclass(frozen=True, slots=True)
class PathTick:
    """One step of the tool's path that has no equilibrium yet.

    Attributes:
        pose: pose of the tool at the end of the tick.
        dt: duration, s.
        touches: whether the tool is in the air in this tick and touches the tissue in the next tick; see
            `ToolInAirInterface.bind_points_on_path`.
    """

    pose: Pose
    dt: float
    touches: bool = False


@dataclass(slots=True)
class PendingPath:
    """Path of the tool since the last equilibrium, as a list of ticks.

    Attributes:
        ticks: ticks in the order of time.
        meets: whether the tool touches the tissue in the next increment; see `ToolInAirInterface.bind_points_on_path`.
        lost: time for which an equilibrium is not that of the tool's own motion, since ticks that were not on one line
            were merged, s.
        gap: time for which an equilibrium depends on a part of the path that was left out, s; infinite while the tool
            is in contact, because friction depends on the whole path since the touch.
        is_direct: whether the tool has moved straight down since its touch, as it does in a `restart`.
        waves: error of the force by waves that the steps do not resolve.
    """

    ticks: list[PathTick] = field(default_factory=list)
    meets: bool = False
    lost: float = 0.0
    gap: float = 0.0
    is_direct: bool = True
    waves: UnresolvedWaveErrorEstimator = field(default_factory=UnresolvedWaveErrorEstimator)
    _spare: float = 0.0

    def copy(self) -> PendingPath:
        """Return an independent copy, for saved states."""
        return replace(self, ticks=list(self.ticks), waves=replace(self.waves))

    @property
    def elapsed_time(self) -> float:
        """Time since the last equilibrium, s."""
        return self._spare + sum(tick.dt for tick in self.ticks)

    @property
    def is_empty(self) -> bool:
        """Whether no motion or time is pending, so that the last equilibrium is that of the last pose."""
        return not self.ticks and self._spare == 0.0

    def append_tick(self, pose: Pose, dt: float) -> None:
        """Append a tick of dt s that ends at a pose."""
        self.ticks.append(PathTick(pose, self._spare + dt))
        self._spare = 0.0
        self.lost, self.gap = max(0.0, self.lost - dt), max(0.0, self.gap - dt)

    def append_motion_to_touch(self, pose: Pose, dt: float) -> None:
        """Append the motion in air of a tool that returns to the tissue: dt s up to a pose at the touch."""
        if dt > 0.0:
            self.ticks.append(PathTick(pose, dt, touches=True))
        else:
            self.meets = True

    def replace_first_tick_by_air_and_contact(self, start: Pose, fraction: float) -> None:
        """Split the first tick at the touch of a returning tool into a tick in air and a tick in contact.

        Args:
            start: pose of the tool at the end of the tick in air.
            fraction: fraction of the time of the tick that the tool spends in the air.
        """
        first, self.ticks = self.ticks[0], self.ticks[1:]
        rest = replace(first, dt=(1.0 - fraction) * first.dt)
        air = PathTick(start, fraction * first.dt, touches=True)
        self.meets = air.dt == 0.0
        self.ticks[:0] = [rest] if self.meets else [air, rest]

    def discard_all_ticks_keeping_time(self) -> None:
        """Remove all ticks, because their poses cannot be reached; their time is added to the next tick."""
        self._spare, self.ticks = self.elapsed_time, []

    @property
    def has_omitted_motion(self) -> bool:
        """Whether motion was left out, so that an equilibrium may differ from that of the complete path."""
        return self.lost > 0.0 or self.gap > 0.0

    def restart_from_above(self, pose: Pose, *, rubs: bool, ages: bool) -> None:
        """Replace all ticks by one tick from above the undeformed tissue straight down to a pose in the same time.

        Args:
            pose: end of the tick.
            rubs: whether the force depends on the path, as with friction.
            ages: whether the force depends on the time of the path.
        """
        self._spare, self.ticks = 0.0, [PathTick(pose, self.elapsed_time)]
        if ages or (rubs and not self.is_direct):
            self.gap = math.inf

    def clear_is_direct_unless_moving_down(self, way: Screw, negligible: float) -> None:
        """Set `is_direct` to False for a motion of the tool in contact that is not straight down.

        Args:
            way: translation, m, and rotation vector, rad.
            negligible: components up to this size are ignored, m and rad.
        """
        x, y, z, a, b, c = way
        if z > negligible or max(abs(x), abs(y), abs(a), abs(b), abs(c)) > negligible:
            self.is_direct = False

    def limit_omitted_path_time_to_memory(self, memory: float) -> None:
        """Limit `gap` to `memory`, the time for which the tissue remembers its path, s; called while in the air."""
        self.gap = min(self.gap, memory)

    def merge_straight_or_excess_ticks(self, start: Pose, radius: float, tolerance: float, lasts: float, *,
                                       timed: bool) -> None:
        """Merge the first ticks along which the tool moves on one line, and the oldest if there are too many.

        Args:
            start: pose of the last equilibrium.
            radius: of the contact, m: a rotation counts as the motion of its edge.
            tolerance: largest distance of a tick's end from the line, m; infinite if the tissue does not depend on the
                path.
            timed: whether the tool must also move evenly, since time counts.
            lasts: time for which the tissue remembers a path that was merged although it was not straight, s.
        """
        if len(self.ticks) < 2:
            return
        count = self._count_straight_ticks(start, radius, tolerance, timed)
        if len(self.ticks) - count >= MOST_TICKS:
            count, self.lost = len(self.ticks) - MOST_TICKS + 1, lasts
        if count > 1:
            merged = self.ticks[:count]
            self.ticks[:count] = [replace(merged[-1], dt=sum(tick.dt for tick in merged))]

    def _count_straight_ticks(self, start: Pose, radius: float, tolerance: float, timed: bool) -> int:
        """Return the number of ticks, from the first, along which the tool moves on one line; at least 1."""
        count, before = 1, start
        passed: list[float] = []
        for number, tick in enumerate(self.ticks):
            length = tick.dt if timed else compute_pose_distance(before, tick.pose, radius)
            passed.append(length + (passed[-1] if passed else 0.0))
            before, total = tick.pose, passed[-1]
            if number and self.ticks[number - 1].touches:
                break
            away = max(compute_pose_distance(interpolate_pose(start, tick.pose, at / total if total else 0.0),
                                              skipped.pose,
                                              radius)
                       for at, skipped in zip(passed, self.ticks, strict=False))
            if away > tolerance:
                break
            count = number + 1
        return count

    def remove_solved_time(self, dt: float, *, arrives: bool, timed: bool) -> None:
        """Remove the time of a solved step from the first tick, or the whole tick if the step ended at its end.

        Args:
            dt: time of the step, s.
            arrives: whether the step ended at the end of the tick, which is then removed.
            timed: whether time counts. Otherwise ticks in which the tool rests need no step.
        """
        first = self.ticks[0]
        if arrives:
            self.meets = first.touches
            del self.ticks[0]
            while self.ticks and not timed and self.ticks[0].pose == first.pose:
                del self.ticks[0]
        else:
            self.ticks[0] = replace(first, dt=max(0.0, first.dt - dt))


@dataclass(frozen=True, slots=True)
class LastEquilibrium:
    """Result of the last equilibrium, and the pose of the tool.

    Attributes:
        stiffness: static stiffness of the tissue.
        stiffness_age: number of inertial equilibria since that stiffness was computed.
        step_stiffness: stiffness within an inertial step; None after a static one.
        stiffness_time: time between the equilibrium whose stiffness it is and this one, s.
    """

    pose: Pose
    wrench: Screw
    stiffness: Matrix
    inertial: bool
    stiffness_age: int = 0
    step_stiffness: Matrix | None = None
    stiffness_time: float = 0.0

    def make_next_equilibrium(self, step: Step, pose: Pose, share: float, inertial: bool,
                              dt: float = 0.0) -> LastEquilibrium:
        """Return the equilibrium after a converged step; the stiffness of this one is kept if the step has none.

        Args:
            step: result of the solver.
            pose: pose of the tool.
            share: factor of effects in reduced form on the force.
            inertial: whether the step was inertial. If it has no static stiffness, that of this equilibrium is kept.
            dt: length of the step, s.

        Raises:
            TypeError: the solver returned no stiffness.
        """
        own, within, wrench = step.stiffness_matrix, step.step_stiffness_matrix, step.wrench
        if own is None and within is None:
            raise TypeError("step() must return a stiffness after enable_stiffness_output(); see "
                            "Solver.enable_stiffness_output")
        if share != 1.0:
            wrench = scale_screw(share, wrench)
            own = None if own is None else scale_matrix(share, own)
            within = None if within is None else scale_matrix(share, within)
        if own is None:
            return LastEquilibrium(pose, wrench, self.stiffness, inertial, self.stiffness_age + 1, within,
                                   self.stiffness_time + dt)
        return LastEquilibrium(pose, wrench, own, inertial, 0, within, step.stiffness_age)

    @classmethod
    def make_in_air(cls, pose: Pose) -> LastEquilibrium:
        """Return the equilibrium of a tool at a pose without contact."""
        return cls(pose, AT_REST.wrench, AT_REST.stiffness, False, NEVER)


#: Equilibrium without contact.
AT_REST = LastEquilibrium(Pose.at_depth(0.0), make_axial_wrench(0.0), make_axial_stiffness_matrix(0.0), False, NEVER)


@dataclass(frozen=True, slots=True)
class NewtonAttempt:
    """Unfinished Newton iteration for the equilibrium at a pose, dt seconds later, which the next step continues.

    Attributes:
        order: order of the extrapolation with which the iteration began.
        limit: largest number of linear solves.
        spent: number of linear solves so far.
    """

    pose: Pose
    dt: float
    order: int
    limit: int
    spent: int = 0


@dataclass(slots=True)
class DampedPathState:
    """Unfinished path of `Solver.iterate_steps_with_damping` to a pose, dt seconds later, and its last step."""

    pose: Pose
    dt: float
    last: Step
    steps: Generator[Step] = field(init=False)
    _allowed: int = field(init=False, default=1)

    def get_allowed_solves_until_yield(self) -> int:
        """Return the number of linear solves that the damped path may make until its next yield."""
        return self._allowed

    def compute_next_step_within_solves_or_none(self, allowed: int) -> Step | None:
        """Continue the damped path with at most `allowed` linear solves.

        Returns:
            The next step, which is also stored as `last`; None if the path is complete.
        """
        self._allowed = allowed
        step = next(self.steps, None)
        self.last = step or self.last
        return step
