"""Newton's iteration of a solid's bulk, condensed onto nodes near the tool, for a contact that is solved elsewhere.

Each call takes the contact forces that were found with the last linearisation, makes the step of the bulk for these
forces, and linearises there: one iteration for each model of the loop, as in the real-time iteration of optimal
control (Diehl, Bock and Schlöder, SIAM J. Control Optim. 43 (2005) 1714). With the tool at rest a few iterations
converge to an equilibrium. The condensation of a tangent takes ten times as long as the assembly of forces. If it runs
in parallel, iterates continue with the previous tangent: forces are exact, and only their derivatives are older.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import (
    CondensedBulk,
    ContactState,
    ContactSurface,
    Executor,
    make_outline_tables,
    run_now_and_get_completion_check,
)
from tissue_sim.fem.contact.pairs import SOLID_PENALTY
from tissue_sim.fem.linear.sparse import get_pardiso_or_scipy_name
from tissue_sim.fem.solid.contact import ToolFrame, differentiate_torque_by_levers
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.equations import CondensedTangent
from tissue_sim.fem.solid.solver import LinearisationSettings, SolidSolver
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, interpolate_pose

#: Largest number of published nodes.
CANDIDATES = 100
_SETTINGS = LinearisationSettings()


@dataclass(frozen=True, eq=False)
class _NewtonIncrementContributions:
    """Increment of the displacements in a Newton step, in the rows of `SolidLineariser._select_rows_for_norm`, m.

    Attributes:
        motion: total increment.
        pushed: contribution of the contact forces.
        carried: contribution of the motion of the held nodes.
    """

    motion: np.ndarray
    pushed: np.ndarray
    carried: np.ndarray

    def is_next_step_shorter(self, settles: np.ndarray, share: float, rounding: float) -> bool:
        """Whether the next Newton step after a damped step is shorter (restricted monotonicity test).

        Source: Deuflhard, Newton Methods for Nonlinear Problems, 2011, section 3.3.

        Args:
            settles: new increment that balances the tissue without contact, m.
            share: damping factor: fraction of the step that was made, 1.
            rounding: length below which a step is zero, m.
        """
        following = settles + self.pushed + (1.0 - share) * self.carried
        return float(np.linalg.norm(following)) <= (1.0 - 0.25 * share) * float(np.linalg.norm(self.motion)) + rounding


class SolidLineariser:
    """Linearisation of a solid for multirate simulation, see `tissue_sim.fem.condensed.model.BulkLineariser`.

    The linearisation owns the solver: no other code may step it.

    Args:
        solver: solver at the first touch.
        candidates: largest number of nodes that are published.

    Attributes:
        solver: solver of the solid; its committed state is the last iterate.
        residual: relative residual at the last iterate, 1.

    Raises:
        InputError: a specimen whose base is not held, or additional contact laws.
    """

    def __init__(self, solver: SolidSolver, candidates: int = CANDIDATES):
        self.solver, self._equations = solver, solver.equations
        equations, contact = self._equations, self._equations.contact
        self._holds = bool(equations.held_nodes.size)
        self._mine = np.flatnonzero(contact.moves)
        if contact.laws:
            raise InputError("must be left out for a multirate solid, which supports no adhesion or other contact laws",
                             field="contact_laws")
        if any(not pair.moves and pair.stays for pair in contact.pairs):
            raise InputError("must be 'bonded', or 'frictionless' under a bonded tool, for a multirate solid: a base "
                             "that slides or lifts off would not hold the bulk", field="friction_base")
        if np.isfinite(equations.largest_motion):
            raise InputError("must be positive for a multirate solid without friction. Give the tool an edge radius",
                             field="tool.edge_radius")
        self.nodes = contact.nodes[self._mine]
        self._freedoms = 3 * self.nodes[:, None] + np.arange(3)
        row = np.full(equations.x.size, -1)  # number of each degree of freedom among the free ones
        row[equations.free] = np.arange(equations.free.size)
        self._rows = row[self._freedoms]
        self._meets = np.flatnonzero((self._rows >= 0).all(axis=1))
        self._count = min(candidates, self._meets.size)
        self._most = min(self._count * (_SETTINGS.more if get_pardiso_or_scipy_name() == "pardiso" else 1),
                         self._meets.size)
        self.surface = self._make_contact_surface(self._count)
        self._untouched = equations.save()
        self._epoch, self._number, self._time = 0, 0, 0.0
        self._interface = self._meets[:0]
        self._tangents = [CondensedTangent(equations) for _ in range(2)]
        # Tangent in use, tangent that is being factorised, and increment that balances the tissue without contact.
        self._tangent: CondensedTangent | None = None
        self._coming: CondensedTangent | None = None
        self._stale = False  # whether the tangent in use belongs to an earlier iterate
        # First half of a solution, see `CondensedTangent.begin_solution_with_interface_rows`.
        self._settles = np.zeros(equations.free.size)
        self.executor: Executor = run_now_and_get_completion_check
        self.residual = 0.0

    def _make_contact_surface(self, candidates: int) -> ContactSurface:
        """Return the description of surface and tool for the contact solver, with at most `candidates` nodes."""
        equations, contact, mine = self._equations, self._equations.contact, self._mine
        pairs = [pair for pair in contact.pairs if pair.moves]
        chains, shapes = make_outline_tables([(pair.profile, pair.first_line, pair.closed) for pair in pairs])
        outlines, friction = np.zeros(mine.size, dtype=np.int32), np.zeros((mine.size, 2))
        for number, pair in enumerate(pairs):
            own = np.isin(self.nodes, pair.surface)
            outlines[own], friction[own] = number, pair.friction
        start = ToolFrame(equations.pose, equations.datum)
        springs = SOLID_PENALTY.normal * np.sqrt(np.maximum(contact.areas, 1e-3 * contact.areas.max(initial=0.0)))[mine]
        return ContactSurface(contact.places[mine].copy(), springs, friction, outlines, chains, shapes,
                              contact.bound[mine].astype(np.int32),
                              start.transform_to_tool(contact.places[mine]) + contact.anchors[mine], equations.pose,
                              equations.datum, equations.tolerance, equations.tissue.contact_radius,
                              equations.negligible_force, candidates)

    def set_material(self, material: Material) -> None:
        """See `SolidSolver.set_material`."""
        self._equations.set_material(material)
        self._tangent = None
        self._untouched = self._equations.save() if self._number == 0 else self._untouched

    def iterate_and_linearise_or_none(self, state: ContactState, ahead: Sequence[Pose] = ()) -> CondensedBulk | None:
        """See `BulkLineariser.iterate_and_linearise_or_none`."""
        equations = self._equations
        if state.epoch != self._epoch:
            self._restore_untouched_state()
            self._epoch, self._tangent, self._time = state.epoch, None, state.time
        if self._tangent is None:
            return self._linearise_from_committed_or_none(state, ahead)
        if state.model != self._number:
            return None
        due = self._coming is None or self._coming.is_done
        if due and self._try_adopting_finished_tangent(state, state.pose, ahead):
            self._store_contact_free_increment()
        before, here = equations.copy_iterate(), equations.pose
        step = self._add_and_get_newton_increment(state)
        after = equations.copy_iterate()
        equations.tissue.set_step_duration(max(0.0, state.time - self._time))
        settles, old = self._settles, self._stale
        for share in _SETTINGS.old_fractions if old else _SETTINGS.fractions:
            for array, one, other in zip(equations.iterate_arrays, before, after, strict=True):
                array[:] = one + share * (other - one)
            if not self._assemble_and_check_volume_ratios(due):
                continue
            pose, self._stale = interpolate_pose(here, state.pose, share), True
            if old:
                self._store_contact_free_increment()
                measured = self._select_rows_for_norm(self._settles)
                if not step.is_next_step_shorter(measured, share, _SETTINGS.rounding * self._displacement_norm):
                    continue
            begun = self._start_condensation_or_none(state, pose, ahead, self.executor) if due else None
            if begun is not None and begun.is_done:
                if not self._try_adopting_finished_tangent(state, pose, ahead):
                    continue  # without parallel factorisation an iterate with a singular tangent is not accepted
                self._stale = False
            if not (old and self._stale):
                self._store_contact_free_increment()
            self._store_relative_residual(state)
            equations.commit_iterate(pose)
            self._time = state.time
            return self._make_and_number_condensed_model(state, pose)
        equations.set_iterate(before)
        self._settles, self._stale = settles, old
        if self._coming is None or not self._assemble_and_check_volume_ratios(False):
            self._tangent = None
        return None

    def _restore_untouched_state(self) -> None:
        """Restore the state before the first touch, with the present material."""
        self._equations.restore(self._untouched)
        self._equations.reset_to_first_touch()
        self._equations.tissue.set_step_duration(0.0)

    def _linearise_from_committed_or_none(self, state: ContactState, ahead: Sequence[Pose]) -> CondensedBulk | None:
        """Linearise with a new tangent at the committed state, or at rest if that tangent is singular; else None."""
        equations, self._coming = self._equations, None
        for go_back in (equations.restore_committed_state, self._restore_untouched_state):
            go_back()
            pose = equations.pose if self._holds else state.pose
            if not self._assemble_and_check_volume_ratios(True):
                continue
            self._start_condensation_or_none(state, pose, ahead, run_now_and_get_completion_check)
            if self._try_adopting_finished_tangent(state, pose, ahead):
                self._stale = False
                self._store_contact_free_increment()
                self._store_relative_residual(state)
                return self._make_and_number_condensed_model(state, pose)
        return None

    def _add_and_get_newton_increment(self, state: ContactState) -> _NewtonIncrementContributions:
        """Add the Newton increment for the pose and the contact forces of a state to displacements and pressures."""
        equations, tangent = self._equations, self._tangent
        assert tangent is not None
        motion, carried = np.zeros_like(equations.x), np.zeros(equations.free.size)
        if self._holds:
            goal = equations.compute_held_node_displacements(ToolFrame(state.pose, equations.datum))
            motion[equations.held_dofs] = goal - equations.x[equations.held_dofs]
            carried = -tangent.begin_solution_with_interface_rows(tangent.held @ motion[equations.held_dofs])
        loaded = np.flatnonzero(state.forces.any(axis=1))
        if np.isin(loaded, tangent.interface).all():
            pushed = -tangent.begin_solution_for_interface_forces(state.forces[tangent.interface])
        else:
            right = np.zeros_like(equations.x)
            right[self._freedoms[loaded]] = state.forces[loaded]
            pushed = -tangent.begin_solution_with_interface_rows(right)
        begun = self._settles + pushed + carried
        motion[equations.free] = tangent.finish_solution(begun)
        equations.x += motion
        equations.tissue.update_pressures(motion)
        return _NewtonIncrementContributions(*(self._select_rows_for_norm(each) for each in (begun, pushed, carried)))

    def _select_rows_for_norm(self, begun: np.ndarray) -> np.ndarray:
        """Return the displacements of a begun solution that the norms of the step control use, m.

        These are the interface, where the contact acts, or all free degrees of freedom if the tool holds tissue.
        """
        tangent = self._tangent
        assert tangent is not None
        return tangent.finish_solution(begun) if self._holds else begun[tangent.interface_rows]

    @property
    def _displacement_norm(self) -> float:
        """Norm of the displacement in the rows of `_select_rows_for_norm`, m."""
        assert self._tangent is not None
        displacement = self._equations.x[self._equations.free]
        rows = displacement if self._holds else displacement[self._tangent.interface_rows]
        return float(np.linalg.norm(rows))

    def _store_contact_free_increment(self) -> None:
        """Store the Newton increment without contact forces for the residual that was assembled last."""
        equations, tangent, right = self._equations, self._tangent, self._equations.batches.residual[:-1].copy()
        assert tangent is not None
        if self._stale:
            equations.tissue.correct_forces_for_reused_matrix(right)
        self._settles = -tangent.begin_solution_with_interface_rows(right)
        if self._holds:
            motion = tangent.finish_solution(self._settles)
            self._reactions = right[equations.held_dofs] + tangent.held[equations.free].T @ motion

    def _assemble_and_check_volume_ratios(self, tangent: bool) -> bool:
        """Assemble forces, and optionally the tangent, without contact; return False if an element is inside out."""
        least = self._equations.tissue.assemble_and_get_least_volume_ratio(tangent)
        if tangent:
            self._equations.matrix.update_free_part()
        return 0.0 < least < 1e30

    def _store_relative_residual(self, state: ContactState) -> None:
        """Set `residual`, the relative residual with the contact forces of a state."""
        equations, unbalanced = self._equations, self._equations.batches.residual[:-1].copy()
        unbalanced[self._freedoms] += state.forces
        held = float(np.linalg.norm(unbalanced[equations.reacting]))
        self.residual = float(np.linalg.norm(unbalanced[equations.free])) / max(held, equations.negligible_force)

    def _start_condensation_or_none(self, state: ContactState, pose: Pose, ahead: Sequence[Pose],
                                    executor: Executor) -> CondensedTangent | None:
        """Start the condensation of the tangent assembled last and return it; None while another one is in progress."""
        # A finished tangent that is not in use may be overwritten.
        spare = next((each for each in self._tangents if each is not self._tangent and each.is_done), None)
        if spare is None or self._coming is not None:
            return None
        order, loaded = self._order_contact_candidates_and_count_loaded(state, pose, ahead)
        if not np.isin(order[:max(int(_SETTINGS.needed * self._most), loaded)], self._interface).all():
            self._interface = np.sort(order[:self._most])
        spare.time, spare.pose = state.time, pose
        spare.start_condensation(self._interface, self._rows[self._interface], executor)
        self._coming = spare
        return spare

    def _try_adopting_finished_tangent(self, state: ContactState, pose: Pose, ahead: Sequence[Pose]) -> bool:
        """Use the tangent whose condensation has ended; return False if there is none or it is singular."""
        coming, self._coming = self._coming, None
        if coming is None or coming.factor is None:
            return False
        order, _ = self._order_contact_candidates_and_count_loaded(state, pose, ahead)
        nodes = order[np.isin(order, coming.interface)][:self._count]
        coming.set_published_nodes_and_compliance(nodes, self._rows[nodes])
        self._tangent, self._base = coming, self._number + 1
        self._equations.batches.known_rates[:] = coming.volume_rates
        return True

    def _order_contact_candidates_and_count_loaded(self, state: ContactState, pose: Pose,
                                                   ahead: Sequence[Pose]) -> tuple[np.ndarray, int]:
        """Order the nodes that the tool may touch: loaded nodes first, then by gap.

        Returns:
            Indices in the `ContactSurface`, shape (k,), and the number of loaded nodes.
        """
        meets, loaded = self._meets, np.abs(state.forces).sum(axis=1) > 0.0
        gaps = np.stack([self._compute_gaps(each) for each in (pose, *ahead)])[:, meets]
        return meets[np.lexsort((gaps.min(axis=0), ~loaded[meets]))], int(loaded.sum())

    def _compute_gaps(self, pose: Pose) -> np.ndarray:
        """Return the gaps between the surface nodes and a tool at a pose, m, shape (s,)."""
        displacement = self._equations.x.reshape(-1, 3)
        return self._equations.compute_tool_gaps(pose, displacement, pressed_in=True)[self._mine]

    def _make_and_number_condensed_model(self, state: ContactState, pose: Pose) -> CondensedBulk:
        """Return the linearisation at the last iterate, condensed onto the published nodes."""
        equations, tangent = self._equations, self._tangent
        assert tangent is not None
        free_displacement = equations.x[self._freedoms[tangent.nodes]] + self._settles[self._rows[tangent.nodes]]
        wrench = np.zeros(6)
        if self._holds:
            held = equations.get_node_positions(equations.held_nodes)
            levers = ToolFrame(pose, equations.datum).differentiate_points(held)
            forces = -self._reactions.reshape(-1, 3)
            wrench = np.einsum("nik,ni->k", levers, forces)
            if self._number + 1 == self._base:
                self._store_held_derivatives(tangent, levers, forces)
        left = np.setdiff1d(self._meets, tangent.nodes)
        reach = float(np.maximum(0.0, self._compute_gaps(pose)[left]).min(initial=np.inf))
        self._number += 1
        return CondensedBulk(self._number, self._base, self._epoch, state.time, pose, tangent.nodes,
                             free_displacement, tangent.compliance, tangent.tool_coupling, wrench, tangent.stiffness,
                             reach, equations.material.mu0, self.residual, tangent.time, tangent.pose)

    def _store_held_derivatives(self, tangent: CondensedTangent, levers: np.ndarray, forces: np.ndarray) -> None:
        """Store the derivatives of nodes and wrench with respect to the pose of a tool that holds tissue.

        Args:
            tangent: tangent that stores them.
            levers: derivatives of the held nodes with respect to the pose, shape (n, 3, 6).
            forces: of the held nodes on the tool, N, shape (n, 3).
        """
        equations = self._equations
        answer = np.zeros((equations.x.size, 6))
        answer[equations.held_dofs] = levers.reshape(-1, 6)
        answer[equations.free] = -tangent.solve(tangent.held @ answer[equations.held_dofs])
        tangent.tool_coupling = answer[self._freedoms[tangent.nodes]].reshape(-1, 6)
        reactions = (tangent.held.T @ answer).reshape(-1, 3, 6)
        rate = -np.einsum("nia,nib->ab", levers, reactions)
        rate[3:] += differentiate_torque_by_levers(levers, forces)
        tangent.stiffness = -rate


def make_lineariser(model: Model, *, resolution: str = "realtime", mesh: SolidMesh | None = None,
                    candidates: int = CANDIDATES) -> SolidLineariser:
    """Make the linearisation of a model; see `tissue_sim.fem.condensed.model.LINEARISATIONS`."""
    return SolidLineariser(make_solver(model, resolution=resolution, mesh=mesh), candidates)
