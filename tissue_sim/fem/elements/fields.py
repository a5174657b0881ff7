"""Names and units of field quantities, and functions of all solvers for values at quadrature points."""

from __future__ import annotations

from typing import Any

import numpy as np

#: Field -> unit. Components of the Cauchy stress refer to the axis of the scene.
FIELD_UNITS = {"displacement": "m", "von_mises": "Pa", "cauchy_rr": "Pa", "cauchy_zz": "Pa", "cauchy_rz": "Pa",
               "cauchy_hoop": "Pa", "pressure": "Pa", "energy": "J/m3", "J": "1", "stretch": "1"}
#: Fraction of the volume that a range of stretches leaves out at each end.
TAIL = 0.01


def compute_volume_weighted_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Return the value below which a given fraction of the volume lies (volume-weighted quantile).

    Args:
        values: at the quadrature points, any shape.
        weights: volumes of the points, m3, of the same shape.
        share: fraction of the volume where the values are at most the quantile, 0 to 1.
    """
    order = np.argsort(values, axis=None)
    below = np.cumsum(weights.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(below, share * below[-1]).clip(0, below.size - 1)])


def extrapolate_to_nodes_and_average(mesh: Any, values: np.ndarray) -> np.ndarray:
    """Extrapolate values from the quadrature points to the nodes and average them over the elements of a node.

    Args:
        mesh: mesh with `nodes`, `connectivity` and `element`.
        values: shape (elements, q), or (elements, 1) for one value in each element.

    Returns:
        Shape (nodes,); 0 at nodes without an element.
    """
    nodes = mesh.connectivity.ravel()
    nodal = (np.repeat(values, mesh.connectivity.shape[1]) if values.shape[1] == 1
             else values @ mesh.element.quadrature_extrapolation_matrix.T)
    times = np.bincount(nodes, minlength=len(mesh.nodes))
    return np.bincount(nodes, nodal.ravel(), len(mesh.nodes)) / np.maximum(times, 1)
