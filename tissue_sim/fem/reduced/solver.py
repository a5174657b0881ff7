"""Real-time quasi-static solver of a reduced solid (Galerkin projection on modes, sampled elements, layer contact).

Fields are computed in all elements of the mesh, including elements outside the sample. Displacements are linear
combinations of the modes. Their volume change is wrong by a few percent of the volume, which the bulk modulus of nearly
incompressible tissue would turn into pressures several times too large. Pressure is therefore not computed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, cast

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.linear.dense import estimate_nonlinear_residual, euclidean_norm, solve_dense_system_or_raise
from tissue_sim.fem.reduced.contact import PenaltyContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.placement import AmplitudePredictor, PrescribedModeAmplitudes, ReducedSolverBase
from tissue_sim.fem.reduced.response import LinearResponse, make_missing_compliance_estimator_or_none
from tissue_sim.fem.reduced.settings import SETTINGS, TOLERANCE
from tissue_sim.fem.solid.batches import compute_quadrature_volumes_gradients_modes
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.fem.solid.discretisation import make_contact_pairs_and_datum
from tissue_sim.fem.solid.fields import SavedState, SolidFields, SolidSurface, extract_deformed_surface
from tissue_sim.fem.solid.tissue import compute_node_shear_moduli, get_modulus_ratios_of_layer_indices
from tissue_sim.fem.solver import Fields, StaticStiffnessRequest, Step, StepStatus
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, Screw, compute_rigid_motion
from tissue_sim.tool_force import Matrix

#: Quadrature data, cached for two meshes.
_quadrature = lru_cache(maxsize=2)(compute_quadrature_volumes_gradients_modes)


def compute_pressureless_fields_or_none(mesh: SolidMesh, material: Material, displacements: Sequence[np.ndarray],
                                        datum: float, layers: np.ndarray) -> SolidFields | None:
    """Return the fields of several states of a reduced solid in all elements of the mesh.

    Args:
        mesh: mesh of the full-order solid.
        material: an elastic material. For a material with history the result is None, because elements outside the
            sample have no history.
        displacements: displacements of the nodes, m, each of shape (nodes, 3).
        datum: height of the scene's origin, which the tool reaches at its first touch, in the frame of the mesh, m.
        layers: number of the material's layer of each element, see `find_element_layer_indices`.

    Returns:
        Fields without pressure, or None for a material with history.
    """
    if material.is_history_dependent:
        return None
    weights, gradients, modes = _quadrature(mesh)
    return SolidFields(mesh, material, np.array(material.bulk_modulus), np.array(displacements), None, gradients,
                       modes, weights, get_modulus_ratios_of_layer_indices(material, layers), None, datum)


class ReducedSolver(ReducedSolverBase):
    """Modified Newton method for the modal equilibrium Phi' f(u + Phi a) + Phi' f_contact = 0 of a `ReducedModel`.

    A step first solves the contact on tissue that is linear about the last evaluated state. The sampled elements are
    evaluated only if the estimated residual of this linear step exceeds the tolerance.

    Args:
        reduced: the reduced solid.
        material: law, parameters and bulk response; may differ from the material of the training.

    Raises:
        InputError: the reduced solid does not support the material.
        MissingBackendError: Taichi is not installed.
    """

    highest_order = 1
    #: Smallest tolerance of a step; smaller requested values are raised to it.
    least_tolerance = TOLERANCE

    def __init__(self, reduced: ReducedModel, material: Material):
        experiment, mesh = reduced.model.experiment, reduced.mesh
        self.mesh, self.reduced, self._reach = mesh, reduced, experiment.contact_radius
        self._start = self._pose = self._landed = experiment.tool_pose(0.0)
        pairs, self.datum = make_contact_pairs_and_datum(experiment, mesh, reduced.rest_positions)
        self._set_up_touch_height_finder(pairs)
        self.elements = SampledElements(
            mesh, reduced.basis, reduced.elements, reduced.shares, groups=SETTINGS.stiffness_groups, rest=reduced.rest,
            layers=reduced.element_layers, contact_radius=self._reach)
        self.contact = PenaltyContact(pairs, reduced.rest_positions, mesh.surface_node_areas, reduced.basis,
                                      reach=self._reach, softness=reduced.softness)
        self.missing_force = make_missing_compliance_estimator_or_none(reduced, self.contact)
        self._tool_motion = PrescribedModeAmplitudes(reduced.lifting, ToolFrame(self._start, self.datum))
        modes = reduced.basis.shape[1]
        self._lifting, self._free = reduced.lifting, slice(reduced.lifting, modes - reduced.watched)
        self.amplitudes, self._prediction = np.zeros(modes), AmplitudePredictor(modes, self._reach)
        self._committed = self.amplitudes.copy(), self.elements.rest_pressures.copy()
        #: Last evaluated state: amplitudes, and modal forces of the elements.
        self._evaluated_at, self._forces = self.amplitudes, np.zeros(modes)
        self._groups_at_rest, self._returns_stiffness = 0, False
        self._largest_force = 0.0  # largest modal force since the last change of the material
        self._suspect_groups = 0  # number of groups whose stiffness may belong to a failed step
        reduced.require_supported_material(material)
        self.elements.set_material(material, reduced.bulk_ratio)
        self.elements.initialise_rest_state()
        self.set_material(material)

    def set_material(self, material: Material) -> None:
        """Set another material and keep the displacements. See `Solver.set_material`."""
        self.reduced.require_supported_material(material)
        stiffer = self.elements.set_material(material, self.reduced.bulk_ratio)
        self.material = material
        for pressures in (self._committed[1], self.elements.pressures):
            pressures *= stiffer
        moduli = compute_node_shear_moduli(material, self.mesh, self.reduced.element_layers)
        least = self.contact.set_penalty_and_get_smallest_modulus(moduli)
        self._prediction.clear_corrections()
        self._floor, self._largest_force = 1e-3 * least * self._reach**2, 0.0
        self._reevaluate_and_invalidate_stiffness()

    @property
    def pose(self) -> Pose:
        """Pose of the tool in the last committed state."""
        return self._pose

    def enable_stiffness_output(self) -> None:
        """Make every following step compute its stiffness matrix."""
        self._returns_stiffness = True

    def step(self, pose: Pose, dt: float = 0.0, *, tolerance: float = TOLERANCE, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = StaticStiffnessRequest.IF_LEFT) -> Step:
        """Move the tool to a pose and solve for static equilibrium; see `Solver.step`. Inertia is neglected."""
        elements, contact = self.elements, self.contact
        if not resumes:
            self._restore_committed_amplitudes()
        frame = ToolFrame(pose, self.datum)
        pressed_in = bool(frame.origin[2] <= self._tool_motion.first.origin[2])
        inside, clear = self._get_inside_and_clear_flags(pose, frame)
        if not (inside or clear):
            return Step(StepStatus.OUTSIDE, 0, 0.0, (0.0,) * 6)
        if not inside:  # without contact the tissue is close to rest
            self.amplitudes[:], elements.pressures[:] = 0.0, elements.rest_pressures
            if not elements.has_history:
                return self._set_to_rest_and_make_air_step(pose)
        elements.set_step_duration(dt)
        held, free = self._lifting, self._free
        # The initial guess is the linear response with unchanged contact, or the end of the last step.
        predicts = predictor_order and inside and not resumes
        tool_step = np.array(compute_rigid_motion(self._pose, pose)) if predicts else np.zeros(6)
        # A tool that can lift off needs no corrections: `_solve_contact_on_linear_tissue` removes the residual.
        here = self.amplitudes + (self._prediction.predict_amplitude_change(tool_step) if held and predicts
                                  else self._prediction.sensitivity @ tool_step)
        here[:held] = self._tool_motion.compute_amplitudes(frame)
        iterations, ratio, last, halvings, status = 0, 0.0, np.inf, 0, None
        groups_to_compute = SETTINGS.groups_per_update if self._suspect_groups else 1
        # State in which the elements were evaluated last, and their forces.
        base, forces = (self._evaluated_at, elements.pressures.copy()), self._forces
        if resumes:
            base, forces = (self.amplitudes.copy(), base[1]), elements.modal_forces.copy()
        if elements.has_stiffness_of_all_groups and inside and not (held or resumes):
            # Solve the contact on linear tissue first: most of a step is a change of contact and friction.
            here, contact_forces, contact_rates = self._solve_contact_on_linear_tissue(
                here, base[0], forces, frame, pressed_in, tolerance)
        else:
            contact_forces, contact_rates = self._compute_modal_contact_forces_and_rates(here, frame, pressed_in)
        updates_pressure = inside and np.array_equal(elements.at, base[0])
        while status is None:
            change = here - base[0]
            linear_change = elements.modal_stiffness @ change
            previous_work, linear_forces = float(change @ linear_change), forces + linear_change
            has_linear_forces = elements.has_stiffness_of_all_groups and updates_pressure
            elements.evaluate_forces_and_stiffness(here, updates_pressure, groups_to_compute)
            forces, evaluated_at = elements.modal_forces.copy(), here
            residual = forces + contact_forces
            residual_norm = euclidean_norm(residual[free])
            force_norm = self._compute_contact_and_held_force_norm(contact_forces, forces)
            ratio = residual_norm / self._compute_reference_force(force_norm)
            is_invalid = not (elements.smallest_volume_ratio > SETTINGS.min_volume_ratio and np.isfinite(ratio))
            if ratio <= max(tolerance, self.least_tolerance) and not is_invalid:
                status = StepStatus.CONVERGED
                break
            if ((is_invalid or residual_norm > (1.0 - SETTINGS.sufficient_decrease) * last)
                    and halvings < SETTINGS.max_halvings and (iterations or is_invalid)):
                halvings += 1
                here = 0.5 * (here + base[0])
                here[:held] = self._tool_motion.compute_amplitudes(frame)
                elements.pressures[:] = 0.5 * (elements.pressures + base[1])
                updates_pressure = False
                contact_forces, contact_rates = self._compute_modal_contact_forces_and_rates(here, frame, pressed_in)
                continue
            if is_invalid:
                status = StepStatus.INVERTED
            elif iterations >= max_iterations:
                status = StepStatus.SLOW
            if status is not None:
                break
            if iterations and (residual_norm > SETTINGS.fast_convergence * last or halvings):
                # Slow convergence: update the oldest groups of the stiffness, or all after several failures.
                updates_all = halvings > 1 or iterations > SETTINGS.max_partial_updates
                groups = SETTINGS.stiffness_groups if updates_all else SETTINGS.groups_per_update
                elements.evaluate_forces_and_stiffness(here, False, groups)
            last, halvings, base = residual_norm, 0, (here, elements.pressures.copy())
            here, contact_forces, contact_rates = self._solve_contact_on_linear_tissue(
                here, here, forces, frame, pressed_in, tolerance)
            updates_pressure, groups_to_compute, iterations = True, 0, iterations + 1
            if has_linear_forces and iterations == 1 and not (self._suspect_groups or elements.has_history):
                # Estimate the residual of this linear step from the nonlinearity of the previous one; if small, accept.
                change = here - base[0]
                added = elements.modal_stiffness @ change
                residual = forces + added + contact_forces
                force_norm = self._compute_contact_and_held_force_norm(contact_forces, forces + added)
                remainder = SETTINGS.residual_safety * estimate_nonlinear_residual(
                    (forces - linear_forces)[free], previous_work, float(change @ added))
                ratio = (euclidean_norm(residual[free]) + remainder) / self._compute_reference_force(force_norm)
                if ratio <= max(tolerance, self.least_tolerance):
                    status = StepStatus.CONVERGED
        self.amplitudes[:] = here
        self._suspect_groups = (max(0, self._suspect_groups - SETTINGS.groups_per_update)
                                if status is StepStatus.CONVERGED else SETTINGS.stiffness_groups)
        stiffness, error, wrench, stiffness_age = None, None, np.zeros(6), 0.0
        if status is StepStatus.CONVERGED:
            rates = self._tool_motion.compute_amplitude_rates(frame)
            wrench = contact.wrench - rates.T @ residual[:held]
            if self._returns_stiffness and contact.has_friction and pose == self._pose:
                # Slipping nodes continue to slip, as in the step that led to this pose.
                _, contact_rates = self._compute_modal_contact_forces_and_rates(here, frame, pressed_in, slips_on=True)
            response = LinearResponse(elements.modal_stiffness + contact_rates, contact, rates, free, residual)
            self._prediction.record_step(np.array(compute_rigid_motion(self._pose, pose)), here - self._committed[0],
                                         response.sensitivity, response.correction)
            error = response.estimate_total_force_error_or_none(
                self.reduced.error_factors, wrench[:3], self.missing_force)
            if self._returns_stiffness:
                age = elements.compute_outdated_stiffness_age_or_none(here)
                if age == 0.0:
                    # Without elapsed time the age would not reveal an outdated stiffness, so compute the stiffness now.
                    elements.evaluate_forces_and_stiffness(here, not np.array_equal(here, evaluated_at),
                                                           SETTINGS.stiffness_groups)
                    evaluated_at, forces = here, elements.modal_forces.copy()
                    response = LinearResponse(elements.modal_stiffness + contact_rates, contact, rates, free, residual)
                stiffness, stiffness_age = response.compute_combined_stiffness_at_tool(self.reduced.box), age or 0.0
            contact.commit_step()
            elements.commit_step()
            self._committed = here.copy(), elements.pressures.copy()
            self._evaluated_at, self._forces, self._pose = evaluated_at, forces, pose
            self._largest_force = max(self._largest_force, force_norm)
        return Step(status, iterations, ratio, cast("Screw", tuple(wrench.tolist())),
                    None if stiffness is None else cast("Matrix", tuple(map(tuple, stiffness.tolist()))),
                    contact.largest_penetration, contact.slipping_count, force_error=error, stiffness_age=stiffness_age)

    def _set_to_rest_and_make_air_step(self, pose: Pose) -> Step:
        """Return the step of a tool in air: elastic tissue is set to rest, and one stiffness group is computed."""
        if self._committed[0].any():
            self._groups_at_rest = 0
        if self._groups_at_rest < SETTINGS.stiffness_groups:
            self._groups_at_rest += 1
            self.elements.evaluate_forces_and_stiffness(self.amplitudes, False, 1)
        self._committed, self._forces = (self.amplitudes.copy(), self.elements.pressures.copy()), 0.0 * self._forces
        self._evaluated_at, self._pose = self.amplitudes.copy(), pose
        self._prediction.reset_predictions()
        self.contact.mark_all_nodes_untouched()
        stiffness = ((0.0,) * 6,) * 6 if self._returns_stiffness else None
        return Step(StepStatus.CONVERGED, 0, 0.0, (0.0,) * 6, stiffness)

    @property
    def is_undeformed_with_complete_stiffness(self) -> bool:
        """Whether the solid is at rest without a touching tool, and all groups of its stiffness are up to date."""
        return self._groups_at_rest >= SETTINGS.stiffness_groups and not self._committed[0].any()

    def _compute_modal_contact_forces_and_rates(self, amplitudes: np.ndarray, frame: ToolFrame, pressed_in: bool, *,
                                                slips_on: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the contact; return the modal contact forces, (modes,), and derivatives, (modes, modes)."""
        self.contact.evaluate_contact(amplitudes, frame, pressed_in, slips_on=slips_on)
        return self.contact.get_modal_forces_and_stiffness()

    def _compute_contact_and_held_force_norm(self, contact_forces: np.ndarray, forces: np.ndarray) -> float:
        """Return the norm of the modal contact forces plus the norm of the forces on the bonded face."""
        return euclidean_norm(contact_forces) + euclidean_norm(forces[: self._lifting])

    def _compute_reference_force(self, force_norm: float) -> float:
        """Return the force by which the residual norm is divided for the relative residual."""
        return max(force_norm, self._floor, SETTINGS.min_reference_force * self._largest_force)

    def _solve_contact_on_linear_tissue(self, guess: np.ndarray, reference: np.ndarray, forces: np.ndarray,
                                        frame: ToolFrame, pressed_in: bool, tolerance: float
                                        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Solve the contact on linear tissue, f(a) = f_0 + K (a - a_0), by Newton's method with step halving.

        Args:
            guess: initial amplitudes; the amplitudes prescribed by the tool stay fixed.
            reference: amplitudes a_0 of the linearisation, shape (modes,).
            forces: modal forces f_0 of the elements, shape (modes,).
            frame: frame of the tool.
            pressed_in: see `PenaltyContact.evaluate_contact`.
            tolerance: largest relative residual of the step.

        Returns:
            Amplitudes, modal contact forces and their derivatives.
        """
        free, tangent = self._free, self.elements.modal_stiffness
        goal = SETTINGS.contact_tolerance * max(tolerance, self.least_tolerance)
        at, before, last, halvings, solves = guess, guess, np.inf, 0, 0
        while True:
            contact_forces, contact_rates = self._compute_modal_contact_forces_and_rates(at, frame, pressed_in)
            tissue_forces = forces + tangent @ (at - reference)
            residual = (tissue_forces + contact_forces)[free]
            residual_norm = euclidean_norm(residual)
            force_norm = self._compute_contact_and_held_force_norm(contact_forces, tissue_forces)
            reference_force = self._compute_reference_force(force_norm)
            if residual_norm <= goal * reference_force or solves >= SETTINGS.max_contact_solves:
                return at, contact_forces, contact_rates
            if residual_norm > (1.0 - SETTINGS.sufficient_decrease) * last and halvings < SETTINGS.max_halvings:
                at, halvings = 0.5 * (at + before), halvings + 1
                continue
            before, at, last, halvings = at, at.copy(), residual_norm, 0
            at[free] -= solve_dense_system_or_raise((tangent + contact_rates)[free, free], residual)
            solves += 1

    def accepts_pose(self, pose: Pose) -> bool:
        """See `Solver.accepts_pose`. Accepted are poses inside the box and poses without contact."""
        return any(self._get_inside_and_clear_flags(pose, ToolFrame(pose, self.datum)))

    def describe_domain(self) -> str:
        """See `Solver.describe_domain`."""
        box, (x, y, _) = self.reduced.box, self._start.position
        return (f"the deepest point of the tool within {1e3 * box.sideways:.3g} mm of ({1e3 * x:.3g}, {1e3 * y:.3g}) "
                f"mm along x and y and at most {1e3 * box.depth:.3g} mm deep, and a rotation of at most "
                f"{math.degrees(box.turn):.3g} degrees")

    def _get_inside_and_clear_flags(self, pose: Pose, frame: ToolFrame) -> tuple[bool, bool]:
        """Return whether a pose counts as inside the box, and whether it is outside and without contact."""
        box, start = self.reduced.box, self._start
        inside = box.contains_pose(pose, start)
        clear = not inside and self._is_tool_clear_of_tissue(frame)
        # A tool that leaves the box upwards may still touch within the thickness of the layer.
        return inside or (not (clear or self._lifting) and box.has_pose_above(pose, start)), clear

    def _reevaluate_and_invalidate_stiffness(self) -> None:
        """Evaluate the committed state and mark all stiffness as invalid, after a change of state or material."""
        self._groups_at_rest = self._suspect_groups = 0
        self._restore_committed_amplitudes()
        self.elements.evaluate_forces_and_invalidate_stiffness(self.amplitudes)
        self._evaluated_at, self._forces = self.amplitudes.copy(), self.elements.modal_forces.copy()

    def _restore_committed_amplitudes(self) -> None:
        """Set amplitudes and pressures to those of the last committed state."""
        self.amplitudes[:], self.elements.pressures[:] = self._committed

    def reset_to_first_touch(self) -> None:
        """Remove the tool and set the amplitudes to rest. Implements `Solver.reset_to_first_touch`."""
        self._committed[0][:], self._committed[1][:] = 0.0, self.elements.rest_pressures
        self._prediction.reset_predictions()
        self.contact.mark_all_nodes_untouched()
        self._pose, self._largest_force = self._start, 0.0
        self._reevaluate_and_invalidate_stiffness()

    def reset_to_rest(self) -> None:
        """Remove the tool, and set tissue and material history to rest without loading."""
        self.elements.reset_history()
        self.reset_to_first_touch()

    def save(self) -> SavedState:
        """Return a copy of the committed state, for `restore`."""
        return SavedState(tuple(map(np.copy, self._state_arrays)), self._pose, self._largest_force, self._landed)

    def restore(self, saved: SavedState) -> None:
        """Make a state that was returned by `save` the committed state."""
        self.place_tool_at_first_touch(saved.start or self._start)
        for array, before in zip(self._state_arrays, saved.arrays, strict=True):
            array[:] = before
        self._pose, self._largest_force = saved.pose, saved.largest_force
        self._reevaluate_and_invalidate_stiffness()

    @property
    def _state_arrays(self) -> tuple[np.ndarray, ...]:
        return *self._committed, *self._prediction.state_arrays, *self.contact.state_arrays, *self.elements.state_arrays

    def displacement(self) -> np.ndarray:
        """Return the displacement of all nodes in the last committed state, m, shape (nodes, 3)."""
        return (self.reduced.basis @ self._committed[0]).reshape(-1, 3) + self.reduced.rest_positions - self.mesh.nodes

    #: The sample of a state that `fields` needs is the displacement.
    field_sample = displacement

    def fields(self, samples: Sequence[Any]) -> Fields | None:
        """See `compute_pressureless_fields_or_none`."""
        return compute_pressureless_fields_or_none(self.mesh, self.material, samples, self.datum,
                                                   self.reduced.element_layers)

    def deformed_surface(self) -> SolidSurface:
        """Return the surface of the tissue in the last committed state."""
        return extract_deformed_surface(self.mesh, self.displacement(), self.datum)

    def get_recording_metadata(self) -> dict[str, Any]:
        """See `Solver.get_recording_metadata`."""
        report = {"element": self.mesh.element.name,
                  "mesh": {"elements": len(self.mesh.connectivity), "freedoms": 3 * len(self.mesh.nodes)},
                  "reduced": dict(self.reduced.report), "penetration_mm": 0.0,
                  "penetration_tolerance_mm": self.reduced.softness * self._reach * 1e3}
        if self.contact.has_friction:
            report["slipping_points"] = 0
        if self.reduced.rest is not None:
            report["self_weight"] = {"sag_mm": 1e3 * self.reduced.sag,
                                     "moulded_height_mm": 1e3 * float(np.ptp(self.mesh.nodes[:, 2]))}
        return report


def make_solver(model: Model, *, resolution: str = "realtime", mesh: SolidMesh | ReducedModel | None = None,
                topology: Model | None = None) -> ReducedSolver:
    """Create the solver of a reduced model; see `tissue_sim.fem.solver.SolverMaker`.

    Args:
        model: a material, and the same experiment as that of the reduced model.
        resolution: ignored.
        mesh: the `ReducedModel`.
        topology: must be None.

    Raises:
        InputError: `mesh` is not a reduced model, or the experiments differ.
    """
    if not isinstance(mesh, ReducedModel):
        raise InputError("must be a ReducedModel. Load the file of `tissue-sim reduce`", field="mesh")
    if topology is not None:
        raise InputError("must be None for a reduced model. Leave it out", field="topology")
    made_of = mesh.model.experiment
    for name in ("specimen", "tool", "friction", "friction_base", "friction_wall", "approach"):
        if getattr(model.experiment, name) != getattr(made_of, name):
            raise InputError("must equal that of the reduced model. Use the same one, or reduce the model again",
                             field=f"experiment.{name}")
    return ReducedSolver(mesh, model.material)
