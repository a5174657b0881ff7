"""Fields of a simulation (stress, strain, energy), computed on demand from the stored states."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.fem.axisymmetric.surface import build_half_section
from tissue_sim.fem.fields import FIELD_UNITS, TAIL, compute_volume_weighted_quantile, extrapolate_to_nodes_and_average
from tissue_sim.fem.result_views import HalfSectionGeometry
from tissue_sim.material.material import Material
from tissue_sim.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Fields:
    """Fields of an axisymmetric simulation at every sample: displacement, stress, pressure, energy, stretch.

    Attributes:
        mesh: undeformed mesh.
        material: material of the specimen.
        bulk_modulus: K of the elements, Pa.
        states: states of the solver, shape (samples, unknowns).
        gradients: see `UndeformedMeshQuadrature.node_gradients`, 1/m, shape (elements, q, nodes, 3).
        pressure_modes: orthonormal pressure modes at the quadrature points, shape (elements, q, modes).
        weights: volumes of the quadrature points, m3, shape (elements, q).
        moduli: moduli of the elements in units of the material's modulus, shape (elements,).
        stresses: isochoric second Piola stress over `moduli`, Pa, shape (samples, elements, q, 4: RR, RZ, ZZ, hoop);
            None for tissue without memory.
        datum: height of the scene's origin in the frame of the mesh, m.
    """

    mesh: Mesh
    material: Material
    bulk_modulus: float
    states: np.ndarray
    gradients: np.ndarray
    pressure_modes: np.ndarray
    weights: np.ndarray
    moduli: np.ndarray
    stresses: np.ndarray | None = None
    datum: float = 0.0

    @property
    def names(self) -> Collection[str]:
        """Names of the available fields, all of `FIELD_UNITS`."""
        return FIELD_UNITS

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return the arrays whose first axis is the sample: states, and stresses with memory; see `with_arrays`."""
        return (self.states,) if self.stresses is None else (self.states, self.stresses)

    def with_arrays(self, arrays: Sequence[np.ndarray]) -> Fields:
        """Return the fields of other samples, whose arrays come from the method `arrays`."""
        return replace(self, states=arrays[0], stresses=arrays[1] if len(arrays) > 1 else None)

    def material_data(self) -> dict[str, Any]:
        """Return name -> value of the attributes that depend on the material; see `with_material`."""
        return {"material": self.material, "bulk_modulus": self.bulk_modulus, "moduli": self.moduli}

    def with_material(self, changed: Mapping[str, Any]) -> Fields:
        """Return the fields with other attributes of the material, from `material_data`."""
        return replace(self, **changed)

    def geometry(self) -> HalfSectionGeometry:
        """Return the half section of the mesh for drawing, the same object for all samples."""
        return build_half_section(self.mesh)

    def displacement(self, sample: int = -1) -> np.ndarray:
        """Return the nodal displacements (r, z), m, shape (nodes, 2)."""
        return self.states[sample, : 2 * len(self.mesh.nodes)].reshape(-1, 2)

    def deformation_gradient(self, sample: int = -1) -> np.ndarray:
        """Return the deformation gradient (rR, rZ, zR, zZ, hoop) at the quadrature points, shape (elements, q, 5)."""
        u = self.displacement(sample)[self.mesh.connectivity]
        rates = np.einsum("eqak,eai->eqik", self.gradients, u)
        return np.stack([1 + rates[..., 0, 0], rates[..., 0, 1], rates[..., 1, 0], 1 + rates[..., 1, 1],
                         1 + rates[..., 0, 2]], axis=-1)

    def at_points(self, name: str, sample: int = -1) -> np.ndarray:
        """Return a field at the quadrature points, shape (elements, q).

        The Cauchy stress of the mixed element is sigma = tau / J + p I, with the pressure p of the element and the
        isochoric Kirchhoff stress tau. With memory, tau need not be deviatoric; `pressure` is minus the mean stress in
        any case. The energy density is W + p^2 / (2 K) per undeformed volume. `stretch` is the largest principal
        stretch.

        Args:
            name: key of `FIELD_UNITS`.
            sample: index of the sample.

        Raises:
            InputError: unknown field.
        """
        if name not in FIELD_UNITS:
            raise InputError(f"unknown field {name!r}{make_hint_with_similar_or_known_words(name, FIELD_UNITS)}",
                             field="field")
        if name == "displacement":
            shapes, _ = self.mesh.element.evaluate_shape_functions_and_gradients(self.mesh.element.quadrature[0])
            u = np.einsum("qa,eai->eqi", shapes, self.displacement(sample)[self.mesh.connectivity])
            return np.linalg.norm(u, axis=-1)
        F = self.deformation_gradient(sample)
        J = (F[..., 0] * F[..., 3] - F[..., 1] * F[..., 2]) * F[..., 4]
        elements, _, modes = self.pressure_modes.shape
        first = 2 * len(self.mesh.nodes)
        amplitudes = self.states[sample, first : first + modes * elements].reshape(elements, modes)
        p = np.einsum("eqm,em->eq", self.pressure_modes, amplitudes)
        if name == "J":
            return J
        modulus = self.moduli[:, None]
        angle, stretches = _compute_principal_angle_and_stretches(F)
        all_stretches = np.stack([*stretches, F[..., 4]], axis=-1)
        if name == "stretch":
            return all_stretches.max(axis=-1)
        energy, tau = self.material.energy_law.compute_energy_and_kirchhoff_stresses(
            all_stretches, self.material.parameters)
        if name == "energy":
            volumetric = p**2 / (2.0 * self.bulk_modulus * modulus)
            return modulus * self.material.instantaneous_over_law_modulus_ratio * energy + volumetric
        if self.stresses is None:
            mean, half, hoop = 0.5 * (tau[..., 0] + tau[..., 1]), 0.5 * (tau[..., 0] - tau[..., 1]), tau[..., 2]
            across, along = half * np.sin(2.0 * angle), half * np.cos(2.0 * angle)
            tensor = np.stack([mean + along, across, across, mean - along], axis=-1).reshape(*F.shape[:-1], 2, 2)
        else:
            in_plane = F[..., :4].reshape(*F.shape[:-1], 2, 2)
            S = self.stresses[sample]
            tensor = np.einsum("eqik,eqkl,eqjl->eqij", in_plane, S[..., [[0, 1], [1, 2]]], in_plane)
            hoop = F[..., 4] ** 2 * S[..., 3]
        tensor, hoop = (modulus / J)[..., None, None] * tensor, modulus / J * hoop
        mean = (np.trace(tensor, axis1=-2, axis2=-1) + hoop) / 3.0
        if name == "pressure":
            return -(mean + p)
        if name == "von_mises":
            deviator = tensor - mean[..., None, None] * np.eye(2)
            return np.sqrt(1.5 * ((deviator**2).sum(axis=(-2, -1)) + (hoop - mean) ** 2))
        return {"cauchy_rr": tensor[..., 0, 0] + p, "cauchy_zz": tensor[..., 1, 1] + p, "cauchy_rz": tensor[..., 0, 1],
                "cauchy_hoop": hoop + p}[name]

    def stretch_range(self, sample: int = -1) -> tuple[float, float]:
        """Return the smallest and largest principal stretch, without the fraction `TAIL` of the volume at each end."""
        F = self.deformation_gradient(sample)
        stretches = np.stack([*_compute_principal_angle_and_stretches(F)[1], F[..., 4]], axis=-1)
        return (compute_volume_weighted_quantile(stretches.min(axis=-1), self.weights, TAIL),
                compute_volume_weighted_quantile(stretches.max(axis=-1), self.weights, 1 - TAIL))

    def at_nodes(self, name: str, sample: int = -1, at_points: np.ndarray | None = None) -> np.ndarray:
        """Return a field at the nodes, shape (nodes,); see `tissue_sim.fem.result_views.Fields.at_nodes`.

        The polynomial through the quadrature points of each element is evaluated at its nodes and averaged over the
        elements that share a node.
        """
        if name == "displacement":
            return np.linalg.norm(self.displacement(sample), axis=1)
        at_points = self.at_points(name, sample) if at_points is None else at_points
        return extrapolate_to_nodes_and_average(self.mesh, at_points)


def _compute_principal_angle_and_stretches(F: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the angle of the larger in-plane principal stretch and both in-plane principal stretches.

    A 2 x 2 matrix is the sum of a scaled rotation and a scaled reflection; their magnitudes give the singular values.

    Args:
        F: deformation gradients, shape (..., 5).

    Returns:
        Angle from r in the deformed state, rad, and the larger and smaller stretch, each of shape (...).

    Source: Blinn, IEEE Computer Graphics and Applications 16 (1996) 82.
    """
    rR, rZ, zR, zZ = (F[..., k] for k in range(4))
    turned = np.hypot(rR + zZ, zR - rZ)
    mirrored = np.hypot(rR - zZ, zR + rZ)
    angle = 0.5 * (np.arctan2(zR - rZ, rR + zZ) + np.arctan2(zR + rZ, rR - zZ))
    return angle, (0.5 * (turned + mirrored), 0.5 * (turned - mirrored))
