"""Point effects of a three-dimensional solid: stress, contributions to forces and stiffness, and state variables.

The formulas are evaluated on numpy arrays of all points, outside of the kernel of the law, so that nothing is compiled.
"""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.elements.point_effects import PointEffects, sum_effect_responses
from tissue_sim.fem.solid.batches import ElementBatches, find_sparse_entry_indices

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
