"""Discrete equations of a solid under a rigid tool: unknowns, boundary conditions, residual, tangent and states.

The unknowns of an iteration are nodal displacements, pressure amplitudes of the elements and contact forces.

Factors of the tangent are reused by Newton iterations, or condensed onto nodes that the tool may touch.
With a reused factor (modified Newton method), pressures and contact forces are eliminated with the stiffness values
that the matrix contains. The iteration is then one for displacements, pressures and contact forces with an earlier
tangent, whose convergence rate depends neither on K/mu nor on the penalty stiffness of the contact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tissue_sim.fem.condensed.model import Executor
from tissue_sim.fem.contact.laws import NodalContactLaws
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.contact.surface_geometry import find_nearest_surface_geometry
from tissue_sim.fem.inertia import LumpedMass
from tissue_sim.fem.linear.sparse import CondensedFactor, Factor, SparseSolver
from tissue_sim.fem.solid.contact import (
    ContactNodes,
    ToolFrame,
    differentiate_rotated_forces,
    differentiate_torque_by_levers,
)
from tissue_sim.fem.solid.fields import SavedState
from tissue_sim.fem.solid.tissue import Tissue
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose, compute_rigid_motion


class SolidEquations:
    """Discrete equations of a solid under a rigid tool, with their present iterate and their committed state.

    `SolidSolver` solves the equations with the contact; `SolidLineariser` iterates them for contact forces that another
    solver found. An iterate consists of `x`, the pressures of `batches` and the forces of `contact`.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        fixed: node set -> axes, ``"z"`` or ``"xyz"``, along which its nodes are fixed.
        bonded: nodes that the tool holds, shape (n,).
        pairs: contact pairs of the surface.
        laws: additional contact laws of the tool.
        tolerance: largest permitted violation of a contact condition, m.
        largest_motion: largest motion of the tool after its first touch, downwards and sideways, with which the contact
            conditions are accurate, m.
        start: pose of the tool at its first touch, in the frame of the scene.
        datum: height of that frame's origin in the frame of the mesh, m.
        contact_radius: m, for the time of drainage, see `Material.make_prony_series`.
        pins: pairs of a node and the axes, ``"xy"``, along which it is fixed if nothing else prevents rigid motions.
        element_layers: see `Tissue`.
        specific_weight: density times gravity, N/m3, towards -z.
        settled: equations of this mesh without a tool, in the state of the first touch; None: the undeformed mesh.
        lift: height of nodes above the surface that the tool is assumed to touch, m, shape (nodes,); None: 0.

    Attributes:
        x: displacements of all degrees of freedom, m, shape (freedoms,).
        tissue, batches, contact: elements with their materials; their forces, pressures and matrix; contact nodes.
        mass: lumped mass of the tissue; None: the tissue has no mass.
        free: indices of the free degrees of freedom.
        reacting: indices of the fixed and of the held degrees of freedom.
        held_nodes: nodes that the tool holds, shape (n,).
        held_dofs: their degrees of freedom, shape (3 n,).
        held_positions_in_tool: their positions in the frame of the tool, m, shape (n, 3).
        first_frame: frame of the tool at its first touch.
        matrix: stiffness matrix, and its part for the free degrees of freedom.
        negligible_force: smallest reference force of a relative residual, N.
        frame: frame of the tool at the present iterate.
        pose: pose of the tool at the committed state.
        largest_force: largest force on the tool so far, N.
        committed, resting: copies of the iterate at the committed state, and at rest without a tool.

    Raises:
        InputError: a part of the material is not supported, or a bulk ratio is outside of `BULK_RATIOS`.
        MissingBackendError: Taichi is not installed.
    """

    def __init__(self, mesh: SolidMesh, material: Material, fixed: dict[str, str], bonded: np.ndarray, *,
                 pairs: Sequence[ContactPair] = (), laws: NodalContactLaws | None = None, tolerance: float = 0.0,
                 largest_motion: float = np.inf, start: Pose, datum: float = 0.0, contact_radius: float = 1.0,
                 pins: Sequence[tuple[int, str]] = (), element_layers: np.ndarray | None = None,
                 specific_weight: float = 0.0, settled: SolidEquations | None = None, lift: np.ndarray | None = None):
        self.mesh, self.datum, self.tolerance, self.largest_motion = mesh, datum, tolerance, largest_motion
        self._contact_radius = contact_radius
        self.x = np.zeros(3 * len(mesh.nodes))
        self.tissue = Tissue(mesh, self.x, contact_radius, element_layers)
        self.batches, self.tissue.specific_weight = self.tissue.batches, specific_weight
        if settled is not None:
            self.x[:], self.batches.pressures[:] = settled.x, settled.batches.pressures
        self.start = self.pose = start
        self.frame = self.first_frame = ToolFrame(start, datum)
        self.largest_force = 0.0
        freedoms, stays = np.arange(self.x.size).reshape(-1, 3), _make_fixed_component_mask_by_node(mesh, fixed, pins)
        self.held_nodes, moved = np.asarray(bonded, dtype=np.intp), np.zeros_like(stays)
        moved[self.held_nodes] = True
        self.free = np.flatnonzero(~(stays | moved))
        self.reacting = np.flatnonzero(stays | moved)
        self.held_dofs = freedoms[self.held_nodes].ravel()
        self.held_positions_in_tool = self.first_frame.transform_to_tool(self.get_node_positions(self.held_nodes))
        self.contact = ContactNodes(pairs, mesh.nodes, mesh.surface_node_areas, laws)
        if lift is not None:
            self.contact.places[self.contact.moves, 2] -= lift[self.contact.nodes[self.contact.moves]]
        self.contact.bind_nodes_at_first_touch(start, datum, self.x.reshape(-1, 3),
                                               None if settled is None else settled.contact)
        self.matrix = FreeDofSubmatrix(self.batches.matrix, self.free, freedoms[self.contact.nodes])
        self.mass: LumpedMass | None = None
        self._sparse = SparseSolver()
        self.committed, self.resting = self.copy_iterate(), self.copy_iterate()
        self.material = material
        self.set_material(material)
        if settled is not None:
            for array, left in zip(self.tissue.state_arrays, settled.tissue.state_arrays, strict=True):
                array[:] = left

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept. See `Solver.set_material`."""
        self.tissue.set_material(material)
        # If all moduli change by one factor, the displacements stay the same and all forces change by the factor.
        for array in (*self.committed[1:], *self.resting[1:], *self.iterate_arrays[1:]):
            array *= material.mu0 / self.material.mu0
        self.material = material
        self.contact.set_penalty_stiffness(material.mu0)
        top = self.mesh.nodes[self.mesh.sets["top"], :2]
        self.negligible_force = 1e-6 * material.mu0 * float(np.prod(np.ptp(top, axis=0)))

    def accepts_pose(self, pose: Pose) -> bool:
        """Whether the contact conditions are accurate at a pose, see `largest_motion`.

        They are accurate at every pose above the first touch.
        """
        x, y, z, *turn = compute_rigid_motion(self.start, pose)
        aside = math.hypot(x, y) + self._contact_radius * math.hypot(*turn[:2])
        return z >= 0.0 or max(-z, aside) <= self.largest_motion

    @property
    def iterate_arrays(self) -> tuple[np.ndarray, ...]:
        """Displacements, pressures and contact forces of the present iterate, not copied."""
        return self.x, self.batches.pressures, self.contact.forces

    def copy_iterate(self) -> tuple[np.ndarray, ...]:
        """Return copies of `iterate_arrays`."""
        return tuple(array.copy() for array in self.iterate_arrays)

    def set_iterate(self, arrays: Sequence[np.ndarray]) -> None:
        """Set displacements, pressures and contact forces to copies of the given arrays."""
        self.x[:], self.batches.pressures[:], self.contact.forces[:] = arrays

    def restore_committed_state(self) -> None:
        """Set the iterate, the bonds of the contact and `frame` to those of the last committed state."""
        self.set_iterate(self.committed)
        self.contact.copy_committed_bonds_to_step()
        self.frame = ToolFrame(self.pose, self.datum)

    def begin_step(self, dt: float, inertial: bool) -> None:
        """Set the duration of the next step, s, for material history and inertia; the mass acts if `inertial`."""
        self.tissue.set_step_duration(dt)
        if self.mass is not None:
            self.mass.prepare_step(self.committed[0], dt, inertial)

    def commit_step(self, pose: Pose, dt: float, inertial: bool) -> None:
        """Commit a converged step of `begin_step`, with its contact, to a pose of the tool."""
        if self.mass is not None:
            self.mass.motion.commit_step(self.committed[0], self.x, dt, inertial)
        self.contact.commit_step()
        self.commit_iterate(pose)

    def commit_iterate(self, pose: Pose) -> None:
        """Commit the iterate with its material history, with the tool at a pose; the bonds of the contact are kept."""
        self.tissue.commit_step()
        self.committed, self.pose = self.copy_iterate(), pose

    def reset_to_first_touch(self) -> None:
        """Restore displacements, pressures and contact of the first touch; the material history is kept."""
        for array, rest in zip(self.committed, self.resting, strict=True):
            array[:] = rest
        self.contact.restore_first_touch_contact_state()
        self.stop_motion()
        self.pose, self.largest_force = self.start, 0.0
        self.restore_committed_state()

    def make_committed_state_the_resting_state(self) -> None:
        """Make the committed state the resting state, without a tool."""
        self.resting = tuple(array.copy() for array in self.committed)

    def stop_motion(self) -> None:
        """Set the velocity of the tissue to zero."""
        if self.mass is not None:
            self.mass.motion.reset_velocity()

    def save(self) -> SavedState:
        """Return a copy of the committed state, for `restore`."""
        return SavedState(tuple(map(np.copy, self._state_arrays)), self.pose, self.largest_force, self.start)

    def restore(self, saved: SavedState) -> None:
        """Make a state that was returned by `save` the committed state."""
        for array, before in zip(self._state_arrays, saved.arrays, strict=True):
            array[:] = before
        self.pose, self.largest_force = saved.pose, saved.largest_force

    @property
    def _state_arrays(self) -> tuple[np.ndarray, ...]:
        moving = () if self.mass is None else self.mass.motion.state_arrays
        return (*self.committed, *self.contact.state_arrays, *self.tissue.state_arrays, *moving)

    def get_node_positions(self, nodes: np.ndarray) -> np.ndarray:
        """Return the deformed positions of nodes, m, shape (n, 3)."""
        return self.mesh.nodes[nodes] + self.x.reshape(-1, 3)[nodes]

    def compute_tool_gaps(self, pose: Pose, displacement: np.ndarray, pressed_in: bool) -> np.ndarray:
        """Return the gaps between the contact nodes and a tool at a pose, m, shape (n,); infinite for bodies at rest.

        Args:
            pose: pose of the tool.
            displacement: displacements of all nodes, m, shape (nodes, 3).
            pressed_in: see `find_nearest_surface_geometry`.
        """
        contact, frame = self.contact, ToolFrame(pose, self.datum)
        gaps = np.full(contact.nodes.size, np.inf)
        for pair, own in contact.parts:
            if pair.moves and own.size:
                at = frame.transform_to_tool(contact.places[own] + displacement[contact.nodes[own]])
                gaps[own] = find_nearest_surface_geometry(pair, at, pressed_in).gap
        return gaps

    def compute_held_node_displacements(self, frame: ToolFrame) -> np.ndarray:
        """Return the displacements of the nodes that the tool holds, for a frame of the tool, m, shape (3 n,)."""
        return (frame.transform_to_mesh(self.held_positions_in_tool) - self.mesh.nodes[self.held_nodes]).ravel()

    def assemble_and_get_least_volume_ratio(self, tangent: bool = True) -> float:
        """Assemble the forces of tissue and inertia in `batches` and, if `tangent`, the matrix; without contact.

        Returns:
            Smallest volume ratio J of all elements, 1.
        """
        least = self.tissue.assemble_and_get_least_volume_ratio(tangent)
        if tangent:
            self.batches.store_assembled_volume_rates()
        if self.mass is not None:
            self.mass.add_inertial_forces(self.x, self.batches.residual[:-1], self.matrix.all if tangent else None)
        return least

    def factorise_or_none(self, symmetric: bool) -> Factor | None:
        """Factorise `matrix.free`; None if it is singular. Only the newest factor is valid."""
        return self._sparse.factorise_or_none(self.matrix.free, symmetric=symmetric)

    def reset_and_factorise_or_none(self) -> Factor | None:
        """Return to the first touch, and factorise the tangent of the tissue there, without contact; else None."""
        self.reset_to_first_touch()
        self.assemble_and_get_least_volume_ratio()
        self.matrix.update_free_part()
        return self.factorise_or_none(symmetric=True)

    def compute_element_forces_at_displacement(self, displacement: np.ndarray, bulk_ratio: float) -> np.ndarray:
        """Return the nodal forces of each element, N, at a displacement from the resting state, m, shape (freedoms,).

        The state is kept. See `Tissue.compute_element_forces_limiting_bulk`.
        """
        rest, pressures, _ = self.resting
        self.x[:] = rest + displacement
        forces = self.tissue.compute_element_forces_limiting_bulk(bulk_ratio, pressures)
        self.restore_committed_state()
        return forces

    def _get_held_forces(self) -> np.ndarray:
        """Return the forces of the tissue on the held nodes at the last assembly, N, shape (n, 3)."""
        return self.batches.residual[:-1][self.held_dofs].reshape(-1, 3)

    def compute_wrench(self, frame: ToolFrame) -> np.ndarray:
        """Return force and torque about the tool's deepest point, of tissue on the tool, N and N m, shape (6,)."""
        contact, moves = self.contact, self.contact.moves
        rates = np.concatenate([frame.differentiate_points(self.get_node_positions(self.held_nodes)),
                                frame.differentiate_points(self.get_node_positions(contact.nodes[moves]))])
        # The residual at held nodes is the force that the tool must apply.
        forces = np.concatenate([-self._get_held_forces(), contact.contact_and_law_forces_by_node[moves]])
        return np.einsum("nik,ni->k", rates, forces)

    def compute_stiffness_and_motion_by_pose(self, frame: ToolFrame, factor: Factor) -> tuple[np.ndarray, np.ndarray]:
        """Condense the stiffness onto the pose of the tool (Schur complement), and differentiate the displacements.

        Args:
            frame: frame of the tool.
            factor: factor of the matrix that was assembled last, contact included.

        Returns:
            Minus the derivative of the wrench with respect to position and rotation of the tool, shape (6, 6), and the
            derivative of all displacements, shape (freedoms, 6).
        """
        contact, moves, matrix = self.contact, self.contact.moves, self.matrix.all
        moved = np.zeros((self.x.size, 6))
        levers = frame.differentiate_points(self.get_node_positions(self.held_nodes))
        moved[self.held_dofs] = levers.reshape(-1, 6)
        way, turned = np.zeros((2, len(contact.nodes), 3, 6))
        way[moves] = frame.differentiate_points(self.get_node_positions(contact.nodes[moves]))
        # Contact forces rotate with the tool.
        turned[moves] = differentiate_rotated_forces(contact.contact_and_law_forces_by_node[moves])
        # Nodal forces for a motion of the tool with fixed tissue; the matrix contains the contact stiffness.
        pushed = matrix @ moved
        np.add.at(pushed.reshape(-1, 3, 6), contact.nodes, turned - np.einsum("nij,njk->nik", contact.rates, way))
        answer = moved.copy()
        answer[self.free] = -factor.solve(pushed[self.free])
        on_tool = turned + np.einsum("nij,njk->nik", contact.rates, answer.reshape(-1, 3, 6)[contact.nodes] - way)
        reactions = (matrix @ answer)[self.held_dofs].reshape(-1, 3, 6)
        wrench_rate = np.einsum("nia,nib->ab", levers, -reactions)
        wrench_rate += np.einsum("nia,nib->ab", way[moves], on_tool[moves])
        # The levers of the torque change as well: by the displacement of the node minus that of the tool.
        wrench_rate[3:] += differentiate_torque_by_levers(
            np.concatenate([levers, answer.reshape(-1, 3, 6)[contact.nodes[moves]]]),
            np.concatenate([-self._get_held_forces(), contact.contact_and_law_forces_by_node[moves]]))
        return -wrench_rate, answer


