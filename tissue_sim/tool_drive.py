"""Motion of the tool of a test: prescribed displacement or force, through the load train of a rig."""

from __future__ import annotations

import math
import sys
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.fem.solver import Solver, Step, StepStatus
from tissue_sim.fem.stepping import AdaptiveIncrements, iterate_adaptive_steps_to_pose
from tissue_sim.material.effect import CombinedForceFactor
from tissue_sim.model import Model
from tissue_sim.pose import Pose, Screw, scale_screw


@dataclass(frozen=True)
class ToolSearchSettings:
    """Settings of the search for the displacement of the tool at a sample.

    Attributes:
        position_tolerance: tolerance of the tool position behind a compliant load train, relative to the displacement,
            1.
        force_tolerance: difference to the prescribed force, over the largest prescribed force so far, 1.
        near_tolerance: relative residual below which a trial after `many_trials` continues from the previous trial
            instead of from the last sample, 1.
        many_trials: number of trials after which `near_tolerance` is used.
        most_trials: largest number of trials for an increment of the force, or for a sample with a prescribed
            displacement.
        most_sample_trials: largest number of trials for all increments of a sample. A smaller value saves time if the
            force cannot be reached, but may stop a search with cut steps before it converges.
        first_step: first displacement of the tool in force control, over the thickness of the specimen, 1.
        expansion: largest ratio of the change of the displacement to the change before it, while no trial is beyond the
            solution.
        deepest: largest displacement of a trial in force control, over the thickness of the specimen, 1.
        longest: largest displacement of a grip in a trial in force control, over the height of the specimen, 1.
            Tough hydrogels reach stretches of about 20 (Sun et al., Nature 489, 2012, 133).
        smallest_increment: smallest increment of the force, over its change from sample to sample, 1.
        sufficient_decrease: largest ratio of a residual to the one before; above this ratio the bracket is bisected.
    """

    position_tolerance: float = 1e-7
    force_tolerance: float = 1e-8
    near_tolerance: float = 1e-3
    many_trials: int = 20
    most_trials: int = 40
    most_sample_trials: int = 200
    first_step: float = 1e-3
    expansion: float = 3.0
    deepest: float = 0.95
    longest: float = 25.0
    smallest_increment: float = 2.0**-5
    sufficient_decrease: float = 0.5


#: Settings of all simulations.
TOOL_SEARCH = ToolSearchSettings()
#: Smallest displacement that a relative tolerance of the displacement refers to, m.
_SMALLEST_DISPLACEMENT = 1e-6
#: Step of a tool in the air.
_NOTHING = Step.from_axial_force(StepStatus.CONVERGED, 0, 0.0, 0.0)


class SafeguardedSecant:
    """Root of an increasing function by the secant method, with bisection where the secant method is slow.

    Args:
        start: first trial.
        slope: estimated slope at the root; None: unknown.
        least_slope: lower bound of the slope, 0 or more.
        first_step: change of the first trial if the slope is unknown.
        lowest, highest: bounds of the trials.

    Attributes:
        trial: next value at which the function is needed.
        slope: last slope between two trials, or the estimate; None: unknown.

    Source: Dekker's method, see Brent, Algorithms for Minimization without Derivatives, 1973, chapter 4.
    """

    def __init__(self, start: float, slope: float | None, *, least_slope: float, first_step: float,
                 lowest: float = -math.inf, highest: float = math.inf):
        self.trial, self.slope = min(max(start, lowest), highest), slope
        self._least_slope, self._step, self._bounds = least_slope, first_step, (lowest, highest)
        self._last: tuple[float, float] | None = None
        self._below: tuple[float, float] | None = None
        self._above: tuple[float, float] | None = None

    @property
    def distance_to_trial_above(self) -> float:
        """Distance from `trial` to the nearest trial above the root; infinite without such a trial."""
        return self._above[0] - self.trial if self._above else math.inf

    def register_residual(self, residual: float, bisects: bool = False) -> bool:
        """Store the function at `trial` and choose the next trial.

        Args:
            residual: value of the function.
            bisects: whether the function has no slope at `trial`, so that a bracket is bisected; without a trial above
                the root the next trial is higher.

        Returns:
            Whether another trial remains.
        """
        x, last = self.trial, self._last
        if last is not None and x != last[0] and (secant := (residual - last[1]) / (x - last[0])) > 0:
            self.slope = max(secant, self._least_slope)
        self._last = x, residual
        if residual < 0:
            self._below = self._last
            if self._above and self._above[0] <= x:
                self._above = None  # the function is not monotonic, or depends on the path
        else:
            self._above = self._last
            if self._below and self._below[0] >= x:
                self._below = None
        self.trial = x - residual / self.slope if self.slope else x - math.copysign(math.inf, residual)
        if self._below and self._above:
            is_slow = bisects or (
                last is not None and abs(residual) > TOOL_SEARCH.sufficient_decrease * abs(last[1]))
            if is_slow or not self._below[0] < self.trial < self._above[0]:
                self.trial = 0.5 * (self._below[0] + self._above[0])
        else:
            limit = TOOL_SEARCH.expansion * max(self._step, abs(x - last[0]) if last is not None else 0.0)
            if bisects:
                self.trial = math.inf
            self.trial = min(max(self.trial, x - limit, self._bounds[0]), x + limit, self._bounds[1])
        return self.trial != x

    def has_jump(self, width: float, change: float) -> bool:
        """Return whether the function changes by more than `change` within a bracket narrower than `width`."""
        return self._below is not None and self._above is not None and (
            self._above[0] - self._below[0] < width and self._above[1] - self._below[1] > change)

    def forget_bracket(self) -> None:
        """Drop the bracket, because the function has changed."""
        self._below = self._above = None


