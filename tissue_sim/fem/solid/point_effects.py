"""Effects at the points of a solid in space: their stress, its share in forces and stiffness, and what they remember.

Formulas are run on arrays of all points at once, beside the kernel of the law, so that nothing is compiled for them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tissue_sim.fem.point_effects import LONGEST, require_formula
from tissue_sim.fem.solid.batches import ElementBatches, places_of
from tissue_sim.fem.taichi.trace import Formula
from tissue_sim.material.effect import PointEffect, TissueEffect

#: Components of formulas, 11, 22, 33, 12, 13, 23, and their places in a memory, XX, XY, XZ, YY, YZ, ZZ.
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_IN_MEMORY = [0, 3, 4, 1, 5, 2]
#: Elements whose stiffness is computed at once.
_AT_ONCE = 200


class SolidEffects:
    """All such effects of a material.

    Args:
        batches: of the mesh. connectivity: shape (elements, nodes of an element).
        elements: numbers of those of the material, shape (n,).

    Attributes:
        states: of all effects at the last committed step, shape (n, q, variables); stress: of all together there, Pa,
            in the order of a memory, shape (n, q, 6).
    """

    def __init__(self, batches: ElementBatches, connectivity: np.ndarray, elements: np.ndarray):
        self._batches, self._elements = batches, elements
        dofs = (3 * connectivity[elements][:, :, None] + np.arange(3)).reshape(
            len(elements), 3 * connectivity.shape[1])
        self._dofs, self._dt = dofs, 0.0
        self._effects: tuple[PointEffect, ...] = ()
        self._makes: tuple[Formula, ...] = ()
        points = (len(elements), batches.weights.shape[1])
        self.states, self.stress = np.zeros((*points, 0)), np.zeros((*points, 6))
        self._found, self._stress = self.states.copy(), self.stress.copy()
        self._places: np.ndarray | None = None

    def __bool__(self) -> bool:
        return bool(self._effects) and len(self._elements) > 0

    def set_effects(self, effects: Iterable[TissueEffect]) -> None:
        """Take over the effects of a material; the memory is kept where they are of the same make; errors as
        `require_formula`."""
        points = tuple(effect for effect in effects if isinstance(effect, PointEffect))
        makes = tuple(Formula.of(effect) for effect in points)
        if makes != self._makes:
            for make in makes:
                require_formula(make)
            rest = [value for effect in points for value in effect.rest]
            self.states = np.broadcast_to(rest, (*self.stress.shape[:2], len(rest))).copy()
            self.stress[:] = 0.0
            self._found, self._makes = self.states.copy(), makes
        self._effects = points

    def prepare(self, dt: float) -> None:
        """Before a step of `dt`, s."""
        self._dt = min(dt, LONGEST)

    def commit(self) -> None:
        """After a step that converged."""
        self.states[:], self.stress[:] = self._found, self._stress

    def add(self, x: np.ndarray, tangent: bool) -> None:
        """Add forces and, if asked for, stiffness at displacements x, m, to those of the batches."""
        gradients = self._batches.of_points[0]
        ratios = self._batches.element_moduli
        forces, stiffness = np.zeros(self._dofs.shape), []
        for first in range(0, len(self._elements), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            mine = self._elements[part]
            G, dofs = gradients[mine], self._dofs[part]
            F = np.eye(3) + np.einsum("eai,eqaJ->eqiJ", x[dofs].reshape(*dofs.shape[:1], -1, 3), G)
            S, D = self._respond(part, F)
            weights = self._batches.weights[mine] * ratios[mine, None]
            # How the Green strains, shears doubled, change with the places of the nodes.
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
                self._places = places_of(matrix, rows, columns).ravel()
            matrix.data += np.bincount(self._places, np.concatenate(stiffness).ravel(), minlength=matrix.nnz)

    def _respond(self, part: slice, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stress, shape (e, q, 6), and tangent, (e, q, 6, 6), Pa, of some elements at deformation gradients, shape
        (e, q, 3, 3); notes what becomes of the states."""
        C = [np.einsum("eqi,eqi->eq", F[..., I], F[..., J]) for I, J in _PAIRS]
        S, D, at = np.zeros((*F.shape[:2], 6)), np.zeros((*F.shape[:2], 6, 6)), 0
        for effect in self._effects:
            # Copies: a formula may add in place, and the committed states must stay.
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
