"""Elements of a solid with their materials: forces, stiffness, weight, material history and point effects.

The formulas of point effects are evaluated on numpy arrays of all points, outside of the kernel of the law, so that
nothing is compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.fem.elements.pressure import compute_element_bulk_modulus
from tissue_sim.fem.history import MATERIAL_ARRAYS, MaterialMemory, PointEffects, sum_effect_responses
from tissue_sim.fem.solid.batches import ElementBatches, find_sparse_entry_indices
from tissue_sim.fem.solid.element import ELEMENT_ARRAYS, AssemblySettingColumn, make_assembly_kernel
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LANES, LOCK
from tissue_sim.material.material import Layer, Material
from tissue_sim.material.viscoelasticity import Prony
from tissue_sim.mesh.solid import SolidMesh

#: Index pairs of the components of formulas: 11, 22, 33, 12, 13, 23.
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Indices of these components in the order of a memory: XX, XY, XZ, YY, YZ, ZZ.
_IN_MEMORY = [0, 3, 4, 1, 5, 2]
#: Number of elements whose stiffness is computed at once, to limit memory.
_AT_ONCE = 200


class SolidPointEffects(PointEffects):
    """Point effects of a material: additional stress at the quadrature points, with state variables.

    The stresses in `states` have the components XX, XY, XZ, YY, YZ and ZZ.

    Args:
        batches: batches of the mesh.
        connectivity: indices of the nodes of each element of the mesh, shape (elements, nodes of an element).
        elements: indices of the elements of the material, shape (n,).
    """

    def __init__(self, batches: ElementBatches, connectivity: np.ndarray, elements: np.ndarray):
        super().__init__((len(elements), batches.weights.shape[1]), 6)
        self._batches, self._elements = batches, elements
        self._dofs = (3 * connectivity[elements][:, :, None] + np.arange(3)).reshape(
            len(elements), 3 * connectivity.shape[1])
        self._places: np.ndarray | None = None

    def add_forces_and_stiffness(self, x: np.ndarray, tangent: bool) -> None:
        """Add forces, and if `tangent` stiffness, at displacements x, m, shape (freedoms,), to those of the batches."""
        gradients = self._batches.point_gradients_and_modes[0]
        ratios = self._batches.element_modulus_ratios
        forces, stiffness = np.zeros(self._dofs.shape), []
        for first in range(0, len(self._elements), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            mine = self._elements[part]
            G, dofs = gradients[mine], self._dofs[part]
            F = np.eye(3) + np.einsum("eai,eqaJ->eqiJ", x[dofs].reshape(*dofs.shape[:1], -1, 3), G)
            S, D = self._evaluate_effects_and_store_states(part, F)
            weights = self._batches.weights[mine] * ratios[mine, None]
            # Derivative of the Green strains, with doubled shears, with respect to the nodal positions.
            B = np.stack([np.einsum("eqi,eqa->eqai", F[..., I], G[..., J])
                          + (0.0 if I == J else np.einsum("eqi,eqa->eqai", F[..., J], G[..., I]))
                          for I, J in _PAIRS], axis=2)
            B = B.reshape(*B.shape[:3], -1)
            forces[part] = np.einsum("eqmn,eqm->en", B, weights[..., None] * S)
            if tangent:
                DB = np.matmul(weights[..., None, None] * D, B)
                flat = B.reshape(len(mine), -1, B.shape[-1])
                K = np.matmul(flat.transpose(0, 2, 1), DB.reshape(flat.shape))
                full = S[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(*S.shape[:2], 3, 3)
                pulled = np.einsum("eqaI,eqIJ,eqbJ->eab", G, weights[..., None, None] * full, G, optimize=True)
                for i in range(3):
                    K[:, i::3, i::3] += pulled
                stiffness.append(K)
        residual = self._batches.residual
        residual += np.bincount(self._dofs.ravel(), forces.ravel(), minlength=residual.size)
        if tangent:
            matrix = self._batches.matrix
            if self._places is None:
                rows, columns = np.broadcast_arrays(self._dofs[:, :, None], self._dofs[:, None])
                self._places = find_sparse_entry_indices(matrix, rows, columns).ravel()
            matrix.data += np.bincount(self._places, np.concatenate(stiffness).ravel(), minlength=matrix.nnz)

    def _evaluate_effects_and_store_states(self, part: slice, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the effects in a range of elements, and store their new state variables.

        Args:
            part: range of the elements in the constructor's `elements`.
            F: deformation gradients, shape (e, q, 3, 3).

        Returns:
            Second Piola-Kirchhoff stress, Pa, shape (e, q, 6: 11, 22, 33, 12, 13, 23), and its derivative with respect
            to the Green strains (shears doubled), Pa, shape (e, q, 6, 6).
        """
        C = [np.einsum("eqi,eqi->eq", F[..., I], F[..., J]) for I, J in _PAIRS]
        states = list(np.moveaxis(self.states[part, :, :-6], -1, 0))
        stress, tangent, found = sum_effect_responses(self.formulas, range(6), C, states, self.settings.tolist())
        S, D = np.empty((*F.shape[:2], 6)), np.empty((*F.shape[:2], 6, 6))
        for i in range(6):
            S[..., i] = stress[i]
            for k in range(6):
                D[..., i, k] = tangent[i][k]
        for i, value in enumerate(found):
            self.found[part, :, i] = value
        self.found[part, :, -6:] = S[..., _IN_MEMORY]
        return S, D


