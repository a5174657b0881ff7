"""Fields of an axisymmetric simulation, with the axes r, z and hoop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.axisymmetric.surface import build_half_section
from tissue_sim.fem.elements.fields import ElementFields
from tissue_sim.fem.result_views import HalfSectionGeometry

#: Index of each entry of a symmetric tensor among its components RR, RZ, ZZ, hoop and a zero.
_SYMMETRIC = np.array([[0, 1, 4], [1, 2, 4], [4, 4, 3]])
#: Axes of each component of the Cauchy stress.
_AXES = {"cauchy_rr": (0, 0), "cauchy_zz": (1, 1), "cauchy_rz": (0, 1), "cauchy_hoop": (2, 2)}


@dataclass(frozen=True, eq=False)
class Fields(ElementFields):
    """Fields of an axisymmetric simulation at every sample: displacement, stress, pressure, energy, stretch.

    The nodes have the coordinates r and z. The last column of `gradients` contains the shape functions over r, see
    `UndeformedMeshQuadrature.node_gradients`, and `stresses` the components RR, RZ, ZZ and hoop.
    """

    def geometry(self) -> HalfSectionGeometry:
        """Return the half section of the mesh for drawing, the same object for all samples."""
        return build_half_section(self.mesh)

    def deformation_gradient(self, sample: int = -1) -> np.ndarray:
        """Return the deformation gradient (rR, rZ, zR, zZ, hoop) at the quadrature points, shape (elements, q, 5)."""
        u = self.displacement(sample)[self.mesh.connectivity]
        rates = np.einsum("eqak,eai->eqik", self.gradients, u)
        return np.stack([1 + rates[..., 0, 0], rates[..., 0, 1], rates[..., 1, 0], 1 + rates[..., 1, 1],
                         1 + rates[..., 0, 2]], axis=-1)

    def _compute_deformation_gradient_matrices(self, sample: int) -> np.ndarray:
        components = self.deformation_gradient(sample)
        F = np.zeros((*components.shape[:-1], 3, 3))
        F[..., :2, :2] = components[..., :4].reshape(*components.shape[:-1], 2, 2)
        F[..., 2, 2] = components[..., 4]
        return F

    def _compute_principal_stretches(self, F: np.ndarray) -> np.ndarray:
        _, (larger, smaller) = _compute_principal_angle_and_stretches(F)
        return np.stack([larger, smaller, F[..., 2, 2]], axis=-1)

    def _compute_principal_stretches_and_directions(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle, (larger, smaller) = _compute_principal_angle_and_stretches(F)
        directions = np.zeros(F.shape)
        directions[..., 0, 0] = directions[..., 1, 1] = np.cos(angle)
        directions[..., 1, 0] = np.sin(angle)
        directions[..., 0, 1] = -directions[..., 1, 0]
        directions[..., 2, 2] = 1.0
        return np.stack([larger, smaller, F[..., 2, 2]], axis=-1), directions

    def _expand_stress_components(self, components: np.ndarray) -> np.ndarray:
        return np.concatenate([components, np.zeros((*components.shape[:-1], 1))], axis=-1)[..., _SYMMETRIC]

    def _compute_component_directions(self, name: str, sample: int) -> tuple[np.ndarray, np.ndarray]:
        first, second = _AXES[name]
        return np.eye(3)[first], np.eye(3)[second]


def _compute_principal_angle_and_stretches(F: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the angle of the larger in-plane principal stretch and both in-plane principal stretches.

    A 2 x 2 matrix is the sum of a scaled rotation and a scaled reflection; their magnitudes give the singular values.

    Args:
        F: deformation gradients, shape (..., 3, 3); axes r, z, hoop.

    Returns:
        Angle from r in the deformed state, rad, and the larger and smaller stretch, each of shape (...).

    Source: Blinn, IEEE Computer Graphics and Applications 16 (1996) 82.
    """
    rR, rZ, zR, zZ = (F[..., i, k] for i in range(2) for k in range(2))
    turned = np.hypot(rR + zZ, zR - rZ)
    mirrored = np.hypot(rR - zZ, zR + rZ)
    angle = 0.5 * (np.arctan2(zR - rZ, rR + zZ) + np.arctan2(zR + rZ, rR - zZ))
    return angle, (0.5 * (turned + mirrored), 0.5 * (turned - mirrored))