def _make_fixed_component_mask_by_node(mesh: SolidMesh, fixed: Mapping[str, str],
                                       pins: Sequence[tuple[int, str]]) -> np.ndarray:
    """Return whether each node is fixed along x, y and z, shape (nodes, 3).

    Args:
        mesh: mesh of the nodes.
        fixed: node set -> axes, ``"z"`` or ``"xyz"``.
        pins: pairs of a node and the axes along which the node is fixed, ``"xy"``.
    """
    stays = np.zeros((len(mesh.nodes), 3), dtype=bool)
    held: list[tuple[Any, str]] = [*((mesh.sets[name], axes) for name, axes in fixed.items()), *pins]
    for nodes, axes in held:
        for axis in axes:
            stays[nodes, "xyz".index(axis)] = True
    return stays


class FreeDofSubmatrix:
    """Submatrix of the stiffness matrix for the free degrees of freedom, with the stiffness of the contact.

    Args:
        matrix: matrix of all degrees of freedom, whose data are overwritten by each assembly.
        free: indices of the free degrees of freedom.
        blocks: degrees of freedom of the contact nodes, shape (n, 3).

    Attributes:
        all: full matrix with the contact stiffness.
        free: submatrix with the contact stiffness.
    """

    def __init__(self, matrix: Any, free: np.ndarray, blocks: np.ndarray):
        from scipy import sparse

        self.all = matrix
        numbered = sparse.csc_array((np.arange(1, matrix.nnz + 1), matrix.indices, matrix.indptr), shape=matrix.shape)
        part = numbered[:, free][free].tocsc()
        part.sort_indices()
        self._entries = part.data - 1
        self.free = sparse.csc_array((np.zeros(part.nnz), part.indices, part.indptr), shape=part.shape)
        # Indices of the entries (i, j) of the diagonal block of each contact node.
        rows, columns = np.broadcast_arrays(blocks[:, :, None], blocks[:, None])
        self._blocks = np.asarray(numbered[rows.ravel(), columns.ravel()]).ravel() - 1 if blocks.size else (
            np.zeros(0, dtype=np.intp))

    def add_contact_stiffness(self, rates: np.ndarray) -> None:
        """Add the contact stiffness to the matrix that was assembled last, and update the submatrix `free`.

        Args:
            rates: stiffness of each contact node, N/m, shape (n, 3, 3).
        """
        np.add.at(self.all.data, self._blocks, rates.ravel())
        self.update_free_part()

    def update_free_part(self) -> None:
        """Copy the entries of the free degrees of freedom to the submatrix `free`."""
        self.free.data[:] = self.all.data[self._entries]


