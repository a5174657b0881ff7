"""Quadrature data of undeformed elements, and their order in batches of SIMD lanes.

The data are the map from the reference element and orthonormal pressure modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tissue_sim.fem.taichi.origins import copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LANES


class ElementLanes:
    """Elements in batches of `LANES` lanes, with the modulus of each lane; each group of elements has its own batches.

    Surplus lanes of the last batch of a group repeat the last element of the group; their results are discarded.

    An array in lanes has one row of `LANES` numbers for each batch and each entry of an element. The rows are numbered
    by batch, then by the entries of an element, the last index fastest.

    Args:
        groups: indices of the elements of each group, a partition of all elements.

    Attributes:
        count: number of elements.
        batches: number of batches.
        parts: batches of each group.
        elements: index of the element in each lane, shape (batches, LANES).
        numbers: index of this element in its group, shape (batches, LANES).
        is_real: False in surplus lanes, shape (batches, LANES).
        lane_of: index of each element among all lanes, shape (elements,).
        moduli: ratio of the moduli in each lane to those of the material, shape (batches, LANES).
    """

    def __init__(self, groups: Sequence[np.ndarray]):
        lanes = [np.arange(-(-len(group) // LANES) * LANES).reshape(-1, LANES) for group in groups]
        numbers = [np.minimum(each, len(group) - 1) for each, group in zip(lanes, groups, strict=True)]
        ends = np.cumsum([len(each) for each in lanes]).tolist()
        self.count, self.batches = sum(len(group) for group in groups), ends[-1]
        self.parts = tuple(slice(end - len(each), end) for each, end in zip(lanes, ends, strict=True))
        self.numbers = copy_to_addressable_array(np.concatenate(numbers).astype(np.int32))
        self.elements = np.concatenate([np.asarray(group)[each] for group, each in zip(groups, numbers, strict=True)])
        self.is_real = np.concatenate([each < len(group) for each, group in zip(lanes, groups, strict=True)])
        self.lane_of = np.zeros(self.count, dtype=np.intp)
        self.lane_of[self.elements[self.is_real]] = np.flatnonzero(self.is_real)
        self.moduli = copy_to_addressable_array(np.ones((self.batches, LANES)))

    def set_modulus_ratios(self, ratios: np.ndarray) -> None:
        """Set the ratio of the moduli of each element to those of the material, shape (elements,)."""
        self.moduli[:] = ratios[self.elements]

    def arrange_in_lanes(self, values: np.ndarray) -> np.ndarray:
        """Return values of the elements, shape (elements, ...), in lanes, shape (rows, LANES)."""
        return copy_to_addressable_array(np.moveaxis(values[self.elements], 1, -1).reshape(-1, LANES))

    def arrange_indices_in_lanes(self, indices: np.ndarray, unused: int) -> np.ndarray:
        """Return indices of the elements, shape (elements, ...), in lanes; surplus lanes get the index `unused`.

        Returns:
            32-bit integers, shape (rows, LANES).
        """
        lanes = self.arrange_in_lanes(indices.astype(np.int32))
        lanes.reshape(self.batches, -1, LANES).swapaxes(1, 2)[~self.is_real] = unused
        return lanes

    def arrange_by_element(self, lanes: np.ndarray, *inner: int) -> np.ndarray:
        """Return an array in lanes by element, shape (elements, *inner); the inverse of `arrange_in_lanes`."""
        return np.moveaxis(lanes.reshape(self.batches, *inner, LANES), -1, 1).reshape(-1, *inner)[self.lane_of]

    def get_rows_of_part(self, lanes: np.ndarray, part: slice) -> np.ndarray:
        """Return the rows of an array in lanes that belong to a range of batches, a view."""
        rows = len(lanes) // self.batches
        return lanes[rows * part.start : rows * part.stop]


def compute_isoparametric_map(mesh: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the isoparametric map at the quadrature points of all elements.

    Args:
        mesh: mesh with `nodes`, `connectivity` and `element`.

    Returns:
        Positions of the quadrature points, m, shape (elements, q, d); Jacobian determinants, m^d, shape (elements, q);
        gradients of the shape functions, 1/m, shape (elements, q, nodes, d), which are invalid where the determinant is
        not positive.
    """
    values, slopes = mesh.element.evaluate_shape_functions_and_gradients(mesh.element.quadrature[0])
    X = mesh.nodes[mesh.connectivity]
    jacobian = np.einsum("eai,qaj->eqij", X, slopes)
    determinants = np.linalg.det(jacobian)
    # A singular matrix has no inverse.
    inverse = np.linalg.inv(np.where((determinants > 0.0)[..., None, None], jacobian, np.eye(X.shape[-1])))
    return np.einsum("qa,eai->eqi", values, X), determinants, np.einsum("qaj,eqji->eqai", slopes, inverse)


def compute_orthonormal_pressure_modes(mesh: Any, positions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute the pressure modes of all elements, orthonormal with the weights in each element.

    Args:
        mesh: mesh with `nodes`, `connectivity` and `element`; one mode is constant, d + 1 modes are linear.
        positions: of the quadrature points, m, shape (elements, q, d).
        weights: volumes of the quadrature points, m3, shape (elements, q).

    Returns:
        Values at the quadrature points, 1/m^1.5, shape (elements, q, modes).
    """
    modes = np.ones((*weights.shape, mesh.element.pressure_modes))
    if mesh.element.pressure_modes > 1:
        size = np.ptp(mesh.nodes[mesh.connectivity], axis=1)[:, None]
        modes[..., 1:] = (positions - positions.mean(axis=1, keepdims=True)) / size
    gram = np.einsum("eq,eqm,eqn->emn", weights, modes, modes)
    return np.einsum("eqm,enm->eqn", modes, np.linalg.inv(np.linalg.cholesky(gram)))
