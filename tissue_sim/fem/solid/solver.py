"""Newton solver of a three-dimensional solid under a rigid tool, stepped from pose to pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from tissue_sim.fem.contact.settings import ALL_POINTS
from tissue_sim.fem.linear.sparse import Factor, SparseSolver
from tissue_sim.fem.solid.bodies import RigidBody
from tissue_sim.fem.solid.contact import ContactNodes, ContactViolationAndCounts
from tissue_sim.fem.solid.contact_laws import NodalContactLaws
from tissue_sim.fem.solid.faceting import faceting_warnings
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.fem.solid.frame import ToolFrame
from tissue_sim.fem.solid.free_dofs import FreeDofSubmatrix, make_fixed_component_mask_by_node
from tissue_sim.fem.solid.mass import LumpedMass
from tissue_sim.fem.solid.placement import SolidSolverBase
from tissue_sim.fem.solid.sensitivity import FirstTouchDerivatives, SolidSensitivity, SolverDataForSensitivity
from tissue_sim.fem.solid.settings import NEWTON
from tissue_sim.fem.solid.state import FieldSample, SavedState
from tissue_sim.fem.solid.surface import SolidSurface, extract_deformed_surface
from tissue_sim.fem.solid.tangent import ReusableTangentFactor
from tissue_sim.fem.solid.tissue import Tissue
from tissue_sim.fem.solid.tool_wrench import HeldAndContactNodes, to_matrix_tuples
from tissue_sim.fem.solver import Neighbours, StaticStiffnessRequest, Step, StepStatus
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose, Screw
from tissue_sim.tool_force import Matrix, PredictedForceOfNextStep


class SolidSolver(SolidSolverBase):
    """Newton solver of one three-dimensional boundary-value problem; it holds the state of the tissue.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        fixed: node set -> axes, ``"z"`` or ``"xyz"``, along which its nodes are fixed.
        bonded: nodes that the tool holds, shape (n,).
        bodies: rigid bodies that the surface may touch.
        laws: additional contact laws of the tool.
        tolerance: largest permitted violation of a contact condition, m.
        start: pose of the tool at its first touch, in the frame of the scene.
        datum: height of that frame's origin in the frame of the mesh, m.
        contact_radius: m, for the time of drainage, see `Material.make_prony_series`.
        pins: pairs of a node and the axes, ``"xy"``, along which it is fixed if nothing else prevents rigid motions.
        element_layers: see `Tissue`.
        specific_weight: density times gravity, N/m3, towards -z.
        settled: solver on this mesh without a tool, in the state of the first touch; None: the undeformed mesh.
        lift: height of nodes above the surface that the tool is assumed to touch, m, shape (nodes,); None: 0.
        start_rates: returns the derivatives of `settled`, and of the touch, with respect to parameters; None: zero.

    Raises:
        InputError: a part of the material is not supported, or a bulk ratio is outside of `BULK_RATIOS`.
        MissingBackendError: Taichi is not installed.
    """

    highest_order = 0

    def __init__(self, mesh: SolidMesh, material: Material, fixed: dict[str, str], bonded: np.ndarray, *,
                 bodies: Sequence[RigidBody] = (), laws: NodalContactLaws | None = None, tolerance: float = 0.0,
                 start: Pose, datum: float = 0.0, contact_radius: float = 1.0, pins: Sequence[tuple[int, str]] = (),
                 element_layers: np.ndarray | None = None, specific_weight: float = 0.0,
                 settled: SolidSolver | None = None, lift: np.ndarray | None = None,
                 start_rates: Callable[[Neighbours], FirstTouchDerivatives | None] | None = None):
        self.mesh, self.datum, self._tolerance = mesh, datum, tolerance
        self.x = np.zeros(3 * len(mesh.nodes))
        self.tissue = Tissue(mesh, self.x, contact_radius, element_layers)
        self.batches, self.tissue.specific_weight = self.tissue.batches, specific_weight
        if settled is not None:
            self.x[:], self.batches.pressures[:] = settled.x, settled.batches.pressures
        self._start = self._pose = start
        freedoms, stays = np.arange(self.x.size).reshape(-1, 3), make_fixed_component_mask_by_node(mesh, fixed, pins)
        self._bonded, moved = np.asarray(bonded, dtype=np.intp), np.zeros_like(stays)
        moved[self._bonded] = True
        self._free = np.flatnonzero(~(stays | moved))
        self._reacting = np.flatnonzero(stays | moved)
        self._moved = freedoms[self._bonded].ravel()
        # Positions of the bonded nodes in the frame of the tool.
        self._held_at = ToolFrame(start, datum).transform_to_tool(self._get_node_positions(self._bonded))
        self.contact = ContactNodes(bodies, mesh.nodes, mesh.surface_node_areas, laws)
        if lift is not None:
            self.contact.places[self.contact.moves, 2] -= lift[self.contact.nodes[self.contact.moves]]
        self.contact.bind_nodes_at_first_touch(start, datum, self.x.reshape(-1, 3),
                                               None if settled is None else settled.contact)
        self._matrix = FreeDofSubmatrix(self.batches.matrix, self._free, freedoms[self.contact.nodes])
        self._sparse = SparseSolver()
        self._tangent = ReusableTangentFactor(self.tissue, self.contact, self._matrix, self._sparse, self._free)
        self._largest_force, self._asked, self._modulus, self._least = 0.0, False, 0.0, 0.0
        self._committed, self._rest = (tuple(array.copy() for array in self._arrays_of_iterate) for _ in range(2))
        self._derivatives: SolidSensitivity | None = None
        self._start_rates, self._mass = start_rates, None
        self._last: Step | None = None
        self._along: np.ndarray | None = None  # d displacements / d pose at the last stiffness, shape (freedoms, 6)
        self._here = ToolFrame(start, datum)  # frame of the tool at the present iterate
        self.set_material(material)
        if settled is not None:
            for array, left in zip(self.tissue.state_arrays, settled.tissue.state_arrays, strict=True):
                array[:] = left

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept. See `Solver.set_material`."""
        before: float = self._modulus or material.mu0
        self.tissue.set_material(material)
        self.material, self._modulus = material, material.mu0
        # If all moduli change by one factor, the displacements stay the same and all forces change by the factor.
        for array in (*self._committed[1:], *self._rest[1:], self.batches.pressures, self.contact.forces):
            array *= material.mu0 / before
        self.contact.set_penalty_stiffness(material.mu0)
        self._floor = 1e-6 * material.mu0 * float(np.prod(np.ptp(self.mesh.nodes[self.mesh.sets["top"], :2], axis=0)))

    @property
    def pose(self) -> Pose:
        """Pose of the tool at the last committed state."""
        return self._pose

    def enable_stiffness_output(self) -> None:
        """Let every step compute its stiffness matrix from now on."""
        self._asked = True

    def step(self, pose: Pose, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = StaticStiffnessRequest.IF_LEFT) -> Step:
        """Move the tool to a pose and solve for equilibrium; see `Solver.step`. The motion is solved linearly first."""
        self.tissue.set_step_duration(dt)
        if self._mass is not None:
            self._mass.prepare_step(self._committed[0], dt, inertial)
        frame = ToolFrame(pose, self.datum)
        if not resumes:
            self._restore_committed_state()
        outcome = self._solve_newton_to_step_result(frame, tolerance, max_iterations)
        if outcome.status is StepStatus.CONVERGED:
            if inertial and self._mass is not None and self._asked:
                has_left = outcome.iterations < max_iterations
                is_due = StaticStiffnessRequest.needs_stiffness_given_spare_solve(own_stiffness, has_left)
                own = self._compute_static_stiffness_or_none(frame) if is_due else None
                outcome = replace(outcome, step_stiffness_matrix=outcome.stiffness_matrix, stiffness_matrix=own)
            if self._mass is not None:
                self._mass.motion.commit_step(self._committed[0], self.x, dt, inertial)
            self.contact.commit_step()
            self.tissue.commit_step()
            self._committed = self.x.copy(), self.batches.pressures.copy(), self.contact.forces.copy()
            self._pose, self._largest_force = pose, max(self._largest_force, float(np.linalg.norm(outcome.wrench[:3])))
            self._last = outcome = self._add_error_estimate(outcome)
        return outcome

    def _restore_committed_state(self) -> None:
        """Set displacements, pressures and contact forces to those of the last committed state."""
        self.x[:], self.batches.pressures[:], self.contact.forces[:] = self._committed
        self.contact.copy_committed_bonds_to_step()
        self._here = ToolFrame(self._pose, self.datum)

    def _solve_newton_to_step_result(self, frame: ToolFrame, tolerance: float, max_iterations: int) -> Step:
        """Solve for equilibrium at a frame of the tool by Newton's method, from the present iterate."""
        contact, batches, x, tangent = self.contact, self.batches, self.x, self._tangent
        goal = self.compute_held_node_displacements(frame)
        here, way = self._here, np.zeros_like(x)
        way[self._moved] = goal - x[self._moved]
        # Nodes in contact with the tool move with it in the first linear solution.
        positions = self._get_node_positions(contact.nodes)
        tool_way = frame.transform_to_mesh(here.transform_to_tool(positions)) - positions
        pending = (max(np.abs(way).max(), np.abs(tool_way).max(initial=0.0))
                   > NEWTON.rest_motion * float(np.ptp(self.mesh.nodes)))
        changeable, bending, iterations, halvings, waits = ALL_POINTS, 0.0, 0, 0, 0
        floor = max(self._floor, NEWTON.min_reference_force * self._largest_force)
        min_force = NEWTON.friction_floor * floor
        before = first_ratio = None
        tangent.stale = False
        while True:
            self._update_assembled_forces_and_tangent(not tangent.stale)
            if self._least <= 0.0 and before is not None and halvings < NEWTON.max_halvings:
                halvings += 1
                for array, earlier in zip(self._arrays_of_iterate, before, strict=True):
                    array[:] = 0.5 * (array + earlier)
                continue
            displacement = x.reshape(-1, 3)[contact.nodes]
            # In the first iteration nodes at zero gap count as pressed, because the tool will move or a law pulls.
            slack = 1e-9 if pending or (contact.laws.strength > 0.0 and iterations == 0) else 0.0
            evaluation = contact.evaluate_and_update_active_set(displacement, here if pending else frame, changeable,
                                                                slack, bending, min_force, self._tolerance)
            wanting, waits = max(evaluation.wanting, waits), 0
            residual = batches.residual[:-1].copy()
            np.add.at(residual.reshape(-1, 3), contact.nodes, contact.contact_and_law_forces_by_node)
            unbalanced = float(np.linalg.norm(residual[self._free]))
            balanced = float(np.hypot(np.linalg.norm(residual[self._reacting]),
                                      np.linalg.norm(contact.contact_and_law_forces_by_node)))
            ratio = unbalanced / max(balanced, floor)
            status = None
            if not self._least > 0.0 or self._least >= 1e30:
                status = StepStatus.INVERTED
            elif not np.isfinite(ratio):
                status = StepStatus.DIVERGED
            elif not pending and ratio <= tolerance and evaluation.violation <= self._tolerance and not wanting:
                if contact.release_pulled_nodes_and_count():
                    changeable, first_ratio, tangent.stale = ALL_POINTS, None, False
                    continue
                if tangent.stale and (self._asked or self._derivatives is not None):
                    self._update_assembled_forces_and_tangent()
                if self._derivatives is not None:
                    # The derivatives belong to this step, with the anchors of the last equilibrium.
                    contact.evaluate_and_update_active_set(displacement, frame, 0, 0.0, 1.0, min_force, self._tolerance)
                    self._derivatives.update_at_equilibrium(frame)
                    if self._asked:
                        self._update_assembled_forces_and_tangent()
                contact.bind_touching_nodes()
                status = StepStatus.CONVERGED
                if self._asked:
                    # The stiffness belongs to the new anchors.
                    evaluation = contact.evaluate_and_update_active_set(displacement, frame, 0, 0.0, 1.0, min_force,
                                                                        self._tolerance)
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
            before = tuple(array.copy() for array in self._arrays_of_iterate)
            motion = tangent.solve_increment(residual, way if pending else None, apart)
            x += motion
            self.tissue.update_pressures(motion)
            contact.update_forces_linearly(motion.reshape(-1, 3)[contact.nodes] + apart)
            self._here = frame
            iterations += 1
            halvings = NEWTON.max_halvings if pending else 0  # the motion of the tool is not bisected here
            tangent.record_residual_and_set_stale(ratio, far=pending)
            pending = False
            changeable = ALL_POINTS if iterations < NEWTON.all_points_iterations else iterations
            bending = 1.0 if ratio < 0.1 else 0.0

    def compute_held_node_displacements(self, frame: ToolFrame) -> np.ndarray:
        """Return the displacements of the nodes that a bonded tool holds, for a frame of the tool, m, (3 n,)."""
        return (frame.transform_to_mesh(self._held_at) - self.mesh.nodes[self._bonded]).ravel()

    @property
    def _arrays_of_iterate(self) -> tuple[np.ndarray, ...]:
        return self.x, self.batches.pressures, self.contact.forces

    def _update_assembled_forces_and_tangent(self, tangent: bool = True) -> None:
        self._least = self.tissue.assemble_and_get_least_volume_ratio(tangent)
        if tangent:
            self.batches.store_assembled_volume_rates()
        if self._mass is not None:
            self._mass.add_inertial_forces(self.x, self.batches.residual[:-1], self._matrix.all if tangent else None)

    def _collect_held_and_contact_nodes(self, frame: ToolFrame) -> HeldAndContactNodes:
        return HeldAndContactNodes(frame, self._moved, self._get_node_positions(self._bonded),
                                   self.batches.residual[:-1][self._moved].reshape(-1, 3), self.contact,
                                   self._get_node_positions(self.contact.nodes))

    def _make_result(self, status: StepStatus, iterations: int, ratio: float, evaluation: ContactViolationAndCounts,
                     frame: ToolFrame, factor: Factor | None = None) -> Step:
        """Return the result of a step, with its stiffness matrix if a factor of the last matrix is given."""
        stiffness, tool = None, self._collect_held_and_contact_nodes(frame)
        if factor is not None:
            stiffness, self._along = tool.compute_stiffness_and_motion_by_pose(self._matrix.all, factor, self._free)
        return Step(status, iterations, ratio, cast("Screw", tuple(tool.compute_wrench().tolist())),
                    None if stiffness is None else to_matrix_tuples(stiffness), evaluation.violation,
                    evaluation.slipping)

    def _compute_static_stiffness_or_none(self, frame: ToolFrame) -> Matrix | None:
        """Return the stiffness without mass after an inertial step; None if the static tangent is indefinite."""
        assert self._mass is not None
        self._mass.rate, rate = 0.0, self._mass.rate
        self._update_assembled_forces_and_tangent()
        self._mass.rate = rate
        factor = self._tangent.factorise_with_contact_or_none(symmetric=not self.contact.state.slides.any())
        if factor is None or not factor.definite:
            return None
        tool = self._collect_held_and_contact_nodes(frame)
        return to_matrix_tuples(tool.compute_stiffness_and_motion_by_pose(self._matrix.all, factor, self._free)[0])

    def enable_inertia(self, density: float) -> bool:
        """Give all regions of the tissue a mass, density in kg/m3; returns True. See `Solver.enable_inertia`."""
        self._mass = LumpedMass(self.mesh, self.batches.weights, density, self._matrix.all)
        return True

    def predict_next_force(self, dt: float) -> PredictedForceOfNextStep | None:
        """Predict the force of the next step; see `Solver.predict_next_force` and the axisymmetric solver."""
        last = self._last
        if self._mass is None or self._along is None or last is None or last.step_stiffness_matrix is None:
            return None
        more, stiffer = self._mass.predict_force_and_stiffness_change(self.x, dt, self._along)
        wrench = cast("Screw", tuple((np.array(last.wrench) - more).tolist()))
        return PredictedForceOfNextStep(wrench, to_matrix_tuples(np.array(last.step_stiffness_matrix) + stiffer))

    def _get_node_positions(self, nodes: np.ndarray) -> np.ndarray:
        """Return the deformed positions of nodes, m, shape (n, 3)."""
        return self.mesh.nodes[nodes] + self.x.reshape(-1, 3)[nodes]

    def enable_force_derivatives(self, neighbours: Neighbours) -> SolidSensitivity | None:
        """See `Solver.enable_force_derivatives`; None with point effects."""
        begins = self._start_rates if neighbours else None
        start = None if begins is None else begins(neighbours)
        if self.tissue.effects or (begins is not None and start is None):
            return None
        parts = SolverDataForSensitivity(self.mesh.nodes, self.x, self._free, self._moved, self.tissue, self.contact,
                                         self._matrix, ToolFrame(self._start, self.datum),
                                         self._update_assembled_forces_and_tangent)
        saved = self.save()
        self._derivatives = SolidSensitivity.from_perturbed_materials(parts, neighbours, self.material,
                                                                      self.set_material)
        self.restore(saved)
        self._restore_committed_state()
        if start is not None:
            self._derivatives.set_first_touch_derivatives(start)
        return self._derivatives

    def reset_to_first_touch(self) -> None:
        """Remove the tool at once; see `Solver.reset_to_first_touch`."""
        for array, rest in zip(self._committed, self._rest, strict=True):
            array[:] = rest
        self.contact.restore_first_touch_contact_state()
        self.stop_tissue_motion()
        self._pose, self._largest_force = self._start, 0.0
        self._restore_committed_state()

    def save(self) -> SavedState:
        """Return a copy of the committed state, for `restore`."""
        return SavedState(tuple(map(np.copy, self._state_arrays)), self._pose, self._largest_force, self._start)

    def restore(self, saved: SavedState) -> None:
        """Make a state that was returned by `save` the committed state."""
        self.place_tool_at_first_touch(saved.start or self._start)
        for array, before in zip(self._state_arrays, saved.arrays, strict=True):
            array[:] = before
        self._pose, self._largest_force = saved.pose, saved.largest_force

    @property
    def _state_arrays(self) -> tuple[np.ndarray, ...]:
        moving = () if self._mass is None else self._mass.motion.state_arrays
        return (*self._committed, *self.contact.state_arrays, *self.tissue.state_arrays, *moving)

    def make_committed_state_the_resting_state(self) -> None:
        """Make the committed state the resting state, without a tool."""
        self._rest = tuple(array.copy() for array in self._committed)

    @property
    def sag(self) -> float:
        """Mean downward displacement of the top under self-weight at the first touch, m."""
        return -float(np.average(self._rest[0][2::3], weights=self.mesh.compute_node_areas_of_named_faces("top")))

    def field_sample(self) -> FieldSample:
        """Return the data of the last committed state that `fields` needs."""
        x, pressures, _ = self._committed
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
        return faceting_warnings(self.contact, self.mesh, self.committed_displacement)

    def get_recording_metadata(self) -> dict[str, Any]:
        """Return the metadata of the solver for a recording; see `Solver.get_recording_metadata`."""
        report = {"element": self.mesh.element.name,
                  "mesh": {"elements": len(self.mesh.connectivity), "freedoms": int(self._free.size)}}
        if self.contact.nodes.size:
            report |= {"penetration_mm": 0.0, "penetration_tolerance_mm": self._tolerance * 1e3,
                       **({"slipping_points": 0} if self.contact.has_friction else {})}
        if self.tissue.specific_weight:
            report["self_weight"] = {"sag_mm": self.sag * 1e3,
                                     "moulded_height_mm": float(np.ptp(self.mesh.nodes[:, 2])) * 1e3}
        return report
