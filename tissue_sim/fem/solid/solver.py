"""Newton solver of a three-dimensional solid under a rigid tool, stepped from pose to pose, and its settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from tissue_sim.fem.contact.pairs import ALL_POINTS, ContactBondState
from tissue_sim.fem.inertia import LumpedMass
from tissue_sim.fem.linear.sparse import Factor
from tissue_sim.fem.solid.coarse_surface import coarse_surface_warnings, estimate_coarse_surface_error_or_none
from tissue_sim.fem.solid.contact import ContactViolationAndCounts, ToolFrame
from tissue_sim.fem.solid.equations import ReusableTangentFactor, SolidEquations
from tissue_sim.fem.solid.fields import FieldSample, SavedState, SolidFields, SolidSurface, extract_deformed_surface
from tissue_sim.fem.solid.sensitivity import FirstTouchDerivatives, SolidSensitivity
from tissue_sim.fem.solid.touch import FirstTouchHeightAndSolverMaker
from tissue_sim.fem.solver import (
    AT_REST,
    FRICTION_PATHS,
    ExperimentDerivatives,
    Neighbours,
    Solver,
    StaticStiffnessRequest,
    Step,
    StepStatus,
)
from tissue_sim.fem.taichi.launch import KernelOwner
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose, Screw, shift_pose_along_z
from tissue_sim.tool_force import Matrix, PredictedForceOfNextStep

#: Differentiates the state of the first touch; None if no derivatives are available. The arguments are those of
#: `Solver.enable_force_derivatives`.
StartDifferentiation = Callable[[Neighbours, Sequence[ExperimentDerivatives] | None], FirstTouchDerivatives | None]


@dataclass(frozen=True)
class SolidNewtonSettings:
    """Settings of Newton's method in `SolidSolver`.

    Attributes:
        max_halvings: largest number of bisections of an increment that turns an element inside out or leaves the domain
            of the law.
        all_points_iterations: number of linear solves after which only a subset of the nodes may change their contact
            state at once, so that the active set does not cycle.
        min_reference_force: smallest reference force of the relative residual, over the largest load so far, 1. A
            larger value tolerates larger residuals at small forces.
        rest_motion: motion of the tool over the size of the mesh below which the tool is at rest, 1.
        friction_floor: friction over the smallest reference force below which friction is ignored, 1.
    """

    max_halvings: int = 4
    all_points_iterations: int = 8
    min_reference_force: float = 0.1
    rest_motion: float = 1e-14
    friction_floor: float = 1e-6


@dataclass(frozen=True)
class SettlingSettings:
    """Settings of the load steps by which a specimen comes into equilibrium under its weight.

    Attributes:
        smallest_part: smallest part of the weight that is applied in one step, 1. A smaller value tries smaller steps
            before the specimen counts as unstable.
        height_width: distance of the neighbours of the logarithm of the height, 1; the half width of the difference is
            ten times this distance.
    """

    smallest_part: float = 2.0**-6
    height_width: float = 1e-6


@dataclass(frozen=True)
class LinearisationSettings:
    """Settings of the linearisation of a solid for multirate simulation.

    Attributes:
        more: number of condensed nodes over the number of published nodes with Pardiso, whose cost hardly depends on
            this ratio.
        needed: fraction of the nearest nodes that must be condensed; otherwise other nodes are chosen, which requires
            a new symbolic analysis.
        fractions: fractions of a step that are tried in turn if it turns elements inside out, 1.
        old_fractions: the same with an earlier tangent, which would overshoot where the tissue has become more than
            twice as stiff, 1.
        rounding: length of a step over that of the displacement below which the step is zero, 1.
    """

    more: int = 3
    needed: float = 0.6
    fractions: tuple[float, ...] = (1.0, 0.5, 0.25)
    old_fractions: tuple[float, ...] = (0.8, 0.4, 0.2)
    rounding: float = 1e-5


#: Settings of every solid.
NEWTON = SolidNewtonSettings()
#: Settings of every specimen with self-weight.
SETTLING = SettlingSettings()


class SolidSolver(KernelOwner, Solver):
    """Newton solver of one three-dimensional boundary-value problem; it holds the state of the tissue.

    The mesh belongs to one position of the first touch. For a first touch at another position the solver is replaced by
    one with a moved mesh.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        fixed: node set -> axes, ``"z"`` or ``"xyz"``, along which its nodes are fixed.
        bonded: nodes that the tool holds, shape (n,).
        start_rates: returns the derivatives of the state of the first touch, and of the touch, with respect to
            parameters; None: zero.
        others: further arguments of `SolidEquations`.

    Attributes:
        equations: discrete equations and state; `x`, `tissue`, `batches` and `contact` are parts of them.
        placement: makes the solver for a first touch at another pose; None: the solver cannot be moved.

    Raises:
        InputError: a part of the material is not supported, or a bulk ratio is outside of `BULK_RATIOS`.
        MissingBackendError: Taichi is not installed.
    """

    highest_order = 0
    ignores_twist = True
    exact_experiment_parameters = FRICTION_PATHS

    def __init__(self, mesh: SolidMesh, material: Material, fixed: dict[str, str], bonded: np.ndarray, *,
                 start_rates: StartDifferentiation | None = None, **others: Any):
        self.equations = equations = SolidEquations(mesh, material, fixed, bonded, **others)
        self.mesh, self.datum, self.x, self.tissue = mesh, equations.datum, equations.x, equations.tissue
        self.batches, self.contact = equations.batches, equations.contact
        self.placement: FirstTouchHeightAndSolverMaker | None = None
        self._tangent = ReusableTangentFactor(equations)
        self._asked, self._start_rates = False, start_rates
        self._derivatives: SolidSensitivity | None = None
        self._last: Step | None = None
        self._along: np.ndarray | None = None  # d displacements / d pose at the last stiffness, shape (freedoms, 6)

    @property
    def material(self) -> Material:
        """Law, parameters and bulk response."""
        return self.equations.material

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept. See `Solver.set_material`."""
        self.equations.set_material(material)

    @property
    def pose(self) -> Pose:
        """Pose of the tool at the last committed state."""
        return self.equations.pose

    @property
    def committed_displacement(self) -> np.ndarray:
        """Displacement of all nodes at the last committed state, m, shape (nodes, 3)."""
        return self.equations.committed[0].reshape(-1, 3)

    def enable_stiffness_output(self) -> None:
        """Let every step compute its stiffness matrix from now on."""
        self._asked = True

    def step(self, pose: Pose, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = StaticStiffnessRequest.IF_LEFT) -> Step:
        """Move the tool to a pose and solve for equilibrium; see `Solver.step`. The motion is solved linearly first."""
        equations, frame = self.equations, ToolFrame(pose, self.datum)
        equations.begin_step(dt, inertial)
        if not resumes:
            equations.restore_committed_state()
        outcome = self._solve_newton_to_step_result(frame, tolerance, max_iterations)
        if outcome.status is StepStatus.CONVERGED:
            if inertial and equations.mass is not None and self._asked:
                has_left = outcome.iterations < max_iterations
                is_due = StaticStiffnessRequest.needs_stiffness_given_spare_solve(own_stiffness, has_left)
                own = self._compute_static_stiffness_or_none(frame) if is_due else None
                outcome = replace(outcome, step_stiffness_matrix=outcome.stiffness_matrix, stiffness_matrix=own)
            equations.commit_step(pose, dt, inertial)
            equations.largest_force = max(equations.largest_force, float(np.linalg.norm(outcome.wrench[:3])))
            self._last = outcome = self._add_error_estimate(outcome)
        return outcome

    def _solve_newton_to_step_result(self, frame: ToolFrame, tolerance: float, max_iterations: int) -> Step:
        """Solve for equilibrium at a frame of the tool by Newton's method, from the present iterate."""
        equations, contact, x, tangent = self.equations, self.contact, self.x, self._tangent
        free, reacting, held, allowed = equations.free, equations.reacting, equations.held_dofs, equations.tolerance
        here, way = equations.frame, np.zeros_like(x)
        way[held] = equations.compute_held_node_displacements(frame) - x[held]
        # Nodes in contact with the tool move with it in the first linear solution.
        positions = equations.get_node_positions(contact.nodes)
        tool_way = frame.transform_to_mesh(here.transform_to_tool(positions)) - positions
        pending = (max(np.abs(way).max(), np.abs(tool_way).max(initial=0.0))
                   > NEWTON.rest_motion * float(np.ptp(self.mesh.nodes)))
        changeable, bending, iterations, halvings, waits = ALL_POINTS, 0.0, 0, 0, 0
        floor = max(equations.negligible_force, NEWTON.min_reference_force * equations.largest_force)
        min_force = NEWTON.friction_floor * floor
        before = first_ratio = None
        tangent.stale = False
        while True:
            least = equations.assemble_and_get_least_volume_ratio(not tangent.stale)
            if least <= 0.0 and before is not None and halvings < NEWTON.max_halvings:
                halvings += 1
                for array, earlier in zip(equations.iterate_arrays, before, strict=True):
                    array[:] = 0.5 * (array + earlier)
                continue
            displacement = x.reshape(-1, 3)[contact.nodes]
            # In the first iteration nodes at zero gap count as pressed, because the tool will move or a law pulls.
            slack = 1e-9 if pending or (contact.laws.strength > 0.0 and iterations == 0) else 0.0
            evaluation = contact.evaluate_and_update_active_set(displacement, here if pending else frame, changeable,
                                                                slack, bending, min_force, allowed)
            wanting, waits = max(evaluation.wanting, waits), 0
            residual = self.batches.residual[:-1].copy()
            np.add.at(residual.reshape(-1, 3), contact.nodes, contact.contact_and_law_forces_by_node)
            unbalanced = float(np.linalg.norm(residual[free]))
            balanced = float(np.hypot(np.linalg.norm(residual[reacting]),
                                      np.linalg.norm(contact.contact_and_law_forces_by_node)))
            ratio = unbalanced / max(balanced, floor)
            status = None
            if not least > 0.0 or least >= 1e30:
                status = StepStatus.INVERTED
            elif not np.isfinite(ratio):
                status = StepStatus.DIVERGED
            elif not pending and ratio <= tolerance and evaluation.violation <= allowed and not wanting:
                if contact.release_pulled_nodes_and_count():
                    changeable, first_ratio, tangent.stale = ALL_POINTS, None, False
                    continue
                if tangent.stale and (self._asked or self._derivatives is not None):
                    equations.assemble_and_get_least_volume_ratio()
                if self._derivatives is not None:
                    # The derivatives belong to this step, with the anchors of the last equilibrium.
                    contact.evaluate_and_update_active_set(displacement, frame, 0, 0.0, 1.0, min_force, allowed)
                    self._derivatives.update_at_equilibrium(frame)
                    if self._asked:
                        equations.assemble_and_get_least_volume_ratio()
                contact.bind_touching_nodes()
                status = StepStatus.CONVERGED
                if self._asked:
                    # The stiffness belongs to the new anchors.
                    evaluation = contact.evaluate_and_update_active_set(displacement, frame, 0, 0.0, 1.0, min_force,
                                                                        allowed)
            elif iterations >= max_iterations:
                status = StepStatus.SLOW
            elif first_ratio is not None and iterations > 3 and ratio > 1e3 * max(first_ratio, 1.0):
                status = StepStatus.DIVERGED
            if status is not None and not (status is StepStatus.CONVERGED and self._asked):
                return self._make_result(status, iterations, ratio, evaluation, frame)
            if tangent.stale and status is None and not tangent.can_reuse_factor(ratio, tolerance,
                                                                                 evaluation.switched > 0):
                tangent.stale, changeable, waits = False, 0, evaluation.wanting
                continue
            if status is not None or not tangent.stale:
                tangent.factorise_with_contact_or_none(symmetric=not evaluation.slipping)
            factor = tangent.factor
            if factor is None or not factor.definite:
                if bending > 0.0 and status is None:
                    bending = 0.0
                    continue
                if status is None:
                    status = StepStatus.INDEFINITE
                return self._make_result(status, iterations, ratio, evaluation, frame)
            if status is not None:
                return self._make_result(status, iterations, ratio, evaluation, frame, factor)
            if iterations == 1:
                first_ratio = ratio
            apart = -np.where(contact.moves[:, None] & pending, tool_way, 0.0)
            before = equations.copy_iterate()
            motion = tangent.solve_increment(residual, way if pending else None, apart)
            x += motion
            self.tissue.update_pressures(motion)
            contact.update_forces_linearly(motion.reshape(-1, 3)[contact.nodes] + apart)
            equations.frame = frame
            iterations += 1
            halvings = NEWTON.max_halvings if pending else 0  # the motion of the tool is not bisected here
            tangent.record_residual_and_set_stale(ratio, far=pending)
            pending = False
            changeable = ALL_POINTS if iterations < NEWTON.all_points_iterations else iterations
            bending = 1.0 if ratio < 0.1 else 0.0

    def _add_error_estimate(self, step: Step) -> Step:
        """Return a converged step with its estimated force error, if stiffness is requested in every step."""
        if not self._asked:
            return step
        error = estimate_coarse_surface_error_or_none(self.equations, math.hypot(*step.wrench[:3]))
        return step if error is None else replace(step, force_error=error)

    def _make_result(self, status: StepStatus, iterations: int, ratio: float, evaluation: ContactViolationAndCounts,
                     frame: ToolFrame, factor: Factor | None = None) -> Step:
        """Return the result of a step, with its stiffness matrix if a factor of the last matrix is given."""
        stiffness, equations = None, self.equations
        if factor is not None:
            stiffness, self._along = equations.compute_stiffness_and_motion_by_pose(frame, factor)
        return Step(status, iterations, ratio, cast("Screw", tuple(equations.compute_wrench(frame).tolist())),
                    None if stiffness is None else _to_matrix_tuples(stiffness), evaluation.violation,
                    evaluation.slipping)

    def _compute_static_stiffness_or_none(self, frame: ToolFrame) -> Matrix | None:
        """Return the stiffness without mass after an inertial step; None if the static tangent is indefinite."""
        equations, mass = self.equations, self.equations.mass
        assert mass is not None
        mass.rate, rate = 0.0, mass.rate
        equations.assemble_and_get_least_volume_ratio()
        mass.rate = rate
        factor = self._tangent.factorise_with_contact_or_none(symmetric=not self.contact.state.slides.any())
        if factor is None or not factor.definite:
            return None
        return _to_matrix_tuples(equations.compute_stiffness_and_motion_by_pose(frame, factor)[0])

    def enable_inertia(self, density: float) -> bool:
        """Give all regions of the tissue a mass, density in kg/m3; returns True. See `Solver.enable_inertia`."""
        self.equations.mass = LumpedMass(self.mesh, self.batches.weights, density, self.batches.matrix)
        return True

    def predict_next_force(self, dt: float) -> PredictedForceOfNextStep | None:
        """Predict the force of the next step; see `Solver.predict_next_force` and the axisymmetric solver."""
        last, mass = self._last, self.equations.mass
        if mass is None or self._along is None or last is None or last.step_stiffness_matrix is None:
            return None
        more, stiffer = mass.predict_force_and_stiffness_change(self.x, dt, self._along)
        wrench = cast("Screw", tuple((np.array(last.wrench) - more).tolist()))
        return PredictedForceOfNextStep(wrench, _to_matrix_tuples(np.array(last.step_stiffness_matrix) + stiffer))

    @property
    def differentiates_geometry(self) -> bool:
        """See `Solver.differentiates_geometry`; False with self-weight, layers, contact laws and curved tops."""
        return (self._start_rates is None and not self.tissue.specific_weight and not self.material.layers
                and not self.contact.laws and self.placement is not None and self.placement.is_level)

    def enable_force_derivatives(self, neighbours: Neighbours,
                                 experiments: Sequence[ExperimentDerivatives] | None = None) -> SolidSensitivity | None:
        """See `Solver.enable_force_derivatives`; None with point effects."""
        begins = self._start_rates if neighbours else None
        start = None if begins is None else begins(neighbours, experiments)
        if self.tissue.effects or (begins is not None and start is None):
            return None
        saved = self.save()
        self._derivatives = SolidSensitivity.from_perturbed_materials(self.equations, neighbours, experiments)
        self.restore(saved)
        self.equations.restore_committed_state()
        if neighbours:
            self._derivatives.set_first_touch_derivatives(
                start or FirstTouchDerivatives.from_undeformed_specimen(np.zeros(len(neighbours))))
        return self._derivatives

    def reset_to_first_touch(self) -> None:
        """Remove the tool at once; see `Solver.reset_to_first_touch`."""
        self.equations.reset_to_first_touch()

    def save(self) -> SavedState:
        """Return a copy of the committed state, for `restore`."""
        return self.equations.save()

    def restore(self, saved: SavedState) -> None:
        """Make a state that was returned by `save` the committed state."""
        self.place_tool_at_first_touch(saved.start or self.equations.start)
        self.equations.restore(saved)

    def accepts_pose(self, pose: Pose) -> bool:
        """Whether the contact conditions are accurate at a pose, see `SolidEquations.accepts_pose`."""
        return self.equations.accepts_pose(pose)

    def describe_domain(self) -> str:
        """See `Solver.describe_domain`."""
        if self.placement is not None and not self.placement.can_move_mesh:
            return "a tool that first touches the tissue at the pose for which the mesh was made"
        return "any pose at which the tool touches the top of the specimen"

    def height_above_tissue(self, pose: Pose) -> float:
        """Return the distance that the tool must go down until it touches the undeformed tissue, m.

        See `ToolInAirInterface.height_above_tissue`.
        """
        return pose.position[2] if self.placement is None else self.placement.height_above_tissue(pose)

    def place_tool_at_first_touch(self, pose: Pose) -> bool:
        """Place the tool at its first touch; the mesh moves with the tool, to stay fine under the tool."""
        if self.placement is None or self.placement.is_at_mesh_position(self.equations.start, pose):
            return True
        other = self.placement.make_solver_for_touch_pose_or_none(pose, self)
        if other is None:
            return False
        self.__dict__.update(other.__dict__)
        return True

    def copy_material_and_requests_to(self, other: Any) -> None:
        """Copy material, density and the request for stiffness to another solver of the same model."""
        if self._asked:
            other.enable_stiffness_output()
        if self.equations.mass is not None:
            other.enable_inertia(self.equations.mass.density)
        if self.material is not other.material:
            other.set_material(self.material)

    def clearance(self, pose: Pose) -> float | None:
        """Return the smallest distance of a node from the tool, m; None for bonded tissue, and with contact laws."""
        contact = self.contact
        if self.equations.held_nodes.size or contact.laws or (
                contact.moves & (contact.stays | (contact.bound != ContactBondState.FREE))).any():
            return None
        gaps = self.equations.compute_tool_gaps(pose, self.committed_displacement, pressed_in=False)
        return float(gaps.min(initial=math.inf))

    @property
    def is_time_dependent(self) -> bool:
        """See `ToolInAirInterface.is_time_dependent`."""
        return self.tissue.has_history

    def stop_tissue_motion(self) -> None:
        """See `ToolInAirInterface.stop_tissue_motion`."""
        self.equations.stop_motion()

    def move_to_next_touch(self, pose: Pose) -> bool:
        """Move a lifted tool to its next touch; return whether the touch begins as a first touch.

        See `ToolInAirInterface.move_to_next_touch`.
        """
        begins = (self.placement is not None and not self.is_time_dependent and self._has_tissue_returned_to_rest
                  and self.place_tool_at_first_touch(shift_pose_along_z(pose, -self.height_above_tissue(pose))))
        if begins:
            self.reset_to_first_touch()
        else:
            self.move_in_air(pose)
        return begins

    @property
    def _has_tissue_returned_to_rest(self) -> bool:
        """Whether the tissue has returned to its state before the first touch."""
        moved = self.equations.committed[0] - self.equations.resting[0]
        return float(np.abs(moved).max()) <= AT_REST * self.equations.tolerance

    def move_in_air(self, pose: Pose) -> None:
        """See `ToolInAirInterface.move_in_air`."""
        self.equations.pose = pose

    @property
    def sag(self) -> float:
        """Mean downward displacement of the top under self-weight at the first touch, m."""
        return -float(np.average(self.equations.resting[0][2::3],
                                 weights=self.mesh.compute_node_areas_of_named_faces("top")))

    def field_sample(self) -> FieldSample:
        """Return the data of the last committed state that `fields` needs."""
        x, pressures, _ = self.equations.committed
        return FieldSample(x.reshape(-1, 3).copy(), self.batches.convert_pressures_to_element_order(pressures),
                           self.tissue.get_committed_isochoric_pk2_or_none())

    def fields(self, samples: Sequence[FieldSample]) -> SolidFields:
        """Return the fields of states that were returned by `field_sample`."""
        stresses = [sample.stresses for sample in samples if sample.stresses is not None]
        return SolidFields(self.mesh, self.material, self.tissue.element_bulk_moduli,
                           np.array([sample.displacement for sample in samples]),
                           np.array([sample.pressures for sample in samples]), *self.batches.point_gradients_and_modes,
                           self.batches.weights, self.batches.element_modulus_ratios, np.array(stresses) if stresses
                           else None, self.datum)

    def deformed_surface(self) -> SolidSurface:
        """Return the deformed surface at the last committed state."""
        return extract_deformed_surface(self.mesh, self.committed_displacement, self.datum)

    def warnings(self) -> list[str]:
        """See `Solver.warnings`."""
        return coarse_surface_warnings(self.equations)

    def get_recording_metadata(self) -> dict[str, Any]:
        """Return the metadata of the solver for a recording; see `Solver.get_recording_metadata`."""
        report = {"element": self.mesh.element.name,
                  "mesh": {"elements": len(self.mesh.connectivity), "freedoms": int(self.equations.free.size)}}
        if self.contact.nodes.size:
            report |= {"penetration_mm": 0.0, "penetration_tolerance_mm": self.equations.tolerance * 1e3,
                       **({"slipping_points": 0} if self.contact.has_friction else {})}
        if self.tissue.specific_weight:
            report["self_weight"] = {"sag_mm": self.sag * 1e3,
                                     "moulded_height_mm": float(np.ptp(self.mesh.nodes[:, 2])) * 1e3}
        return report


def _to_matrix_tuples(matrix: np.ndarray) -> Matrix:
    """Convert a 6 x 6 array to the tuples of `ToolForce`."""
    return cast("Matrix", tuple(map(tuple, matrix.tolist())))
