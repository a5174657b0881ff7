"""Fields of a simulation (stress, strain, energy) at quadrature points and nodes, computed on request."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.material.material import Material

#: Field -> unit. Components of the Cauchy stress refer to the axis of the scene.
FIELD_UNITS = {"displacement": "m", "von_mises": "Pa", "cauchy_rr": "Pa", "cauchy_zz": "Pa", "cauchy_rz": "Pa",
               "cauchy_hoop": "Pa", "pressure": "Pa", "energy": "J/m3", "J": "1", "stretch": "1"}
#: Fields that do not need the pressure.
WITHOUT_PRESSURE = ("displacement", "von_mises", "J", "stretch")
#: Names of the shear components of the Cauchy stress.
_SHEARS = ("cauchy_rz", "cauchy_xy", "cauchy_xz", "cauchy_yz")
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


@dataclass(frozen=True, eq=False)
class ElementFields(ABC):
    """Fields of mixed elements, with displacements and pressures, at every sample of a simulation.

    Tensors are 3 x 3 matrices that refer to orthonormal axes. A subclass defines these axes, the deformation gradient
    and the directions of the stress components.

    Attributes:
        units: name -> unit of the fields of the class.
        mesh: undeformed mesh.
        material: material of the elements.
        bulk_modulus: K of each element in units of `moduli`, Pa, shape (elements,); one number applies to all elements.
        displacements: of the nodes, m, shape (samples, nodes, coordinates of a node).
        pressures: amplitudes of the pressure modes, shape (samples, elements, modes); None if the solver does not
            compute the pressure: `names` then has fewer fields.
        gradients: of the shape functions at the quadrature points, 1/m, shape (elements, q, nodes, 3).
        pressure_modes: orthonormal pressure modes there, shape (elements, q, modes).
        weights: volumes of the quadrature points, m3, shape (elements, q).
        moduli: ratio of the moduli of each element to those of the material, shape (elements,).
        stresses: isochoric second Piola-Kirchhoff stress in units of `moduli`, Pa, shape (samples, elements, q,
            components), if it depends on the history; else None.
        datum: height of the scene's origin in the frame of the mesh, m.
    """

    units: ClassVar[Mapping[str, str]] = FIELD_UNITS

    mesh: Any
    material: Material
    bulk_modulus: np.ndarray
    displacements: np.ndarray
    pressures: np.ndarray | None
    gradients: np.ndarray
    pressure_modes: np.ndarray
    weights: np.ndarray
    moduli: np.ndarray
    stresses: np.ndarray | None = None
    datum: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "bulk_modulus", np.broadcast_to(self.bulk_modulus, self.moduli.shape))

    @abstractmethod
    def _compute_deformation_gradient_matrices(self, sample: int) -> np.ndarray:
        """Return the deformation gradients at the quadrature points of a sample, shape (elements, q, 3, 3)."""

    @abstractmethod
    def _compute_principal_stretches(self, F: np.ndarray) -> np.ndarray:
        """Return the principal stretches of deformation gradients, in any order, shape (..., 3) from (..., 3, 3)."""

    @abstractmethod
    def _compute_principal_stretches_and_directions(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return principal stretches, shape (..., 3), and their spatial directions as columns, shape (..., 3, 3)."""

    @abstractmethod
    def _expand_stress_components(self, components: np.ndarray) -> np.ndarray:
        """Return symmetric matrices, shape (..., 3, 3), from the stored components of `stresses`."""

    @abstractmethod
    def _compute_component_directions(self, name: str, sample: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the unit vectors a and b of the stress component a . sigma b, shape (elements, q, 3) or (3,) each."""

    @property
    def names(self) -> Collection[str]:
        """Names of the available fields, all or some of `units`."""
        return self.units if self.pressures is not None else WITHOUT_PRESSURE

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return the arrays of the state: displacements, pressures and stresses, as far as they exist."""
        return tuple(each for each in (self.displacements, self.pressures, self.stresses) if each is not None)

    def with_arrays(self, arrays: Sequence[np.ndarray]) -> Self:
        """Return a copy with other displacements, pressures and stresses.

        Args:
            arrays: displacements, pressures and stresses, in this order; fields that are None here are left out.
        """
        more = iter(arrays[1:])
        return replace(self, displacements=arrays[0], pressures=None if self.pressures is None else next(more),
                       stresses=None if self.stresses is None else next(more))

    def material_data(self) -> dict[str, Any]:
        """Return the values that depend on the material: material, bulk moduli (Pa), relative moduli."""
        return {"material": self.material, "bulk_modulus": self.bulk_modulus, "moduli": self.moduli}

    def with_material(self, changed: Mapping[str, Any]) -> Self:
        """Return the same fields with other values of `material_data`."""
        return replace(self, **changed)

    def displacement(self, sample: int = -1) -> np.ndarray:
        """Return the displacements of the nodes at a sample, m, shape (nodes, coordinates of a node)."""
        return self.displacements[sample]

    def at_points(self, name: str, sample: int = -1) -> np.ndarray:
        """Return a field at the quadrature points of a sample, shape (elements, q).

        The Cauchy stress of the mixed element is sigma = tau / J + p I, with the pressure p of the element and the
        isochoric Kirchhoff stress tau. With memory, tau need not be deviatoric; `pressure` is minus the mean stress in
        any case. The energy density is W + p^2 / (2 K) per undeformed volume. `stretch` is the largest principal
        stretch. Components rr, zz, rz and hoop refer to the axis of the scene, at the deformed position of the point.

        Args:
            name: key of `units`.
            sample: index of the sample.

        Raises:
            InputError: an unknown field, or one that the solver does not compute.
        """
        self._require_available_field(name)
        if name == "displacement":
            return np.linalg.norm(self._interpolate_at_points(self.displacement(sample)), axis=-1)
        F = self._compute_deformation_gradient_matrices(sample)
        if name == "stretch":
            return self._compute_principal_stretches(F).max(axis=-1)
        J = _compute_determinant(F)
        if name == "J":
            return J
        modulus = self.moduli[:, None]
        p = 0.0 if self.pressures is None else np.einsum("eqm,em->eq", self.pressure_modes, self.pressures[sample])
        if name == "energy":
            energy, _ = self._compute_energy_and_principal_stresses(self._compute_principal_stretches(F))
            volumetric = p**2 / (2.0 * self.bulk_modulus[:, None] * modulus)
            return modulus * self.material.instantaneous_over_law_modulus_ratio * energy + volumetric
        scale = modulus / J
        if self.stresses is None and name in ("pressure", "von_mises"):
            # From principal stresses, without their directions.
            _, tau = self._compute_energy_and_principal_stresses(self._compute_principal_stretches(F))
            if name == "pressure":
                return -(scale * tau.mean(axis=-1) + p)
            return scale * np.sqrt(1.5 * ((tau - tau.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1))
        tensor = scale[..., None, None] * self._compute_relative_isochoric_kirchhoff(F, sample)
        mean = np.trace(tensor, axis1=-2, axis2=-1) / 3.0
        if name == "pressure":
            return -(mean + p)
        if name == "von_mises":
            return np.sqrt(1.5 * ((tensor - mean[..., None, None] * np.eye(3)) ** 2).sum(axis=(-2, -1)))
        first, second = self._compute_component_directions(name, sample)
        return np.einsum("...i,...ik,...k->...", first, tensor, second) + (0.0 if name in _SHEARS else p)

    def _require_available_field(self, name: str) -> None:
        """Raise an InputError for an unknown field or one that needs a pressure that the solver does not compute."""
        if name not in self.units:
            raise InputError(f"unknown field {name!r}{make_hint_with_similar_or_known_words(name, self.units)}",
                             field="field")
        if name not in self.names:
            raise InputError(f"this solver does not compute pressure and therefore no {name!r}; use one of "
                             f"{', '.join(self.names)}", field="field")

    def _compute_energy_and_principal_stresses(self, stretches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return energy density, J/m3, and principal Kirchhoff stresses, Pa, for principal stretches, (..., 3)."""
        return self.material.energy_law.compute_energy_and_kirchhoff_stresses(stretches, self.material.parameters)

    def _compute_relative_isochoric_kirchhoff(self, F: np.ndarray, sample: int) -> np.ndarray:
        """Return the isochoric Kirchhoff stress over the ratio `moduli`, Pa, shape (elements, q, 3, 3)."""
        if self.stresses is not None:
            return F @ self._expand_stress_components(self.stresses[sample]) @ F.swapaxes(-1, -2)
        stretches, directions = self._compute_principal_stretches_and_directions(F)
        _, tau = self._compute_energy_and_principal_stresses(stretches)
        return (directions * tau[..., None, :]) @ directions.swapaxes(-1, -2)

    def _interpolate_at_points(self, nodal: np.ndarray) -> np.ndarray:
        """Interpolate nodal vectors to the quadrature points, shape (elements, q, components)."""
        values, _ = self.mesh.element.evaluate_shape_functions_and_gradients(self.mesh.element.quadrature[0])
        if self.weights.shape[1] == 1 < len(values):
            values = values.mean(axis=0, keepdims=True)
        return np.einsum("qa,eai->eqi", values, nodal[self.mesh.connectivity])

    def stretch_range(self, sample: int = -1) -> tuple[float, float]:
        """Return smallest and largest principal stretch, without the fraction `TAIL` of the volume at each end."""
        stretches = self._compute_principal_stretches(self._compute_deformation_gradient_matrices(sample))
        return (compute_volume_weighted_quantile(stretches.min(axis=-1), self.weights, TAIL),
                compute_volume_weighted_quantile(stretches.max(axis=-1), self.weights, 1 - TAIL))

    def at_nodes(self, name: str, sample: int = -1, at_points: np.ndarray | None = None) -> np.ndarray:
        """Return a field at the nodes of a sample, shape (nodes,); see `tissue_sim.fem.result_views.Fields.at_nodes`.

        Each element's polynomial through its quadrature points is averaged over the elements of a node; 0 at nodes
        without an element.
        """
        if name == "displacement":
            return np.linalg.norm(self.displacement(sample), axis=1)
        at_points = self.at_points(name, sample) if at_points is None else at_points
        return extrapolate_to_nodes_and_average(self.mesh, at_points)


def _compute_determinant(F: np.ndarray) -> np.ndarray:
    """Return the determinants of 3 x 3 matrices, shape (...) from (..., 3, 3), without a factorisation."""
    (a, b, c), (d, e, f), (g, h, i) = ([F[..., row, column] for column in range(3)] for row in range(3))
    return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
