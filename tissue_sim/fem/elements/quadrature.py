"""Quadrature data of undeformed elements: map from the reference element, and orthonormal pressure modes."""

from __future__ import annotations

from typing import Any

import numpy as np


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
