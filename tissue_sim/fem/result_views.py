"""Contracts of the results that a solver shows: fields in the tissue, and its deformed surface."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from tissue_sim.material.material import Material


class Fields(Protocol):
    """Fields at the samples of a simulation, computed on request."""

    @property
    def mesh(self) -> Any:
        """Undeformed mesh, of a type of the solver."""

    @property
    def material(self) -> Material:
        """Material of the tissue."""

    @property
    def names(self) -> Collection[str]:
        """Names of the available fields; see `tissue_sim.fem.fields.FIELD_UNITS`."""

    def displacement(self, sample: int = -1) -> np.ndarray:
        """Displacement of the nodes, m, shape (nodes, coordinates of a node)."""

    def at_points(self, name: str, sample: int = -1) -> np.ndarray:
        """Field at the quadrature points, shape (elements, q)."""

    def at_nodes(self, name: str, sample: int = -1) -> np.ndarray:
        """Field at the nodes, shape (nodes,)."""

    def stretch_range(self, sample: int = -1) -> tuple[float, float]:
        """Smallest and largest principal stretch in the tissue; 1 % of the volume is left out at each end."""


@runtime_checkable
class SharedFields(Fields, Protocol):
    """Fields that a loop publishes for viewers in other processes."""

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that change from sample to sample; the other data are sent once."""

    def with_arrays(self, arrays: Sequence[np.ndarray]) -> SharedFields:
        """Return the fields of another sample."""

    def material_data(self) -> dict[str, Any]:
        """Return the data, besides the arrays, that change with the parameters of the material."""

    def with_material(self, changed: Mapping[str, Any]) -> SharedFields:
        """Return the fields with the data of `material_data` of another material."""


class Surface(Protocol):
    """Deformed surface of the tissue in the frame of the scene."""

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