@dataclass(frozen=True)
class ReuseSettings:
    """Conditions for the reuse of a factor.

    Attributes:
        gain: largest ratio of the residuals after and before a solution for which the factor is reused, 1.
        more: number of further solutions within which the tolerance must be reached with a larger ratio.
        no_gain: bound of the ratio, 1; a residual that was zero before has no finite ratio.
        far: relative residual above which the next solution needs a new tangent, 1.
    """

    gain: float = 1e-2
    more: int = 3
    no_gain: float = 1e6
    far: float = 100.0


_SETTINGS = ReuseSettings()


class ReusableTangentFactor:
    """Factor of an assembled tangent that several Newton iterations use (modified Newton method).

    Args:
        equations: assembled equations, whose matrix gets the contact stiffness.

    Attributes:
        factor: factor of the free part of the matrix; None before the first factorisation, or if singular.
        stale: whether the factor belongs to an earlier iterate.
    """

    def __init__(self, equations: SolidEquations):
        self._equations = equations
        self.factor: Factor | None = None
        self.stale, self._before = False, np.inf

    def factorise_with_contact_or_none(self, symmetric: bool) -> Factor | None:
        """Add the contact stiffness to the matrix that was assembled last, factorise it, and return the factor.

        The factor is also stored in `factor`; it is None if the matrix is singular.
        """
        contact = self._equations.contact
        self._equations.matrix.add_contact_stiffness(contact.rates)
        contact.store_assembled_contact_rates()
        self.factor, self.stale = self._equations.factorise_or_none(symmetric), False
        return self.factor

    def solve_increment(self, right: np.ndarray, way: np.ndarray | None, apart: np.ndarray) -> np.ndarray:
        """Return the Newton increment of the displacements for a residual, m, shape (freedoms,).

        Args:
            right: residual, the unbalanced forces, N, shape (freedoms,); the array is overwritten.
            way: prescribed increments of the degrees of freedom that move with the tool, m; None: none.
            apart: additional increments of the contact nodes relative to their bodies, m, shape (n, 3).
        """
        assert self.factor is not None
        equations, contact, motion = self._equations, self._equations.contact, np.zeros_like(right)
        if self.stale:
            equations.tissue.correct_forces_for_reused_matrix(right)
        pushed = np.einsum("nij,nj->ni", contact.known_rates, contact.missed)
        if way is not None:
            motion += way
            pushed = pushed + np.einsum("nij,nj->ni", contact.rates, apart)
            right += equations.matrix.all @ way
        np.add.at(right.reshape(-1, 3), contact.nodes, pushed)
        motion[equations.free] = -self.factor.solve(right[equations.free])
        return motion

    def record_residual_and_set_stale(self, ratio: float, far: bool) -> None:
        """Record the relative residual before a linear solution; `can_reuse_factor` compares the next residual with it.

        Args:
            ratio: relative residual before the solution, 1.
            far: whether the solution moved the tool, so that the next iteration needs a new tangent.
        """
        self.stale, self._before = not far and ratio <= _SETTINGS.far, ratio

    def can_reuse_factor(self, ratio: float, goal: float, changed: bool) -> bool:
        """Return whether the factor of an earlier iterate reduces the residual fast enough to be used again.

        Args:
            ratio: present relative residual, 1.
            goal: relative residual at which Newton's method ends, 1.
            changed: whether the active sets of the contact changed; the factor is then not accurate.
        """
        gain = min(ratio / max(self._before, 1e-300), _SETTINGS.no_gain)
        return not changed and (gain <= _SETTINGS.gain or ratio * gain**_SETTINGS.more <= goal)


