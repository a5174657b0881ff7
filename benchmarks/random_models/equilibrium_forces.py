"""Nodal forces of the axisymmetric body from displacements and pressures, in numpy: nine-node quadrilaterals with three
pressures each, and derivatives of the law by complex steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tissue_sim.laws import InvariantLaw, Law

#: Of the complex differences, relative to nothing: there is no cancellation.
_STEP = 1e-40


class Section:
    """Quadrature of the axisymmetric integrals over the undeformed half plane.

    Attributes:
        gradients: of the shape functions along r and z, and their value over r, 1/m, (elements, 9, 9 nodes, 3).
        weights: volumes of the Gauss points, m3, (elements, 9); modes: of the pressure, orthonormal, (elements, 9, 3).
        volumes: of the nodes, m3.
    """

    def __init__(self, nodes: np.ndarray, connectivity: np.ndarray):
        self.nodes, self.connectivity = nodes, connectivity
        places = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0), (0, 0)])
        g = np.sqrt(0.6)
        a, b = (line.ravel() for line in np.meshgrid([-g, 0.0, g], [-g, 0.0, g]))
        share = np.array([5.0, 8.0, 5.0]) / 9.0

        def line(x: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return the quadratic shape functions with nodes -1, 0 and 1, and their derivatives."""
            x = x[:, None]
            return (np.where(at == 0, 1 - x**2, x * (x + at) / 2), np.where(at == 0, -2 * x, x + at / 2))

        (va, sa), (vb, sb) = line(a, places[:, 0]), line(b, places[:, 1])
        shape = va * vb
        corners = nodes[connectivity]
        jacobian = np.einsum("eai,qaj->eqij", corners, np.stack([sa * vb, va * sb], axis=-1))
        slopes = np.einsum("qaj,eqji->eqai", np.stack([sa * vb, va * sb], axis=-1), np.linalg.inv(jacobian))
        points = np.einsum("qa,eai->eqi", shape, corners)
        self.weights = 2 * np.pi * points[..., 0] * np.linalg.det(jacobian) * np.outer(share, share).ravel()
        over_r = np.broadcast_to(shape, slopes.shape[:-1]) / points[..., :1]
        self.gradients = np.concatenate([slopes, over_r[..., None]], axis=-1)
        # 1, r and z made orthonormal one after the other, as the solver counts its pressures.
        raw = np.ones((*self.weights.shape, 3))
        raw[..., 1:] = (points - points.mean(axis=1, keepdims=True)) / np.ptp(corners, axis=1)[:, None]
        modes: list[np.ndarray] = []
        for k in range(3):
            mode = raw[..., k]
            for _ in range(2):
                for other in modes:
                    mode = mode - (self.weights * mode * other).sum(axis=1, keepdims=True) * other
            modes.append(mode / np.sqrt((self.weights * mode**2).sum(axis=1, keepdims=True)))
        self.modes = np.stack(modes, axis=-1)
        self.volumes = np.bincount(connectivity.ravel(), np.einsum("eq,qa->ea", self.weights, shape).ravel(),
                                   len(nodes))

    def deformation(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the in-plane deformation gradient (elements, 9, 2, 2), hoop stretch and J (elements, 9)."""
        rates = displacement[self.connectivity][:, None].swapaxes(-1, -2) @ self.gradients
        plane, hoop = np.eye(2) + rates[..., :2], 1.0 + rates[..., 0, 2]
        return plane, hoop, (plane[..., 0, 0] * plane[..., 1, 1] - plane[..., 0, 1] * plane[..., 1, 0]) * hoop

    def forces(self, plane: np.ndarray, hoop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return nodal forces (r, z) of first Piola stresses, N, (nodes, 2), and the sums of absolute contributions."""
        # Products of stacked matrices take a sixth of the time of `einsum`.
        in_plane = self.gradients[..., :2] @ (self.weights[..., None, None] * plane).swapaxes(-1, -2)
        around = (self.weights * hoop)[..., None] * self.gradients[..., 2]
        result = []
        for measure in (np.array, np.abs):
            weighted = measure(in_plane)
            weighted[..., 0] += measure(around)
            sums = weighted.sum(axis=1)
            result.append(np.stack([np.bincount(self.connectivity.ravel(), sums[..., i].ravel(), len(self.nodes))
                                    for i in range(2)], axis=-1))
        return result[0], result[1]


def energy_of(law: Law, parameters: dict[str, float]) -> Callable[[np.ndarray], np.ndarray]:
    """Return the energy of a law as a function of complex isochoric stretches (..., 3)."""
    values = [parameters[name] for name in law.parameters]
    if isinstance(law, InvariantLaw):
        return lambda bar: law.energy((bar**2).sum(axis=-1), (bar**-2).sum(axis=-1), *values)
    return lambda bar: law.energy_of_stretch(bar, *values).sum(axis=-1)


def isochoric_stress(energy: Callable, plane: np.ndarray, hoop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first Piola stress of W(F / J^(1/3)), in plane (..., 2, 2) and hoop, Pa."""
    left, stretches, right = np.linalg.svd(plane)
    three = np.concatenate([stretches, hoop[..., None]], axis=-1)
    slopes = []
    for k in range(3):
        moved = three.astype(complex)
        moved[..., k] += 1j * _STEP
        slopes.append(energy(moved * np.prod(moved, axis=-1, keepdims=True) ** (-1 / 3)).imag / _STEP)
    return (left * np.stack(slopes[:2], axis=-1)[..., None, :]) @ right, slopes[2]
