"""Point effects of a three-dimensional solid: stress, contributions to forces and stiffness, and state variables.

The formulas are evaluated on numpy arrays of all points, outside of the kernel of the law, so that nothing is compiled.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tissue_sim.fem.elements.point_effects import LONGEST, require_valid_formula
from tissue_sim.fem.solid.batches import ElementBatches, find_sparse_entry_indices
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants
from tissue_sim.material.effect import PointEffect, TissueEffect

#: Index pairs of the components of formulas: 11, 22, 33, 12, 13, 23.
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Indices of these components in the order of a memory: XX, XY, XZ, YY, YZ, ZZ.
_IN_MEMORY = [0, 3, 4, 1, 5, 2]
#: Number of elements whose stiffness is computed at once, to limit memory.
_AT_ONCE = 200


class SolidPointEffects:
    """Point effects of a material: additional stress at the quadrature points, with state variables.

    Args:
        batches: batches of the mesh.
        connectivity: indices of the nodes of each element of the mesh, shape (elements, nodes of an element).
        elements: indices of the elements of the material, shape (n,).

    Attributes:
        states: state variables of all effects at the last committed step, shape (n, q, variables).
        stress: sum of their second Piola-Kirchhoff stresses there, Pa, shape (n, q, 6: XX, XY, XZ, YY, YZ, ZZ).
    """

    def __init__(self, batches: ElementBatches, connectivity: np.ndarray, elements: np.ndarray):
        self._batches, self._elements = batches, elements
        dofs = (3 * connectivity[elements][:, :, None] + np.arange(3)).reshape(
            len(elements), 3 * connectivity.shape[1])
        self._dofs, self._dt = dofs, 0.0
        self._effects: tuple[PointEffect, ...] = ()
        self._makes: tuple[FormulaClassAndConstants, ...] = ()
        points = (len(elements), batches.weights.shape[1])
        self.states, self.stress = np.zeros((*points, 0)), np.zeros((*points, 6))
        self._found, self._stress = self.states.copy(), self.stress.copy()
        self._places: np.ndarray | None = None

    def __bool__(self) -> bool:
        return bool(self._effects) and len(self._elements) > 0

    def set_effects(self, effects: Iterable[TissueEffect]) -> None:
        """Set the effects of a material; state variables are kept if the formulas are the same.

        Raises:
            InputError: see `require_valid_formula`.
        """
        points = tuple(effect for effect in effects if isinstance(effect, PointEffect))
        makes = tuple(FormulaClassAndConstants.from_law_or_effect(effect) for effect in points)
        if makes != self._makes:
            for make in makes:
                require_valid_formula(make)
            rest = [value for effect in points for value in effect.rest]
            self.states = np.broadcast_to(rest, (*self.stress.shape[:2], len(rest))).copy()
            self.stress[:] = 0.0
            self._found, self._makes = self.states.copy(), makes
        self._effects = points

    def set_step_duration(self, dt: float) -> None:
        """Set the duration dt of the next step, s."""
        self._dt = min(dt, LONGEST)

    def commit_step(self) -> None:
        """Make state variables and stresses of the converged step the committed ones."""
        self.states[:], self.stress[:] = self._found, self._stress

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
        S, D, at = np.zeros((*F.shape[:2], 6)), np.zeros((*F.shape[:2], 6, 6)), 0
        for effect in self._effects:
            # Copies, because a formula may change its arguments, and the committed states must not change.
            state = [self.states[part, :, at + i].copy() for i in range(len(effect.rest))]
            stress, tangent, found = effect.response([each.copy() for each in C], state, self._dt)
            for i in range(6):
                S[..., i] += stress[i]
                for j in range(6):
                    D[..., i, j] += tangent[i][j]
            for i, value in enumerate(found):
                self._found[part, :, at + i] = value
            at += len(state)
        self._stress[part] = S[..., _IN_MEMORY]
        return S, D