class CondensedTangent:
    """Copy of the tangent of a solid's bulk at one iterate, with its factor and Schur complement on interface nodes.

    The copy stays constant while the iteration of the solver continues.

    Args:
        equations: equations of the solid.

    Attributes:
        time: time of the contact state of the iterate, s; set by the owner.
        pose: pose of the tool at the iterate; set by the owner.
        interface: indices, in the `ContactSurface`, of the nodes onto which the tangent is condensed, shape (m,).
        interface_rows: sorted indices of their degrees of freedom among the free ones, shape (3 m,).
        nodes: interface nodes that are published to the contact solver, shape (n,).
        volume_rates: volume derivatives with which the pressures were eliminated, see `ElementBatches`.
        held: columns of the matrix for the degrees of freedom that the tool holds.
        factor: None before it is computed, or if the matrix is singular.
        compliance: compliance matrix of the published nodes, m/N, shape (3 n, 3 n).
        tool_coupling: derivative of the nodal displacements with respect to the pose of the tool that holds tissue,
            shape (3 n, 6).
        stiffness: minus the derivative of the wrench of the held nodes with respect to the pose, shape (6, 6).
    """

    time: float
    pose: Pose
    compliance: np.ndarray
    tool_coupling: np.ndarray
    stiffness: np.ndarray

    def __init__(self, equations: SolidEquations):
        from scipy import sparse

        pattern, self._equations = equations.matrix.free, equations
        self._matrix = sparse.csc_array((np.zeros(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        self._sparse = SparseSolver()
        self._is_done: Callable[[], bool] = lambda: True
        self.interface = self.nodes = np.zeros(0, dtype=np.intp)
        self.volume_rates, self.held = np.zeros(0), equations.matrix.all[:, equations.held_dofs]
        self.factor: CondensedFactor | None = None

    def start_condensation(self, interface: np.ndarray, rows: np.ndarray, executor: Executor) -> None:
        """Copy the tangent that was assembled last, and start its factorisation and condensation in an executor.

        Args:
            interface: indices of the interface nodes in the surface, shape (m,).
            rows: indices of their degrees of freedom among the free ones, shape (m, 3).
            executor: runs the factorisation.
        """
        matrix = self._equations.matrix
        self._matrix.data[:], self.held = matrix.free.data, matrix.all[:, self._equations.held_dofs]
        self.interface, self.volume_rates = interface, self._equations.batches.volume_rates.copy()
        self.factor, self._order = None, np.argsort(rows.ravel())
        self.interface_rows = rows.ravel()[self._order]
        self._is_done = executor(self._condense)

    def _condense(self) -> None:
        """Set `factor`; it stays None if the matrix is singular."""
        self.factor = self._sparse.factorise_condensed_or_none(self._matrix, self.interface_rows)

    @property
    def is_done(self) -> bool:
        """Whether the factorisation has ended, with or without a factor."""
        return self._is_done()

    def set_published_nodes_and_compliance(self, nodes: np.ndarray, rows: np.ndarray) -> None:
        """Set the published nodes and their compliance.

        Args:
            nodes: indices in the `ContactSurface`, a subset of `interface`, shape (n,).
            rows: indices of their degrees of freedom among the free ones, shape (n, 3).
        """
        assert self.factor is not None
        indices = np.searchsorted(self.interface_rows, rows.ravel())
        self.nodes, self.compliance = nodes, self.factor.compliance[np.ix_(indices, indices)]
        self.tool_coupling, self.stiffness = np.zeros((3 * nodes.size, 6)), np.zeros((6, 6))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return displacements of the free degrees of freedom, m, shape (free, n), under forces on all, N."""
        assert self.factor is not None
        return self.factor.solve(right[self._equations.free])

    def begin_solution_with_interface_rows(self, right: np.ndarray) -> np.ndarray:
        """Do the first half of `solve`, after which the rows of the interface already contain displacements, m.

        Args:
            right: forces on all degrees of freedom, N, shape (freedoms,).

        Returns:
            Argument of `finish_solution`, shape (free,); see `CondensedFactor.solve_up_to_interface`.
        """
        assert self.factor is not None
        return self.factor.solve_up_to_interface(right[self._equations.free])

    def begin_solution_for_interface_forces(self, forces: np.ndarray) -> np.ndarray:
        """Do the first half of a solution for forces on the interface nodes only, N, shape (m, 3)."""
        assert self.factor is not None
        return self.factor.solve_up_to_interface_for_force(forces.ravel()[self._order])

    def finish_solution(self, begun: np.ndarray) -> np.ndarray:
        """Do the second half of a solution; return the displacements of all free degrees of freedom, m."""
        assert self.factor is not None
        return self.factor.complete_solution(begun)
