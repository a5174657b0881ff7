"""Free degrees of freedom, and the part of a sparse matrix that belongs to them, with contact stiffness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tissue_sim.mesh.solid import SolidMesh


def make_fixed_component_mask_by_node(mesh: SolidMesh, fixed: Mapping[str, str],
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
        self.free.data[:] = self.all.data[self._entries]