class RegionMaterialArrays(NamedTuple):
    """Arrays and history of the elements of one region that depend on its material, for `SolidSensitivity`.

    Attributes:
        inputs: arrays that the material sets in place and the assembly reads.
        memory: history of these elements.
        relaxation: returns the Prony series of these elements, or None, for a material of the whole solid.
    """

    inputs: tuple[np.ndarray, ...]
    memory: MaterialMemory
    relaxation: Callable[[Material], Prony | None]


class RegionElements:
    """Elements of one region: their material, its history, and the assembly kernel.

    Args:
        name: name of the region of the mesh; "" for elements without a region.
        elements: indices of the elements, shape (n,).
        points: number of quadrature points of an element.
        settings: number of settings of the kernel, see `AssemblySettingColumn`.

    Attributes:
        bulk: bulk modulus of the material, Pa.
        mu0: shear modulus of the material, Pa.
    """

    def __init__(self, name: str, elements: np.ndarray, points: int, settings: int = 4):
        self.name, self.elements = name, elements
        self.memory = MaterialMemory((elements.size, points), 6)
        self.settings, self.least = np.zeros(settings), np.zeros(1)
        self.coefficients = allocate_array((0,))
        self.bulk = self.mu0 = 0.0
        self.kernel: BoundKernel

    def set_material(self, own: Material, bulk: float, contact_radius: float) -> None:
        """Set material and bulk modulus, Pa, which is stated separately, because a kernel needs a finite one."""
        coefficients = own.energy_law.kernel_coefficients(own.parameters)
        if coefficients.size == self.coefficients.size:
            self.coefficients[:] = coefficients
        else:
            self.coefficients = copy_to_addressable_array(np.array(coefficients))
        self.memory.set_relaxation_and_softening(own.make_prony_series(contact_radius), own.softening,
                                                 own.instantaneous_over_law_modulus_ratio)
        self.bulk, self.mu0 = bulk, own.mu0
        self.settings[AssemblySettingColumn.KAPPA] = bulk
        self.settings[AssemblySettingColumn.REMEMBERS] = self.memory.works

    def bind_kernel(self, kernel, elements: Mapping[str, np.ndarray], arguments: Mapping[str, np.ndarray]) -> None:
        """Bind a kernel to the arrays of this region.

        Args:
            kernel: kernel with the arguments ``settings``, ``least``, ``batches`` and the tables of elements and
                material.
            elements: arrays of the elements, see `ElementBatches.collect_arrays_by_name`.
            arguments: other arguments by name.
        """
        material = {"coefficients": self.coefficients, **self.memory.collect_arrays_by_name()}
        self.kernel = BoundKernel(kernel, {
            "settings": self.settings, "least": self.least,
            "batches": np.array([len(elements["moduli"])], dtype=np.int32), **arguments,
            "element_table": ELEMENT_ARRAYS.make_offset_table(elements),
            "material_table": MATERIAL_ARRAYS.make_offset_table(material)})


