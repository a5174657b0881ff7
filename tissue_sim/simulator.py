"""Real-time stepping: where the tool is, a thousand times a second, to the force on it."""

from __future__ import annotations

import math
import threading
import time
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.explicit_coupling import MotionCheck
from tissue_sim.fem.solver import SOLVERS, ResolutionLevel, Surface
from tissue_sim.kernel_owner import KernelOwner, busy, exclusive
from tissue_sim.live_material import require_live, require_same_layers, require_tissue
from tissue_sim.material.effect import ReducedForce
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.motion_limits import LimitError, MotionLimits, checked_pose
from tissue_sim.parameters import with_values
from tissue_sim.path_following import LARGEST_PART, PathFollower
from tissue_sim.pending_path import PendingPath
from tissue_sim.pose import Pose
from tissue_sim.realtime_ladder import choose_level, measure_tick
from tissue_sim.simulator_state import AT_REST, NEVER, Attempt, Creep, SimulatorState, StateOrigin
from tissue_sim.snapshot import Snapshot, snapshot
from tissue_sim.step_clock import StepClock, require_solves
from tissue_sim.tool_force import ForceStatus, ToolForce, error_floor
from tissue_sim.tool_track import ToolTrack, is_on_axis

#: Unbalanced over balanced forces at which an equilibrium is one.
TOLERANCE = 1e-6
#: Density of tissue for which none is stated, kg/m3: that of water.
DENSITY = 1000.0
#: Inertial steps after which the stiffness of the tissue without its mass is computed again, by a linear solution.
_STIFFNESS_LASTS = 5
#: Number of the level of the ladder of meshes that is tried first.
_FIRST_LEVEL = 1


