"""Modal forces and stiffness of a reduced solid from its sampled elements."""

from __future__ import annotations

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.reduced.kernels import SampledElementSettingColumn, make_sampled_elements_kernel
from tissue_sim.fem.reduced.model import SelfWeightEquilibriumFields
from tissue_sim.fem.solid.batches import ElementBatches
from tissue_sim.fem.solid.element import AssemblySettingColumn
from tissue_sim.fem.solid.tissue import (
    RegionElements,
    find_finite_bulk_modulus,
    get_modulus_ratios_of_layer_indices,
    group_elements_by_region,
)
from tissue_sim.fem.taichi.runtime import LANES, LOCK
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh

#: Largest relative change of the amplitudes for which a computed stiffness counts as current. Under a needle the
#: relative change of the stiffness is 0.4 times the relative change of the amplitudes.
SAME_STATE = 0.01


class SampledElements:
    """Galerkin projection of the weighted sampled elements: Phi' f and Phi' K Phi.

    The stiffness is stored by groups of elements, so that a step can recompute some groups and reuse the others from
    earlier steps (a modified Newton method).

    Args:
        mesh: mesh of the full-order solid.
        basis: displacements Phi of the modes, m per amplitude, shape (freedoms, modes).
        elements: numbers of the sampled elements, shape (n,).
        shares: weights of the sampled elements (`compute_sparse_weights`), shape (n,).
        layers: number of the material's layer of each element of the mesh, see `find_element_layer_indices`.
        groups: number of groups of elements.
        rest: equilibrium under self-weight at zero amplitudes; None: undeformed.
        contact_radius: contact radius, m, which sets the drainage time of pores, see `Material.make_prony_series`.

    Attributes:
        at: amplitudes of the last evaluation, shape (modes,).
    """

    def __init__(self, mesh: SolidMesh, basis: np.ndarray, elements: np.ndarray, shares: np.ndarray, *,
                 layers: np.ndarray, groups: int = 1, contact_radius: float = 1.0,
                 rest: SelfWeightEquilibriumFields | None = None):
        connectivity = mesh.connectivity[elements]
        used, local = np.unique(connectivity, return_inverse=True)
        self._mesh, self._layers = mesh, layers[elements]
        # The elements of each material must be contiguous in the batches.
        chosen = {name: np.flatnonzero(np.isin(elements, each)) for name,
                  each in group_elements_by_region(mesh).items()}
        chosen = {name: each for name, each in chosen.items() if each.size}
        part = SolidMesh(mesh.element, mesh.nodes[used], local.reshape(connectivity.shape))
        self._batches = batches = ElementBatches(part, tuple(chosen.values()), shares)
        points = batches.weights.shape[1]
        self._regions = tuple(RegionElements(name, each, points, SampledElementSettingColumn.COUNT)
                              for name, each in chosen.items())
        for region in self._regions[1:]:
            region.settings[AssemblySettingColumn.ADDS] = True
        self.modes = modes = basis.shape[1]
        self._forces = np.zeros(modes)
        self._contact_radius = contact_radius
        freedoms, count = 3 * connectivity.shape[1], batches.batches
        basis = basis.reshape(-1, 3, modes)
        #: Displacements of the modes at the nodes of the sampled elements, shape (freedoms, modes).
        self._rows = np.ascontiguousarray(basis[used].reshape(-1, modes))
        self._x, self._x_before, self._motion = np.zeros((3, len(self._rows)))
        self._standing = np.zeros_like(batches.pressures)
        #: Displacement of the nodes at rest, m.
        self._at_rest = np.zeros(len(self._rows))
        #: Amplitudes of the pressure modes at rest, Pa.
        self.rest_pressures = np.zeros_like(batches.pressures)
        #: Modal forces at rest, N m per m, which balance the self-weight.
        self._weight_forces = np.zeros(modes)
        self._settled: tuple[np.ndarray, ...] = ()
        if rest is not None:
            self._at_rest = rest.displacement.reshape(-1, 3)[used].ravel()
            # The batches scale the pressure modes of an element by 1 / sqrt(weight).
            self.rest_pressures = batches.arrange_in_lanes(rest.pressures[elements] * np.sqrt(shares)[:, None])
        self._x_before[:] = self._at_rest
        self.at = np.zeros(modes)
        # Single precision halves the time; the stiffness is partly that of earlier steps anyway.
        self._lanes = np.zeros((count * LANES, freedoms, modes), dtype=np.float32)
        self._lanes[batches.lane_of] = basis[connectivity].reshape(-1, freedoms, modes)
        self._blocks = np.zeros((count * LANES, freedoms, freedoms), dtype=np.float32)
        groups = min(groups, count)
        self._groups = (np.arange(count) * groups // count).astype(np.int32)
        #: First lane of each group.
        self._ends = LANES * np.searchsorted(self._groups, np.arange(groups + 1))
        self._wanted, self._tangents = np.zeros(groups), np.zeros((groups, modes, modes))
        # Group whose stiffness is computed next; -1: all groups are invalid.
        self._next = -1
        #: Amplitudes for which the stiffness of each group was computed, shape (groups, modes).
        self._computed_at = np.zeros((groups, modes))
        #: Time at which the stiffness of each group was computed, s.
        self._computed = np.zeros(groups)
        #: Time of the last committed step and of the present step, s.
        self._time = self._now = 0.0
        self._tangent: np.ndarray | None = None
        #: Shear moduli in the lanes, Pa.
        self._moduli = np.zeros((count, LANES))

    @property
    def modal_forces(self) -> np.ndarray:
        """Modal forces of the last evaluation, N m per m, shape (modes,)."""
        return self._forces

    @property
    def has_stiffness_of_all_groups(self) -> bool:
        """Whether the stiffness of all groups was computed since the material was set or the stiffness was reset."""
        return self._next >= 0

    @property
    def smallest_volume_ratio(self) -> float:
        """Smallest volume ratio J, or margin of the domain of the law, of the points in the last evaluation."""
        return min(float(region.least[0]) for region in self._regions)

    @property
    def pressures(self) -> np.ndarray:
        """Amplitudes of the pressure modes in the arrangement of `ElementBatches`, Pa; part of the solver's state."""
        return self._batches.pressures

    @property
    def has_history(self) -> bool:
        """Whether the stress of any element depends on its loading history."""
        return any(region.memory.works for region in self._regions)

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the material history of the last committed step; writing earlier values restores that step."""
        return tuple(array for region in self._regions for array in region.memory.state_arrays)

    def set_step_duration(self, dt: float) -> None:
        """Prepare the material history for a step of `dt` seconds; see `MaterialMemory.set_step_duration`."""
        self._now = self._time + dt
        for region in self._regions:
            region.memory.set_step_duration(dt)

    def commit_step(self) -> None:
        """Make time and material history of a converged step the committed ones."""
        self._time = self._now
        for region in self._regions:
            region.memory.commit_step()

    def compute_outdated_stiffness_age_or_none(self, amplitudes: np.ndarray) -> float | None:
        """Return the time since the oldest outdated stiffness group was computed, at the end of the step, s.

        Args:
            amplitudes: amplitudes at the equilibrium of the step, shape (modes,).

        Returns:
            None if all groups are current: their amplitudes differ by at most `SAME_STATE` times the norm.
        """
        changes = np.linalg.norm(self._computed_at - amplitudes, axis=1)
        is_old = changes > SAME_STATE * np.linalg.norm(amplitudes)
        return float((self._now - self._computed)[is_old].max()) if is_old.any() else None

    def set_material(self, material: Material, bulk_ratio: float) -> np.ndarray:
        """Set the material of the elements, and mark the stiffness of all groups as invalid.

        Args:
            material: material of the whole solid, with layers and regions.
            bulk_ratio: upper limit of the bulk modulus over the shear modulus, 1.

        Returns:
            Ratio of the new to the previous shear modulus for each row of `pressures`; 1 for the first material.

        Raises:
            InputError: the elements do not support the bulk ratio or the law; the previous material stays.
        """
        batches, freedoms = self._batches, 3 * self._mesh.connectivity.shape[1]
        materials = [material.regions.get(region.name, material) for region in self._regions]
        for each in materials:
            if each.bulk.kind == "of_law":
                raise InputError(f"must not be {each.law}: a reduced solid has no elements without pressure. Use the "
                                 "solver \"solid\", or a law with a bulk response", field="material.law")
        wholes = [find_finite_bulk_modulus(each, self._mesh) for each in materials]
        bulks = [min(whole, bulk_ratio * each.mu0) for whole, each in zip(wholes, materials, strict=True)]
        batches.set_modulus_ratios(get_modulus_ratios_of_layer_indices(material, self._layers))
        before = self._moduli.copy()
        for region, part, stated, whole, bulk in zip(self._regions, batches.parts, materials, wholes, bulks,
                                                     strict=True):
            blocks = self._blocks[LANES * part.start : LANES * part.stop]
            region.set_material(stated, bulk, self._contact_radius)
            standing = batches.get_rows_of_part(self._standing, part)
            # The pressures at rest belong to the bulk modulus of the full-order solid, not to the limited one.
            per_bulk = (1.0 / whole - 1.0 / bulk) / batches.moduli[part]
            pressures = batches.get_rows_of_part(self.rest_pressures, part).reshape(len(per_bulk), -1, LANES)
            standing[:] = (per_bulk[:, None] * pressures).reshape(-1, LANES)
            with LOCK:
                kernel = make_sampled_elements_kernel(self._mesh.element.name, stated.energy_law.kernel_energy)
                region.bind_kernel(kernel, batches.collect_arrays_by_name(part), {
                    "x": self._x, "motion": self._motion, "residual": batches.residual, "groups": self._groups[part],
                    "wanted": self._wanted, "blocks": blocks.reshape(len(blocks) * freedoms**2),
                    "standing": standing})
            self._moduli[part] = stated.mu0 * batches.moduli[part]
        self._next = -1
        stiffer = np.divide(self._moduli, before, out=np.ones_like(before), where=before > 0.0)
        return np.repeat(stiffer, len(self.pressures) // len(stiffer), axis=0)

    def evaluate_forces_and_stiffness(self, amplitudes: np.ndarray, updates_pressure: bool,
                                      groups_to_compute: int) -> None:
        """Compute `modal_forces`, and the stiffness of some groups of elements, at modal amplitudes.

        Args:
            amplitudes: modal amplitudes, shape (modes,).
            updates_pressure: whether the pressures are updated with the change since the last evaluation.
            groups_to_compute: number of groups whose stiffness is computed; all after a change of the material.
        """
        np.dot(self._rows, amplitudes, out=self._x)
        self._x += self._at_rest
        np.subtract(self._x, self._x_before, out=self._motion)
        self._x_before[:], self.at[:] = self._x, amplitudes
        groups = self._wanted.size
        if self._next < 0:
            groups_to_compute, self._next = groups, 0
        groups_to_compute = min(groups_to_compute, groups)
        wanted = (np.arange(self._next, self._next + groups_to_compute) % groups).tolist()
        self._wanted[:] = 0.0
        self._wanted[wanted] = 1.0
        self._next = (self._next + groups_to_compute) % groups
        with LOCK:
            for region in self._regions:
                region.settings[SampledElementSettingColumn.UPDATES_PRESSURE] = updates_pressure
                region.kernel()
        np.dot(self._batches.residual[:-1], self._rows, out=self._forces)
        self._forces -= self._weight_forces
        for group in wanted:
            self._tangent = None
            self._computed_at[group], self._computed[group] = amplitudes, self._now
            lanes = self._lanes[self._ends[group] : self._ends[group + 1]]
            pushed = np.matmul(self._blocks[self._ends[group] : self._ends[group + 1]], lanes)
            flat = lanes.reshape(-1, self.modes)
            self._tangents[group] = np.dot(flat.T, pushed.reshape(flat.shape))

    def initialise_rest_state(self) -> None:
        """Set pressures and history to rest under self-weight; `modal_forces` then excludes the forces of this state.

        Without self-weight the method does nothing.
        """
        if not self._at_rest.any():
            return
        self.pressures[:], self._weight_forces[:] = self.rest_pressures, 0.0
        self.set_step_duration(np.inf)
        self._now = self._time
        self.evaluate_forces_and_stiffness(np.zeros(self.modes), False, 0)
        self._weight_forces[:] = self._forces
        self.commit_step()
        self._settled = tuple(array.copy() for array in self.state_arrays)

    def reset_history(self) -> None:
        """Set the material history to that at rest without loading."""
        for number, array in enumerate(self.state_arrays):
            array[:] = self._settled[number] if self._settled else 0.0

    def evaluate_forces_and_invalidate_stiffness(self, amplitudes: np.ndarray) -> None:
        """Evaluate forces and volumes at restored amplitudes, and mark the stiffness of all groups as invalid."""
        self._next = -1
        self.evaluate_forces_and_stiffness(amplitudes, False, 0)
        self._next = -1

    @property
    def modal_stiffness(self) -> np.ndarray:
        """Modal stiffness, the sum over all groups of elements, N/m, shape (modes, modes)."""
        if self._tangent is None:
            self._tangent = self._tangents.sum(axis=0)
        return self._tangent