class Tissue:
    """All elements of a solid; each region of the mesh may have its own material.

    Args:
        mesh: undeformed mesh.
        x: array of the displacements, m, shape (freedoms,).
        contact_radius: m, for the time of drainage, see `Material.make_prony_series`.
        element_layers: index of the material's layer of each element, shape (elements,); the index after the last layer
            means no layer. None: no layers.

    Attributes:
        batches: forces, pressures and matrix of the elements.
        bulk_moduli: bulk moduli of the batches, Pa, shape (batches,).
        specific_weight: density times gravity, N/m3, towards -z.
        effects: point effects of the elements without a region.
        material: material of the elements without a region.
    """

    def __init__(self, mesh: SolidMesh, x: np.ndarray, contact_radius: float,
                 element_layers: np.ndarray | None = None):
        count, named = len(mesh.connectivity), group_elements_by_region(mesh)
        self.batches = ElementBatches(mesh, tuple(named.values()))
        points = self.batches.weights.shape[1]
        self._regions = tuple(RegionElements(name, elements, points) for name, elements in named.items())
        self._mesh, self._x, self.contact_radius = mesh, x, contact_radius
        self._layers = np.zeros(count, dtype=np.intp) if element_layers is None else element_layers
        self.bulk_moduli = np.zeros(self.batches.batches)
        self.specific_weight = 0.0
        # Named regions have no point effects.
        self.effects = SolidPointEffects(self.batches, mesh.connectivity, named.get("", np.zeros(0, dtype=np.intp)))

    @property
    def element_bulk_moduli(self) -> np.ndarray:
        """Bulk modulus of each element's material, Pa, shape (elements,)."""
        return np.repeat(self.bulk_moduli, LANES)[self.batches.lane_of]

    @property
    def region_material_arrays(self) -> tuple[RegionMaterialArrays, ...]:
        """For each region, in the order of the regions: arrays and history that depend on its material."""
        def make_region_prony_getter(name: str) -> Callable[[Material], Prony | None]:
            """Return the function that returns the Prony series of a region, or None, for a solid's material."""
            return lambda material: material.regions.get(name, material).make_prony_series(self.contact_radius)

        kappa = slice(AssemblySettingColumn.KAPPA, AssemblySettingColumn.KAPPA + 1)
        return tuple(RegionMaterialArrays((region.settings[kappa], region.coefficients, self.batches.moduli[part]),
                                          region.memory, make_region_prony_getter(region.name))
                     for region, part in zip(self._regions, self.batches.parts, strict=True))

    def set_material(self, material: Material) -> None:
        """Set the materials of all regions; the history is kept.

        Raises:
            InputError: an effect that kernels do not support, a region that the mesh does not have, or a bulk ratio
                outside of `BULK_RATIOS`; nothing is changed.
        """
        require_mesh_regions(material, self._mesh)
        materials = [material.regions.get(region.name, material) for region in self._regions]
        bulks = [find_finite_bulk_modulus(each, self._mesh) for each in materials]
        self.effects.set_effects(material.effects.values())
        self.material = material
        self.batches.set_modulus_ratios(get_modulus_ratios_of_layer_indices(material, self._layers))
        for region, own, bulk, part in zip(self._regions, materials, bulks, self.batches.parts, strict=True):
            region.set_material(own, bulk, self.contact_radius)
            region.settings[AssemblySettingColumn.REMEMBERS] = region.memory.works or bool(self.effects)
            self.bulk_moduli[part] = bulk
            with LOCK:
                kernel = make_assembly_kernel(self._mesh.element.name, own.energy_law.kernel_energy)
                region.bind_kernel(kernel, self.batches.collect_arrays_by_name(part), {
                    "x": self._x, "residual": self.batches.residual, "data": self.batches.matrix_data})

    def assemble_and_get_least_volume_ratio(self, tangent: bool = True) -> float:
        """Assemble residual and, if `tangent`, matrix in `batches` at the present displacements.

        Returns:
            Smallest volume ratio J of all elements, 1.
        """
        self._run_region_kernels(self._regions, tangent)
        if self.effects:
            self.effects.add_forces_and_stiffness(self._x, tangent)
        if self.specific_weight:
            self.batches.residual[2:-1:3] += self.specific_weight * self.batches.volumes
        return min(float(region.least[0]) for region in self._regions)

    def set_residual_to_regions_forces(self, numbers: Sequence[int]) -> None:
        """Overwrite the residual with the forces of the regions with these indices, without weight and effects."""
        self.batches.residual[:] = 0.0
        self._run_region_kernels([self._regions[number] for number in numbers], False)

    def _run_region_kernels(self, regions: Sequence[RegionElements], tangent: bool) -> None:
        """Run the assembly kernels; the first region overwrites residual and matrix, the others add to them."""
        with LOCK:
            for region in regions:
                region.settings[AssemblySettingColumn.TANGENT] = tangent
                region.settings[AssemblySettingColumn.ADDS] = region is not regions[0]
                region.kernel()

    def compute_element_forces_limiting_bulk(self, bulk_ratio: float, standing: np.ndarray) -> np.ndarray:
        """Compute the forces of each element on its nodes, without weight, N, shape (elements, freedoms of an element).

        The bulk modulus is the element's, or `bulk_ratio` times its shear modulus if that is less. Residual, matrix and
        pressures in `batches` are overwritten.

        Args:
            bulk_ratio: largest K / mu0, 1.
            standing: pressures at an equilibrium, see `ElementBatches.pressures`; there both moduli give the same.
        """
        self.batches.pressures[:], left = 0.0, np.zeros(self.batches.batches)
        for region, part in zip(self._regions, self.batches.parts, strict=True):
            region.settings[AssemblySettingColumn.KAPPA] = min(region.bulk, bulk_ratio * region.mu0)
            left[part] = 1.0 - region.settings[AssemblySettingColumn.KAPPA] / region.bulk
        self.assemble_and_get_least_volume_ratio()
        for region in self._regions:
            region.settings[AssemblySettingColumn.KAPPA] = region.bulk
        lost = left[:, None, None] * standing.reshape(self.batches.batches, -1, LANES)
        return self.batches.last_assembled_element_forces + self.batches.compute_pressure_forces_by_element(
            lost.reshape(standing.shape))

    def update_pressures(self, motion: np.ndarray) -> None:
        """Update the pressures after a linear solution with displacement increments, m, shape (freedoms,)."""
        self.batches.update_pressures_linearly(motion, self.bulk_moduli)

    def correct_forces_for_reused_matrix(self, forces: np.ndarray) -> None:
        """Correct forces, N, shape (freedoms,), in place for a matrix that was assembled at an earlier state.

        The pressures were eliminated from the matrix with the volume derivatives of that state.
        """
        self.batches.correct_forces_for_old_volume_rates(forces, self.bulk_moduli)

    def set_step_duration(self, dt: float) -> None:
        """Set the duration dt (s) of the next step in the material history and the point effects."""
        for region in self._regions:
            region.memory.set_step_duration(dt)
        self.effects.set_step_duration(dt)

    def commit_step(self) -> None:
        """Make the history of the converged step the committed one."""
        for region in self._regions:
            region.memory.commit_step()
        if self.effects:
            self.effects.commit_step()

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the committed material history; writing saved copies into them restores an earlier state."""
        added = (self.effects.states,) if self.effects else ()
        return (*(array for region in self._regions for array in region.memory.state_arrays), *added)

    @property
    def has_history(self) -> bool:
        """Whether the stress depends on the history, so that the force may change while the tool is at rest."""
        return bool(self.effects) or any(region.memory.works for region in self._regions)

    def get_committed_isochoric_pk2_or_none(self) -> np.ndarray | None:
        """Return isochoric second Piola-Kirchhoff stresses of the committed step, Pa, shape (elements, q, 6).

        None if no material has a history.
        """
        if not self.has_history:
            return None
        found = np.zeros((*self.batches.weights.shape, 6))
        for region in self._regions:
            found[region.elements] = region.memory.compute_committed_stress_with_relaxation()
            if self.effects and region.name == "":
                found[region.elements] += self.effects.committed_effect_stress
        return found


def group_elements_by_region(mesh: SolidMesh) -> dict[str, np.ndarray]:
    """Return region name -> indices of its elements; "" for elements without a region. Empty groups are omitted.

    Raises:
        InputError: an element in two regions.
    """
    taken = np.concatenate([np.zeros(0, dtype=np.intp), *mesh.regions.values()])
    if np.unique(taken).size != taken.size:
        raise InputError("must contain each element in at most one region; got an element in two.",
                         field="mesh.regions")
    groups = {"": np.setdiff1d(np.arange(len(mesh.connectivity)), taken), **mesh.regions}
    return {name: np.asarray(elements, dtype=np.intp) for name, elements in groups.items() if len(elements)}


def require_mesh_regions(material: Material, mesh: SolidMesh) -> None:
    """Require that a mesh has all regions that a material names; further regions of the mesh are allowed.

    Raises:
        InputError: the mesh lacks a region.
    """
    for name in material.regions:
        if name not in mesh.regions:
            known = make_hint_with_similar_or_known_words(name, mesh.regions) if mesh.regions \
                else "; it has no named regions"
            raise InputError(f"the mesh has no region {name!r}{known}", field="material.regions")


def find_element_layer_indices(mesh: SolidMesh, layers: tuple[Layer, ...]) -> np.ndarray:
    """Return for each element the index of the layer that contains its centre, shape (elements,).

    The index of an element below all layers is the number of layers.
    """
    return np.searchsorted(np.cumsum([layer.thickness for layer in layers]), mesh.element_depths)


def get_modulus_ratios_of_layer_indices(material: Material, layers: np.ndarray) -> np.ndarray:
    """Return for each layer index the factor on the moduli of the material, 1, shape of `layers`.

    The factor is 1 for the index after the last layer, which means no layer.
    """
    ratios = np.array([*(layer.ratio for layer in material.layers), 1.0])
    return ratios[np.minimum(layers, ratios.size - 1)]


def compute_node_shear_moduli(material: Material, mesh: SolidMesh, layers: np.ndarray) -> np.ndarray:
    """Return the shear modulus mu0 at each node, the mean over the elements of the node, Pa, shape (nodes,).

    The argument `layers` is the result of `find_element_layer_indices`.
    """
    moduli = get_modulus_ratios_of_layer_indices(material, layers)
    for name, elements in group_elements_by_region(mesh).items():
        moduli[elements] *= material.regions.get(name, material).mu0
    nodes = mesh.connectivity.ravel()
    total = np.bincount(nodes, np.repeat(moduli, mesh.connectivity.shape[1]), minlength=len(mesh.nodes))
    return total / np.maximum(1, np.bincount(nodes, minlength=len(mesh.nodes)))


def find_finite_bulk_modulus(material: Material, mesh: SolidMesh) -> float:
    """Return the bulk modulus of the pressure in the elements of a mesh, Pa; see `compute_element_bulk_modulus`."""
    wide, _, high = np.ptp(mesh.nodes, axis=0).tolist()
    return compute_element_bulk_modulus(material, 0.5 * wide, high)
