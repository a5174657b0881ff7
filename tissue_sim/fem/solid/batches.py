"""Batches of elements as the arrays on which the kernels work."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.elements.quadrature import (
    ElementLanes,
    compute_isoparametric_map,
    compute_orthonormal_pressure_modes,
)
from tissue_sim.fem.taichi.origins import allocate_array
from tissue_sim.fem.taichi.runtime import LANES
from tissue_sim.mesh.solid import SOLID_ELEMENTS, SolidMesh


def compute_quadrature_volumes_gradients_modes(mesh: SolidMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute quadrature data of all undeformed elements.

    Returns:
        Volumes of the quadrature points, m3, shape (elements, q); gradients of the shape functions there, 1/m, shape
        (elements, q, nodes, 3); orthonormal pressure modes, 1/m^1.5, shape (elements, q, modes).

    Raises:
        InputError: an element type that is not registered, or an element of zero or negative volume.
    """
    SOLID_ELEMENTS.find(mesh.element.name, "mesh")  # kernels refer to elements by name
    positions, determinants, gradients = compute_isoparametric_map(mesh)
    weights = determinants * mesh.element.quadrature[1]
    if not (weights > 0.0).all():
        worst = int(np.argmin(weights.min(axis=1)))
        raise InputError(f"must have elements of positive volume; element {worst} is inside out or has no volume. "
                         "Correct the order of its nodes, or remove it", field="mesh")
    return weights, gradients, compute_orthonormal_pressure_modes(mesh, positions, weights)


