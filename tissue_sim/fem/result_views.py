"""Contracts of the results that a solver shows: fields in the tissue, and its deformed surface."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from tissue_sim.material.material import Material


class Fields(Protocol):
    """Interface of field quantities at the samples of a simulation, computed on request."""

    @property
    def mesh(self) -> Any:
        """Undeformed mesh, of a type of the solver."""

    @property
    def material(self) -> Material:
        """Material of the tissue."""

    @property
    def names(self) -> Collection[str]:
        """Names of the available fields; see `tissue_sim.fem.elements.fields.FIELD_UNITS`."""

    def displacement(self, sample: int = -1) -> np.ndarray:
        """Return the displacements of the nodes, m, shape (nodes, coordinates of a node)."""

    def at_points(self, name: str, sample: int = -1) -> np.ndarray:
        """Return the field `name` at the quadrature points, shape (elements, q), in the unit of `FIELD_UNITS`."""

    def at_nodes(self, name: str, sample: int = -1) -> np.ndarray:
        """Return the field `name` at the nodes, shape (nodes,), in the unit of `FIELD_UNITS`."""

    def stretch_range(self, sample: int = -1) -> tuple[float, float]:
        """Return the smallest and largest principal stretch in the tissue, without 1 % of the volume at each end."""


@runtime_checkable
class SharedFields(Fields, Protocol):
    """Interface of fields that a loop publishes, as arrays, for viewers in other processes."""

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return the arrays that change from sample to sample; all other data are sent once."""

    def with_arrays(self, arrays: Sequence[np.ndarray]) -> SharedFields:
        """Return fields with the arrays of another sample, from `arrays`."""

    def material_data(self) -> dict[str, Any]:
        """Return the attributes that change with the parameters of the material, by name; see `with_material`."""

    def with_material(self, changed: Mapping[str, Any]) -> SharedFields:
        """Return fields with the attributes of another material, from `material_data`."""


class Surface(Protocol):
    """Interface of the deformed surface of the tissue, in the frame of the scene."""

    @property
    def outline(self) -> np.ndarray | None:
        """Outline (r, z) of an axisymmetric specimen, m, shape (n, 2); None for other specimens."""

    def triangles(self, segments: int = 48) -> tuple[np.ndarray, np.ndarray]:
        """Return a triangulation of the surface.

        Args:
            segments: number of segments around the axis of an axisymmetric specimen.

        Returns:
            Vertices, m, shape (v, 3), and triangles, shape (t, 3), with normals that point out of the tissue.
        """
