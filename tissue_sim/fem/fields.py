"""What the fields of all solvers share: names, units, and how values at the points are carried on."""

from __future__ import annotations

from typing import Any

import numpy as np

#: Field -> unit. Components of Cauchy stress are those along and around the axis of the scene.
FIELD_UNITS = {"displacement": "m", "von_mises": "Pa", "cauchy_rr": "Pa", "cauchy_zz": "Pa", "cauchy_rz": "Pa",
               "cauchy_hoop": "Pa", "pressure": "Pa", "energy": "J/m3", "J": "1", "stretch": "1"}
#: Share of the volume that a range of stretches leaves out at either end: an edge alone is no range.
TAIL = 0.01


def volume_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Value that this share of the volume does not exceed.

    Args:
        values: at the quadrature points, any shape.
        weights: volumes of the points, m3, of the same shape.
        share: of the volume.
    """
    order = np.argsort(values, axis=None)
    below = np.cumsum(weights.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(below, share * below[-1]).clip(0, below.size - 1)])


def extrapolate(mesh: Any, values: np.ndarray) -> np.ndarray:
    """Values at the quadrature points, shape (elements, q), or one of each element, shape (elements, 1), as nodal
    averages, shape (nodes,); 0 at nodes of no element."""
    nodes = mesh.connectivity.ravel()
    nodal = (np.repeat(values, mesh.connectivity.shape[1]) if values.shape[1] == 1
             else values @ mesh.element.from_quadrature.T)
    times = np.bincount(nodes, minlength=len(mesh.nodes))
    return np.bincount(nodes, nodal.ravel(), len(mesh.nodes)) / np.maximum(times, 1)
