"""Shape functions, weights and pressure modes at the quadrature points of the undeformed mesh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.elements.quadrature import compute_isoparametric_map, compute_orthonormal_pressure_modes
from tissue_sim.mesh import Mesh
from tissue_sim.mesh.elements import ELEMENTS


class UndeformedMeshQuadrature(NamedTuple):
    """Quadrature data of the undeformed mesh: points, volumes, shape function gradients, pressure modes.

    Attributes:
        points: (r, z) of the quadrature points, m, shape (elements, q, 2).
        weights: volumes of the quadrature points, m3, shape (elements, q).
        node_gradients: derivatives of the shape functions along r and z, and shape functions over r, 1/m, shape
            (elements, q, nodes, 3).
        pressure_modes: pressure modes, orthonormal in each element, shape (elements, q, modes).
        volumes: volume that each node represents, m3, shape (elements, nodes): the integral of its shape function; of
            elements with a negative integral, the scaled diagonal of the mass matrix.
        rounding: force residual caused by rounding errors of displacements, N per m of displacement and Pa of bulk
            modulus, shape (elements,).
    """

    points: np.ndarray
    weights: np.ndarray
    node_gradients: np.ndarray
    pressure_modes: np.ndarray
    volumes: np.ndarray
    rounding: np.ndarray


def compute_undeformed_mesh_quadrature(mesh: Mesh) -> UndeformedMeshQuadrature:
    """Compute the quadrature data of an undeformed mesh.

    Raises:
        InputError: an element has zero or negative area, or its type is not registered.
    """
    element = mesh.element
    ELEMENTS.find(element.name, "mesh")  # kernels refer to elements by name
    points, weights = element.quadrature
    N, _ = element.evaluate_shape_functions_and_gradients(points)
    place, determinants, gradient = compute_isoparametric_map(mesh)
    weights = 2.0 * np.pi * place[..., 0] * determinants * weights
    if not (weights > 0).all():
        raise InputError("must have elements of positive area; got an element of zero or negative area. "
                         "Number the nodes of each element counterclockwise.", field="mesh")
    node_gradients = np.ascontiguousarray(np.concatenate([gradient, (N / place[..., :1])[..., None]], axis=-1))
    modes = compute_orthonormal_pressure_modes(mesh, place, weights)
    # Rounding of displacements u causes strain errors eps u / h, where h is the smallest node spacing of an element;
    # the bulk modulus K turns the errors into residual forces. The sum of squares overestimates observed residuals
    # 13-fold for spacings from 0.27 mm to 0.15 um; the factor 0.25 is fitted.
    divergence = gradient.copy()
    divergence[..., 0] += N / place[..., :1]
    constraint = np.einsum("eq,eqm,eqai->emai", weights, modes, divergence)
    spacing = np.ptp(mesh.nodes[mesh.connectivity], axis=1).min(axis=1) / element.order
    per_element = np.einsum("emai,emai->e", constraint, constraint) * weights.sum(axis=1) / spacing**2
    volumes = np.einsum("eq,qa->ea", weights, N)
    if volumes.min() < -1e-9 * volumes.max():  # the integral of a node on the axis of Q9/P-1 is zero up to rounding
        # The corners of serendipity elements. The diagonal of the consistent mass matrix is positive; it is scaled to
        # the volume of the element (Hinton, Rock and Zienkiewicz, Earthquake Eng. Struct. Dyn. 4 (1976) 245).
        volumes = np.einsum("eq,qa->ea", weights, N**2)
        volumes *= (weights.sum(axis=1) / volumes.sum(axis=1))[:, None]
    return UndeformedMeshQuadrature(place, weights, node_gradients, modes, volumes,
                                    0.25 * np.finfo(float).eps * np.sqrt(per_element))