@dataclass(frozen=True)
class _LastSample:
    """Displacement and force at the last sample or increment, from which a search starts.

    Attributes:
        depth: displacement of the tool, m.
        force: N.
        change: change of the displacement since the sample before, m.
        path_stiffness: dF/dd from the sample before, N/m; None: unknown or not positive.
        trial_stiffness: dF/dd between the last two trials, N/m; None: unknown.
    """

    depth: float = 0.0
    force: float = 0.0
    change: float = 0.0
    path_stiffness: float | None = None
    trial_stiffness: float | None = None

    def advance(self, depth: float, force: float, trial_stiffness: float | None) -> _LastSample:
        """Return the next sample with its displacement, m, force, N, and stiffness between trials, N/m."""
        change, rise = depth - self.depth, force - self.force
        return _LastSample(depth, force, change, rise / change if change * rise > 0 else None, trial_stiffness)


@dataclass(frozen=True)
class _Goal:
    """Equation of a sample: displacement_weight d + force_weight F(d) = value.

    Attributes:
        displacement_weight: 1 with prescribed displacement, 0 with prescribed force.
        force_weight: compliance of the load train, m/N, or 1 with prescribed force.
        value: displacement with a rigid load train, m, or force on the tool, N.
        scale: magnitude of the force that the tolerance refers to, N.
        words: value in words.
    """

    displacement_weight: float
    force_weight: float
    value: float
    scale: float
    words: str

    def compute_residual(self, depth: float, force: float) -> float:
        """Return the residual, m or N, at a displacement, m, and a force, N."""
        return self.displacement_weight * depth + self.force_weight * force - self.value

    def compute_scale(self, depth: float) -> float:
        """Return the magnitude that the residual is compared with, m or N."""
        return max(abs(self.value), abs(depth), _SMALLEST_DISPLACEMENT) if self.displacement_weight else self.scale

    @property
    def tolerance(self) -> float:
        """Largest ratio of the residual to its scale, 1."""
        return TOOL_SEARCH.position_tolerance if self.displacement_weight else TOOL_SEARCH.force_tolerance


