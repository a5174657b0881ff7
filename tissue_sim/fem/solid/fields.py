"""Fields of a three-dimensional solid, computed from stored states on request."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.fem.fields import FIELD_UNITS, TAIL, compute_volume_weighted_quantile, extrapolate_to_nodes_and_average
from tissue_sim.fem.result_views import SolidGeometry
from tissue_sim.fem.solid.surface import build_solid_geometry
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh

#: Components of the Cauchy stress along the axes of the scene, which only three-dimensional solids have -> indices.
_ALONG = {f"cauchy_{'xyz'[i]}{'xyz'[k]}": (i, k) for i in range(3) for k in range(i, 3)}
#: Field -> unit.
SOLID_UNITS = FIELD_UNITS | dict.fromkeys(_ALONG, "Pa")
#: Fields that do not need the pressure.
_WITHOUT_PRESSURE = ("displacement", "von_mises", "J", "stretch")
#: Index of each entry of a symmetric tensor among its components XX, XY, XZ, YY, YZ, ZZ.
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, eq=False)
class SolidFields:
    """Fields of a three-dimensional solid at every sample of a simulated recording.

    Attributes:
        mesh: undeformed mesh.
        material: material of the elements.
        bulk_modulus: K of each element in units of `moduli`, Pa, shape (elements,).
        displacements: of the nodes, m, shape (samples, nodes, 3).
        pressures: amplitudes of the pressure modes, shape (samples, elements, modes); None if the solver does not
            compute the pressure: `names` then has fewer fields.
        gradients: of the shape functions at the quadrature points, 1/m, shape (elements, q, nodes, 3).
        pressure_modes: orthonormal pressure modes there, shape (elements, q, modes).
        weights: volumes of the quadrature points, m3, shape (elements, q).
        moduli: ratio of the moduli of each element to those of the material, shape (elements,).
        stresses: isochoric second Piola-Kirchhoff stress in units of `moduli`, Pa, shape (samples, elements, q, 6: XX,
            XY, XZ, YY, YZ, ZZ), if it depends on the history; else None.
        datum: height of the scene's origin in the frame of the mesh, m.
    """

    mesh: SolidMesh
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
        # A scalar applies to all elements.
        object.__setattr__(self, "bulk_modulus", np.broadcast_to(self.bulk_modulus, self.moduli.shape))

    @property
    def names(self) -> Collection[str]:
        """Names of the available fields; see `SOLID_UNITS`."""
        return SOLID_UNITS if self.pressures is not None else _WITHOUT_PRESSURE

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return the arrays of the state: displacements, pressures and stresses, as far as they exist."""
        return tuple(each for each in (self.displacements, self.pressures, self.stresses) if each is not None)

    def with_arrays(self, arrays: Sequence[np.ndarray]) -> SolidFields:
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

    def with_material(self, changed: Mapping[str, Any]) -> SolidFields:
        """Return the same fields with other values of `material_data`."""
        return replace(self, **changed)

    def with_selected_elements(self, elements: np.ndarray) -> SolidFields:
        """Return a copy with some of the elements only; all nodes remain, with their indices.

        Args:
            elements: indices of the elements, shape (m,).
        """
        mesh = replace(self.mesh, connectivity=self.mesh.connectivity[elements], regions={})
        return replace(self, mesh=mesh, bulk_modulus=self.bulk_modulus[elements],
                       pressures=None if self.pressures is None else self.pressures[:, elements],
                       gradients=self.gradients[elements], pressure_modes=self.pressure_modes[elements],
                       weights=self.weights[elements], moduli=self.moduli[elements],
                       stresses=None if self.stresses is None else self.stresses[:, elements])

    def with_one_mean_point_per_element(self, previous: SolidFields | None = None) -> SolidFields:
        """Return a copy with one quadrature point in each element, with the mean deformation of the element.

        Args:
            previous: an earlier result of the same tissue, whose gradients, modes and volumes are used again unless the
                stresses depend on the history.
        """
        if previous is not None and self.stresses is None:
            return replace(self, gradients=previous.gradients, pressure_modes=previous.pressure_modes,
                           weights=previous.weights)
        volumes = self.weights.sum(axis=1, keepdims=True)
        shares = self.weights / volumes
        return replace(self, gradients=np.einsum("eq,eqai->eai", shares, self.gradients)[:, None],
                       pressure_modes=np.einsum("eq,eqm->em", shares, self.pressure_modes)[:, None], weights=volumes,
                       stresses=None if self.stresses is None
                       else np.einsum("eq,seqi->sei", shares, self.stresses)[:, :, None])

    def geometry(self) -> SolidGeometry:
        """Return the geometry of the mesh for drawing, the same object for all samples."""
        return build_solid_geometry(self.mesh)

    def displacement(self, sample: int = -1) -> np.ndarray:
        """Return the displacement (x, y, z) of the nodes at a sample, m, shape (nodes, 3)."""
        return self.displacements[sample]

    def deformation_gradient(self, sample: int = -1) -> np.ndarray:
        """Return the deformation gradient F_iJ at the quadrature points of a sample, shape (elements, q, 3, 3)."""
        u = self.displacement(sample)[self.mesh.connectivity]
        count, points, nodes, _ = self.gradients.shape
        # As matrix products, (i, a) (a, qJ).
        flat = self.gradients.transpose(0, 2, 1, 3).reshape(count, nodes, 3 * points)
        rates = (u.transpose(0, 2, 1) @ flat).reshape(count, 3, points, 3).transpose(0, 2, 1, 3)
        return rates + np.eye(3)

    def at_points(self, name: str, sample: int = -1) -> np.ndarray:
        """Return a field of `SOLID_UNITS` at the quadrature points of a sample, shape (elements, q).

        For the definition of stress, pressure and energy see `tissue_sim.fem.axisymmetric.fields.Fields.at_points`.
        Components rr, zz, rz and hoop refer to the axis of the scene, at the deformed position of the point.

        Raises:
            InputError: an unknown field, or one that the solver does not compute.
        """
        if name not in SOLID_UNITS:
            raise InputError(f"unknown result field {name!r}{make_hint_with_similar_or_known_words(name, SOLID_UNITS)}",
                             field="field")
        if name not in self.names:
            raise InputError(f"this solver does not compute pressure and therefore no {name!r}; use one of "
                             f"{', '.join(self.names)}", field="field")
        if name == "displacement":
            return np.linalg.norm(self._interpolate_at_points(self.displacement(sample)), axis=-1)
        if self.material.regions and self.mesh.regions:
            return self._evaluate_field_by_region(name, sample)
        F = self.deformation_gradient(sample)
        J = _compute_determinant(F)
        if name == "J":
            return J
        left = F @ F.swapaxes(-1, -2)
        if name == "stretch":
            return compute_stretches_of_cauchy_green_tensors(left)[..., 0]
        modulus = self.moduli[:, None]
        p = 0.0 if self.pressures is None else np.einsum("eqm,em->eq", self.pressure_modes, self.pressures[sample])
        if name == "energy":
            energy, _ = self._compute_energy_and_principal_stresses(compute_stretches_of_cauchy_green_tensors(left))
            own = modulus * self.material.instantaneous_over_law_modulus_ratio * energy
            return own + p**2 / (2.0 * self.bulk_modulus[:, None] * modulus)
        scale = modulus / J
        if self.stresses is None and name in ("pressure", "von_mises"):
            # From principal stresses, without their directions.
            _, tau = self._compute_energy_and_principal_stresses(compute_stretches_of_cauchy_green_tensors(left))
            if name == "pressure":
                return -(scale * tau.mean(axis=-1) + p)
            return scale * np.sqrt(1.5 * ((tau - tau.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1))
        tensor = scale[..., None, None] * self._compute_relative_isochoric_kirchhoff(F, left, sample)
        mean = np.trace(tensor, axis1=-2, axis2=-1) / 3.0
        if name == "pressure":
            return -(mean + p)
        if name == "von_mises":
            return np.sqrt(1.5 * ((tensor - mean[..., None, None] * np.eye(3)) ** 2).sum(axis=(-2, -1)))
        first, second = self._compute_component_directions(name, sample)
        across = 0.0 if name in ("cauchy_rz", "cauchy_xy", "cauchy_yz", "cauchy_xz") else p
        return np.einsum("eqi,eqik,eqk->eq", first, tensor, second) + across

    def _evaluate_field_by_region(self, name: str, sample: int) -> np.ndarray:
        """Return a field at the quadrature points, each region evaluated with its own material, (elements, q)."""
        count, materials = len(self.mesh.connectivity), self.material.regions
        base = replace(self.material, regions={})
        taken = np.concatenate(list(self.mesh.regions.values()))
        found = np.empty(self.weights.shape)
        parts = [(np.setdiff1d(np.arange(count), taken), base)]
        parts += [(each, materials.get(region, base)) for region, each in self.mesh.regions.items()]
        for elements, material in parts:
            found[elements] = replace(self.with_selected_elements(elements), material=material).at_points(name, sample)
        return found

    def _compute_energy_and_principal_stresses(self, stretches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return energy density, J/m3, and principal Kirchhoff stresses, Pa, for principal stretches, (..., 3)."""
        return self.material.energy_law.compute_energy_and_kirchhoff_stresses(stretches, self.material.parameters)

    def _compute_relative_isochoric_kirchhoff(self, F: np.ndarray, left: np.ndarray, sample: int) -> np.ndarray:
        """Return the isochoric Kirchhoff stress over the ratio `moduli`, Pa, shape (elements, q, 3, 3)."""
        if self.stresses is not None:
            return F @ self.stresses[sample][..., _SYMMETRIC] @ F.swapaxes(-1, -2)
        squares, ways = np.linalg.eigh(left)
        _, tau = self._compute_energy_and_principal_stresses(np.sqrt(squares))
        return (ways * tau[..., None, :]) @ ways.swapaxes(-1, -2)

    def _interpolate_at_points(self, nodal: np.ndarray) -> np.ndarray:
        """Interpolate nodal vectors, shape (nodes, 3), to the quadrature points, shape (elements, q, 3)."""
        values, _ = self.mesh.element.evaluate_shape_functions_and_gradients(self.mesh.element.quadrature[0])
        if self.weights.shape[1] == 1 < len(values):
            values = values.mean(axis=0, keepdims=True)
        return np.einsum("qa,eai->eqi", values, nodal[self.mesh.connectivity])

    def _compute_component_directions(self, name: str, sample: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the unit vectors a and b of the stress component a . sigma b, shape (elements, q, 3) each."""
        shape = (*self.weights.shape, 3)
        if name in _ALONG:
            first, second = (np.broadcast_to(np.eye(3)[axis], shape) for axis in _ALONG[name])
            return first, second
        radial = self._interpolate_at_points(self.mesh.nodes + self.displacement(sample))
        radial[..., 2] = 0.0
        length = np.linalg.norm(radial, axis=-1, keepdims=True)
        radial = np.where(length > 0.0, radial / np.where(length > 0.0, length, 1.0), [1.0, 0.0, 0.0])
        up = np.broadcast_to([0.0, 0.0, 1.0], shape)
        around = np.stack([-radial[..., 1], radial[..., 0], radial[..., 2]], axis=-1)
        return {"cauchy_rr": (radial, radial), "cauchy_zz": (up, up), "cauchy_rz": (radial, up),
                "cauchy_hoop": (around, around)}[name]

    def stretch_range(self, sample: int = -1) -> tuple[float, float]:
        """Return smallest and largest principal stretch, without the fraction `TAIL` of the volume at each end."""
        F = self.deformation_gradient(sample)
        stretches = compute_stretches_of_cauchy_green_tensors(F @ F.swapaxes(-1, -2))
        return (compute_volume_weighted_quantile(stretches[..., 2], self.weights, TAIL),
                compute_volume_weighted_quantile(stretches[..., 0], self.weights, 1 - TAIL))

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


def compute_stretches_of_cauchy_green_tensors(left: np.ndarray) -> np.ndarray:
    """Return principal stretches, largest first, (..., 3), of left or right Cauchy-Green tensors, (..., 3, 3).

    Trigonometric roots of the characteristic polynomial, a few times faster than eigenvectors; the error is 1e-8 of the
    differences of the stretches (Smith, Communications of the ACM 4 (1961) 168).
    """
    a, b, c = left[..., 0, 0], left[..., 1, 1], left[..., 2, 2]
    d, e, f = left[..., 0, 1], left[..., 1, 2], left[..., 0, 2]
    mean = (a + b + c) / 3.0
    a, b, c = a - mean, b - mean, c - mean
    spread = np.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    half = 0.5 * (a * (b * c - e * e) - d * (d * c - e * f) + f * (d * e - b * f))
    cube = spread**3
    angle = np.arccos(np.clip(half / np.where(cube > 0.0, cube, 1.0), -1.0, 1.0)) / 3.0
    large, small = 2.0 * np.cos(angle), 2.0 * np.cos(angle + 2.0 * np.pi / 3.0)
    squares = np.stack([large, -(large + small), small], axis=-1) * spread[..., None] + mean[..., None]
    return np.sqrt(np.maximum(squares, 0.0))
