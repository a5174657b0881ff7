"""Solver of the axisymmetric solid: mesh, material, supports and contact, stepped by the depth of the tool.

Snap-through and abrupt changes of contact are solved by pseudo-transient continuation with artificial viscous damping.
Each step solves R(u) + c V (u - u_0) = 0, where R is the residual of the equilibrium, V the nodal volumes, u_0 the
state of the last step and c the damping. A large c keeps u close to u_0, so that Newton's iteration converges. The
damping is reduced from step to step, and the last step has none. Friction follows the path of the damped motion.

Source: Kelley and Keyes, SIAM J. Numer. Anal. 35 (1998) 508.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.contact import OutlineSpanColumn
from tissue_sim.fem.axisymmetric.equations import EquilibriumEquations
from tissue_sim.fem.axisymmetric.fields import DeformedSurface, Fields, extract_deformed_surface
from tissue_sim.fem.axisymmetric.resolutions import RESOLUTIONS, list_realtime_levels_finest_first
from tissue_sim.fem.axisymmetric.state import SavedState, SolverState, compute_extrapolation_weights
from tissue_sim.fem.axisymmetric.touch import bind_at_first_touch_and_get_height, bind_points_reached_in_half_increment
from tissue_sim.fem.contact.pairs import ContactPairs
from tissue_sim.fem.inertia import InertiaTimeIntegrator
from tissue_sim.fem.solver import (
    AT_REST,
    FRICTION_PATHS,
    ErrorEstimationRule,
    ExperimentDerivatives,
    Neighbours,
    ResolutionLevel,
    Solver,
    StaticStiffnessRequest,
    Step,
    StepStatus,
)
from tissue_sim.fem.taichi.launch import KernelOwner
from tissue_sim.material.material import Material
from tissue_sim.mesh import Mesh
from tissue_sim.model import Model
from tissue_sim.pose import NO_ROTATION, Pose
from tissue_sim.tool_force import (
    PredictedForceOfNextStep,
    get_depth_of_pose_or_number,
    make_axial_stiffness_matrix,
    make_axial_wrench,
)

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric.sensitivity import MaterialSensitivity


@dataclass(frozen=True)
class PseudoTransientSettings:
    """Settings of the pseudo-transient continuation.

    Damping is given in shear moduli over the squared height of the specimen.

    Attributes:
        first_damping: damping of the first step.
        last_damping: damping below which the next step has none.
        repeated_damping: smallest damping to which the continuation returns after a failure.
        max_reduction: largest ratio of the dampings of two successive steps.
        min_reduction: smallest ratio.
        reduction_growth: factor of the ratio after a step that converges quickly; a failed step halves the ratio.
        quick_solves: number of linear solves up to which a step counts as quick.
        first_increase: factor of the damping after a failure of the first step.
        increase: factor of the damping after a failure of a step whose damping has already converged once.
        max_pause: maximum number of steps with constant damping after a failure. The pause doubles at each failure,
            because tissue that snaps moves a long way during which no smaller damping converges.
        near_residual: relative residual below which a step may use more linear solves; then only points that change
            between stick and slip remain.
        near_factor: factor of the maximum number of linear solves of such a step.
        max_failures: number of successive failures after which the continuation stops.
        max_solves: total number of linear solves after which the continuation stops.
    """

    first_damping: float = 1e4
    last_damping: float = 1.0
    repeated_damping: float = 0.01
    max_reduction: float = 10.0
    min_reduction: float = 1.5
    reduction_growth: float = 1.5
    quick_solves: int = 12
    first_increase: float = 100.0
    increase: float = 10.0
    max_pause: int = 8
    near_residual: float = 1e-2
    near_factor: int = 4
    max_failures: int = 8
    max_solves: int = 1000


#: Settings of every continuation.
_SETTINGS = PseudoTransientSettings()


class DampableSolverProtocol(Protocol):
    """Attributes and methods of a solver that the continuation uses."""

    equations: EquilibriumEquations
    committed: SolverState

    def try_depth_step(self, depth: float, dt: float, tolerance: float, max_iterations: int, predictor_order: int,
                       rate: float, *, resumes: bool = False) -> Step:
        """Try a step with a damping force, `rate` (N/m4) times nodal volume times displacement from rest."""

    def save(self) -> SavedState:
        """Return the committed state."""

    def restore(self, saved: SavedState) -> None:
        """Return to a saved state."""


def iterate_damped_steps(solver: DampableSolverProtocol, depth: float, dt: float, tolerance: float, max_iterations: int,
                         allowed: Callable[[], int] | None = None) -> Generator[Step]:
    """Yield the steps of the continuation to a depth; the last one has converged without damping.

    The first step is damped towards the extrapolated motion of the tissue, the others towards the last state. If the
    continuation fails or is closed early, the solver returns to the state in which it began.

    Args:
        solver: solver with its last committed state.
        depth: depth of the tool, m.
        dt: duration of the first step, s; the others take no time.
        tolerance: relative residual of a converged step.
        max_iterations: maximum number of linear solves in a step.
        allowed: function that returns the number of linear solves until the next yield; None: no limit.

    Yields:
        Steps; `Step.dissipated` is the energy that the damping dissipates, J.
    """
    equations, state = solver.equations, solver.committed
    saved, volumes = solver.save(), equations.compute_dof_volumes()
    masses, rest, density = equations.replace_masses_by_damping_volumes()
    # Unit of the damping: shear modulus over the squared height of the specimen.
    unit = equations.material.mu0 / float(np.ptp(equations.mesh.nodes[:, 1])) ** 2
    working_damping = damping = _SETTINGS.first_damping * unit
    ratio, failures, has_begun, has_arrived = _SETTINGS.max_reduction, 0, False, False
    total_solves, remaining_pause, pause = 0, 0, 1
    try:
        while failures <= _SETTINGS.max_failures and total_solves < _SETTINGS.max_solves:
            if has_begun:
                rest[:] = state.last_committed_solution[: rest.size]
            else:
                weights = compute_extrapolation_weights(state.depths, depth, 1)
                rest[:] = sum(weight * state.history[slot, : rest.size]
                              for weight, slot in zip(weights, state.slots, strict=True))
            origin = rest.copy()
            step_solves, limit, resumes = 0, max_iterations, False
            while True:
                left = limit - step_solves
                most = left if allowed is None else min(left, allowed())
                step = solver.try_depth_step(depth, 0.0 if has_begun else dt, tolerance, most, 0 if has_begun else 1,
                                             damping, resumes=resumes)
                step_solves += max(1, step.iterations)
                if step.status is StepStatus.SLOW and most == left and limit == max_iterations and (
                        step.residual <= _SETTINGS.near_residual):
                    limit = _SETTINGS.near_factor * max_iterations
                elif step.status is not StepStatus.SLOW or most == left:
                    break
                resumes = True
                yield step
            total_solves += step_solves
            if step.status is StepStatus.CONVERGED:
                displacement = state.last_committed_solution[: rest.size] - origin
                has_arrived, has_begun, failures = damping == 0.0, True, 0
                working_damping = max(damping, _SETTINGS.repeated_damping * unit)
                yield replace(step, dissipated=damping * float(volumes @ displacement**2))
                if has_arrived:
                    break
                if step_solves <= _SETTINGS.quick_solves:
                    ratio = min(_SETTINGS.max_reduction, _SETTINGS.reduction_growth * ratio)
                if remaining_pause > 0:
                    remaining_pause -= 1
                else:
                    damping = damping / ratio if damping > _SETTINGS.last_damping * unit else 0.0
            else:
                yield step
                failures += 1
                # A damping that has converged once nearly always converges again from the present state.
                if not has_begun or damping >= working_damping:
                    working_damping = damping * (_SETTINGS.increase if has_begun else _SETTINGS.first_increase)
                else:
                    remaining_pause, pause = pause, min(2 * pause, _SETTINGS.max_pause)
                damping, ratio = working_damping, max(_SETTINGS.min_reduction, 0.5 * ratio)
    finally:
        equations.restore_masses_and_density(masses, density)
        if not has_arrived:
            solver.restore(saved)
    if not has_arrived:
        yield replace(step, status=StepStatus.SLOW if step.status is StepStatus.CONVERGED else step.status,
                      iterations=0)


#: Largest depth of the tool over the height of the specimen. At a stretch of 0.444 the free surface of compressed
#: incompressible neo-Hookean tissue becomes unstable (surface instability); beyond it equilibria are not unique.
#: Source: Biot, Appl. Sci. Res. A 12 (1963) 168.
MAX_RELATIVE_DEPTH = 1.0 - 0.444

_STATUSES = {int(status): status for status in StepStatus}


@dataclass(frozen=True, eq=False)
class FieldSample:
    """Solution of a committed step, from which fields are computed.

    Attributes:
        state: nodal displacements, pressure amplitudes, contact forces, shape (unknowns,).
        stresses: isochoric second Piola stresses, see `Fields.stresses`; None for tissue without memory.
    """

    state: np.ndarray
    stresses: np.ndarray | None


class AxisymmetricSolver(KernelOwner, Solver):
    """Stateful Newton solver of one axisymmetric boundary-value problem with contact.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        supports: node set -> fixed components, ``"r"``, ``"z"`` or ``"rz"``.
        tool: node set -> components that are bonded to the tool: ``"z"`` moves with the tool, ``"rz"`` also sticks.
        contact: contact pairs; None without contact.
        specific_weight: density times gravity, N/m3, towards -z.
        element_layers: index of the material's layer of each element, shape (elements,); an element with the number of
            layers as its index belongs to no layer. None: no element belongs to a layer.
        contact_radius: radius that determines the drainage time of the pores, m, see `Material.make_prony_series`.
        start: solver on the same mesh whose last state is the initial state, in which the tool touches; its contact
            pairs are the first pairs of this solver. None: the undeformed mesh.

    Raises:
        InputError: the bulk ratio is outside `BULK_RATIOS`.
        MissingBackendError: Taichi is not installed.
    """

    exact_experiment_parameters = FRICTION_PATHS

    def __init__(self, mesh: Mesh, material: Material, supports: dict[str, str], tool: dict[str, str], *,
                 contact: ContactPairs | None = None, specific_weight: float = 0.0,
                 element_layers: np.ndarray | None = None, contact_radius: float = 1.0,
                 start: AxisymmetricSolver | None = None):
        self.mesh = mesh
        self.equations: EquilibriumEquations = EquilibriumEquations(mesh, material, supports, tool, contact,
                                                                    specific_weight, element_layers, contact_radius,
                                                                    None if start is None else start.equations)
        equations = self.equations
        self.committed = equations.state
        #: Derivatives with respect to the material; None unless `enable_force_derivatives` was called.
        self._sensitivity: MaterialSensitivity | None = None
        # Target depth of the last iteration (m), and its number of linear solves.
        self._target_depth, self._iterated, self._pose = 0.0, 0, Pose.at_depth(0.0)
        self.datum = equations.settings[newton.StepSettingIndex.TOUCH] = 0.0 if contact is None \
            else bind_at_first_touch_and_get_height(
            mesh, contact, equations.surface, equations.start.reshape(-1, 2))
        self.committed.store_initial_bonds()
        self._max_depth = min(MAX_RELATIVE_DEPTH * float(np.ptp(mesh.nodes[:, 1])),
                              np.inf if contact is None else contact.largest_depth)
        self._holds_tissue = any(mesh.sets[name].size for name in tool)

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law of the material; the displacements stay.

        Raises:
            InputError: the bulk ratio is outside `BULK_RATIOS`; nothing is changed.
        """
        before = self.equations.material.mu0
        self.equations.set_material(material)
        # Pressures and contact forces scale with the modulus, exactly if all moduli change by the same factor.
        self.committed.history[:, self.equations.equation.size :] *= material.mu0 / before

    def project_pose(self, pose: Pose) -> Pose:
        """Return the upright pose on the axis that has the depth of a pose."""
        x, y, z = pose.position
        if x == y == 0.0 and pose.orientation == NO_ROTATION:
            return pose
        return Pose((0.0, 0.0, z))

    def accepts_pose(self, pose: Pose) -> bool:
        """Whether equilibria are unique and contact conditions are accurate at the depth of a pose.

        The limits are `MAX_RELATIVE_DEPTH` times the height, and `ContactPairs.largest_depth`.
        """
        return pose.depth <= self._max_depth

    def describe_domain(self) -> str:
        """See `Solver.describe_domain`."""
        return f"an upright tool on the axis of the scene, at most {1e3 * self._max_depth:.3g} mm deep"

    def step(self, pose: Pose | float, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = StaticStiffnessRequest.IF_LEFT) -> Step:
        """Move the tool to a depth (m), or to the depth of a pose, and solve for equilibrium; see `Solver.step`."""
        state, rate = self.committed, 0.0
        if state.motion is not None and inertial:
            rate = state.motion.prepare_step(state.last_committed_solution, dt)
        return self.try_depth_step(get_depth_of_pose_or_number(pose), dt, tolerance, max_iterations, predictor_order,
                                   rate, inertial=inertial, resumes=resumes, own_stiffness=own_stiffness)

    def try_depth_step(self, depth: float, dt: float, tolerance: float, max_iterations: int, predictor_order: int,
                       rate: float, *, inertial: bool = False, resumes: bool = False,
                       own_stiffness: int = StaticStiffnessRequest.IF_LEFT) -> Step:
        """Solve a step with the force `rate` times mass times displacement from rest (`EquilibriumEquations.rest`).

        Args:
            depth: depth of the tool, m.
            dt: duration, s.
            tolerance: relative residual of a converged step.
            max_iterations: maximum number of linear solves.
            predictor_order: order of the extrapolation of earlier states.
            rate: factor, 1/s2; of artificial damping, N/m4; 0: quasi-static.
            inertial: whether the force is that of inertia.
            resumes: whether the iteration of the last call continues.
            own_stiffness: an `StaticStiffnessRequest`.
        """
        equations, state = self.equations, self.committed
        if not resumes:
            by_time = inertial and len(state.times) > 1
            equations.set_extrapolation_weights(compute_extrapolation_weights(state.times, dt,
                                                                              predictor_order) if by_time
                                                else compute_extrapolation_weights(state.depths, depth,
                                                                                   predictor_order))
        equations.set_step_duration(dt)
        equations.settings[newton.StepSettingIndex.INERTIA] = rate
        self._iterated *= resumes
        equations.solve_equilibrium(depth, tolerance, max_iterations,
                                    resumed_depth=self._target_depth if resumes else None, iterated=self._iterated)
        self._target_depth = depth
        status, iterations, residual, force, violation, slipping, stiffness = equations.report.tolist()
        self._iterated += int(iterations)
        asked = bool(equations.counts[newton.StepIntegerIndex.STIFFNESS_ASKED])
        outcome, own, within = _STATUSES[int(status)], stiffness if asked else None, None
        converged = outcome is StepStatus.CONVERGED
        if converged and asked and inertial:
            is_due = StaticStiffnessRequest.needs_stiffness_given_spare_solve(
                own_stiffness, iterations < max_iterations)
            own, within = equations.compute_static_stiffness_or_none() if is_due else None, stiffness
        result = Step.from_axial_force(outcome, int(iterations), residual, force, violation, int(slipping), own, within)
        if converged:
            if inertial or rate == 0.0:  # the force of artificial damping is no load
                state.largest_force = max(state.largest_force, abs(force))
            if self._sensitivity is not None:
                self._sensitivity.update_at_equilibrium()
            if state.motion is not None:
                state.motion.commit_step(state.last_committed_solution, state.x, dt, inertial)
            state.commit_step(depth, dt if inertial else 0.0, watched=asked)
        return result

    def iterate_steps_with_damping(self, pose: Pose | float, dt: float = 0.0, *, tolerance: float = 1e-9,
                                   max_iterations: int = 20, allowed: Callable[[], int] | None = None
                                   ) -> Generator[Step]:
        """Step to a depth (m), or to the depth of a pose, with decreasing damping."""
        return iterate_damped_steps(self, get_depth_of_pose_or_number(pose), dt, tolerance, max_iterations, allowed)

    def enable_inertia(self, density: float) -> bool:
        """Enable inertial steps with a mass density, kg/m3; returns True, because the solver supports inertia."""
        equations = self.equations
        self.committed.motion = InertiaTimeIntegrator(equations.masses, equations.rest,
                                                      density * equations.dof_volumes_of_shared_nodes)
        equations.settings[newton.StepSettingIndex.DENSITY] = density
        self._masses = density * equations.compute_dof_volumes()
        return True

    def predict_next_force(self, dt: float) -> PredictedForceOfNextStep | None:
        """Predict the force of the next inertial step if the tool stays; see `Solver.predict_next_force`.

        Let D be the displacement of all degrees of freedom per depth of the tool, f the internal forces and a the
        accelerations. The force is D.(f + M a), and its derivative with respect to the depth is D.(K + rate M) D. In a
        next step without motion f stays constant unless the tissue relaxes, and a results from the finite differences
        in time. A change of contact changes D.
        """
        motion, equations = self.committed.motion, self.equations
        _, _, _, force, _, _, stiffness = equations.report.tolist()
        if motion is None or stiffness <= 0.0:
            return None
        more, stiffer = map(float, motion.predict_inertial_force_and_stiffness_change(
            self.committed.last_committed_solution, dt, self._masses, equations.compute_displacement_per_depth()))
        return PredictedForceOfNextStep(make_axial_wrench(force + more),
                                        make_axial_stiffness_matrix(max(stiffness + stiffer, 0.0)))

    def enable_stiffness_output(self) -> None:
        """Enable the computation of the stiffness (derivative of the force with respect to the depth) in every step."""
        self.equations.counts[newton.StepIntegerIndex.STIFFNESS_ASKED] = 1

    @classmethod
    def realtime_levels(cls, model: Model) -> Sequence[ResolutionLevel]:
        """See `Solver.realtime_levels`."""
        return list_realtime_levels_finest_first(model.experiment)

    @classmethod
    def error_estimation_rule(cls, resolution: str) -> ErrorEstimationRule | None:
        """See `Solver.error_estimation_rule`."""
        return RESOLUTIONS[resolution].error_estimation_rule if resolution in RESOLUTIONS else None

    @property
    def differentiates_geometry(self) -> bool:
        """See `Solver.differentiates_geometry`; False with point effects, contact laws or weight."""
        equations = self.equations
        return not (equations.effects.formulas or equations.specific_weight
                    or (equations.contact is not None and equations.contact.laws))

    def enable_force_derivatives(
            self, neighbours: Neighbours,
            experiments: Sequence[ExperimentDerivatives] | None = None) -> MaterialSensitivity | None:
        """Make every step compute exact derivatives of the force with respect to parameters.

        To be called before the first step; for the arguments see `Solver.enable_force_derivatives`.

        Returns:
            None with effects at the quadrature points, contact laws or weight, for which no derivatives exist.
        """
        if neighbours and not self.differentiates_geometry:
            return None
        from tissue_sim.fem.axisymmetric.sensitivity import MaterialSensitivity

        self._sensitivity = MaterialSensitivity(self.equations, neighbours, experiments)
        return self._sensitivity

    @property
    def is_time_dependent(self) -> bool:
        """Whether the tissue has relaxation, softening or point effects; see `ToolInAirInterface.is_time_dependent`."""
        return self.equations.has_material_history

    def clearance(self, pose: Pose) -> float | None:
        """Return the distance of the tool from the tissue, m; see `ToolInAirInterface.clearance`.

        None for a tool that touches the tissue or is bonded to it, and with contact laws.
        """
        equations, surface = self.equations, self.equations.surface
        own, contact = surface.moves, equations.contact
        if (contact is None or contact.laws or self._holds_tissue or not own.any() or surface.anchors[own, 0].any()
                or surface.spans[own, OutlineSpanColumn.STAYS].any()):
            return None
        positions = surface.deformed_positions(
            self.committed.last_committed_solution[: 2 * len(self.mesh.nodes)].reshape(-1, 2))
        positions[own, 1] += pose.depth - self.datum
        return float(surface.signed_gaps(positions)[own].min())

    def move_in_air(self, pose: Pose) -> None:
        """Set the depth of a tool in the air without solving a step; see `ToolInAirInterface.move_in_air`."""
        self.committed.restart_depth_history_at(pose.depth)

    def move_to_next_touch(self, pose: Pose) -> bool:
        """Move a lifted tool to its next touch; return whether this touch is like a first touch.

        See `ToolInAirInterface.move_to_next_touch`.
        """
        tolerance = AT_REST * float(self.equations.settings[newton.StepSettingIndex.CONTACT_TOLERANCE])
        begins = not self.is_time_dependent \
            and self.committed.have_displacements_recovered(2 * len(self.mesh.nodes), tolerance)
        if begins:
            self.committed.restore_untouched_shape_and_bonds()
        else:
            self.move_in_air(pose)
        return begins

    def bind_points_on_path(self, pose: Pose) -> None:
        """Bind the points with friction that touch in the first half of an increment.

        See `ToolInAirInterface.bind_points_on_path`.
        """
        committed = self.committed
        if committed.motion is not None:
            committed.motion.restart_at_first_order()
        displacement = committed.last_committed_solution[: 2 * len(self.mesh.nodes)].reshape(-1, 2)
        bind_points_reached_in_half_increment(self.equations.surface, displacement,
                                              committed.depths[0] - self.datum, pose.depth - committed.depths[0])

    def stop_tissue_motion(self) -> None:
        """Set the velocity of the tissue to zero; see `ToolInAirInterface.stop_tissue_motion`."""
        if self.committed.motion is not None:
            self.committed.motion.reset_velocity()

    def reset_to_first_touch(self) -> None:
        """Remove the tool at once and restore the displacements before the first touch."""
        self.committed.restore_untouched_shape_and_bonds()

    def save(self) -> SavedState:
        """Return a copy of the committed state, for `restore`."""
        return self.committed.save()

    def restore(self, saved: SavedState) -> None:
        """Restore a state that `save` returned."""
        self.committed.restore(saved)

    @property
    def pose(self) -> Pose:
        """Pose of the tool at the last committed state."""
        if self._pose.position[2] != -self.committed.depths[0]:
            self._pose = Pose.at_depth(self.committed.depths[0])
        return self._pose

    @property
    def depth(self) -> float:
        """Depth of the tool at the last committed state, m."""
        return self.committed.depths[0]

    @property
    def equilibria_since_contact_change(self) -> int:
        """Number of equilibria since a contact point last touched, separated, stuck or slipped.

        Counted if stiffness is requested. The number is at least 1 if contact iterates on the linearised tissue,
        because linear extrapolation then reaches the change of contact.
        """
        return max(self.committed.equilibria_since_contact_change,
                   int(self.equations.iterates_contact_on_linearisation))

    @property
    def state(self) -> np.ndarray:
        """Copy of the last committed state: nodal displacements (m), pressure amplitudes, contact forces (N)."""
        return self.committed.last_committed_solution.copy()

    @property
    def sag(self) -> float:
        """Sag at the first touch: area average of the downward displacement of the top under the weight, m."""
        from scipy.integrate import simpson

        top = self.mesh.sets["top"]
        r = self.mesh.nodes[top, 0]
        return -float(simpson(self.equations.start[2 * top + 1] * r, x=r) / simpson(r, x=r))

    def field_sample(self) -> FieldSample:
        """Return the data of the last committed state from which `fields` computes fields."""
        equations = self.equations
        if not equations.has_material_history:
            return FieldSample(self.state, None)
        stresses = equations.memory.compute_committed_stress_with_relaxation()
        if equations.effects.formulas:
            stresses = stresses + equations.effects.committed_effect_stress
        return FieldSample(self.state, stresses)

    def fields(self, samples: Sequence[FieldSample]) -> Fields:
        """Return the fields of the solutions that `field_sample` returned."""
        equations = self.equations
        reference = equations.reference
        stresses = [sample.stresses for sample in samples if sample.stresses is not None]
        states, (elements, _, modes) = np.array([sample.state for sample in samples]), reference.pressure_modes.shape
        displacements, pressures, _ = np.split(states, np.cumsum([2 * len(self.mesh.nodes), elements * modes]), axis=1)
        return Fields(self.mesh, equations.material, np.array(equations.bulk_modulus),
                      displacements.reshape(len(states), -1, 2), pressures.reshape(len(states), elements, modes),
                      reference.node_gradients, reference.pressure_modes, reference.weights, equations.moduli,
                      np.array(stresses) if stresses else None, self.datum)

    def deformed_surface(self) -> DeformedSurface:
        """Return the deformed outline at the last committed state; z = 0 is the height of the first touch."""
        return extract_deformed_surface(self.mesh, self.state, self.datum)

    def get_recording_metadata(self) -> dict[str, Any]:
        """Return the metadata of the solver for recordings: element, mesh size, contact."""
        contact = self.equations.contact
        report = {"element": self.mesh.element.name,
                  "mesh": {"elements": len(self.mesh.connectivity), "freedoms": self.equations.free}}
        if contact is not None:
            report |= {"penetration_mm": 0.0, "penetration_tolerance_mm": contact.tolerance * 1e3}
            if self.equations.surface.has_coulomb_friction_points:
                report["slipping_points"] = 0
        if self.equations.specific_weight:
            report["self_weight"] = {"sag_mm": self.sag * 1e3,
                                     "moulded_height_mm": -float(self.mesh.nodes[:, 1].min()) * 1e3}
        return report