class Simulator(PathFollower, KernelOwner):
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
        inertia: ``"auto"``: the mass of the tissue counts if the tool is faster than
            `tissue_sim.path_following.INERTIAL_SPEED`, if the solver has a mass, and if the steps resolve the motion
            (`tissue_sim.explicit_coupling.MotionCheck`); ``"on"``, ``"off"``.
        tolerance: unbalanced over balanced nodal forces.
        solver: name in `tissue_sim.fem.solver.SOLVERS`.
        looks_ahead: whether answers in which the mass counts say what the next step would answer (`ToolForce.ahead`),
            for a virtual coupling; a tenth of the step's time.
        max_solves: linear solutions of a step, those of its stiffness included (of a reduced solid iterations, each
            with a contact of its own), after which it answers what it knows (`ForceStatus.LATE`). A stiffness of
            inertial steps for which none was left gets one more in every tenth step. None: with a budget as many as
            `warm_up` finds to fit into it, else no bound.
        strict_axis: whether an axisymmetric scene refuses a pose away from its axis or across it
            (`ForceStatus.REFUSED`), instead of marking the answer (`ToolForce.is_on_axis`). The tolerances are
            `tissue_sim.tool_track.AXIS_OFFSET` and `AXIS_ANGLE`.
        limits: of poses and time steps; see `MotionLimits`.

    One thread at a time may call a simulator; simultaneous calls raise `BusyError`. It cannot be copied or pickled:
    `clone` makes an independent simulator at the same state, `save` and `restore` keep a state.

    Attributes:
        resolution: which of the solver's names it has come to; "own mesh" where it was given.
        force_error: largest known error of the force on that mesh, over the force; None if it is not known.
        error: estimate of the error of the force at the last equilibrium, N; None if it is not known.

    Raises:
        InputError: an unknown solver, resolution or inertia, inertia that must be on where a solver has none, a tool
            that leans or slips in part, a modulus that is none of tissue, a bulk response or layers that do not fit.
        ConvergenceError: the specimen does not stand under its own weight.
        MissingBackendError: Taichi is not there.
    """

    copy_remedy = "Use clone() for an independent simulator at the same state, or save() and restore()."

    def __init__(self, model: Model, *, resolution: str = "realtime", mesh: Any = None,
                 budget: float | None = None, inertia: str = "auto", tolerance: float = TOLERANCE,
                 solver: str = "axisymmetric", looks_ahead: bool = False, max_solves: int | None = None,
                 strict_axis: bool = False, limits: MotionLimits | None = None):
        if inertia not in ("auto", "on", "off"):
            raise InputError(f"{inertia!r} is not a choice of inertia; use 'auto', 'on' or 'off'", field="inertia")
        if budget is not None and not budget > 0:
            raise InputError(f"{budget:g} s is not a time to compute in; give a positive one or None", field="budget")
        require_solves(max_solves)
        require_live(model.experiment)
        require_tissue(model.material)
        self.model, self.budget, self.inertia, self.tolerance = model, budget, inertia, tolerance
        self.looks_ahead, self.strict_axis, self.limits = looks_ahead, strict_axis, limits or MotionLimits()
        self._made_of, self._guard = (model, mesh), threading.RLock()
        self._solver = SOLVERS.find(solver, "solver")(model, resolution=resolution, mesh=mesh)
        self._solver_name, levels = solver, () if mesh is not None else self._solver.realtime_levels(model)
        #: To choose from.
        self._levels = levels if resolution == "realtime" and budget is not None else ()
        self.resolution = "own mesh" if mesh is not None else resolution
        self.force_error = {level.resolution: level.force_error for level in levels}.get(resolution)
        self._solver.ask_for_stiffness()
        self.density = model.experiment.specimen.density or model.material.density or DENSITY
        # Whether the solver knows of mass.
        self._weighs = inertia != "off" and self._solver.follow_motion(self.density) is not False
        if inertia == "on" and not self._weighs:
            raise InputError(f"the solver {solver!r} knows no mass of the tissue; use 'auto' or 'off'", field="inertia")
        # Whether the tool stays on the tissue, and whether the tissue can pull at it.
        self._bonded = model.experiment.friction == "bonded"
        self._pulls = self._bonded or bool(model.experiment.acting_laws)
        # Whether the force depends on the path of the tool even if time does not count.
        self._keeps_path = model.experiment.is_path_dependent or model.material.remembers
        # A turn counts as the way of a point at the edge of the contact.
        self._radius = model.experiment.contact_radius
        self._largest_part = LARGEST_PART * self._radius
        self._error_floor = error_floor(model.material.mu0, self._radius)
        self._reduced = ReducedForce(model.material.reduced_effects(plate=model.experiment.tool.is_plate))
        # What the effects on the whole force left of it at the last equilibrium.
        self._left = 1.0
        self._solve: float | None = None  # wall time of one when it was warmed up, s
        self._clock, self._most = StepClock(), max_solves
        self._answer = ToolForce.axial(0.0, 0.0, ForceStatus.CONVERGED)
        self._equilibrium = AT_REST
        self.error: float | None = None
        # Where the tool is, and whether it has touched; whether its first pose in the tissue has yet to be reached.
        self._tool, self._begins, self._largest_force = ToolTrack(), False, 0.0
        self._pose, self._motion_check, self._has_warned = self._solver.pose, MotionCheck(), False
        # Path since the last equilibrium; time since the last fast motion, s; fraction of the largest part that works.
        self._pending, self._lingers, self._share = PendingPath(), math.inf, 1.0
        # Whether the tool is pressed on again after no other way was left: until then no time passes.
        self._leaps = False
        # Whether the last equilibrium is one of merged ticks of tissue that swings.
        self._is_long = False
        # An iteration to go on with; whether one may begin with an extrapolation; and whether the tool may be pressed
        # anew where no other way is left.
        self._attempt: Attempt | None = None
        self._extrapolates, self._anew = True, not self._bonded
        self._creep: Creep | None = None
        self._stiffness_lasts = _STIFFNESS_LASTS
        self._origin = StateOrigin.of(solver, self._solver.identity(), model)
        self._start = self.save()

    @property
    def has_touched(self) -> bool:
        """Whether the tool has touched the tissue since the last `reset`."""
        return self._tool.touch.has_touched

    @property
    def mesh(self) -> Any:
        """The undeformed mesh."""
        return self._solver.mesh

    @property
    def solve_time(self) -> float:
        """Wall time of a linear solve with all that belongs to it, s, as it is known after `warm_up`."""
        return self._clock.solve

    @exclusive
    def warm_up(self) -> None:
        """Compile what a step needs, or load it from the cache, choose a mesh where there is one to choose, and leave
        the state as it is. Takes seconds the first time on a computer; call it before the first step."""
        self._compile()
        if self._levels:
            self._choose_mesh()

    def _choose_mesh(self) -> None:
        """Take the finest mesh whose ticks fit into the budget, once."""
        levels, self._levels = self._levels, ()
        depth = float(np.max(self.model.experiment.protocol.displacement))
        made: dict[str, Simulator] = {}

        def tick_of(level: ResolutionLevel) -> float:
            try:
                one = Simulator(self.model, resolution=level.resolution, inertia=self.inertia, tolerance=self.tolerance,
                                solver=self._solver_name, looks_ahead=self.looks_ahead)
            except ConvergenceError:  # a specimen that stands under its own weight on finer meshes only
                return math.inf
            made[level.resolution] = one
            one._compile()
            one._stiffness_lasts = NEVER  # it has time where there is some
            tick = measure_tick(one, depth, lifts=not self._bonded, budget=self.budget or math.inf)
            one.reset()
            return tick

        level = choose_level(levels, _FIRST_LEVEL, self.budget or math.inf, tick_of)
        if level.resolution not in made:
            return
        one = made[level.resolution]
        self._solver, self._clock, self._solve, self._start = one._solver, one._clock, one._solve, one._start
        self._origin = one._origin
        self.resolution, self.force_error = level.resolution, level.force_error
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
        self.restore(saved if saved.tool.touch.has_touched else replace(saved, equilibrium=touch))

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """Go where the tool is now.

        Until the tool touches for the first time, and while it is in the air after lift-off, no equilibrium is computed
        because of its motion. A tool that is inside in the first step is at rest there. A step that came late leaves
        the rest of the path and of the time to the next one.

        Args:
            pose: depth, m, or a `Pose`; an axisymmetric scene uses its depth only.
            dt: time since the last step, s; 0 for a sudden step.

        Returns:
            The force and its status. REFUSED, with the last force and nothing changed: numbers that are not finite, or
            beyond `limits`; with `strict_axis` a pose away from the axis or across it.

        Raises:
            InputError: a pose or a time that does not consist of numbers.
            BusyError: another thread is inside a call of this simulator.
        """
        if not self._guard.acquire(blocking=False):
            raise busy(self)
        try:
            return self._step(checked_pose(pose), dt, time.perf_counter())
        finally:
            self._guard.release()

    def _step(self, pose: Pose, dt: float, began: float) -> ToolForce:
        tool, solver = self._tool, self._solver
        try:
            self.limits.require(pose, tool.pose, dt)
        except LimitError:
            return self._refused(began)
        seen = tool.untwisted(pose)
        target = solver.project_pose(seen)
        on_axis = target is seen or is_on_axis(pose, target, self._radius)
        if not on_axis and self.strict_axis:
            return replace(self._refused(began), is_on_axis=False)
        tick, is_behind = dt, not self._pending.is_empty
        if not tool.touch.has_touched:
            first = tool.touch.height is None or tool.touch.height <= 0.0
            spent, is_possible = tool.first_contact(solver, pose, dt)
            if spent is None or not is_possible:
                tool.pose = pose
                status = ForceStatus.CONVERGED if is_possible else ForceStatus.STOPPED
                self._answer = ToolForce(AT_REST.wrench, AT_REST.stiffness, status, pose=pose, is_on_axis=on_axis,
                                         compute_time=time.perf_counter() - began)
                return self._answer
            self._begins, dt = first, spent
            self._pose, target = tool.seen_by(solver, tool.pose or pose), tool.seen_by(solver, pose)
        elif self._is_free:
            in_air = self._step_in_air(pose, target, dt, began)
            if isinstance(in_air, ToolForce):
                return in_air
            dt = in_air
            target = tool.seen_by(solver, pose)
        self._note_motion(target, tick)
        tool.pose, self._pose = pose, target
        self._pending.extend(target, dt)
        answer = self._follow(target, tick, began, is_behind)
        self._answer = answer if on_axis else replace(answer, is_on_axis=False)
        return self._answer

    def _refused(self, began: float) -> ToolForce:
        return replace(self._answer, status=ForceStatus.REFUSED, iterations=0,
                       compute_time=time.perf_counter() - began)

    @exclusive
    def reset(self) -> None:
        """Back to the specimen that nobody has touched."""
        self.restore(self._start)

    @exclusive
    def save(self) -> SimulatorState:
        """State on which the next step depends, without the parameters. A creep is stopped and starts again."""
        self._stop_creeping()
        return SimulatorState(self._origin, self._solver.save(), self._answer, self._equilibrium, self._tool.copy(),
                              self._pose, self._leaps, self._pending.copy(), self._lingers, self._share, self._begins,
                              self._largest_force, self._motion_check.copy(), self._reduced.history, self.error)

    @exclusive
    def restore(self, state: SimulatorState) -> None:
        """Restore a saved state, in this simulator or in one of the same solver, mesh, experiment and structure of the
        material; the values of parameters may differ.

        Raises:
            InputError: not a saved state, or one of another solver, mesh, experiment or material structure; nothing is
                changed.
        """
        if not isinstance(state, SimulatorState):
            raise InputError(f"must be a state that save() returned; got {type(state).__name__}.", field="state")
        self._origin.require(state.origin)
        self._stop_creeping()
        self._solver.restore(state.solver)
        self.error, self._answer, self._equilibrium = state.error, state.answer, state.equilibrium
        self._tool, self._pose, self._leaps = state.tool.copy(), state.pose, state.leaps
        self._pending, self._lingers, self._share = state.pending.copy(), state.lingers, state.share
        self._begins, self._largest_force = state.begins, state.largest_force
        self._motion_check, self._reduced.history = state.motion_check.copy(), state.history
        self._attempt, self._extrapolates, self._anew, self._is_long = None, True, not self._bonded, False

    @exclusive
    def clone(self) -> Simulator:
        """An independent simulator with the same parameters at the same state.

        Compiled kernels are shared, all arrays are its own. Steps of one do not change the other, so that planners and
        tree searches can try motions on it, also in another thread.
        """
        model, mesh = self._made_of
        chosen = self.resolution if mesh is None else "realtime"
        other = type(self)(model, resolution=chosen, mesh=mesh, inertia=self.inertia, tolerance=self.tolerance,
                           solver=self._solver_name, looks_ahead=self.looks_ahead, max_solves=self._most,
                           strict_axis=self.strict_axis, limits=self.limits)
        other.resolution, other.force_error, other.budget = self.resolution, self.force_error, self.budget
        other._levels, other._solve, other._clock = self._levels, self._solve, copy(self._clock)
        other._start, other._left, other._stiffness_lasts = self._start, self._left, self._stiffness_lasts
        if self.model is not model:
            other._set_material(self.model.material)
        other.restore(self.save())
        return other

    def _stop_creeping(self) -> None:
        """Back to the equilibrium from which the tissue crept away."""
        if self._creep is not None:
            self._creep.steps.close()
            self._creep = None

    @exclusive
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
        self._set_material(material)

    def _set_material(self, material: Material) -> None:
        self._solver.set_material(material)
        self.model = replace(self.model, material=material)
        history = self._reduced.history
        self._reduced = ReducedForce(material.reduced_effects(plate=self.model.experiment.tool.is_plate))
        self._reduced.history = history

    @exclusive
    def surface(self) -> Surface:
        """The surface of the tissue at the last equilibrium."""
        return self._solver.surface()

    @exclusive
    def snapshot(self) -> Snapshot:
        """The whole tissue at the last equilibrium, with its fields."""
        return snapshot(self._solver)
