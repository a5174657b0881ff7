"""Newton's iteration of a solid's bulk, condensed onto nodes near the tool, for a contact that is solved elsewhere.

Each call takes the contact forces that were found with the last linearisation, makes the step of the bulk for these
forces, and linearises there: one iteration for each model of the loop, as in the real-time iteration of optimal
control (Diehl, Bock and Schlöder, SIAM J. Control Optim. 43 (2005) 1714). With the tool at rest a few iterations
converge to an equilibrium. The condensation of a tangent takes ten times as long as the assembly of forces. If it runs
in parallel, iterates continue with the previous tangent: forces are exact, and only their derivatives are older.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.outline import OutlineLineColumn
from tissue_sim.fem.condensed.model import (
    CondensedBulk,
    ContactState,
    ContactSurface,
    Executor,
    run_now_and_get_completion_check,
)
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.contact.settings import SOLID_PENALTY
from tissue_sim.fem.contact.surface_geometry import find_nearest_surface_geometry
from tissue_sim.fem.linear.sparse import get_pardiso_or_scipy_name
from tissue_sim.fem.solid.condensed_tangent import CondensedTangent
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.frame import ToolFrame
from tissue_sim.fem.solid.settings import LinearisationSettings
from tissue_sim.fem.solid.solver import SolidSolver
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
        residual: relative residual at the last iterate, 1.

    Raises:
        InputError: a specimen whose base is not held, or additional contact laws.
    """

    def __init__(self, solver: SolidSolver, candidates: int = CANDIDATES):
        # This class belongs to `SolidSolver` and uses its protected members; it is separate to keep the files short.
        self._solver, contact = solver, solver.contact
        self._holds = bool(solver._bonded.size)
        self._mine = np.flatnonzero(contact.moves)
        if contact.laws:
            raise InputError("must be left out for a multirate solid, which supports no adhesion or other contact laws",
                             field="contact_laws")
        if any(not pair.moves and pair.stays for pair in contact.pairs):
            raise InputError("must be 'bonded', or 'frictionless' under a bonded tool, for a multirate solid: a base "
                             "that slides or lifts off would not hold the bulk", field="friction_base")
        if np.isfinite(solver.largest_motion):
            raise InputError("must be positive for a multirate solid without friction. Give the tool an edge radius",
                             field="tool.edge_radius")
        self.nodes = contact.nodes[self._mine]
        self._freedoms = 3 * self.nodes[:, None] + np.arange(3)
        equation = np.full(solver.x.size, -1)
        equation[solver._free] = np.arange(solver._free.size)
        self._equations = equation[self._freedoms]
        self._meets = np.flatnonzero((self._equations >= 0).all(axis=1))
        self._count = min(candidates, self._meets.size)
        self._most = min(self._count * (_SETTINGS.more if get_pardiso_or_scipy_name() == "pardiso" else 1),
                         self._meets.size)
        self.surface = self._make_contact_surface(self._count)
        self._untouched = solver.save()
        self._epoch, self._number, self._time = 0, 0, 0.0
        self._interface = self._meets[:0]
        self._none = np.zeros_like(contact.rates)
        self._tangents = [CondensedTangent(solver._matrix, solver._moved) for _ in range(2)]
        # Tangent in use, tangent that is being factorised, and increment that balances the tissue without contact.
        self._tangent: CondensedTangent | None = None
        self._coming: CondensedTangent | None = None
        self._stale = False  # whether the tangent in use belongs to an earlier iterate
        # First half of a solution, see `CondensedTangent.begin_solution_with_interface_rows`.
        self._settles = np.zeros(solver._free.size)
        self.executor: Executor = run_now_and_get_completion_check
        self.residual = 0.0

    def _make_contact_surface(self, candidates: int) -> ContactSurface:
        """Return the description of surface and tool for the contact solver, with at most `candidates` nodes."""
        solver, contact, mine = self._solver, self._solver.contact, self._mine
        pairs = [pair for pair in contact.pairs if pair.moves]
        lines = max((len(pair.profile.lines) - pair.first_line for pair in pairs), default=1)
        chains, shapes = np.zeros((max(1, len(pairs)), lines, 5)), np.zeros((max(1, len(pairs)), 5))
        outlines, friction = np.zeros(mine.size, dtype=np.int32), np.zeros((mine.size, 2))
        for number, pair in enumerate(pairs):
            chain, shapes[number] = _pack_outline_segments_and_constants(pair)
            chains[number, :len(chain)] = chain
            own = np.isin(self.nodes, pair.surface)
            outlines[own], friction[own] = number, pair.friction
        start = ToolFrame(solver.pose, solver.datum)
        springs = SOLID_PENALTY.normal * np.sqrt(np.maximum(contact.areas, 1e-3 * contact.areas.max(initial=0.0)))[mine]
        return ContactSurface(contact.places[mine].copy(), springs, friction, outlines, chains, shapes,
                              contact.bound[mine].astype(np.int32),
                              start.transform_to_tool(contact.places[mine]) + contact.anchors[mine], solver.pose,
                              solver.datum, solver._tolerance, solver.tissue.contact_radius, solver._floor, candidates)

    def set_material(self, material: Material) -> None:
        """See `SolidSolver.set_material`."""
        self._solver.set_material(material)
        self._tangent = None
        self._untouched = self._solver.save() if self._number == 0 else self._untouched

    @property
    def solver(self) -> SolidSolver:
        """Solver of the solid; its committed state is the last iterate."""
        return self._solver

    def iterate_and_linearise_or_none(self, state: ContactState, ahead: Sequence[Pose] = ()) -> CondensedBulk | None:
        """See `BulkLineariser.iterate_and_linearise_or_none`."""
        solver = self._solver
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
        before, here = tuple(array.copy() for array in solver._arrays_of_iterate), solver.pose
        step = self._add_and_get_newton_increment(state)
        after = tuple(array.copy() for array in solver._arrays_of_iterate)
        solver.tissue.set_step_duration(max(0.0, state.time - self._time))
        settles, old = self._settles, self._stale
        for share in _SETTINGS.old_fractions if old else _SETTINGS.fractions:
            for array, one, other in zip(solver._arrays_of_iterate, before, after, strict=True):
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
            self._commit_iterate(pose)
            self._time = state.time
            return self._make_and_number_condensed_model(state, pose)
        for array, old_one in zip(solver._arrays_of_iterate, before, strict=True):
            array[:] = old_one
        self._settles, self._stale = settles, old
        if self._coming is None or not self._assemble_and_check_volume_ratios(False):
            self._tangent = None
        return None

    def _restore_untouched_state(self) -> None:
        """Restore the solver's state before the first touch, with the present material."""
        solver = self._solver
        solver.restore(self._untouched)
        for array, rest in zip(solver._committed, solver._rest, strict=True):
            array[:] = rest
        solver.tissue.set_step_duration(0.0)
        solver._restore_committed_state()

    def _linearise_from_committed_or_none(self, state: ContactState, ahead: Sequence[Pose]) -> CondensedBulk | None:
        """Linearise with a new tangent at the committed state, or at rest if that tangent is singular; else None."""
        solver, self._coming = self._solver, None
        for go_back in (solver._restore_committed_state, self._restore_untouched_state):
            go_back()
            pose = solver.pose if self._holds else state.pose
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
        solver, tangent = self._solver, self._tangent
        assert tangent is not None
        motion, carried = np.zeros_like(solver.x), np.zeros(solver._free.size)
        if self._holds:
            goal = solver.compute_held_node_displacements(ToolFrame(state.pose, solver.datum))
            motion[solver._moved] = goal - solver.x[solver._moved]
            carried = -tangent.begin_solution_with_interface_rows((tangent.held @ motion[solver._moved])[solver._free])
        loaded = np.flatnonzero(state.forces.any(axis=1))
        if np.isin(loaded, tangent.interface).all():
            pushed = -tangent.begin_solution_for_interface_forces(state.forces[tangent.interface])
        else:
            right = np.zeros_like(solver.x)
            right[self._freedoms[loaded]] = state.forces[loaded]
            pushed = -tangent.begin_solution_with_interface_rows(right[solver._free])
        begun = self._settles + pushed + carried
        motion[solver._free] = tangent.finish_solution(begun)
        solver.x += motion
        solver.tissue.update_pressures(motion)
        return _NewtonIncrementContributions(*(self._select_rows_for_norm(each) for each in (begun, pushed, carried)))

    def _select_rows_for_norm(self, begun: np.ndarray) -> np.ndarray:
        """Return the displacements of a begun solution that the norms of the step control use, m.

        These are the interface, where the contact acts, or all free degrees of freedom if the tool holds tissue.
        """
        tangent = self._tangent
        assert tangent is not None
        return tangent.finish_solution(begun) if self._holds else begun[tangent.sorted_free_interface_equations]

    @property
    def _displacement_norm(self) -> float:
        """Norm of the displacement in the rows of `_select_rows_for_norm`, m."""
        assert self._tangent is not None
        displacement = self._solver.x[self._solver._free]
        rows = displacement if self._holds else displacement[self._tangent.sorted_free_interface_equations]
        return float(np.linalg.norm(rows))

    def _store_contact_free_increment(self) -> None:
        """Store the Newton increment without contact forces for the residual that was assembled last."""
        solver, tangent, right = self._solver, self._tangent, self._solver.batches.residual[:-1].copy()
        assert tangent is not None
        if self._stale:
            solver.tissue.correct_forces_for_reused_matrix(right)
        self._settles = -tangent.begin_solution_with_interface_rows(right[solver._free])
        if self._holds:
            motion = tangent.finish_solution(self._settles)
            self._reactions = right[solver._moved] + tangent.held[solver._free].T @ motion

    def _assemble_and_check_volume_ratios(self, tangent: bool) -> bool:
        """Assemble forces, and optionally the tangent, without contact; return False if an element is inside out."""
        solver = self._solver
        solver._least = solver.tissue.assemble_and_get_least_volume_ratio(tangent)
        if tangent:
            solver._matrix.add_contact_stiffness(self._none)
        return 0.0 < solver._least < 1e30

    def _commit_iterate(self, pose: Pose) -> None:
        """Make the present iterate, with this pose of the tool, the committed state of the solver."""
        solver = self._solver
        solver.tissue.commit_step()
        solver._committed = solver.x.copy(), solver.batches.pressures.copy(), solver.contact.forces.copy()
        solver._pose = pose

    def _store_relative_residual(self, state: ContactState) -> None:
        """Set `residual`, the relative residual with the contact forces of a state."""
        solver, unbalanced = self._solver, self._solver.batches.residual[:-1].copy()
        unbalanced[self._freedoms] += state.forces
        held = float(np.linalg.norm(unbalanced[solver._reacting]))
        self.residual = float(np.linalg.norm(unbalanced[solver._free])) / max(held, solver._floor)

    def _start_condensation_or_none(self, state: ContactState, pose: Pose, ahead: Sequence[Pose],
                                    executor: Executor) -> CondensedTangent | None:
        """Start the condensation of the tangent assembled last and return it; None while another one is in progress."""
        # A finished tangent that is not in use may be overwritten.
        spare = next((each for each in self._tangents if each is not self._tangent and each.is_done), None)
        if spare is None or self._coming is not None:
            return None
        solver, order, loaded = self._solver, *self._order_contact_candidates_and_count_loaded(state, pose, ahead)
        if not np.isin(order[:max(int(_SETTINGS.needed * self._most), loaded)], self._interface).all():
            self._interface = np.sort(order[:self._most])
        spare.time, spare.pose = state.time, pose
        spare.start_condensation(solver._matrix, self._interface, self._equations[self._interface],
                                 solver.batches.volume_rates, executor)
        self._coming = spare
        return spare

    def _try_adopting_finished_tangent(self, state: ContactState, pose: Pose, ahead: Sequence[Pose]) -> bool:
        """Use the tangent whose condensation has ended; return False if there is none or it is singular."""
        coming, self._coming = self._coming, None
        if coming is None or coming.factor is None:
            return False
        order, _ = self._order_contact_candidates_and_count_loaded(state, pose, ahead)
        nodes = order[np.isin(order, coming.interface)][:self._count]
        coming.set_published_nodes_and_compliance(nodes, self._equations[nodes])
        self._tangent, self._base = coming, self._number + 1
        self._solver.batches.known_rates[:] = coming.volume_rates
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
        solver, contact = self._solver, self._solver.contact
        frame, gaps = ToolFrame(pose, solver.datum), np.full(self.nodes.size, np.inf)
        at = frame.transform_to_tool(contact.places[self._mine] + solver.x[self._freedoms])
        for pair in contact.pairs:
            if pair.moves:
                own = np.isin(self.nodes, pair.surface)
                gaps[own] = find_nearest_surface_geometry(pair, at[own], pressed_in=True).gap
        return gaps

    def _make_and_number_condensed_model(self, state: ContactState, pose: Pose) -> CondensedBulk:
        """Return the linearisation at the last iterate, condensed onto the published nodes."""
        solver, tangent = self._solver, self._tangent
        assert tangent is not None
        free_displacement = solver.x[self._freedoms[tangent.nodes]] + self._settles[self._equations[tangent.nodes]]
        wrench = np.zeros(6)
        if self._holds:
            levers = ToolFrame(pose, solver.datum).differentiate_points(solver._get_node_positions(solver._bonded))
            forces = -self._reactions.reshape(-1, 3)
            wrench = np.einsum("nik,ni->k", levers, forces)
            if self._number + 1 == self._base:
                self._store_held_derivatives(tangent, levers, forces)
        left = np.setdiff1d(self._meets, tangent.nodes)
        reach = float(np.maximum(0.0, self._compute_gaps(pose)[left]).min(initial=np.inf))
        self._number += 1
        return CondensedBulk(self._number, self._base, self._epoch, state.time, pose, tangent.nodes,
                             free_displacement, tangent.compliance, tangent.tool_coupling, wrench, tangent.stiffness,
                             reach, solver.material.mu0, self.residual, tangent.time, tangent.pose)

    def _store_held_derivatives(self, tangent: CondensedTangent, levers: np.ndarray, forces: np.ndarray) -> None:
        """Store the derivatives of nodes and wrench with respect to the pose of a tool that holds tissue.

        Args:
            tangent: tangent that stores them.
            levers: derivatives of the held nodes with respect to the pose, shape (n, 3, 6).
            forces: of the held nodes on the tool, N, shape (n, 3).
        """
        solver = self._solver
        answer = np.zeros((solver.x.size, 6))
        answer[solver._moved] = levers.reshape(-1, 6)
        answer[solver._free] = -tangent.solve((tangent.held @ answer[solver._moved])[solver._free])
        tangent.tool_coupling = answer[self._freedoms[tangent.nodes]].reshape(-1, 6)
        reactions = (tangent.held.T @ answer).reshape(-1, 3, 6)
        rate = -np.einsum("nia,nib->ab", levers, reactions)
        apart = levers - np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
        rate[3:] += np.cross(apart, forces[:, :, None], axisa=1, axisb=1, axisc=1).sum(axis=0)
        tangent.stiffness = -rate


def make_lineariser(model: Model, *, resolution: str = "realtime", mesh: SolidMesh | None = None,
                    candidates: int = CANDIDATES) -> SolidLineariser:
    """Make the linearisation of a model; see `tissue_sim.fem.condensed.model.LINEARISATIONS`."""
    return SolidLineariser(make_solver(model, resolution=resolution, mesh=mesh), candidates)


def _pack_outline_segments_and_constants(pair: ContactPair) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return the segments of a body's outline, shape (lines, 5), and its row of `ContactSurface.shapes`."""
    profile, first = pair.profile, pair.first_line
    lines = profile.lines[first:]
    length = lines[:, OutlineLineColumn.LENGTH]
    closed = float(pair.closed and first == profile.shaft and profile.rounding == 0.0)
    return lines, (
        profile.rounding, profile.shaft - first, closed, len(length), _SETTINGS.on_axis * length.max(initial=1.0))
