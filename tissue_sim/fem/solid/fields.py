"""Saved states of a three-dimensional solid, and their fields, geometry for drawing, and deformed surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from tissue_sim.fem.elements.fields import FIELD_UNITS, ElementFields
from tissue_sim.fem.result_views import SolidGeometry, SolidSurface
from tissue_sim.mesh.sections import (
    find_outline_edges_of_face,
    subdivide_face_into_triangles,
    subdivide_into_tetrahedra,
    triangulate_surface_faces,
)
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose


@dataclass(frozen=True, eq=False)
class FieldSample:
    """Committed state from which `SolidSolver.fields` computes fields.

    Attributes:
        displacement: displacement of the nodes, m, shape (nodes, 3).
        pressures: pressure amplitudes of the elements, Pa, shape (elements, modes).
        stresses: isochoric stresses, see `SolidFields.stresses`; None if the material has no history.
    """

    displacement: np.ndarray
    pressures: np.ndarray
    stresses: np.ndarray | None


@dataclass(frozen=True, eq=False)
class SavedState:
    """Copy of everything on which the next step of a solver depends; see `SolidSolver.save`.

    Attributes:
        arrays: copies of the state arrays of solver, contact and material history.
        pose: pose of the tool.
        largest_force: largest force so far, N.
        start: pose of the tool at its first touch, for which the mesh was made; None: the position of the model.
    """

    arrays: tuple[np.ndarray, ...]
    pose: Pose
    largest_force: float
    start: Pose | None = None


@lru_cache(maxsize=4)
def build_solid_geometry(mesh: SolidMesh) -> SolidGeometry:
    """Divide the faces on the surface into triangles and the elements into tetrahedra; the result is cached."""
    element, sides = mesh.element, np.concatenate(list(mesh.faces.values()))
    cell_sides = element.local_face_node_indices[:, subdivide_face_into_triangles(element)].reshape(-1, 3)
    return SolidGeometry(mesh.nodes, triangulate_surface_faces(element, sides).reshape(len(sides), -1, 3),
                         sides[:, find_outline_edges_of_face(element)], mesh.connectivity,
                         subdivide_into_tetrahedra(element), cell_sides, mesh.sets.get("top"))


def extract_deformed_surface(mesh: SolidMesh, displacement: np.ndarray, datum: float) -> SolidSurface:
    """Return the deformed surface of a mesh.

    Args:
        mesh: undeformed mesh.
        displacement: displacements of the nodes, m, shape (nodes, 3).
        datum: height of the first touch, which becomes z = 0, m.
    """
    return SolidSurface(build_solid_geometry(mesh), mesh.nodes + displacement - [0.0, 0.0, datum])


#: Components of the Cauchy stress along the axes of the scene, which only three-dimensional solids have -> indices.
_ALONG = {f"cauchy_{'xyz'[i]}{'xyz'[k]}": (i, k) for i in range(3) for k in range(i, 3)}
#: Field -> unit.
SOLID_UNITS = FIELD_UNITS | dict.fromkeys(_ALONG, "Pa")
#: Index of each entry of a symmetric tensor among its components XX, XY, XZ, YY, YZ, ZZ.
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, eq=False)
class SolidFields(ElementFields):
    """Fields of a three-dimensional solid at every sample of a simulated recording, with the axes x, y and z.

    The attribute `stresses` has the components XX, XY, XZ, YY, YZ and ZZ.
    """

    units = SOLID_UNITS

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

    def deformation_gradient(self, sample: int = -1) -> np.ndarray:
        """Return the deformation gradient F_iJ at the quadrature points of a sample, shape (elements, q, 3, 3)."""
        u = self.displacement(sample)[self.mesh.connectivity]
        count, points, nodes, _ = self.gradients.shape
        # As matrix products, (i, a) (a, qJ).
        flat = self.gradients.transpose(0, 2, 1, 3).reshape(count, nodes, 3 * points)
        rates = (u.transpose(0, 2, 1) @ flat).reshape(count, 3, points, 3).transpose(0, 2, 1, 3)
        return rates + np.eye(3)

    def at_points(self, name: str, sample: int = -1) -> np.ndarray:
        """Return a field at the quadrature points of a sample, shape (elements, q); see `ElementFields.at_points`.

        Each region is evaluated with its own material.
        """
        if name != "displacement" and self.material.regions and self.mesh.regions:
            return self._evaluate_field_by_region(name, sample)
        return super().at_points(name, sample)

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

    def _compute_deformation_gradient_matrices(self, sample: int) -> np.ndarray:
        return self.deformation_gradient(sample)

    def _compute_principal_stretches(self, F: np.ndarray) -> np.ndarray:
        return compute_stretches_of_cauchy_green_tensors(F @ F.swapaxes(-1, -2))

    def _compute_principal_stretches_and_directions(self, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        squares, directions = np.linalg.eigh(F @ F.swapaxes(-1, -2))
        return np.sqrt(squares), directions

    def _expand_stress_components(self, components: np.ndarray) -> np.ndarray:
        return components[..., _SYMMETRIC]

    def _compute_component_directions(self, name: str, sample: int) -> tuple[np.ndarray, np.ndarray]:
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
