"""Exact derivatives of a solid's force with respect to parameters of material, friction and geometry.

The discrete equations of tissue and contact are differentiated at every converged step (Michaleris, Tortorelli and
Vidal, Int. J. Numer. Methods Eng. 37 (1994) 2471). The derivative of the forces at constant displacements is a central
difference of the assembly, in the direction of all inputs that depend on the parameter, the history included. The
derivative of the displacements is solved with the tangent at the converged state.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain

import numpy as np

from tissue_sim.fem.history import MaterialMemory, RelaxationSofteningCoefficient, shift_points_from_softening_kink
from tissue_sim.fem.linear.sparse import SparseSolver
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.fem.solid.equations import SolidEquations
from tissue_sim.fem.solid.law_sensitivity import LawDerivativesByPositionSlipForce
from tissue_sim.fem.solid.shape_sensitivity import MeshDerivative, NeighbourEquations, ToolShapeDerivatives
from tissue_sim.fem.solver import ExperimentDerivatives, Neighbours
from tissue_sim.material.viscoelasticity import Prony


class HistoryDerivatives:
    """Derivatives of the history of one material with respect to m parameters, at the last committed step.

    Args:
        memory: history of the elements of the material.
        past_rates: derivatives of `MaterialMemory.past`, shape (m, 6).
        relaxations: for each parameter the relaxing terms with the parameter increased and decreased.
        widths: differences of the two parameter values, shape (m,).

    Attributes:
        inherited: derivatives of the contribution of earlier stresses in the step, shape (m, elements, q, 6).
    """

    def __init__(self, memory: MaterialMemory, past_rates: np.ndarray,
                 relaxations: Sequence[tuple[Prony | None, Prony | None]], widths: np.ndarray):
        self.memory, self._past_rates, self._relaxations, self._widths = memory, past_rates, relaxations, widths
        m = widths.size
        self._past_rates[:, RelaxationSofteningCoefficient.INSTANT] = 0.0
        shape = (m, *memory.stresses.shape) if memory.works else (m, 0)
        self._before, self._largest = np.zeros(shape), np.zeros(shape[:-1])
        self._internal = np.zeros((m, *memory.internal.shape))
        self.inherited = np.zeros_like(self._before)
        self._decays, self._gains = np.zeros((2, m, len(memory.internal)))

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Derivatives of stresses, internal variables and largest energy density, parameters first.

        Writing saved copies into these arrays restores the derivatives of another step.
        """
        return self._before, self._internal, self._largest

    def compute_inherited_derivatives(self) -> None:
        """Set `inherited` for a step, after `MaterialMemory.set_step_duration`."""
        memory = self.memory
        if not len(memory.internal):
            return
        decay, gain = memory.step
        for k, ((more, less), width) in enumerate(zip(self._relaxations, self._widths, strict=True)):
            if more is not None and less is not None and more != less:
                self._past_rates[k, RelaxationSofteningCoefficient.INSTANT], self._decays[k], self._gains[k] = (
                    (np.asarray(a) - np.asarray(b)) / width
                    for a, b in zip(more.compute_recursion_coefficients(memory.dt),
                                    less.compute_recursion_coefficients(memory.dt), strict=True))
            self.inherited[k] = (np.tensordot(decay, self._internal[k], 1)
                                 + np.tensordot(self._decays[k], memory.internal, 1)
                                 - gain.sum() * self._before[k] - self._gains[k].sum() * memory.before)

    def get_input_and_derivative_pairs(self, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return pairs (history array that the assembly reads, its derivative with respect to parameter k)."""
        memory = self.memory
        if not memory.works:
            return []
        return [(memory.past, self._past_rates[k]), (memory.inherited, self.inherited[k]),
                (memory.largest, self._largest[k])]

    def commit_derivatives_for_parameter(self, k: int, stress: np.ndarray, energy: np.ndarray) -> None:
        """Update the derivatives of the history with respect to parameter k when a step is committed.

        Args:
            k: index of the parameter.
            stress: derivative of the stress of the law, Pa, shape (elements, q, 6).
            energy: derivative of the energy density, J/m3, shape (elements, q).
        """
        memory = self.memory
        if len(memory.internal):
            decay, gain = memory.step
            wide = (slice(None), None, None, None)
            self._internal[k] = (decay[wide] * self._internal[k] + self._decays[k][wide] * memory.internal
                                 + gain[wide] * (stress - self._before[k])
                                 + self._gains[k][wide] * (memory.stresses - memory.before))
        self._before[k] = stress
        self._largest[k] = np.where(memory.energies > memory.largest, energy, self._largest[k])


#: Half width of the differences in units of the distance of the neighbours, which is 1e-6 of the parameter.
_WIDTH = 10.0
#: The same for parameters of the geometry. The error of these differences increases with K/mu times the square of their
#: width.
_GEOMETRY_WIDTH = 1.0


@dataclass(frozen=True)
class IterativeRefinementSettings:
    """Settings of the iterative refinement of the linear solutions.

    Attributes:
        tolerance: relative residual at which the refinement ends, 1.
        acceptable: largest acceptable relative residual after the last iteration, 1; above it the result is NaN.
        max_solutions: largest number of solutions with one factor.
    """

    tolerance: float = 1e-10
    acceptable: float = 1e-7
    max_solutions: int = 12


_SETTINGS = IterativeRefinementSettings()


@dataclass(frozen=True, eq=False)
class FirstTouchDerivatives:
    """Derivatives of the state of the first touch with respect to m parameters.

    Attributes:
        stretch: derivative of the logarithm of the height of the undeformed mesh, in addition to its derivative from
            neighbouring solvers, shape (m,).
        settled: `SolidSensitivity.state_derivatives` of the settled specimen; None: the specimen is undeformed.
        resting: indices of the contact nodes of the settled specimen, shape (n,).
        datum: derivative of the height of the scene's origin in the frame of the mesh, m, shape (m,).
        lift: derivative of the height of the nodes above the surface that the tool is assumed to touch, m, shape
            (nodes, m); None: 0.
    """

    stretch: np.ndarray
    settled: Sequence[np.ndarray] | None
    resting: np.ndarray
    datum: np.ndarray
    lift: np.ndarray | None

    @classmethod
    def from_undeformed_specimen(cls, stretch: np.ndarray) -> FirstTouchDerivatives:
        """Make the derivatives of an undeformed specimen from those of the logarithm of its height, shape (m,)."""
        return cls(stretch, None, np.zeros(0, dtype=np.intp), np.zeros_like(stretch), None)


class SolidSensitivity:
    """Derivatives of a solver's state with respect to m parameters, at its last committed step.

    Args:
        equations: equations of a solver before its first step.
        input_rates: derivatives of each region's inputs, in their order, shape (m, ...).
        memories: derivatives of the history of each region.
        widths: distance of each parameter's neighbours, shape (m,).
        experiments: derivatives of the inputs from the experiment.
        geometries: equations around each parameter of the geometry, else None.

    Attributes:
        force: derivatives of the force on the tool along z, N per unit of the parameter, shape (m,).
        vector: derivatives of all three components of this force, shape (m, 3).
    """

    def __init__(self, equations: SolidEquations, input_rates: Sequence[Sequence[np.ndarray]],
                 memories: Sequence[HistoryDerivatives], widths: np.ndarray,
                 experiments: Sequence[ExperimentDerivatives], geometries: Sequence[NeighbourEquations | None]):
        self._equations, self._memories = equations, memories
        self._half = np.where([each is None for each in geometries], _WIDTH, _GEOMETRY_WIDTH) * widths
        self._regions = range(len(memories))
        m, n = widths.size, equations.contact.nodes.size
        #: Derivatives of the friction of face, shaft and base, shape (3, m).
        self._frictions = np.array([each[:3] for each in experiments]).reshape(m, 3).T
        #: For each parameter and region: input arrays and their derivatives.
        self._inputs = [[[(array, rate[k]) for array, rate in zip(region.inputs, rates, strict=True) if rate[k].any()]
                         for region, rates in zip(equations.tissue.region_material_arrays, input_rates, strict=True)]
                        for k in range(m)]
        self.vector = np.zeros((m, 3))
        self.force = self.vector[:, 2]
        #: Derivatives of: the anchors, in the frames of their bodies; the undeformed positions relative to the bodies;
        #: the held nodes in the frame of the tool, and their displacements at the first touch; the origin of the tool,
        #: and the undeformed positions, in the frame of the mesh.
        self._anchors, self._apart = np.zeros((2, n, 3, m))
        self._held, self._held_motion = np.zeros((2, equations.held_dofs.size // 3, 3, m))
        self._origin, self._undeformed = np.zeros((3, m)), np.zeros((*equations.mesh.nodes.shape, m))
        self._motion = np.zeros((equations.x.size, m))
        self._meshes = [None if near is None else MeshDerivative.from_neighbours(equations, near)
                        for near in geometries]
        self._shapes = ToolShapeDerivatives(equations.contact, geometries)
        self._shape = self._shapes.differentiate(np.zeros((n, 3)), equations.first_frame)
        self._laws: LawDerivativesByPositionSlipForce | None = None
        self._added, self._sparse = np.zeros((n, 3, 3)), SparseSolver()
        self._kinds, self._changed = np.zeros((5, n), dtype=bool), False

    @classmethod
    def from_perturbed_materials(cls, equations: SolidEquations, neighbours: Neighbours,
                                 experiments: Sequence[ExperimentDerivatives] | None = None) -> SolidSensitivity:
        """Make the derivatives from materials with increased and decreased parameters, set one after the other.

        The material of the solver is restored.

        Args:
            equations: equations of a solver before its first step.
            neighbours: see `tissue_sim.fem.solver.Neighbours`.
            experiments: derivatives of the inputs from the experiment; None: zero.
        """
        def copy_inputs(near: SolidEquations) -> list[list[np.ndarray]]:
            """Return copies of the arrays that depend on the material, for each region."""
            return [[array.copy() for array in (*region.inputs, region.memory.past)]
                    for region in near.tissue.region_material_arrays]

        regions, here = equations.tissue.region_material_arrays, equations.material
        experiments = experiments or [ExperimentDerivatives()] * len(neighbours)
        geometries: list[NeighbourEquations | None] = []
        sides, relaxations = [], []
        try:
            for (more, less, width), experiment in zip(neighbours, experiments, strict=True):
                near, both, series = experiment.neighbour_solvers, [], []
                for material, side in zip((more, less), near or (None, None), strict=True):
                    at = equations if side is None else side.equations
                    at.set_material(material)
                    both.append(copy_inputs(at))
                    series.append([region.relaxation(material) for region in at.tissue.region_material_arrays])
                sides.append(both)
                relaxations.append(series)
                geometries.append(near and NeighbourEquations(near[0].equations, near[1].equations, width))
        finally:
            equations.set_material(here)
        widths = np.array([width for *_, width in neighbours])
        rates, memories = [], []
        for number, region in enumerate(regions):
            arrays = (*region.inputs, region.memory.past)
            found = [np.zeros((widths.size, *array.shape)) for array in arrays]
            for k, (high, low) in enumerate(sides):
                for rate, above, below in zip(found, high[number], low[number], strict=True):
                    rate[k] = (above - below) / widths[k]
            rates.append(found[:-1])
            memories.append(HistoryDerivatives(region.memory, found[-1], [
                (more[number], less[number]) for more, less in relaxations], widths))
        return cls(equations, rates, memories, widths, experiments, geometries)

    def set_first_touch_derivatives(self, start: FirstTouchDerivatives) -> None:
        """Set the derivatives of the state of the first touch, before the first step."""
        equations, contact, first = self._equations, self._equations.contact, self._equations.first_frame
        if start.stretch.any():
            stretched = MeshDerivative.from_logarithm_of_height(equations)
            self._meshes = [stretched.scale(factor) if factor else None for factor in start.stretch]
        self._origin[2] = start.datum
        for k, mesh in enumerate(self._meshes):
            if mesh is not None:
                self._undeformed[:, :, k] = mesh.nodes
                self._origin[2, k] += mesh.datum
        self._apart[:] = self._undeformed[contact.nodes]
        if start.lift is not None:
            self._apart[contact.moves, 2] -= start.lift[contact.nodes[contact.moves]]
        # The base is under the lowest nodes.
        self._apart[contact.moves] -= self._origin
        self._apart[~contact.moves, 2] -= self._undeformed[np.argmin(equations.mesh.nodes[:, 2]), 2]
        if start.settled is not None:
            motion, anchors, *remembered = start.settled
            self._motion[:] = motion.T
            for array, left in zip([array for each in self._memories for array in each.state_arrays], remembered,
                                   strict=True):
                array[:] = left
        met, turned = self._select_contact_rows(self._motion) + self._apart, first.rotation.T
        self._anchors[:] = np.where(contact.moves[:, None, None], turned @ met, met)
        if start.settled is not None:
            _, here, there = np.intersect1d(np.where(contact.moves, -1, contact.nodes), start.resting,
                                            return_indices=True)
            self._anchors[here] = np.moveaxis(anchors, 0, -1)[there]
        held = equations.held_dofs[::3] // 3
        self._held_motion[:] = self._motion.reshape(self._undeformed.shape)[held]
        self._held[:] = turned @ (self._undeformed[held] + self._held_motion - self._origin)

    @property
    def state_derivatives(self) -> list[np.ndarray]:
        """Derivatives of displacements, anchors and history arrays at the last committed step, parameters first."""
        return [self._motion.T, np.moveaxis(self._anchors, -1, 0), *(array for each in self._memories
                                                                     for array in each.state_arrays)]

    def pop_contact_changed_flag(self) -> bool:
        """Whether the contact changed since the last call; see `tissue_sim.fem.solver.Derivatives`."""
        changed, self._changed = self._changed, False
        return changed

    def update_at_equilibrium(self, frame: ToolFrame) -> None:
        """Update the derivatives at an equilibrium, before anchors change and the step is committed.

        The contact must have been evaluated with the anchors of the step. The matrix must be that of the tissue; the
        contact stiffness is added.

        Args:
            frame: frame of the tool.
        """
        equations = self._equations
        state = equations.contact.state
        self._changed |= not np.array_equal(state.discrete_contact_flags, self._kinds)
        self._kinds = state.discrete_contact_flags
        if not self._half.size:
            return
        residual = equations.batches.residual.copy()
        with ExitStack() as shifted:
            moved = [shifted.enter_context(shift_points_from_softening_kink(each.memory)) for each in self._memories]
            if any(moved):
                equations.assemble_and_get_least_volume_ratio()
            for each in self._memories:
                each.compute_inherited_derivatives()
            self._differentiate_equations(frame)
        equations.batches.residual[:] = residual

    def _differentiate_equations(self, frame: ToolFrame) -> None:
        """Update the derivatives of force, displacements, history and anchors."""
        equations, m = self._equations, self._half.size
        state = equations.contact.state
        rates = np.stack([self._differentiate_forces_by_one_parameter(k) for k in range(m)], axis=1)
        # Without rounding errors while the tool does not turn: no force would be their reference.
        follows = self._held_motion + (frame.rotation - equations.first_frame.rotation) @ self._held
        displacement = equations.x.reshape(-1, 3)[equations.contact.nodes]
        self._laws = LawDerivativesByPositionSlipForce.make_from_differences_or_none(equations.contact, displacement,
                                                                                     frame)
        self._shape = self._shapes.differentiate(displacement, frame)
        motion, forces = self._solve_displacement_and_force_derivatives(rates, follows.reshape(-1, m))
        held = -(rates + self._multiply_by_tissue_tangent(motion))[equations.held_dofs].reshape(-1, 3, m)
        self.vector[:] = held.sum(axis=0).T + forces[equations.contact.moves].sum(axis=0).T
        self._update_history_rates(motion)
        self._anchors = state.differentiate_anchors(self._select_contact_rows(motion) + self._apart, self._anchors,
                                                    self._shape)
        self._motion = motion

    def _differentiate_forces_by_one_parameter(self, k: int) -> np.ndarray:
        """Return d forces / d parameter k at constant displacements, N per unit, shape (freedoms,)."""
        acting = {number: [(array, rate) for array,
                           rate in self._get_material_input_and_derivative_pairs(k, number) if rate.any()]
                  for number in self._regions}
        mesh, tissue = self._meshes[k], self._equations.tissue
        regions = [number for number in self._regions if acting[number] or mesh is not None]
        directions = [*self._get_mesh_input_and_derivative_pairs(k), *chain(*acting.values())]
        forces, = self._differentiate_assembly_along_direction(k, regions, directions, [tissue.batches.residual])
        if mesh is not None:
            forces[2:-1:3] += tissue.specific_weight * mesh.volumes
        return forces[:-1]

    def _update_history_rates(self, motion: np.ndarray) -> None:
        """Update the derivatives of the history for the step that will be committed."""
        for number, each in enumerate(self._memories):
            memory = each.memory
            for k in range(motion.shape[1] if memory.works else 0):
                directions = [*self._get_mesh_input_and_derivative_pairs(k),
                              *self._get_material_input_and_derivative_pairs(k, number),
                              (self._equations.x, motion[:, k])]
                each.commit_derivatives_for_parameter(k, *self._differentiate_assembly_along_direction(
                    k, [number], directions, [memory.stresses, memory.energies]))

    def _get_material_input_and_derivative_pairs(self, k: int, number: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return pairs (input array of a region's assembly, its derivative with respect to parameter k)."""
        return self._inputs[k][number] + self._memories[number].get_input_and_derivative_pairs(k)

    def _get_mesh_input_and_derivative_pairs(self, k: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return pairs (input array that depends on the undeformed mesh, its derivative by parameter k)."""
        mesh = self._meshes[k]
        return [] if mesh is None else mesh.inputs

    def _differentiate_assembly_along_direction(self, k: int, regions: Sequence[int],
                                                directions: Sequence[tuple[np.ndarray, np.ndarray]],
                                                results: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Differentiate the assembly of some regions in a direction, by central differences.

        Args:
            k: index of the parameter, which determines the step.
            regions: indices of the regions.
            directions: input arrays and their derivatives.
            results: arrays that the assembly writes and whose derivatives are returned. All arrays are restored.
        """
        arrays = [array for array, _ in directions]
        written: list[np.ndarray] = [self._equations.batches.residual]
        for number in regions:
            written += [self._memories[number].memory.stresses, self._memories[number].memory.energies]
        kept = [(array, array.copy()) for array in arrays + written]
        here, found = [value for _, value in kept], []
        try:
            for step in (self._half[k], -self._half[k]):
                for (array, rate), value in zip(directions, here, strict=False):
                    array[:] = value + step * rate
                self._equations.tissue.set_residual_to_regions_forces(regions)
                found.append([result.copy() for result in results])
        finally:
            for array, value in kept:
                array[:] = value
        return [(more - less) / (2.0 * self._half[k]) for more, less in zip(*found, strict=True)]

    def _solve_displacement_and_force_derivatives(self, rates: np.ndarray,
                                                  follows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solve for the derivatives of displacements and contact forces with respect to m parameters.

        Args:
            rates: derivatives of the forces at constant displacements, shape (freedoms, m).
            follows: derivatives of the displacements of the held nodes, shape (3 held nodes, m).

        Returns:
            Derivatives of displacements, m per unit, shape (freedoms, m), and of contact forces, N per unit, shape
            (n, 3, m); NaN if the tangent is singular or the refinement does not reach the acceptable residual.
        """
        equations, contact = self._equations, self._equations.contact
        state, m, own = contact.state, rates.shape[1], contact.rates - contact.law_rates
        motion, forces = np.zeros_like(rates), np.zeros((contact.nodes.size, 3, m))
        motion[equations.held_dofs] = follows
        self._added = own if self._laws is None else own + self._laws.differentiate_law_forces_by_displacement(own)
        equations.matrix.add_contact_stiffness(self._added)
        symmetric = not state.slides.any() and _are_symmetric(self._added)
        factor = self._sparse.factorise_or_none(equations.matrix.free, symmetric=symmetric)
        if factor is None:
            return np.full_like(motion, np.nan), np.full_like(forces, np.nan)
        # Reference: forces of tissue and contact; the penalty forces of the contact are much larger.
        size = np.linalg.norm(rates, axis=0)
        for _ in range(_SETTINGS.max_solutions):
            found, missing, acting = self._differentiate_contact_forces_and_residuals(motion, forces)
            right = rates + self._multiply_by_tissue_tangent(motion)
            np.add.at(right.reshape(-1, 3, m), contact.nodes, acting)
            left = np.linalg.norm(right[equations.free], axis=0)
            size = np.maximum(size, np.linalg.norm(found.reshape(-1, m), axis=0))
            if (left <= _SETTINGS.tolerance * size).all():
                return motion, acting - missing
            change = np.zeros_like(motion)
            change[equations.free] = -factor.solve(np.asfortranarray(right[equations.free])).reshape(-1, m)
            motion += change
            forces = found + missing + own @ self._select_contact_rows(change)
        _, missing, acting = self._differentiate_contact_forces_and_residuals(motion, forces)
        if not (left <= _SETTINGS.acceptable * size).all():
            return np.full_like(motion, np.nan), np.full_like(acting, np.nan)
        return motion, acting - missing

    def _differentiate_contact_forces_and_residuals(self, motion: np.ndarray, forces: np.ndarray
                                                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate the forces of the contact nodes with respect to m parameters.

        Returns:
            Derivatives of the contact forces, of the residuals of the constraints, and of all acting forces with those
            of the laws, N, shape (n, 3, m) each.
        """
        state, against = self._equations.contact.state, self._select_contact_rows(motion) + self._apart
        found, missing = state.differentiate_forces_and_residuals(against, self._anchors, self._shape, forces,
                                                                  self._select_friction_derivatives())
        acting = found + missing
        if self._laws is not None:
            slip = against - state.turn @ self._anchors
            acting = acting + self._laws.differentiate_law_forces_by_parameters(against, slip, acting)
        return found, missing, acting

    def _select_friction_derivatives(self) -> np.ndarray:
        """Return the derivatives of the friction of the surface that each contact node touches, shape (n, m)."""
        face, shaft, base = self._frictions
        contact = self._equations.contact
        at_tool = np.where(contact.state.on_shaft[:, None], shaft, face)
        return np.where(contact.moves[:, None], at_tool, base)

    def _multiply_by_tissue_tangent(self, motion: np.ndarray) -> np.ndarray:
        """Return the tissue's stiffness times displacements, N per unit; the contact stiffness is excluded."""
        product = self._equations.matrix.all @ motion
        np.add.at(product.reshape(-1, 3, motion.shape[1]), self._equations.contact.nodes,
                  -(self._added @ self._select_contact_rows(motion)))
        return product

    def _select_contact_rows(self, motion: np.ndarray) -> np.ndarray:
        """Return the rows of the contact nodes, shape (n, 3, m), of an array of shape (freedoms, m)."""
        return motion.reshape(-1, 3, motion.shape[1])[self._equations.contact.nodes]


def _are_symmetric(blocks: np.ndarray) -> bool:
    """Whether matrices, shape (n, 3, 3), are symmetric up to the rounding of differences."""
    return bool(np.abs(blocks - blocks.swapaxes(1, 2)).max(initial=0.0) <= 1e-7 * np.abs(blocks).max(initial=0.0))
