"""Path following: equilibria along the path of the tool from step to step, within a budget of wall time.

The budget determines how many linear solves fit into a step, and the remaining time of the step.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from numbers import Integral

from tissue_sim.errors import InputError
from tissue_sim.fem.solver import Solver, StaticStiffnessRequest, Step, StepStatus
from tissue_sim.pose import (
    Pose,
    Screw,
    compute_pose_distance,
    compute_rigid_motion,
    interpolate_pose,
    shift_pose_along_z,
)
from tissue_sim.realtime.inertia_limits import (
    ContactWaveTimeAndShearSpeed,
    PathSettings,
    ToolReversalDetector,
    issue_light_tool_warning,
    minimum_stable_tool_mass,
)
from tissue_sim.realtime.pending_path import (
    AT_REST,
    DampedPathState,
    LastEquilibrium,
    NewtonAttempt,
    PendingPath,
    ToolTrack,
    compute_fraction_in_air,
)
from tissue_sim.realtime.tissue import RealTimeTissue
from tissue_sim.tool_force import (
    ForceStatus,
    ToolForce,
    compute_largest_force_change_for_motion,
    compute_negligible_force_error,
    extrapolate_wrench,
    is_force_error_acceptable_or_unknown,
    limit_force_of_wrench,
)

#: Smallest bound on the linear solves of a step: one for the iteration, one for the contact stiffness, and one for the
#: stiffness of tissue with mass.
LEAST_SOLVES = 3
#: Number of solves that stands for no bound.
_UNBOUNDED = 1 << 30


@dataclass(frozen=True)
class StepTimeEstimateSettings:
    """Settings of a `StepTimeEstimator`; all dimensionless.

    Attributes:
        gain_up: fraction by which the estimate of the fixed time approaches a step that took longer.
        gain_down: the same for a step that took less time.
        outlier_factor: a step longer than this many times its estimate counts as that long: the operating system may
            have interrupted it.
        step_weight: weight of one step in the moving means of the regression.
        least_variance: variance of the number of solves from which the regression determines the time of a solve.
        least_solve_fraction: smallest time of a solve as a fraction of the mean time per solve, where the fixed part
            counts as one solve.
    """

    gain_up: float = 0.5
    gain_down: float = 0.1
    outlier_factor: float = 2.0
    step_weight: float = 0.02
    least_variance: float = 0.1
    least_solve_fraction: float = 0.25


_SETTINGS = StepTimeEstimateSettings()


class StepTimeEstimator:
    """Estimates the wall time of a step, t = fixed + solve n, with n the number of its linear solves.

    The fixed part assembles, factorises and computes the force; each solve is one more pass over the tissue. The slope
    is a linear regression of the times on n with exponentially decaying weights.

    Attributes:
        fixed: time of a step without solves, s.
        solve: time of a linear solve, s.
    """

    def __init__(self):
        self.restart_estimate_from_solve_time(1e-9)

    def restart_estimate_from_solve_time(self, solve: float) -> None:
        """Restart the estimate from the measured time of one linear solve with its assembly, s."""
        self.fixed = self.solve = solve
        self._solves, self._time, self._variance, self._covariance = 1.0, 2.0 * solve, 0.0, 0.0

    def count_fitting_solves(self, time: float, first: bool = False) -> int:
        """Return the number of linear solves that fit, with the fixed time of a step, into a time.

        Args:
            time: s.
            first: whether this is the first part of a step. One solve is then allowed if the fixed part fits: a force
                that is a little late is better than none.

        Returns:
            The number; -1 if not even the fixed part fits.
        """
        return max(int((time - self.fixed) / self.solve), int(first)) if time >= self.fixed else -1

    def update_estimate(self, time: float, solves: int) -> None:
        """Update the estimate with a step that took this time, s, and made this number of solves."""
        expected = self.fixed + solves * self.solve
        time = min(time, _SETTINGS.outlier_factor * expected)
        excess, weight = time - expected, _SETTINGS.step_weight
        gain = _SETTINGS.gain_up if excess > 0.0 else _SETTINGS.gain_down
        self.fixed = max(self.fixed + gain * excess, 1e-9)
        a, b = solves - self._solves, time - self._time
        self._solves += weight * a
        self._time += weight * b
        self._variance += weight * ((1.0 - weight) * a * a - self._variance)
        self._covariance += weight * ((1.0 - weight) * a * b - self._covariance)
        if self._variance > _SETTINGS.least_variance:
            mean = self._time / (1.0 + self._solves)
            least = _SETTINGS.least_solve_fraction * mean
            self.solve = min(max(self._covariance / self._variance, least), mean)

    def halve_fixed_time(self) -> None:
        """Halve the estimated fixed time, which may come from one slow step, after a step without any solve."""
        self.fixed *= 0.5


def require_valid_max_solves(most: int | None) -> None:
    """Raise an error if the largest number of linear solves of a step is too small for any step.

    Raises:
        InputError: `most` is not an integer, or less than `LEAST_SOLVES`.
    """
    if most is not None and not (isinstance(most, Integral) and most >= LEAST_SOLVES):
        raise InputError(f"must be an integer of at least {LEAST_SOLVES}, or None; got {most!r}.", field="max_solves")


def count_solves_in_budget_or_none(budget: float | None, solve: float | None) -> int | None:
    """Return the number of linear solves that fit into a time budget, at least `LEAST_SOLVES`.

    Args:
        budget: wall time, s; None: no limit.
        solve: wall time of a linear solve, s; None: not known.

    Returns:
        The number; None if there is no budget or the time of a solve is not known.
    """
    if budget is None or solve is None:
        return None
    return max(LEAST_SOLVES, int(min(budget / solve, _UNBOUNDED)))


class StepBudget:
    """Number of linear solves and wall time that a step may still use.

    A step consists of parts; each part is a call of the solver, which makes one linear solve for the contact stiffness
    in addition to those of its iteration. All of them count.

    Args:
        clock: estimates the time of solves.
        most: largest number of linear solves of the step; None: no limit.
        ends: value of `time.perf_counter` at which the budget ends, s; None: no limit.
    """

    def __init__(self, clock: StepTimeEstimator, most: int | None, ends: float | None):
        self._clock, self._ends, self._left = clock, ends, _UNBOUNDED if most is None else most
        self._begins = True

    def count_fitting_solves(self, answers: int = 1) -> int:
        """Return the number of solves that the next substep may make besides its stiffnesses; below 1: do not begin.

        Args:
            answers: number of stiffnesses of the part, one solve each.
        """
        return min(self._left - answers, self._count_solves_in_time(answers, first=self._begins))

    def has_time_for_solves(self, solves: int, answers: int) -> bool:
        """Return whether the remaining time suffices for these solves and stiffnesses (`answers`)."""
        return self._count_solves_in_time(answers, first=False) >= solves

    def _count_solves_in_time(self, answers: int, first: bool) -> int:
        """Return the number of solves, besides stiffnesses (`answers`), that fit into the remaining time."""
        if self._ends is None:
            return _UNBOUNDED
        left = self._ends - time.perf_counter() - (answers - 1) * self._clock.fixed
        return self._clock.count_fitting_solves(left, first)

    def subtract_solves(self, solves: int, answers: int = 1) -> None:
        """Subtract the solves and stiffnesses (`answers`) of a completed substep from the budget."""
        self._left -= solves + answers
        self._begins = self._begins and solves == 0

    def lower_time_estimate_if_nothing_begun(self) -> None:
        """End the step: no further substep fits; if no substep was begun, lower the time estimate of the clock."""
        if self._begins and self._left > 1:
            self._clock.halve_fixed_time()


#: Number of inertial steps after which the static stiffness is computed again, by a linear solve.
_STIFFNESS_LASTS = 5


class PathFollowingTissue(RealTimeTissue):
    """Base of `Simulator` that follows the path of the tool: substeps, retries, damped paths, and the step result.

    Attributes:
        error: estimate of the error of the force at the last equilibrium, N; None if it is unknown.
    """

    budget: float | None
    inertia: str
    tolerance: float
    looks_ahead: bool
    force_error: float | None
    _solver: Solver
    _weighs: bool

    def _start_at_rest(self, settings: PathSettings, max_solves: int | None, density: float) -> None:
        """Set the parts of the path following, and the state before the first step; `density` in kg/m3."""
        experiment, self._settings, self._most = self.model.experiment, settings, max_solves
        # Whether the tool cannot lift off, and whether the tissue can attract the tool.
        self._bonded = experiment.friction == "bonded"
        self._pulls = self._bonded or bool(experiment.acting_laws)
        # Whether the force depends on the path of the tool, apart from its dependence on time.
        self._keeps_path = experiment.is_path_dependent or self.model.material.is_history_dependent
        # A rotation counts as the displacement of a point at the edge of the contact.
        self._radius = experiment.contact_radius
        self._largest_part = settings.largest_part * self._radius
        self._wave_scale = ContactWaveTimeAndShearSpeed.from_model(self.model, density)
        self._error_floor = compute_negligible_force_error(self.model.material.mu0, self._radius)
        self._left = 1.0  # factor of effects in reduced form on the force at the last equilibrium
        self._solve: float | None = None  # wall time of a linear solve at warm-up, s
        self._clock, self._stiffness_lasts = StepTimeEstimator(), _STIFFNESS_LASTS
        self._answer = ToolForce.from_axial_force(0.0, 0.0, ForceStatus.CONVERGED)
        self._equilibrium, self._pose = AT_REST, self._solver.pose
        self.error: float | None = None
        # Track of the tool; whether its first pose in the tissue has yet to be reached; largest force so far, N.
        self._tool, self._begins, self._largest_force = ToolTrack(), False, 0.0
        self._motion_check, self._has_warned = ToolReversalDetector(), False
        # Path since the last equilibrium; time since the last fast motion, s; fraction of the largest part that works.
        self._pending, self._lingers, self._share = PendingPath(), math.inf, 1.0
        # Whether a quasi-static transition is in progress: the tool is pressed on again, and no time passes.
        self._leaps = False
        self._has_waves = False  # whether waves that the last step did not resolve are too large a part of its force
        # Unfinished iteration; whether the next may extrapolate first; whether the tool may be pressed on again.
        self._attempt: NewtonAttempt | None = None
        self._extrapolates, self._can_restart = True, not self._bonded
        self._creep: DampedPathState | None = None

    @property
    def max_solves(self) -> int | None:
        """Largest number of linear solves of a step; None: no limit."""
        return self._most or count_solves_in_budget_or_none(self.budget, self._solve)

    def _register_motion_speed_and_reversals(self, target: Pose, dt: float) -> None:
        """Register speed, direction and reversals of a tool motion to a pose in dt s; warn once of a light tool."""
        if self._begins:
            return
        x, y, z, a, b, c = way = compute_rigid_motion(self._pose, target)
        if self._pending.is_direct:
            self._pending.clear_is_direct_unless_moving_down(way, self._settings.rounding * self._radius)
        length = math.hypot(x, y, z)
        if a or b or c:
            length += self._radius * math.hypot(a, b, c)
        is_fast = length >= self._settings.inertial_speed * dt > 0.0
        self._lingers = 0.0 if is_fast else self._lingers + dt
        self._motion_check.register_translation_and_detect_oscillation(x, y, z, dt, is_fast)
        if self._motion_check.quiet == 0.0 and self._equilibrium.inertial and not self._has_warned:
            self._has_warned = True
            issue_light_tool_warning(self._answer.least_tool_mass, looks_ahead=self.looks_ahead)

    @property
    def _is_tool_unloaded(self) -> bool:
        """Whether the tool may have lifted off at the last equilibrium."""
        x, y, z, *_ = self._equilibrium.wrench
        return not self._pulls and abs(x) + abs(y) + abs(z) <= self._settings.free_force * self._largest_force

    @property
    def _is_unloaded_above_first_touch(self) -> bool:
        """Whether the tool is unloaded and not below its first touch, where waves exert no force on the tool."""
        return self._is_tool_unloaded and self._solver.pose.depth <= 0.0

    def _move_in_air_and_get_force_or_time(self, pose: Pose, target: Pose, dt: float,
                                           began: float) -> ToolForce | float:
        """Move a tool that has lifted off to a pose, through the air as far as it does not touch.

        Returns:
            The result of the step, with zero force, if no equilibrium is needed; else the time of the step that remains
            to be solved, s, because the tool touches (it is then at the touch), or the tissue relaxes or oscillates.
        """
        solver, tool = self._solver, self._tool
        clearance = solver.clearance(target)
        if clearance is None:
            return dt
        if clearance <= 0.0:
            until, begins = tool.place_at_next_touch_and_get_fraction(solver, pose)
            assert tool.pose is not None
            self._pose = tool.project_to_solver_pose_without_twist(solver, tool.pose)
            if not begins:
                # The tissue relaxes or swings until the touch without the tool.
                solver.move_in_air(self._pose)
                depends_on_time = solver.is_time_dependent or self._includes_inertia
                self._pending.append_motion_to_touch(self._pose, until * dt if depends_on_time else 0.0)
            return (1.0 - until) * dt
        solver.move_in_air(target)
        self._pose = target
        self._pending.is_direct = True
        if self._pending.gap > 0.0:
            self._pending.limit_omitted_path_time_to_memory(self.model.material.compute_memory_time(self._radius))
        if solver.is_time_dependent or self._includes_inertia:
            return dt
        self._lingers += dt
        solver.stop_tissue_motion()
        self._reduced.record_depth_and_get_force_factor(target.depth, dt)
        tool.pose, self._equilibrium, self.error = pose, LastEquilibrium.make_in_air(target), None
        self._answer = self._make_zero_force(ForceStatus.CONVERGED, pose, began)
        return self._answer

    def _split_first_tick_at_renewed_touch(self, inertial: bool) -> None:
        """Split the first pending tick at the touch if the unloaded tool returns to the tissue in this tick."""
        solver, pending, here, first = self._solver, self._pending, self._solver.pose, self._pending.ticks[0]
        if not self._is_tool_unloaded or solver.ignores_twist or here == first.pose:
            return
        clearance, before = solver.clearance(first.pose), solver.clearance(here)
        if clearance is None or before is None or clearance > 0.0 or before <= 0.0:
            return
        until = compute_fraction_in_air(solver, here, first.pose)
        begins = solver.move_to_next_touch(interpolate_pose(here, first.pose, until))
        if not begins:
            solver.move_in_air(here)
        if begins or not (inertial or solver.is_time_dependent):
            pending.ticks[0] = replace(first, dt=(1.0 - until) * first.dt)
            pending.meets = not begins
        else:
            pending.replace_first_tick_by_air_and_contact(here, until)

    def _move_to_next_touch(self) -> Pose:
        """Move a tool in the air to the pose at which it touches the tissue in the next tick; return this pose."""
        solver, end = self._solver, self._pending.ticks[0].pose
        here = solver.pose
        clearance, before = solver.clearance(end), solver.clearance(here)
        if clearance is not None and before is not None and clearance <= 0.0 < before:
            solver.move_in_air(interpolate_pose(here, end, compute_fraction_in_air(solver, here, end)))
        return solver.pose

    def _restart_path_from_above(self, pose: Pose) -> None:
        """Lift the tool above a pose that was not reached, and make the pending path straight down to the pose."""
        solver = self._solver
        solver.reset_to_first_touch()
        solver.move_in_air(shift_pose_along_z(pose, -solver.height_above_tissue(pose)))
        # In the first step the motion to the pose is unknown, and the tool comes from above.
        self._pending.restart_from_above(pose, rubs=self._keeps_path and not self._begins,
                                         ages=self.model.material.is_history_dependent and not self._begins)
        self._share, self._leaps, self._can_restart = 1.0, True, False

    def _step_along_pending_path(self, pose: Pose, tick: float, began: float, is_behind: bool) -> ToolForce:
        """Solve the pending path up to a pose in as many parts as needed, within the budget; return the result.

        The parts are not `AdaptiveIncrements`: their length is a fraction of the contact radius that is kept from step
        to step, a tick is divided into parts of equal length, and the next step may continue an unfinished part.

        Args:
            pose: pose of the solver at the end.
            tick: length of the step, s; the next step is assumed to be as long.
            began: start of the step, `time.perf_counter`.
            is_behind: whether ticks of earlier steps have yet to be solved.
        """
        solver, status, solves, residual, outside = self._solver, None, 0, self._answer.residual, False
        pending = self._pending
        allowance = StepBudget(self._clock, self.max_solves, None if self.budget is None else began + self.budget)
        while status is None:
            started, creep, here, inertial = time.perf_counter(), self._creep, solver.pose, self._includes_inertia
            if creep is None and self._attempt is None:
                if len(pending.ticks) > 1 and allowance.count_fitting_solves() < LEAST_SOLVES * len(pending.ticks):
                    pending.merge_straight_or_excess_ticks(here, self._radius,
                                                           self._compute_straightness_tolerance(inertial),
                                                           self._settings.inertial_time,
                                                           timed=inertial or solver.is_time_dependent)
                if is_behind and not pending.meets:
                    self._split_first_tick_at_renewed_touch(inertial)
                if pending.meets:
                    here = self._move_to_next_touch()
            first = pending.ticks[0]
            way, part = compute_pose_distance(here, first.pose, self._radius), self._share * self._largest_part
            # Parts of equal length, because the mass of the tissue resists a short part like an impact.
            share = 1.0 / max(1, math.ceil(way / part - self._settings.rounding)) if way else 1.0
            # Without rounding the last part ends where the tool is.
            target, dt = interpolate_pose(here, first.pose, share), 0.0 if self._leaps else share * first.dt
            if (attempt := self._attempt) is not None:
                target, dt = attempt.pose, attempt.dt
            elif creep is None and not solver.accepts_pose(target):
                status, outside = ForceStatus.STOPPED, True
                break
            weighs = inertial and dt > 0.0 and creep is None
            if attempt is None and creep is None and pending.meets:
                solver.bind_points_on_path(target)
                pending.meets = False
            if attempt is None:
                # Extrapolation is inaccurate across a change of contact, but less with mass.
                known = max(solver.equilibria_since_contact_change, weighs) if self._extrapolates else 0
                order = min(solver.highest_order, known)
                limit = self._settings.most_extrapolated_solves if order > 0 else self._settings.most_solves
                attempt = NewtonAttempt(target, dt, order, limit)
            most = attempt.limit - attempt.spent
            fitting = allowance.count_fitting_solves()
            if fitting < 1:
                status = ForceStatus.LATE
                allowance.lower_time_estimate_if_nothing_begun()
                break
            allowed = min(most, fitting)
            asks = self._choose_stiffness_request(allowance, allowed)
            if creep is None:
                step = solver.step(target, dt, tolerance=self.tolerance, max_iterations=allowed, own_stiffness=asks,
                                   predictor_order=attempt.order, inertial=weighs, resumes=attempt is self._attempt)
            elif (crept := creep.compute_next_step_within_solves_or_none(fitting)) is not None:
                step = crept
            else:  # the damped path has ended
                step, target, dt, self._creep = replace(creep.last, iterations=0), creep.pose, creep.dt, None
            solves, residual = solves + step.iterations, step.residual
            # The static stiffness takes one answer, computed or not; a reserved solve is not part of the allowance.
            allowance.subtract_solves(
                step.iterations, 1 + (weighs and asks is StaticStiffnessRequest.IF_LEFT and step.iterations < allowed))
            if not step.has_static_and_step_stiffness:
                self._clock.update_estimate(time.perf_counter() - started, step.iterations)
            if self._creep is not None:
                continue
            spent, self._attempt = attempt.spent + step.iterations, None
            if step.status is StepStatus.CONVERGED:
                self._store_equilibrium(step, dt, weighs)
                self._update_omitted_wave_error(compute_rigid_motion(here, target), dt, weighs=weighs)
                self._share, self._extrapolates = min(1.0, 2.0 * self._share), True
                is_timed = inertial or solver.is_time_dependent
                is_over = self._leaps or not is_timed or first.dt - dt <= self._settings.rounding * first.dt
                arrives = is_over and target == first.pose
                pending.remove_solved_time(dt, arrives=arrives, timed=is_timed)
                if arrives and self._begins:
                    # The motion to the first pose is unknown: the tissue is at rest there.
                    solver.stop_tissue_motion()
                    self._begins = False
                elif inertial and (creep is not None or self._leaps):
                    # The tissue was brought to rest without its mass: its waves are lost.
                    pending.lost = self._settings.inertial_time
                if not pending.ticks:
                    self._leaps, self._can_restart, status = False, not self._bonded, ForceStatus.CONVERGED
            elif creep is None and step.status is StepStatus.SLOW and allowed < most:
                # The next step continues this iteration, and then the rest of the path.
                self._attempt, status = replace(attempt, spent=spent), ForceStatus.LATE
            elif step.status is StepStatus.OUTSIDE:
                # No shorter part reaches this pose; the tissue keeps its state.
                status, outside = ForceStatus.STOPPED, True
            elif creep is None and attempt.order:
                is_near = step.status is StepStatus.SLOW and step.residual <= self._settings.near_residual
                if is_near and attempt.limit < self._settings.most_near_solves:
                    self._attempt = replace(attempt, spent=spent, limit=self._settings.most_near_solves)
                else:
                    self._extrapolates = False
            elif creep is None and min(self._share, way / self._largest_part) < self._settings.damped_fraction:
                self._share = max(self._settings.smallest_cut, min(self._share, way / self._largest_part))
                self._creep = DampedPathState(target, dt, step)
                self._creep.steps = solver.iterate_steps_with_damping(
                    target, dt, tolerance=self.tolerance, max_iterations=self._settings.most_damped_solves,
                    allowed=self._creep.get_allowed_solves_until_yield)
            else:
                self._share, self._extrapolates = 0.5 * self._share, True
                if self._share < self._settings.smallest_cut and self._can_restart:
                    self._restart_path_from_above(pose)
                elif self._share < self._settings.smallest_cut:
                    self._share, self._can_restart = self._settings.smallest_cut, not self._bonded
                    status = ForceStatus.STOPPED
        if status is ForceStatus.LATE and not solver.accepts_pose(pose):
            # Extrapolate to the last pose that the tool may have; no force is estimated beyond it.
            status, outside = ForceStatus.STOPPED, True
        if status is ForceStatus.STOPPED:
            pending.discard_all_ticks_keeping_time()
        return self._make_path_step_result(pose, tick, status, outside, solves, residual, began)

    def _update_omitted_wave_error(self, way: Screw, dt: float, *, weighs: bool) -> None:
        """Update the force error by waves that a step omits: motion `way`, m, rad, in `dt` s; `weighs`: inertial."""
        waves, at, scale = self._pending.waves, self._equilibrium, self._wave_scale
        if not weighs or at.step_stiffness is None:
            waves.reset_error_at_step_without_mass(None if self._is_tool_unloaded else way, dt)
            return
        waves.register_step_with_mass(at.stiffness, at.step_stiffness, way, dt, scale)
        self._has_waves = not self._is_unloaded_above_first_touch and (
            waves.is_supersonic or not is_force_error_acceptable_or_unknown(at.wrench, waves.force, scale.floor))

    def _compute_straightness_tolerance(self, inertial: bool) -> float:
        """Return the largest distance of pending poses from a line, m; infinite if the path has no influence."""
        if inertial or self._solver.is_time_dependent or self._keeps_path:
            return self._settings.straightness * self._largest_part
        return math.inf

    def _choose_stiffness_request(self, allowance: StepBudget, allowed: int) -> StaticStiffnessRequest:
        """Decide whether a substep of at most `allowed` linear solves also computes the static stiffness."""
        age = self._equilibrium.stiffness_age + 1
        if age < self._stiffness_lasts:
            return StaticStiffnessRequest.OMITTED
        is_due = age >= self._settings.reserved_after * self._stiffness_lasts
        if is_due and allowance.has_time_for_solves(allowed, answers=2):
            return StaticStiffnessRequest.RESERVED
        if allowance.count_fitting_solves(answers=2) > 0:
            return StaticStiffnessRequest.IF_LEFT
        return StaticStiffnessRequest.OMITTED

    @property
    def _includes_inertia(self) -> bool:
        """Whether the inertia of the tissue acts in this step."""
        if not self._weighs or self._begins:
            return False
        least = self._settings.inertial_time
        return self.inertia == "on" or (self._lingers < least and self._motion_check.quiet >= least)

    def _make_path_step_result(self, pose: Pose, tick: float, status: ForceStatus, outside: bool, solves: int,
                               residual: float, began: float) -> ToolForce:
        """Make the result of a step: wrench of the last equilibrium, extrapolated to a pose unless converged."""
        at, tool, waiting = self._equilibrium, self._tool, self._pending.elapsed_time
        wrench, ahead, within = at.wrench, None, None
        if status is ForceStatus.CONVERGED:
            if self.looks_ahead and at.inertial and tick > 0.0:
                ahead = self._solver.predict_next_force(tick)
                if ahead is not None and self._left != 1.0:
                    ahead = ahead.multiply_wrench_and_stiffness(self._left)
            within = at.step_stiffness
            is_known = is_force_error_acceptable_or_unknown(wrench, self.error, self._error_floor)
            if self._pending.has_omitted_motion or self._has_waves or not is_known:
                status = ForceStatus.LATE
        elif not outside:
            # Mass resists the acceleration within a step, not a steady motion.
            wrench = extrapolate_wrench(wrench, at.stiffness, compute_rigid_motion(at.pose, pose))
            if not self._pulls and wrench[2] <= 0.0:
                wrench = AT_REST.wrench  # zero instead of a pull
            if status is ForceStatus.STOPPED:
                change = compute_largest_force_change_for_motion(at.stiffness, self._largest_part)
                wrench = limit_force_of_wrench(wrench, self._largest_force + change)
        # An equilibrium without the waves of the tissue, or after another path, has an unknown error.
        error = None if status is ForceStatus.STOPPED or self._pending.has_omitted_motion else self.error
        if error is not None and not self._is_unloaded_above_first_touch:
            error += self._pending.waves.force
        return ToolForce(wrench, at.stiffness, status, solves, residual, time.perf_counter() - began, at.inertial,
                         waiting, at.pose if tool.twist is None else tool.add_twist_at_last_touch(at.pose), ahead,
                         within, at.stiffness_time + waiting, error, waiting, True,
                         minimum_stable_tool_mass(at.stiffness, at.step_stiffness, tick))

    def _store_equilibrium(self, step: Step, dt: float, inertial: bool) -> None:
        """Store a converged step as the last equilibrium, its force times the factor of the reduced effects."""
        self._has_waves = False
        left = self._left = self._reduced.record_depth_and_get_force_factor(self._solver.pose.depth, dt)
        at = self._equilibrium = self._equilibrium.make_next_equilibrium(step, self._solver.pose, left, inertial, dt)
        x, y, z, *_ = at.wrench
        force = math.sqrt(x * x + y * y + z * z)
        if force > self._largest_force:
            self._largest_force = force
        # A solver's estimate, such as that of coarse elements at an edge, is a part of the stated error of the mesh.
        stated = None if self.force_error is None else self.force_error * force
        found = None if step.force_error is None else left * step.force_error
        self.error = max((error for error in (stated, found) if error is not None), default=None)