class ToolDrive:
    """Motion of the tool along the protocol of an experiment, through a load train, in steps that converge.

    Args:
        solver: solver of the model.
        model: experiment, material and rig.
        options: options of each step of the solver, such as its tolerance.

    Raises:
        InputError: a grip rotates, and an effect of the material scales the force by the displacement.

    Attributes:
        protocol: protocol with the samples that are known so far; see `Protocol.append_remaining_segments`.
        reported: displacement that the stage reports at each sample so far, m.
        travel: displacement of the tool along its direction of motion at the last sample, m.
        failure: why the last sample has no solution; empty: the status of its last step states the cause.
    """

    def __init__(self, solver: Solver, model: Model, **options: Any):
        self._solver, self._model, self._experiment, self._options = solver, model, model.experiment, options
        self._reduced = CombinedForceFactor(
            effects := model.material.list_acting_force_scaling_effects(plate=model.experiment.tool.is_plate))
        if effects and model.experiment.protocol.prescribes_angle:
            raise InputError(f"must not scale the force by a displacement in torsion; got {effects[0].name}. Remove "
                             "the effect", field="material.effects")
        self.protocol = model.experiment.protocol
        self.reported: list[float] = []
        self.failure = ""
        self.travel = 0.0
        self._readings: list[float] = []
        self._last = _LastSample()
        # Displacement with a rigid load train, and reported displacement, when the stage last moved, m.
        self._before: tuple[float, float] | None = None
        self._largest_force = 0.0
        self._sample_trials = 0

    @property
    def combined_force_factor(self) -> float:
        """Factor of the effects in reduced form on the force at the present depth of the tool."""
        return self._reduced.compute_force_factor_at_depth(self._depth_for_effects)

    def register_sample_and_scale_wrench(self, wrench: Screw, dt: float) -> Screw:
        """Register a converged sample, dt s after the last one; returns its wrench with effects in reduced form."""
        wrench = scale_screw(self._reduced.record_depth_and_get_force_factor(self._depth_for_effects, dt), wrench)
        force = self._experiment.compute_force_against_motion(wrench)
        number, rig = len(self.reported), self._model.rig
        self._readings.append(rig.compute_reading_without_noise(
            force, self.protocol.time[number] - self.protocol.time[0]))
        unloaded = self.travel + rig.compliance * force
        prescribed = float(self.protocol.displacement[number])
        if math.isnan(prescribed):
            prescribed = rig.compute_reported_displacement(unloaded, self._before)
        self.reported.append(prescribed)
        if self._before is None or prescribed != self._before[1]:
            self._before = unloaded, prescribed
        return wrench

    def iterate_goals_durations_and_steps(self) -> Iterator[tuple[str, float, Iterable[Step]]]:
        """Yield the prescribed value in words, the time since the last sample, s, and the steps, for each sample.

        After a change of control that depends on the response, `protocol` grows by the following segments. If a segment
        cannot start from the response, the step of the last sample has not converged.
        """
        rig, is_in_air = self._model.rig, self._experiment.grip is None
        while True:
            protocol, first = self.protocol, len(self.reported)
            waits = np.diff(protocol.time, prepend=protocol.time[0]).tolist()
            is_force = protocol.is_force_controlled
            while first < protocol.time.size:
                # Samples with the same control; a motion of the stage is converted to that of the tool at once.
                end = first + int(np.argmax(np.append(is_force[first:] != is_force[first], True)))
                if is_force[first]:
                    for sample in range(first, end):
                        is_in_air = False
                        goal = self._make_force_goal(float(protocol.force[sample]), protocol.time[sample])
                        yield goal.words, waits[sample], self._iterate_solver_steps_to_goal(goal, waits[sample])
                else:
                    motion = np.concatenate([self.reported, protocol.displacement[first:end]])
                    positions = rig.compute_unloaded_tool_displacement(motion).tolist()
                    for sample in range(first, end):
                        position, dt = positions[sample], waits[sample]
                        goal = _Goal(1.0, rig.compliance, position, 0.0, self._experiment.format_displacement(position))
                        if is_in_air and position < 0.0:
                            # Nothing is solved.
                            self.travel, self._last = position, replace(self._last, depth=position)
                            yield goal.words, dt, [_NOTHING]
                            continue
                        if is_in_air and sample:
                            # Only the time after the touch counts.
                            dt *= position / (position - positions[sample - 1])
                        is_in_air = False
                        yield goal.words, dt, self._iterate_solver_steps_to_goal(goal, dt)
                first = end
            if protocol.remaining is None:
                return
            try:
                self.protocol = protocol.append_remaining_segments(np.array(self.reported), np.array(self._readings))
            except InputError as error:
                self.failure = error.problem
                yield "the next segment", 0.0, [replace(_NOTHING, status=StepStatus.OUTSIDE)]

    def make_followed_protocol(self) -> Protocol:
        """Return the displacement-controlled protocol along the displacements that the stage reported so far."""
        done = len(self.reported)
        segment, cycle = (None if labels is None else labels[:done]
                          for labels in (self.protocol.segment, self.protocol.cycle))
        return Protocol(self.protocol.time[:done], np.array(self.reported), segment, cycle,
                        expected_depth=self.protocol.expected_depth, prescribes_angle=self.protocol.prescribes_angle)

    def compute_prescribed_motion(self) -> np.ndarray:
        """Return a dimensionless motion that increases, rests and decreases with the prescribed quantity, shape (n,).

        It changes by 1, 0 or -1 from sample to sample.
        """
        forces = self.protocol.is_force_controlled[1:len(self.reported)]
        change = np.where(forces, np.diff(self._readings), np.diff(self.reported))
        if forces.any():
            # Rounding of a reading is not a motion.
            change[forces & (np.abs(change) <= TOOL_SEARCH.force_tolerance * self._largest_force)] = 0.0
        return np.concatenate([[0.0], np.cumsum(np.sign(change))])

    def _make_force_goal(self, reading: float, time: float) -> _Goal:
        """Return the goal of a sample at which the load cell reads a force, N, at a time, s."""
        force = self._model.rig.compute_controlled_force(reading, time - self.protocol.time[0])
        self._largest_force = max(self._largest_force, abs(force))
        return _Goal(0.0, 1.0, force, self._largest_force, f"a force of {reading:.4g} N")

    def _iterate_solver_steps_to_goal(self, goal: _Goal, dt: float) -> Iterator[Step]:
        """Yield the steps to one sample, `dt` s after the last sample; the last step is that of the sample."""
        solver, self._sample_trials = self._solver, 0
        if not goal.force_weight:
            self.travel = goal.value
            for step in iterate_adaptive_steps_to_pose(solver, self._make_pose(goal.value), dt, **self._options):
                yield step
            if step.status is StepStatus.CONVERGED:
                self._last = self._last.advance(goal.value, self._compute_trial_force(step, dt), None)
            return
        if goal.displacement_weight:
            yield from self._iterate_trials(goal, dt, dt)
            return
        # A long step with friction or lift-off is cut at places that differ from trial to trial, so that the force is
        # not continuous in the displacement; shorter increments of the force are not cut.
        increments, first = AdaptiveIncrements(TOOL_SEARCH.smallest_increment), self._last.force
        while not increments.is_complete:
            saved, end = solver.save(), increments.end
            part = replace(goal, value=first + end * (goal.value - first) if end < 1.0 else goal.value)
            if (yield from self._iterate_trials(part, (end - increments.done) * dt, end * dt)):
                increments.advance()
                continue
            if not increments.halve_and_check_size() or self._sample_trials >= TOOL_SEARCH.most_sample_trials:
                return
            solver.restore(saved)

    def _iterate_trials(self, goal: _Goal, dt: float, elapsed: float) -> Generator[Step, None, bool]:
        """Yield the steps of all trials for a goal.

        Args:
            goal: equation that the trials solve.
            dt: time since the state of the solver, s.
            elapsed: time since the last sample, s.

        Returns:
            Whether the last step solves the equation.
        """
        solver = self._solver
        saved, search, residual, lifts_off = solver.save(), self._start_search(goal), math.inf, False
        closest = (math.inf, 0.0, 0.0)
        for trial in range(min(TOOL_SEARCH.most_trials, TOOL_SEARCH.most_sample_trials - self._sample_trials)):
            self._sample_trials += 1
            # With cut steps friction takes another path in each trial, and the secant method does not converge: when
            # the goal is almost reached, the tool continues from there.
            near = trial >= TOOL_SEARCH.many_trials and (
                abs(residual) <= TOOL_SEARCH.near_tolerance * goal.compute_scale(self.travel))
            if near:
                search.forget_bracket()
            elif trial:
                solver.restore(saved)
            self.travel = search.trial
            force: float | None = None
            for step in iterate_adaptive_steps_to_pose(solver, self._make_pose(self.travel), 0.0 if near else dt,
                                                       **self._options):
                yield step
                if step.status is StepStatus.CONVERGED:
                    force = self._compute_trial_force(step, elapsed)
            if step.status is not StepStatus.CONVERGED:
                # The solution may be before the position at which the steps end.
                self.travel = search.trial = self._get_displacement_of_solver()
                if goal.displacement_weight or force is None or goal.compute_residual(self.travel, force) < 0.0:
                    return False
            assert force is not None
            residual, scale = goal.compute_residual(self.travel, force), goal.compute_scale(self.travel)
            # Before the first contact, every position in the air gives the prescribed force 0. After it, a trial in the
            # air is beyond the solution, for a force of 0 (the point of lift-off) and for a pulling force.
            is_in_air = force == 0.0 >= goal.value and not goal.displacement_weight and self._largest_force > 0.0
            lifts_off |= is_in_air and goal.value < 0.0
            closest = min(closest, (abs(residual), self.travel, force))
            if step.status is StepStatus.CONVERGED and abs(residual) <= goal.tolerance * scale and not (
                    is_in_air and search.distance_to_trial_above > self._position_tolerance):
                stiffness = None if search.slope is None else \
                    (search.slope - goal.displacement_weight) / goal.force_weight
                self._last, self.failure = self._last.advance(self.travel, force, stiffness), ""
                return True
            if not search.register_residual(-sys.float_info.min if is_in_air else residual, bisects=is_in_air) or (
                    search.has_jump(self._position_tolerance, TOOL_SEARCH.near_tolerance * scale)):
                break
        if not goal.displacement_weight:
            _, travel, force = closest
            force = 0.0 if abs(force) <= goal.tolerance * goal.scale else force
            self.failure = (f"no displacement of the tool gives this force; at "
                            f"{self._experiment.format_displacement(travel)} the force is {force:.4g} N. "
                            + ("The tool lifts off at a smaller pull. Pull with a smaller force, or prescribe the "
                               "displacement" if lifts_off else "Use smaller forces or more samples"))
        yield replace(step, status=StepStatus.SLOW, iterations=0)
        return False

    @property
    def _position_tolerance(self) -> float:
        """Tolerance of the position of a tool that touches without a force, m."""
        return TOOL_SEARCH.position_tolerance * max(abs(self.travel), _SMALLEST_DISPLACEMENT)

    @property
    def _depth_for_effects(self) -> float:
        """Depth of a tool, or displacement of a grip, m, at the state of the solver, for effects in reduced form."""
        return self._solver.pose.depth if self._experiment.grip is None else self._get_displacement_of_solver()

    def _get_displacement_of_solver(self) -> float:
        """Return the displacement of the tool along its direction of motion at the state of the solver, m."""
        return self._experiment.compute_displacement_on_path(self._solver.pose, near=self.travel)

    def _compute_trial_force(self, step: Step, dt: float) -> float:
        """Return the force of a converged step with effects in reduced form, N."""
        share = self._reduced.compute_force_factor_at_depth(self._depth_for_effects, dt)
        return share * self._experiment.compute_force_against_motion(step.wrench)

    def _start_search(self, goal: _Goal) -> SafeguardedSecant:
        """Return the search for the displacement of the tool, which starts from the last sample."""
        weight, thickness, last = goal.displacement_weight, self._experiment.thickness, self._last
        missing = -goal.compute_residual(last.depth, last.force)
        # The path from the sample before contains the relaxation, and predicts the next sample if the tool does not
        # turn; a secant of trials excludes the relaxation, and predicts the change from trial to trial.
        local = last.trial_stiffness or last.path_stiffness
        predicted, slope = (weight + goal.force_weight * (stiffness or 0.0) for stiffness in (
            last.path_stiffness if missing * last.change > 0 else local, local))
        if weight:
            return SafeguardedSecant(last.depth + missing / predicted, slope, least_slope=weight, first_step=math.inf)
        least = TOOL_SEARCH.first_step * thickness
        limit = max(least, TOOL_SEARCH.expansion * abs(last.change))
        change = missing / predicted if predicted else math.copysign(least, missing) if missing else 0.0
        grip, lowest = self._experiment.grip, -thickness
        highest = TOOL_SEARCH.longest * thickness
        if grip is None:
            highest = min(TOOL_SEARCH.deepest * thickness, self._experiment.largest_accurate_depth)
        elif not grip.axis[2]:
            lowest = -highest
        return SafeguardedSecant(last.depth + min(max(change, -limit), limit), slope or None, least_slope=0.0,
                                 first_step=least, lowest=lowest, highest=highest)

    def _make_pose(self, travel: float) -> Pose:
        return self._solver.project_pose(self._experiment.tool_pose(travel))
