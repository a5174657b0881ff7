"""Real-time stepping: where the tool is, a thousand times a second, to the force on it."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.solver import SOLVERS, Rung, Step, StepStatus, Surface
from tissue_sim.live_material import require_live, require_same_layers, require_tissue
from tissue_sim.material.effect import ReducedForce
from tissue_sim.model import Model
from tissue_sim.parameters import with_values
from tissue_sim.pose import Pose, Screw, between, motion
from tissue_sim.realtime_ladder import choose, measure_tick
from tissue_sim.simulator_state import AT_REST, NEVER, Attempt, Creep, SimulatorState
from tissue_sim.snapshot import Snapshot, snapshot
from tissue_sim.step_clock import Allowance, StepClock, require_solves, solves_in
from tissue_sim.tool_force import ForceStatus, NextForce, ToolForce, carried_on, pose_of

#: Unbalanced over balanced forces at which an equilibrium is one.
TOLERANCE = 1e-6
#: Linear solves that a part of a step may take: after an extrapolation, which is right or leads astray, and without.
_MOST_SOLVES = {True: 6, False: 30}
#: So many after an extrapolation that has led so near, unbalanced over balanced forces.
_MOST_IF_NEAR, _NEAR = 12, 1e-2
#: A tool that moves further in one step than this share of the contact's radius is followed in parts.
_LARGEST_PART = 0.0625
#: That no part is made for.
_ROUNDING = 1e-9
#: A part is cut until it is this share of the largest one; where one that is cut to less than the other share fails,
#: the tissue is let creep there, in steps of so many linear solves at most.
_SMALLEST_CUT, _CREEPS, _MOST_OF_CREEP = 2.0**-8, 0.5, 12
#: Tool speed, m/s, from which on the mass of the tissue counts, and for how long (s) after the tool was last so fast.
INERTIAL_SPEED, _LINGERS = 0.005, 0.1
#: Of tissue whose density nobody stated, kg/m3: that of water.
DENSITY = 1000.0
#: After so many inertial ticks the tissue's own stiffness is found anew: it costs a linear solve.
_STIFFNESS_LASTS = 5
#: Number of the rung of the ladder of meshes that is tried first.
_FIRST_RUNG = 1


class Simulator:
    """Force on a tool that goes where it likes, step by step.

    A step finds the equilibrium at the new pose from the one before; a long way is followed in parts, along a rigid
    motion at an even rate. Everything that the model's experiment and material state takes part: friction,
    relaxation, softening, layers, adhesion, puncture, self-weight. The rig does not: it belongs to the measurement.

    Args:
        model: experiment, material; of the protocol only the largest depth matters, to the mesh of tools without a
            flat face.
        resolution: as in `simulate`. With a budget ``"realtime"`` is the finest mesh of a ladder that this computer
            steps in it, chosen by `warm_up`; ``"realtime_63"`` and the like fix it.
        mesh: a mesh of your own instead.
        budget: wall time of a step, s, after which it answers what it knows (`ForceStatus.LATE`); None: however long
            it takes, and the same motion gives the same forces bit for bit.
        inertia: ``"auto"``: the mass of the tissue counts where the tool is faster than `INERTIAL_SPEED` and the
            solver knows of mass; ``"on"``, ``"off"``.
        tolerance: unbalanced over balanced nodal forces.
        solver: name in `tissue_sim.fem.solver.SOLVERS`.
        looks_ahead: whether answers in which the mass counts say what the next step would answer (`ToolForce.ahead`),
            for a virtual coupling; a tenth of the step's time.
        max_solves: linear solutions of a step, those of its stiffness included (of a reduced solid iterations, each
            with a contact of its own), after which it answers what it knows (`ForceStatus.LATE`). None: with a budget
            as many as `warm_up` finds to fit into it, else no bound.

    Attributes:
        resolution: which of the solver's names it has come to; "own mesh" where it was given.
        force_error: largest known error of the force on that mesh, over the force; None where nobody knows.
        error: estimate of how far the force of the last equilibrium may be off, N; None where the solver has none.

    Raises:
        InputError: an unknown solver, resolution or inertia, inertia that must be on where a solver has none, a tool
            that leans or slips in part, a modulus that is none of tissue, a bulk response or layers that do not fit.
        ConvergenceError: the specimen does not stand under its own weight.
        MissingBackendError: Taichi is not there.
    """

    def __init__(self, model: Model, *, resolution: str = "realtime", mesh: Any = None,
                 budget: float | None = None, inertia: str = "auto", tolerance: float = TOLERANCE,
                 solver: str = "axisymmetric", looks_ahead: bool = False, max_solves: int | None = None):
        if inertia not in ("auto", "on", "off"):
            raise InputError(f"{inertia!r} is not a choice of inertia; use 'auto', 'on' or 'off'", field="inertia")
        if budget is not None and not budget > 0:
            raise InputError(f"{budget:g} s is not a time to compute in; give a positive one or None", field="budget")
        require_solves(max_solves)
        require_live(model.experiment)
        require_tissue(model.material)
        self.model, self.budget, self.inertia, self.tolerance = model, budget, inertia, tolerance
        self.looks_ahead = looks_ahead
        self._solver = SOLVERS.find(solver, "solver")(model, resolution=resolution, mesh=mesh)
        self._solver_name, rungs = solver, () if mesh is not None else self._solver.realtime_rungs(model)
        #: To choose from.
        self._rungs = rungs if resolution == "realtime" and budget is not None else ()
        self.resolution = "own mesh" if mesh is not None else resolution
        self.force_error = {rung.resolution: rung.force_error for rung in rungs}.get(resolution)
        self._solver.ask_for_stiffness()
        self.density = model.experiment.specimen.density or model.material.density or DENSITY
        # Whether the solver knows of mass.
        self._weighs = inertia != "off" and self._solver.follow_motion(self.density) is not False
        if inertia == "on" and not self._weighs:
            raise InputError(f"the solver {solver!r} knows no mass of the tissue; use 'auto' or 'off'", field="inertia")
        # Whether the tool stays on the tissue, and whether the tissue can pull at it.
        self._bonded = model.experiment.friction == "bonded"
        self._pulls = self._bonded or bool(model.experiment.acting_laws)
        # A turn counts as the way of a point at the edge of the contact.
        self._radius = model.experiment.contact_radius
        self._largest_part = _LARGEST_PART * self._radius
        self._reduced = ReducedForce(model.material.reduced_effects(plate=model.experiment.tool.is_plate))
        # What the effects on the whole force left of it at the last equilibrium.
        self._left = 1.0
        self._solve: float | None = None  # wall time of one when it was warmed up, s
        self._clock, self._most = StepClock(), max_solves
        self._answer = ToolForce.axial(0.0, 0.0, ForceStatus.CONVERGED)
        self._equilibrium = AT_REST
        self.error: float | None = None
        # Where the tool is said to be; whether it has touched the tissue; time since the last equilibrium, and since
        # the tool was fast; and the share of the largest part that works.
        self._pose, self._touched = self._solver.pose, False
        self._waiting, self._lingers, self._share = 0.0, math.inf, 1.0
        # Whether a step without time has yet to arrive: on the way tissue has no mass, however many ticks it takes.
        self._leaps = False
        # An iteration to go on with; whether one may begin with an extrapolation; and whether the tool may be pressed
        # anew where no other way is left.
        self._attempt: Attempt | None = None
        self._extrapolates, self._anew = True, not self._bonded
        self._creep: Creep | None = None
        self._stiffness_lasts = _STIFFNESS_LASTS
        self._start = self.save()

    @property
    def mesh(self) -> Any:
        """The undeformed mesh."""
        return self._solver.mesh

    @property
    def solve_time(self) -> float:
        """Wall time of a linear solve with all that belongs to it, s, as it is known after `warm_up`."""
        return self._clock.solve

    @property
    def max_solves(self) -> int | None:
        """Linear solutions of a step at most; None: no bound."""
        return self._most or solves_in(self.budget, self._solve)

    def warm_up(self) -> None:
        """Compile what a step needs, or load it from the cache, choose a mesh where there is one to choose, and leave
        the state as it is. Takes seconds the first time on a computer; call it before the first step."""
        self._compile()
        if self._rungs:
            self._choose_mesh()

    def _choose_mesh(self) -> None:
        """Take the finest mesh whose ticks fit into the budget, once."""
        rungs, self._rungs = self._rungs, ()
        depth = float(np.max(self.model.experiment.protocol.displacement))
        made: dict[str, Simulator] = {}

        def tick_of(rung: Rung) -> float:
            try:
                one = Simulator(self.model, resolution=rung.resolution, inertia=self.inertia, tolerance=self.tolerance,
                                solver=self._solver_name, looks_ahead=self.looks_ahead)
            except ConvergenceError:  # a specimen that stands under its own weight on finer meshes only
                return math.inf
            made[rung.resolution] = one
            one._compile()
            one._stiffness_lasts = NEVER  # it has time where there is some
            tick = measure_tick(one, depth, lifts=not self._bonded, budget=self.budget or math.inf)
            one.reset()
            return tick

        rung = choose(rungs, _FIRST_RUNG, self.budget or math.inf, tick_of)
        if rung.resolution not in made:
            return
        one = made[rung.resolution]
        self._solver, self._clock, self._solve, self._start = one._solver, one._clock, one._solve, one._start
        self.resolution, self.force_error = rung.resolution, rung.force_error
        self.restore(self._start)

    def _compile(self) -> None:
        """Take three tiny steps, and go back."""
        saved, pose = self.save(), self._solver.pose
        x, y, z = pose.position
        spent = []
        for way in (1e-5, 2e-5, 3e-5):
            started = time.perf_counter()
            step = self._solver.step(replace(pose, position=(x, y, z - way * self._radius)), 1e-3,
                                     tolerance=self.tolerance)
            spent.append((time.perf_counter() - started) / (1 + step.iterations))
        self._clock.begin(min(spent))
        self._solve = self._clock.solve
        # What the first touch is carried on with, where it comes late.
        touch = replace(AT_REST, stiffness=AT_REST.followed_by(step, AT_REST.pose, 1.0, False).stiffness)
        self._start = replace(self._start, equilibrium=touch)
        self.restore(saved if saved.touched else replace(saved, equilibrium=touch))

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """Go where the tool is now.

        Args:
            pose: depth, m, or a `Pose`, of which an axisymmetric scene takes the depth only.
            dt: time since the step before, s. A step of no time is a sudden one.

        Returns:
            The force, and how it came about. What is not a number is refused and changes nothing. Of a step that came
            late the next one takes over the way and the time that are left.
        """
        began = time.perf_counter()
        pose = self._solver.follow(pose_of(pose))
        if not (pose.is_finite and math.isfinite(dt) and dt >= 0.0):
            return replace(self._answer, status=ForceStatus.REFUSED, iterations=0,
                           compute_time=time.perf_counter() - began)
        before, self._pose, tick = self._pose, pose, dt
        self._lingers = 0.0 if self._distance(before, pose) >= INERTIAL_SPEED * dt > 0.0 else self._lingers + dt
        if not self._touched:
            height, height_before = pose.position[2], before.position[2]
            if height > 0.0:
                # In the air, and the tissue rests as it was.
                self._answer = ToolForce(AT_REST.wrench, AT_REST.stiffness, ForceStatus.CONVERGED, pose=pose,
                                         compute_time=time.perf_counter() - began)
                return self._answer
            self._touched = True
            # The way from the touch on.
            dt *= height / (height - height_before) if height_before > 0.0 else 1.0
        self._waiting, self._leaps = self._waiting + dt, self._leaps or tick == 0.0
        self._answer = self._follow(pose, tick, began)
        return self._answer

    def _distance(self, start: Pose, end: Pose) -> float:
        """How far the points of the contact go at most, m."""
        x, y, z, a, b, c = motion(start, end)
        return math.hypot(x, y, z) + self._radius * math.hypot(a, b, c)

    def _follow(self, pose: Pose, tick: float, began: float) -> ToolForce:
        """Step to a pose in as many parts as it takes; the next step is thought as long as this tick, s."""
        solver, status, solves, residual, outside = self._solver, None, 0, self._answer.residual, False
        inertial = self.inertia == "on" or (self.inertia == "auto" and self._lingers < _LINGERS)
        allowance = Allowance(self._clock, self.max_solves, None if self.budget is None else began + self.budget)
        while status is None:
            started, creep, here = time.perf_counter(), self._creep, solver.pose
            way, part = self._distance(here, pose), self._share * self._largest_part
            # Parts of one length: the mass of the tissue resists a short one as a blow.
            share = 1.0 / max(1, math.ceil(way / part - _ROUNDING)) if way else 1.0
            # Without rounding the last part ends where the tool is.
            target, dt = between(here, pose, share), 0.0 if self._leaps else share * self._waiting
            if (attempt := self._attempt) is not None:
                target, dt = attempt.pose, attempt.dt
            weighs = inertial and self._weighs and dt > 0.0 and creep is None
            if attempt is None:
                # Across a change of contact extrapolation leads astray, but less so where mass is in the way.
                order = min(solver.highest_order, max(solver.unchanged, weighs)) if self._extrapolates else 0
                attempt = Attempt(target, dt, order, _MOST_SOLVES[order > 0])
            most = attempt.limit - attempt.spent
            asks = self._equilibrium.stiffness_age + 1 >= self._stiffness_lasts and allowance.fitting(answers=2) > 0
            fitting = allowance.fitting()
            if fitting < 1:
                status = ForceStatus.LATE
                allowance.end()
                break
            allowed = min(most, fitting)
            if creep is None:
                step = solver.step(target, dt, tolerance=self.tolerance, max_iterations=allowed, own_stiffness=asks,
                                   predictor_order=attempt.order, inertial=weighs, resumes=attempt is self._attempt)
            elif (crept := creep.go_on(fitting)) is not None:
                step = crept
            else:  # it has arrived, or will not
                step, target, dt, self._creep = replace(creep.last, iterations=0), creep.pose, creep.dt, None
            solves, residual = solves + step.iterations, step.residual
            # Its own stiffness, whether it was found or not.
            allowance.take(step.iterations, 1 + (weighs and asks and step.iterations < allowed))
            if not step.found_own_stiffness:
                self._clock.follow(time.perf_counter() - started, step.iterations)
            if self._creep is not None:
                continue
            attempt, self._attempt = replace(attempt, spent=attempt.spent + step.iterations), None
            if step.status is StepStatus.CONVERGED:
                self._take(step, dt, weighs)
                self._waiting = max(0.0, self._waiting - dt)
                self._share, self._extrapolates = min(1.0, 2.0 * self._share), True
                if target == pose and (creep is not None or share == 1.0 or self._waiting == 0.0):
                    self._waiting, self._leaps, self._anew = 0.0, False, not self._bonded
                    status = ForceStatus.CONVERGED
            elif creep is None and step.status is StepStatus.SLOW and allowed < most:
                # The next step goes on with this iteration, and with what is left of the way then.
                self._attempt, status = attempt, ForceStatus.LATE
            elif step.status is StepStatus.OUTSIDE:
                # No shorter part leads there; the tissue waits where it is, and what it would do is not guessed.
                status, outside = ForceStatus.STOPPED, True
            elif creep is None and attempt.order:
                if step.status is StepStatus.SLOW and step.residual <= _NEAR and attempt.limit < _MOST_IF_NEAR:
                    self._attempt = replace(attempt, limit=_MOST_IF_NEAR)
                else:
                    self._extrapolates = False
            elif creep is None and min(self._share, way / self._largest_part) < _CREEPS:
                # After a hold parts are as short as they may be, and no shorter.
                self._share = max(_SMALLEST_CUT, min(self._share, way / self._largest_part))
                self._creep = Creep(target, dt, step)
                self._creep.steps = solver.creep(target, dt, tolerance=self.tolerance, max_iterations=_MOST_OF_CREEP,
                                                 allowed=self._creep.may_take)
            else:
                self._share, self._extrapolates = 0.5 * self._share, True
                if self._share < _SMALLEST_CUT and self._anew:
                    # Press anew from the touch on; what friction remembers begins there.
                    solver.lift_off()
                    self._share, self._leaps, self._anew = 1.0, True, False
                elif self._share < _SMALLEST_CUT:
                    self._share, self._anew, status = _SMALLEST_CUT, not self._bonded, ForceStatus.STOPPED
        if status is ForceStatus.LATE and not solver.takes(pose):
            # It goes on to where the tool may be; what the force would be beyond is not guessed either.
            status, outside = ForceStatus.STOPPED, True
        at = self._equilibrium
        wrench, ahead, within = at.wrench, None, None
        if status is ForceStatus.CONVERGED:
            ahead = self._ahead(tick) if self.looks_ahead and at.inertial and tick > 0.0 else None
            within = at.step_stiffness
        elif not outside:
            # Mass resists a motion within the step, not one that goes on.
            wrench = self._carried_on(wrench, motion(at.pose, pose))
        return ToolForce(wrench, at.stiffness, status, solves, residual, time.perf_counter() - began, at.inertial,
                         self._waiting, at.pose, ahead, within)

    def _ahead(self, tick: float) -> NextForce | None:
        """What a next step of a tick, s, would answer, after one that converged."""
        ahead, left = self._solver.ahead(tick), self._left
        return ahead if ahead is None or left == 1.0 else ahead.scaled(left)

    def _carried_on(self, wrench: Screw, way: Screw) -> Screw:
        """The wrench of the last equilibrium a little further on; tissue that cannot pull at the tool does not."""
        wrench = carried_on(wrench, self._equilibrium.stiffness, way)
        return wrench if self._pulls or wrench[2] > 0.0 else AT_REST.wrench

    def _take(self, step: Step, dt: float, inertial: bool) -> None:
        """Keep what an equilibrium answers."""
        left = self._left = self._reduced.go(self._solver.pose.depth, dt)
        self._equilibrium = self._equilibrium.followed_by(step, self._solver.pose, left, inertial)
        self.error = None if step.force_error is None else left * step.force_error

    def reset(self) -> None:
        """Back to the specimen that nobody has touched."""
        self.restore(self._start)

    def save(self) -> SimulatorState:
        """All that the next step depends on, but for the parameters; where the tissue creeps it will do so anew."""
        self._stop_creeping()
        return SimulatorState(self._solver.save(), self._answer, self._equilibrium, self._pose,
                              self._leaps, self._waiting, self._lingers, self._share, self._touched,
                              self._reduced.history)

    def restore(self, state: SimulatorState) -> None:
        """Go back to where `save` was called, in this simulator or in one of the same model and mesh."""
        self._stop_creeping()
        self.error = None
        self._solver.restore(state.solver)
        self._answer, self._equilibrium = state.answer, state.equilibrium
        self._pose, self._leaps = state.pose, state.leaps
        self._waiting, self._lingers, self._share = state.waiting, state.lingers, state.share
        self._touched, self._reduced.history = state.touched, state.history
        self._attempt, self._extrapolates, self._anew = None, True, not self._bonded

    def _stop_creeping(self) -> None:
        """Back to the equilibrium from which the tissue crept away."""
        if self._creep is not None:
            self._creep.steps.close()
            self._creep = None

    def set_parameters(self, **values: float) -> None:
        """Change parameters of the material; the state is kept, and the next step finds its equilibrium.

        Args:
            values: by name, as in `sensitivities`: ``C10``; those of paths through a mapping,
                ``set_parameters(**{"viscoelastic.terms[0].g": 0.2})``.

        Raises:
            InputError: no such parameter, a value that the material refuses, or a modulus that is none of tissue
                (`tissue_sim.live_material`); nothing is changed.
        """
        material = with_values(self.model.material, values)
        require_same_layers(self.model.material, material)
        require_tissue(material)
        self._stop_creeping()
        self._solver.set_material(material)
        self.model = replace(self.model, material=material)
        history = self._reduced.history
        self._reduced = ReducedForce(material.reduced_effects(plate=self.model.experiment.tool.is_plate))
        self._reduced.history = history

    def surface(self) -> Surface:
        """The surface of the tissue at the last equilibrium."""
        return self._solver.surface()

    def snapshot(self) -> Snapshot:
        """The whole tissue at the last equilibrium, with its fields."""
        return snapshot(self._solver)
