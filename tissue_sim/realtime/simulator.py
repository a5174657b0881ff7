"""Real-time simulation: pose of the tool in, force on the tool out, about 1000 times per second.

A simulator saves its state between two steps. It selects the finest mesh that this computer steps within a time budget.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, is_dataclass, replace
from numbers import Real
from typing import Any

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.solver import SOLVERS, ResolutionLevel, Surface
from tissue_sim.fem.taichi.launch import make_single_thread_method
from tissue_sim.material.effect import ToolHistory
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.pose import Pose
from tissue_sim.public_names import with_old_names
from tissue_sim.realtime.inertia_limits import PATH, PathSettings, ToolReversalDetector
from tissue_sim.realtime.path_following import PathFollowingTissue, require_valid_max_solves
from tissue_sim.realtime.pending_path import AT_REST, NEVER, LastEquilibrium, PendingPath, ToolTrack, is_pose_on_axis
from tissue_sim.realtime.tissue import MotionLimits, require_real_time_experiment
from tissue_sim.snapshot import Snapshot, snapshot
from tissue_sim.tool_force import ForceStatus, Tissue, ToolForce


@dataclass(frozen=True)
class StateOrigin:
    """Origin of a saved state. A simulator restores states whose origin equals the origin of the states that it saves.

    Attributes:
        solver: name.
        mesh: digest of the undeformed mesh.
        experiment: specimen, tool, interfaces, approach and laws of contact, as text.
        material: law, effects and layers, without the values of parameters, as text.
    """

    solver: str
    mesh: str
    experiment: str
    material: str

    @classmethod
    def from_model(cls, solver: str, mesh: str, model: Model) -> StateOrigin:
        """Make the origin of saved states from solver name, digest of the mesh, and model."""
        experiment = {each.name: getattr(model.experiment, each.name) for each in fields(model.experiment)
                      if each.name != "protocol"}
        return cls(solver, mesh, repr(experiment), format_material_structure_as_text(model.material))

    def require_equal_origin(self, other: StateOrigin) -> None:
        """Raise an error unless a state has the same solver, mesh, experiment and material structure.

        Raises:
            InputError: another solver, mesh, experiment or structure of the material.
        """
        for name, what in (("solver", "solver"), ("experiment", "specimen, tool or interface"),
                           ("material", "law or with other effects or layers"), ("mesh", "mesh")):
            if getattr(self, name) != getattr(other, name):
                raise InputError(f"must be of the same model and mesh; this state is of another {what}. Restore the "
                                 "state in the simulator that saved it, or in a clone() of that simulator.",
                                 field="state")


def format_material_structure_as_text(value: Any) -> str:
    """Return law, effects and layers of a material as text, without numbers and names, to compare two structures."""
    if is_dataclass(value):
        inner = [f"{each.name}={format_material_structure_as_text(getattr(value, each.name))}" for each in fields(value)
                 if each.name not in ("name", "bulk", "parameters", "density", "source")]
        return f"{type(value).__name__}({', '.join(inner)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {format_material_structure_as_text(entry)}" for key,
                               entry in sorted(value.items())) + "}"
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(format_material_structure_as_text, value)) + "]"
    return "None" if value is None else "number" if isinstance(value, Real) else type(value).__name__


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """State of a simulator between two steps; see `Simulator.save`."""

    origin: StateOrigin
    solver: Any
    answer: ToolForce
    equilibrium: LastEquilibrium
    tool: ToolTrack
    pose: Pose
    leaps: bool
    pending: PendingPath
    lingers: float
    share: float
    begins: bool
    largest_force: float
    motion_check: ToolReversalDetector
    history: ToolHistory
    error: float | None


@dataclass(frozen=True)
class TimingMotionSettings:
    """Test motion by which the time of a tick is measured: a cosine in depth.

    Attributes:
        ticks: number of time steps.
        tick: time step, s.
        period: of the motion, s.
        depth_fraction: largest depth of the motion over the largest depth of the protocol, 1.
        lift_fraction: largest height above the tissue over the largest depth of the protocol, 1.
        in_time: fraction of the ticks that must be in time, 1.
    """

    __test__ = False  # for pytest

    ticks: int = 300
    tick: float = 1e-3
    period: float = 0.15
    depth_fraction: float = 0.5
    lift_fraction: float = 0.05
    in_time: float = 0.99


#: Motion of every measurement.
MOTION = TimingMotionSettings()
#: Least ratio of the time of a tick of a finer mesh to that of the next coarser mesh.
_LEAST_COST_RATIO = 1.5


def measure_tick_time_or_infinity(simulator: Tissue, depth: float, *, lifts: bool,
                                  budget: float = math.inf) -> float:
    """Measure the CPU time of this thread, s, within which 99 % of the ticks of a fast motion end.

    Args:
        simulator: simulator with its tool at the touch; its state changes.
        depth: largest depth, m.
        lifts: whether the tool leaves the tissue during the motion.
        budget: s; the result is infinity as soon as more than 1 % of the ticks took longer, so that a mesh that is too
            fine is rejected early.
    """
    height = MOTION.lift_fraction * depth if lifts else 0.0
    spent: list[float] = []
    slow, most = 0, MOTION.ticks - math.ceil(MOTION.in_time * MOTION.ticks)
    for k in range(MOTION.ticks):
        swing = 0.5 - 0.5 * math.cos(2.0 * math.pi * k * MOTION.tick / MOTION.period)
        began = time.thread_time()
        simulator.step((MOTION.depth_fraction * depth + height) * swing - height, MOTION.tick)
        spent.append(time.thread_time() - began)
        slow += spent[-1] > budget
        if slow > most:
            return math.inf
    return sorted(spent)[math.ceil(MOTION.in_time * MOTION.ticks) - 1]


def choose_finest_level_in_budget(levels: Sequence[ResolutionLevel], start: int, budget: float,
                                  tick_of: Callable[[ResolutionLevel], float]) -> ResolutionLevel:
    """Return the finest level whose tick fits into the budget; the coarsest if none fits.

    Args:
        levels: the finest first.
        start: index of the level that is measured first.
        budget: wall time of a tick, s.
        tick_of: measures the time of a tick on a level, s.
    """
    tick, index = tick_of(levels[start]), start
    if tick > budget:
        while tick > budget and index + 1 < len(levels):
            index += 1
            tick = tick_of(levels[index])
        return levels[index]
    while index > 0 and _LEAST_COST_RATIO * tick <= budget:
        tick = tick_of(levels[index - 1])
        if tick > budget:
            break
        index -= 1
    return levels[index]


#: Relative residual below which a state is an equilibrium, 1.
TOLERANCE = 1e-6
#: Density of tissue for which none is stated, kg/m3: that of water.
DENSITY = 1000.0
#: Index of the resolution level that is measured first.
_FIRST_LEVEL = 1


@with_old_names(solve_time="linear_solve_time")
class Simulator(PathFollowingTissue):
    """Force on a tool that follows any path, step by step.

    A step computes the equilibrium at the new pose from the previous one; a long motion is divided into parts along a
    rigid motion at constant velocity. All parts of the model's experiment and material act: friction, relaxation,
    softening, layers, adhesion, puncture, self-weight. The rig does not act, because it belongs to a measurement.

    Args:
        model: experiment and material. Of the protocol only the largest depth is used, for the mesh under tools without
            a flat face.
        resolution: as in `simulate`. With a budget ``"realtime"`` is the finest mesh whose steps fit into the budget on
            this computer, chosen by `warm_up`; ``"realtime_63"`` and similar names fix the mesh.
        mesh: mesh to use instead.
        budget: wall time of a step, s, after which the step returns an extrapolated force (`ForceStatus.LATE`); None:
            no limit, and the same motion gives the same forces bit for bit.
        inertia: ``"auto"``: the mass of the tissue acts if the tool is faster than `PathSettings.inertial_speed`, the
            solver has a mass, and the steps resolve the motion (`ToolReversalDetector`); ``"on"``, ``"off"``.
        tolerance: relative residual of the nodal forces, 1.
        solver: name in `tissue_sim.fem.solver.SOLVERS`.
        looks_ahead: whether inertial steps predict the force of the next step (`ToolForce.ahead`), for a virtual
            coupling; takes a tenth of the time of a step.
        max_solves: largest number of linear solves of a step, with those of its stiffness (for a reduced solid:
            iterations, each with a contact solution), after which the step returns an extrapolated force
            (`ForceStatus.LATE`). Every tenth step has one more for a static stiffness that found none left. None: the
            number that fits into the budget, as measured by `warm_up`; without a budget no limit.
        strict_axis: whether an axisymmetric scene refuses a pose off its axis or tilted (`ForceStatus.REFUSED`),
            instead of marking the result (`ToolForce.is_on_axis`); tolerances:
            `tissue_sim.realtime.pending_path.AxisTolerances`.
        limits: of poses and time steps; see `MotionLimits`.
        path_settings: division of the path of the tool into parts, and repetition of failed parts.

    Before the first touch, and in the air after lift-off, a motion of the tool needs no equilibrium. A tool that is
    inside of the tissue in the first step is at rest there. A late step leaves the rest of its path and of its time to
    the next step. With `strict_axis` the status of a pose off the axis or tilted is REFUSED.

    One thread at a time may call a simulator; simultaneous calls raise `BusyError`. It cannot be copied or pickled:
    `clone` makes an independent simulator at the same state, `save` and `restore` keep a state.

    Attributes:
        resolution: name of the resolution in use; "own mesh" for a given mesh.
        force_error: largest known relative error of the force on this mesh, 1; None if unknown.
        error: estimated error of the force at the last equilibrium, N; None if unknown.

    Raises:
        InputError: an unknown solver, resolution or inertia; inertia "on" with a solver without inertia; a tilted tool
            or partial slip; a modulus outside of the range of tissues; a bulk response or layers that the solver does
            not support.
        ConvergenceError: the specimen has no equilibrium under its own weight.
        MissingBackendError: Taichi is not installed.

    Examples:
        >>> from tissue_sim import KINDS, Bulk, Protocol, Specimen, Tool
        >>> needle = KINDS["needle_indentation"].experiment(
        ...     specimen=Specimen(0.040, 0.070), protocol=Protocol.ramp(0.002), tool=Tool("flat", radius=0.008))
        >>> simulator = Simulator(Model(needle, Material("neo_hooke", {"C10": 1000.0}, Bulk("bulk_ratio", 1e3))))
        >>> result = simulator.step(0.001, dt=0.001)
        >>> result.status.name, round(result.force, 2)  # N
        ('CONVERGED', 0.13)
    """

    copy_remedy = "Use clone() for an independent simulator at the same state, or save() and restore()."

    def __init__(self, model: Model, *, resolution: str = "realtime", mesh: Any = None,
                 budget: float | None = None, inertia: str = "auto", tolerance: float = TOLERANCE,
                 solver: str = "axisymmetric", looks_ahead: bool = False, max_solves: int | None = None,
                 strict_axis: bool = False, limits: MotionLimits | None = None, path_settings: PathSettings = PATH):
        if inertia not in ("auto", "on", "off"):
            raise InputError(f"must be 'auto', 'on' or 'off'; got {inertia!r}.", field="inertia")
        if budget is not None and not budget > 0:
            raise InputError(f"must be positive or None; got {budget:g} s.", field="budget")
        require_valid_max_solves(max_solves)
        require_real_time_experiment(model.experiment)
        model.experiment.protocol.require_displacement_control("the real-time simulation")
        super().__init__(model, limits)
        self.budget, self.inertia, self.tolerance = budget, inertia, tolerance
        self.looks_ahead, self.strict_axis = looks_ahead, strict_axis
        self._made_of = model, mesh
        self._solver = SOLVERS.find(solver, "solver")(model, resolution=resolution, mesh=mesh)
        self._solver_name, levels = solver, () if mesh is not None else self._solver.realtime_levels(model)
        #: Levels among which `warm_up` chooses.
        self._levels = levels if resolution == "realtime" and budget is not None else ()
        self.resolution = "own mesh" if mesh is not None else resolution
        self.force_error = {level.resolution: level.force_error for level in levels}.get(
            resolution, self._solver.stated_force_error)
        self._solver.enable_stiffness_output()
        self.density = model.experiment.specimen.density or model.material.density or DENSITY
        # Whether the solver supports inertia.
        self._weighs = inertia != "off" and self._solver.enable_inertia(self.density) is not False
        if inertia == "on" and not self._weighs:
            raise InputError(f"must be 'auto' or 'off' with the solver {solver!r}, which supports no inertia.",
                             field="inertia")
        self._start_at_rest(path_settings, max_solves, self.density)
        self._origin = StateOrigin.from_model(solver, self._solver.mesh_digest(), model)
        self._start = self.save()

    @property
    def has_touched(self) -> bool:
        """Whether the tool has touched the tissue since the last `reset`."""
        return self._tool.touch.has_touched

    @property
    def domain(self) -> str:
        """Poses for which the simulator has a force, and the error of the force on this mesh, as sentences."""
        error = "unknown" if self.force_error is None else f"{100.0 * self.force_error:.2g} %"
        return (f"The solver '{self._solver_name}' has forces for {self._solver.describe_domain()}. Largest known "
                f"force error of this mesh: {error}.")

    @property
    def mesh(self) -> Any:
        """Undeformed mesh of the specimen."""
        return self._solver.mesh

    @property
    def linear_solve_time(self) -> float:
        """Wall time of a linear solve with its assembly, s, estimated since `warm_up`."""
        return self._clock.solve

    @make_single_thread_method
    def warm_up(self) -> None:
        """Compile the kernels of a step or load them from the cache, and choose the mesh; the state is kept.

        This takes seconds the first time on a computer; call it before the first step.
        """
        self._compile_kernels_and_measure_solve_time()
        if self._levels:
            self._switch_to_finest_mesh_in_budget()

    def _switch_to_finest_mesh_in_budget(self) -> None:
        """Measure ticks, and replace the solver by that of the finest mesh in the budget; at the first call only."""
        levels, self._levels = self._levels, ()
        depth = self.model.experiment.protocol.depth
        made: dict[str, Simulator] = {}

        def measure_level_tick(level: ResolutionLevel) -> float:
            try:
                one = Simulator(self.model, resolution=level.resolution, inertia=self.inertia, tolerance=self.tolerance,
                                solver=self._solver_name, looks_ahead=self.looks_ahead, path_settings=self._settings)
            except ConvergenceError:  # the specimen has an equilibrium under its weight on finer meshes only
                return math.inf
            made[level.resolution] = one
            one._compile_kernels_and_measure_solve_time()
            one._stiffness_lasts = NEVER  # the static stiffness is only computed in spare time
            tick = measure_tick_time_or_infinity(one, depth, lifts=not self._bonded, budget=self.budget or math.inf)
            one.reset()
            return tick

        level = choose_finest_level_in_budget(levels, _FIRST_LEVEL, self.budget or math.inf, measure_level_tick)
        if level.resolution not in made:
            return
        one = made[level.resolution]
        self._solver, self._clock, self._solve, self._start = one._solver, one._clock, one._solve, one._start
        self._origin = one._origin
        self.resolution, self.force_error = level.resolution, level.force_error
        self.restore(self._start)

    def _compile_kernels_and_measure_solve_time(self) -> None:
        """Compile the kernels by three small steps, and restore the state."""
        saved, pose = self.save(), self._solver.pose
        x, y, z = pose.position
        spent = []
        for depth in (1e-5, 2e-5, 3e-5):
            started = time.perf_counter()
            step = self._solver.step(replace(pose, position=(x, y, z - depth * self._radius)), 1e-3,
                                     tolerance=self.tolerance)
            spent.append((time.perf_counter() - started) / (1 + step.iterations))
        self._clock.restart_estimate_from_solve_time(min(spent))
        self._solve = self._clock.solve
        # Stiffness with which a late first touch is extrapolated.
        touch = replace(AT_REST, stiffness=AT_REST.make_next_equilibrium(step, AT_REST.pose, 1.0, False).stiffness)
        self._start = replace(self._start, equilibrium=touch)
        self.restore(saved if saved.tool.touch.has_touched else replace(saved, equilibrium=touch))

    @property
    def _last_pose(self) -> Pose | None:
        """Pose of the tool in the last step; None before the first step."""
        return self._tool.pose

    def _compute_step(self, pose: Pose, dt: float, began: float) -> ToolForce:
        tool, solver = self._tool, self._solver
        seen = tool.remove_twist_at_last_touch(pose)
        target = solver.project_pose(seen)
        on_axis = target is seen or is_pose_on_axis(pose, target, self._radius)
        if not on_axis and self.strict_axis:
            return replace(self._make_refused_result(began), is_on_axis=False)
        tick, is_behind = dt, not self._pending.is_empty
        if not tool.touch.has_touched:
            first = tool.touch.height is None or tool.touch.height <= 0.0
            spent, is_possible = tool.register_air_step_and_place_at_touch(solver, pose, dt)
            if spent is None or not is_possible:
                tool.pose = pose
                status = ForceStatus.CONVERGED if is_possible else ForceStatus.STOPPED
                self._answer = self._make_zero_force(status, pose, began, on_axis)
                return self._answer
            self._begins, dt = first, spent
            self._pose, target = (tool.project_to_solver_pose_without_twist(solver, each)
                                  for each in (tool.pose or pose, pose))
        elif self._is_tool_unloaded and self._attempt is None and self._creep is None and self._pending.is_empty:
            in_air = self._move_in_air_and_get_force_or_time(pose, target, dt, began)
            if isinstance(in_air, ToolForce):
                return in_air
            dt = in_air
            target = tool.project_to_solver_pose_without_twist(solver, pose)
        self._register_motion_speed_and_reversals(target, tick)
        tool.pose, self._pose = pose, target
        self._pending.append_tick(target, dt)
        answer = self._step_along_pending_path(target, tick, began, is_behind)
        if not on_axis:
            answer = replace(answer, is_on_axis=False)
        self._answer = answer if dt == tick else replace(answer, time_since_touch=dt)
        return self._answer

    @make_single_thread_method
    def reset(self) -> None:
        """Return to the specimen before the first touch."""
        self.restore(self._start)

    @make_single_thread_method
    def save(self) -> SimulatorState:
        """Return the state on which the next step depends, without parameters; a damped path is restarted."""
        self._abandon_damped_path()
        return SimulatorState(self._origin, self._solver.save(), self._answer, self._equilibrium, self._tool.copy(),
                              self._pose, self._leaps, self._pending.copy(), self._lingers, self._share, self._begins,
                              self._largest_force, replace(self._motion_check), self._reduced.history, self.error)

    @make_single_thread_method
    def restore(self, state: SimulatorState) -> None:
        """Restore a saved state of this simulator or of a similar one.

        A similar simulator has the same solver, mesh, experiment and material structure; parameter values may differ.

        Raises:
            InputError: not a saved state, or one of another solver, mesh, experiment or material; nothing is changed.
        """
        if not isinstance(state, SimulatorState):
            raise InputError(f"must be a state that save() returned; got {type(state).__name__}.", field="state")
        self._origin.require_equal_origin(state.origin)
        self._abandon_damped_path()
        self._solver.restore(state.solver)
        self.error, self._answer, self._equilibrium = state.error, state.answer, state.equilibrium
        self._tool, self._pose, self._leaps = state.tool.copy(), state.pose, state.leaps
        self._pending, self._lingers, self._share = state.pending.copy(), state.lingers, state.share
        self._begins, self._largest_force = state.begins, state.largest_force
        self._motion_check, self._reduced.history = replace(state.motion_check), state.history
        self._attempt, self._extrapolates, self._can_restart, self._has_waves = None, True, not self._bonded, False

    @make_single_thread_method
    def clone(self) -> Simulator:
        """Return an independent simulator with the same parameters at the same state.

        Compiled kernels are shared, arrays are copied: planners can try motions on a clone, also in another thread.
        """
        model, mesh = self._made_of
        chosen = self.resolution if mesh is None else "realtime"
        other = type(self)(model, resolution=chosen, mesh=mesh, inertia=self.inertia, tolerance=self.tolerance,
                           solver=self._solver_name, looks_ahead=self.looks_ahead, max_solves=self._most,
                           strict_axis=self.strict_axis, limits=self.limits, path_settings=self._settings)
        other.resolution, other.force_error, other.budget = self.resolution, self.force_error, self.budget
        other._levels, other._solve, other._clock = self._levels, self._solve, copy(self._clock)
        other._start, other._left, other._stiffness_lasts = self._start, self._left, self._stiffness_lasts
        if self.model is not model:
            other._set_material(self.model.material)
        other.restore(self.save())
        return other

    def _abandon_damped_path(self) -> None:
        """Stop an unfinished damped path; the solver returns to the equilibrium at the start of the path."""
        if self._creep is not None:
            self._creep.steps.close()
            self._creep = None

    def _send_material_to_solver(self, material: Material) -> None:
        self._abandon_damped_path()
        self._solver.set_material(material)

    @make_single_thread_method
    def surface(self) -> Surface:
        """Return the surface of the tissue at the last equilibrium."""
        return self._solver.deformed_surface()

    @make_single_thread_method
    def snapshot(self) -> Snapshot:
        """Return a snapshot of the tissue at the last equilibrium, with its fields."""
        return snapshot(self._solver)
