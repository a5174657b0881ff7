"""The undeformed mesh at its quadrature points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh import Mesh


class Reference(NamedTuple):
    """What the integrals over the undeformed mesh need.

    Attributes:
        points: (r, z) of the quadrature points, m, shape (elements, q, 2); weights: their volumes, m3, (elements, q).
        node_gradients: of the shape functions along r and z, and their value over r, 1/m, shape (elements, q, nodes,
            3).
        pressure_modes: orthonormal, shape (elements, q, modes).
        volumes: that each node of an element stands for, m3, shape (elements, nodes).
        rounding: unbalanced force that rounded displacements cost, N per m of displacement and Pa of bulk modulus,
            shape (elements,).
    """

    points: np.ndarray
    weights: np.ndarray
    node_gradients: np.ndarray
    pressure_modes: np.ndarray
    volumes: np.ndarray
    rounding: np.ndarray


def integrate(mesh: Mesh) -> Reference:
    """Shape gradients, weights and orthonormal pressure modes at the quadrature points.

    Raises:
        InputError: an element of no or negative area.
    """
    element = mesh.element
    points, weights = element.quadrature
    N, dN = element.shape_functions(points)
    X = mesh.nodes[mesh.connectivity]  # (elements, nodes, 2)
    jacobian = np.einsum("eai,qaj->eqij", X, dN)
    inverse = np.linalg.inv(jacobian)
    gradient = np.einsum("qaj,eqji->eqai", dN, inverse)
    place = np.einsum("qa,eai->eqi", N, X)
    weights = 2.0 * np.pi * place[..., 0] * np.linalg.det(jacobian) * weights
    if not (weights > 0).all():
        raise InputError("the mesh has an element of no or negative area", field="mesh")
    node_gradients = np.ascontiguousarray(np.concatenate([gradient, (N / place[..., :1])[..., None]], axis=-1))
    modes = np.ones((*weights.shape, element.pressure_modes))
    if element.pressure_modes == 3:
        modes[..., 1:] = (place - place.mean(axis=1, keepdims=True)) / np.ptp(X, axis=1)[:, None]
    gram = np.einsum("eq,eqm,eqn->emn", weights, modes, modes)
    modes = np.einsum("eqm,enm->eqn", modes, np.linalg.inv(np.linalg.cholesky(gram)))
    # Displacements of size u resolve strains to eps u / h only, h the smallest spacing of an element's nodes; K turns
    # that into unbalanced force. Per m of displacement and Pa of K (the quarter is fitted: the sum overrates what is
    # seen 13-fold, evenly over gradings from 0.27 mm down to 0.15 um):
    divergence = gradient.copy()
    divergence[..., 0] += N / place[..., :1]
    constraint = np.einsum("eq,eqm,eqai->emai", weights, modes, divergence)
    spacing = np.ptp(X, axis=1).min(axis=1) / element.order
    per_element = np.einsum("emai,emai->e", constraint, constraint) * weights.sum(axis=1) / spacing**2
    return Reference(place, weights, node_gradients, modes, np.einsum("eq,qa->ea", weights, N),
                     0.25 * np.finfo(float).eps * np.sqrt(per_element))