class ElementBatches(ElementLanes):
    """Elements in batches of SIMD lanes as the arrays on which the kernels work.

    Args:
        mesh: undeformed mesh.
        groups: indices of the elements of each group, a partition of all elements; None: one group.
        shares: weight of each element in units of its volume, shape (elements,); None: 1.

    Attributes:
        weights: volumes of the quadrature points, m3, shape (elements, q).
        volumes: volume that each node represents, m3, shape (nodes,).
        pressures: amplitudes of the elements' pressure modes, Pa.
        matrix: stiffness of all degrees of freedom, a `scipy.sparse.csc_array` whose data the kernel writes.
        residual: forces of all degrees of freedom and one unused entry, N, shape (freedoms + 1,).

    Raises:
        InputError: an element of zero or negative volume.
    """

    def __init__(self, mesh: SolidMesh, groups: Sequence[np.ndarray] | None = None,
                 shares: np.ndarray | None = None):
        count, nodes = mesh.connectivity.shape
        super().__init__([np.arange(count)] if groups is None else groups)
        self._modes = mesh.element.pressure_modes
        self.weights, gradients, modes = compute_quadrature_volumes_gradients_modes(mesh)
        if shares is not None:
            self.weights *= shares[:, None]
            modes = modes / np.sqrt(shares)[:, None, None]
        values, _ = mesh.element.evaluate_shape_functions_and_gradients(mesh.element.quadrature[0])
        self.volumes = np.bincount(mesh.connectivity.ravel(), np.einsum("eq,qa->ea", self.weights, values).ravel(),
                                   minlength=len(mesh.nodes))
        self.pressures, self.gaps = (allocate_array((self.batches * self._modes, LANES)) for _ in range(2))
        self.volume_rates, self.known_rates = (
            allocate_array((3 * self.batches * self._modes * nodes, LANES)) for _ in range(2))
        self.residual = np.zeros(3 * len(mesh.nodes) + 1)
        self._forces = allocate_array((3 * self.batches * nodes, LANES))
        self._dofs = 3 * mesh.connectivity.astype(np.int32)
        self._all_dofs = (self._dofs[:, :, None] + np.arange(3, dtype=np.int32)).reshape(count, -1)
        self._equations = self.arrange_indices_in_lanes(self._all_dofs, self.residual.size - 1)
        self._gradients = [self.arrange_in_lanes(gradients[..., i]) for i in range(3)]
        self._weights, self._mode_values = self.arrange_in_lanes(self.weights), self.arrange_in_lanes(modes)
        self._set_matrix_and_entry_indices(mesh.connectivity, len(mesh.nodes))

    @cached_property
    def point_gradients_and_modes(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute the gradients of the shape functions and the pressure modes at the quadrature points.

        Returns:
            Gradients, 1/m, shape (elements, q, nodes, 3); orthonormal pressure modes, shape (elements, q, modes).
        """
        points, nodes = self.weights.shape[1], self._dofs.shape[1]
        gradients = np.stack([self.arrange_by_element(each, points, nodes) for each in self._gradients], axis=-1)
        return gradients, self.arrange_by_element(self._mode_values, points, self._modes)

    @property
    def element_modulus_ratios(self) -> np.ndarray:
        """Ratio of the moduli of each element to those of the material, shape (elements,)."""
        return self.arrange_by_element(self.moduli)

    def _set_matrix_and_entry_indices(self, connectivity: np.ndarray, nodes: int) -> None:
        """Set `matrix`, and the indices in its data of the stiffness entries of each pair of nodes of an element."""
        from scipy import sparse

        of_element = connectivity.shape[1]
        c, a = np.array([(c, a) for c in range(of_element) for a in range(c + 1)]).T
        ones = np.ones(connectivity.size, dtype=np.int8)
        holds = sparse.csr_array((ones, (np.repeat(np.arange(len(connectivity)), of_element), connectivity.ravel())),
                                 shape=(len(connectivity), nodes))
        pattern = (holds.T @ holds).tocsc()
        pattern.sort_indices()
        # Index of the block of each pair of nodes of an element, in the column of the second node.
        places = find_sparse_entry_indices(pattern, connectivity[:, a], connectivity[:, c])
        mirrored = find_sparse_entry_indices(pattern, connectivity[:, c], connectivity[:, a])
        starts, rows = pattern.indptr.astype(np.int64), pattern.indices
        blocks = np.diff(starts)
        i, k = np.tile(np.arange(3), 3), np.repeat(np.arange(3), 3)

        def compute_block_entry_indices(place: np.ndarray, column: np.ndarray, row: np.ndarray,
                                        along: np.ndarray) -> np.ndarray:
            """Return the indices in the matrix data of the 3 x 3 entries of node blocks, shape (..., 9)."""
            first = 9 * starts[column] + 3 * (place - starts[column])
            return first[..., None] + 3 * blocks[column][..., None] * along + row

        unused = 9 * rows.size
        direct = compute_block_entry_indices(places, connectivity[:, c], i, k)
        # A diagonal block has no mirror image.
        across = np.where((c == a)[:, None], unused, compute_block_entry_indices(mirrored, connectivity[:, a], k, i))
        self._places, self._mirrored = (self.arrange_indices_in_lanes(each, unused) for each in (direct, across))
        self._stiffness = allocate_array((9 * c.size, LANES))
        self._data = np.zeros(unused + 1)
        lengths = np.repeat(3 * blocks, 3)
        indices = np.concatenate([(3 * rows[starts[n] : starts[n + 1], None] + np.arange(3)).ravel()
                                  for n in range(nodes) for _ in range(3)])
        self.matrix = sparse.csc_array((self._data[:-1], indices.astype(np.int32), np.concatenate(
            [[0], np.cumsum(lengths)])), shape=(3 * nodes, 3 * nodes))

    def collect_arrays_by_name(self, part: slice) -> dict[str, np.ndarray]:
        """Return the arrays of `tissue_sim.fem.solid.element.ELEMENT_ARRAYS` for the batches of one group of elements.

        Args:
            part: range of the batches of the group, an entry of `parts`. The array ``numbers`` contains indices within
                the group. Other groups have the same array ``stiffness``, that of one batch.
        """
        named = dict(zip(("gradient_x", "gradient_y", "gradient_z"), self._gradients, strict=True))
        named |= {"numbers": self.numbers, "pressures": self.pressures, "dofs": self._first_dofs_in_lanes,
                  "equations": self._equations, "weights": self._weights, "mode_values": self._mode_values,
                  "moduli": self.moduli, "volume_rates": self.volume_rates, "gaps": self.gaps,
                  "forces": self._forces, "places": self._places, "mirrored": self._mirrored}
        return {name: self.get_rows_of_part(array, part) for name, array in named.items()} | {
            "stiffness": self._stiffness}

    @cached_property
    def _first_dofs_in_lanes(self) -> np.ndarray:
        """First degree of freedom of each node of each element, shape (batches * nodes, LANES)."""
        return self.arrange_in_lanes(self._dofs)

    @property
    def matrix_data(self) -> np.ndarray:
        """Data of `matrix`, followed by one unused entry, shape (entries + 1,)."""
        return self._data

    @property
    def last_assembled_element_forces(self) -> np.ndarray:
        """Forces of each element on its degrees of freedom after the last assembly, N, shape (elements, freedoms)."""
        return self.arrange_by_element(self._forces, 3 * self._dofs.shape[1])

    def compute_pressure_forces_by_element(self, pressures: np.ndarray) -> np.ndarray:
        """Compute the nodal forces of pressures on each element, at the last assembled displacements.

        Args:
            pressures: amplitudes of the pressure modes, Pa, arranged like `pressures` of this class.

        Returns:
            Forces, N, shape (elements, freedoms of an element).
        """
        rates = self.arrange_by_element(self.volume_rates, self._modes, 3 * self._dofs.shape[1])
        return np.einsum("em,emi->ei", self.convert_pressures_to_element_order(pressures), rates)

    @property
    def geometry_arrays(self) -> tuple[np.ndarray, ...]:
        """Kernel arrays that depend on the undeformed mesh: gradients along x, y and z, weights, pressure modes."""
        return (*self._gradients, self._weights, self._mode_values)

    def convert_pressures_to_element_order(self, amplitudes: np.ndarray) -> np.ndarray:
        """Convert amplitudes of the pressure modes from the arrangement in lanes to shape (elements, modes)."""
        return self.arrange_by_element(amplitudes, self._modes)

    def update_pressures_linearly(self, motion: np.ndarray, kappa: np.ndarray | float) -> None:
        """Update `pressures` by the linearised pressure equation after the displacements of a linear solution.

        Args:
            motion: increments of the degrees of freedom, m, shape (freedoms,).
            kappa: bulk modulus of all batches, or of each batch, Pa.
        """
        nodes = self._dofs.shape[1]
        moved = motion[self._dof_numbers_in_lanes].reshape(self.batches, 1, 3 * nodes, LANES)
        rates = self.known_rates.reshape(self.batches, self._modes, 3 * nodes, LANES)
        change = self.gaps.reshape(self.batches, self._modes, LANES) + (rates * moved).sum(axis=2)
        self.pressures += ((np.reshape(kappa, (-1, 1)) * self.moduli)[:, None] * change).reshape(-1, LANES)

    def store_assembled_volume_rates(self) -> None:
        """Copy the present volume derivatives to `known_rates`, because the assembled matrix contains them."""
        self.known_rates[:] = self.volume_rates

    def correct_forces_for_old_volume_rates(self, forces: np.ndarray, kappa: np.ndarray) -> None:
        """Correct forces for a matrix of an earlier state, whose pressures were eliminated with `known_rates`.

        Args:
            forces: N, shape (freedoms,); changed in place.
            kappa: bulk moduli of the batches, Pa.
        """
        shape = self.batches, self._modes, -1, LANES
        missed = (kappa[:, None] * self.moduli)[:, None] * self.gaps.reshape(self.batches, self._modes, LANES)
        more = (missed[:, :, None] * (self.known_rates - self.volume_rates).reshape(shape)).sum(axis=1)
        # The additional equation is that of the unused lanes.
        forces += np.bincount(self._equations.ravel(), more.ravel(), minlength=forces.size + 1)[:-1]

    @cached_property
    def _dof_numbers_in_lanes(self) -> np.ndarray:
        """Indices of the degrees of freedom of each element, fixed ones included, shape (batches, freedoms, LANES)."""
        # Unused lanes have the equations of the last element, so that they remain copies of it.
        return self.arrange_in_lanes(self._all_dofs).reshape(self.batches, -1, LANES)


def find_sparse_entry_indices(pattern, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the indices in ``data`` of entries (row, column) of a sparse matrix in compressed columns.

    Args:
        pattern: a `scipy.sparse.csc_array` with sorted row indices.
        rows: row numbers of entries that exist in the matrix, shape (...).
        columns: their column numbers, shape (...).
    """
    count = pattern.shape[0]
    keys = np.repeat(np.arange(count, dtype=np.int64), np.diff(pattern.indptr)) * count + pattern.indices
    return np.searchsorted(keys, columns.astype(np.int64) * count + rows)
