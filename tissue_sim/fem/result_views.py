"""Contracts of the results of a solver: fields in the tissue, geometry for drawing the fields, deformed surface.

Pictures use these contracts and no mesh types. A solver whose fields have `DrawableFields.geometry` is drawn with
colours and with a cut; a solver without it is drawn as a plain surface.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from tissue_sim.material.material import Material

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def _make_empty_table(columns: int) -> np.ndarray:
    """Return an array of integers of shape (0, columns)."""
    return np.empty((0, columns), dtype=int)


@dataclass(frozen=True, eq=False)
class HalfSectionGeometry:
    """Half section of an axisymmetric specimen, divided into triangles that stay the same from sample to sample.

    The corners of the triangles are points. A point is a node, or its position is interpolated between nodes.

    Attributes:
        nodes: undeformed coordinates (r, z) of the nodes, m, shape (n, 2).
        triangles: point numbers, anticlockwise in the (r, z) plane, shape (t, 3).
        top: numbers of the points on the top from the axis outwards; the last one is the first of `side`.
        side: numbers of the points on the side downwards; the last one is the first of `base`.
        base: numbers of the points on the base towards the axis.
        edges: lines of the drawn mesh, point numbers, shape (k, 2).
        weights: shape functions that interpolate from the nodes to the points, shape (points, n); None: the points are
            the nodes.
        surface_nodes: node numbers of the top from the axis outwards, then of the side, shape (m,); None: the points of
            top and side.
        contact_weights: shape functions at the points where the solver enforces contact, one point between two
            neighbours of `surface_nodes`, shape (m - 1, n); None: the midpoints.
    """

    nodes: np.ndarray
    triangles: np.ndarray
    top: np.ndarray
    side: np.ndarray
    base: np.ndarray
    edges: np.ndarray = field(default_factory=lambda: _make_empty_table(2))
    weights: csr_array | None = None
    surface_nodes: np.ndarray | None = None
    contact_weights: csr_array | None = None

    @property
    def outline(self) -> np.ndarray:
        """Point numbers from the axis along the top, down the side and along the base back to the axis."""
        return np.concatenate([self.top, self.side[1:], self.base[1:]])

    def interpolate_at_points(self, nodal: np.ndarray) -> np.ndarray:
        """Interpolate nodal values, shape (n, ...), to the points, shape (points, ...)."""
        return nodal if self.weights is None else self.weights @ nodal

    def select_surface_nodes(self, nodal: np.ndarray) -> np.ndarray:
        """Return the nodal values, shape (n, ...), at the nodes of top and side, shape (m, ...)."""
        numbers = np.concatenate([self.top, self.side[1:]]) if self.surface_nodes is None else self.surface_nodes
        return nodal[numbers]

    def interpolate_at_contact_points(self, nodal: np.ndarray) -> np.ndarray:
        """Interpolate nodal values, shape (n, ...), to the contact points of top and side, shape (m - 1, ...)."""
        if self.contact_weights is not None:
            return self.contact_weights @ nodal
        surface = self.select_surface_nodes(nodal)
        return 0.5 * (surface[:-1] + surface[1:])


@dataclass(frozen=True, eq=False)
class SolidGeometry:
    """Surface of a three-dimensional solid, and its interior divided into cells, which stay the same in all samples.

    All cells have the same type. A geometry without cells has a surface only, and a cut through it shows no section.

    Attributes:
        nodes: undeformed coordinates, m, shape (n, 3).
        faces: triangles of each face of the surface, node numbers with outward normals, shape (faces, k, 3).
        face_edges: lines of the drawn mesh around each face, node numbers, shape (faces, l, 2).
        cells: node numbers of the cells, shape (cells, nodes of a cell).
        tetrahedra: tetrahedra that fill a cell, numbers of nodes within the cell, shape (t, 4).
        cell_sides: triangles that bound a cell, numbers of nodes within the cell, shape (s, 3).
        top: numbers of the nodes on the top, which the tool approaches; None: unknown.
    """

    nodes: np.ndarray
    faces: np.ndarray
    face_edges: np.ndarray
    cells: np.ndarray = field(default_factory=lambda: _make_empty_table(4))
    tetrahedra: np.ndarray = field(default_factory=lambda: _make_empty_table(4))
    cell_sides: np.ndarray = field(default_factory=lambda: _make_empty_table(3))
    top: np.ndarray | None = None

    @classmethod
    def from_tetrahedra(cls, nodes: np.ndarray, tetrahedra: np.ndarray, top: np.ndarray | None = None) -> SolidGeometry:
        """Make the geometry of a mesh of tetrahedra; its surface consists of the faces without a neighbour.

        Args:
            nodes: undeformed coordinates, m, shape (n, 3).
            tetrahedra: node numbers with positive volume, shape (t, 4).
            top: numbers of the nodes on the top; None: unknown.
        """
        outward = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
        sides = tetrahedra[:, outward].reshape(-1, 3)
        _, first, times = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
        faces = sides[np.sort(first[times == 1])]
        return cls(nodes, faces[:, None], faces[:, [[0, 1], [1, 2], [2, 0]]], tetrahedra, np.arange(4)[None], outward,
                   top)

    @property
    def surface_triangles(self) -> np.ndarray:
        """Triangles of the whole surface, node numbers, shape (faces k, 3)."""
        return self.faces.reshape(-1, 3)

    def list_side_triangles(self, cells: Any = slice(None)) -> np.ndarray:
        """Return the triangles that bound the cells with the given numbers, node numbers, shape (triangles, 3)."""
        return self.cells[cells][:, self.cell_sides].reshape(-1, 3)

    def list_tetrahedra(self, cells: Any = slice(None)) -> np.ndarray:
        """Return the tetrahedra of the cells with the given numbers, node numbers, shape (tetrahedra, 4)."""
        return self.cells[cells][:, self.tetrahedra].reshape(-1, 4)


#: Geometry from which pictures draw fields.
TissueGeometry = HalfSectionGeometry | SolidGeometry


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

    def at_nodes(self, name: str, sample: int = -1, at_points: np.ndarray | None = None) -> np.ndarray:
        """Return the field `name` at the nodes, shape (nodes,), in the unit of `FIELD_UNITS`.

        Args:
            name: name of the field.
            sample: index of the sample.
            at_points: result of the method `at_points` for the same field and sample, which need not be computed a
                second time; None: unknown.
        """

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


class DrawableFields(SharedFields, Protocol):
    """Interface of fields that pictures show with colours, sections and lines."""

    @property
    def weights(self) -> np.ndarray:
        """Volumes of the quadrature points of `at_points`, m3, shape (elements, q)."""

    @property
    def datum(self) -> float:
        """Height of the scene's origin in the frame of the nodes, m."""

    def geometry(self) -> TissueGeometry:
        """Return the geometry of the tissue, the same object for all samples: pictures prepare it once."""


@runtime_checkable
class SubsampledFields(DrawableFields, Protocol):
    """Interface of fields of large solids, of which pictures evaluate the visible cells only.

    The elements of `at_points` are the cells of the geometry.
    """

    def with_selected_elements(self, elements: np.ndarray) -> SubsampledFields:
        """Return the fields of the elements with the given numbers, shape (m,), with all nodes."""

    def with_one_mean_point_per_element(self, previous: Any = None) -> SubsampledFields:
        """Return the fields with one point in each element, which has the mean deformation of the element.

        Args:
            previous: an earlier result of the same tissue, whose data that do not depend on the sample are used again;
                None: no earlier result.
        """


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


def get_drawable_fields_or_none(fields: Any) -> DrawableFields | None:
    """Return fields that have the methods of `DrawableFields`; None for other fields and for None.

    The class is examined, because isinstance with a protocol takes longer and evaluates properties.
    """
    kind: Any = type(fields)
    return fields if has_shared_fields_interface(kind) and hasattr(kind, "geometry") else None


@cache
def has_shared_fields_interface(kind: type) -> bool:
    """Return whether a class has the methods of `SharedFields`."""
    return all(hasattr(kind, name) for name in ("arrays", "with_arrays", "material_data", "with_material"))


@dataclass(frozen=True, eq=False)
class DeformedSurface:
    """Deformed surface of an axisymmetric specimen, in the frame of the scene.

    Attributes:
        outline: (r, z) from the axis along the top and down the side to the base, m, shape (n, 2); z = 0 is the height
            of the first touch.
    """

    outline: np.ndarray

    def triangles(self, segments: int = 48) -> tuple[np.ndarray, np.ndarray]:
        """Return a triangulation of the surface of revolution.

        Args:
            segments: number of segments around the axis, 3 or more.

        Returns:
            Vertices, m, shape (v, 3), and vertex indices of the triangles, shape (t, 3), with outward normals.
        """
        ring = self.outline[1:] if self.outline[0, 0] == 0.0 else self.outline
        angle = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
        r, z = ring[:, :1], np.broadcast_to(ring[:, 1:], (len(ring), segments))
        rings = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1).reshape(-1, 3)
        here = np.arange(len(ring) * segments).reshape(len(ring), segments)
        next_ones = np.roll(here, -1, axis=1)
        inner, outer = here[:-1], here[1:]
        quads = np.concatenate([np.stack([inner, outer, next_ones[:-1]], axis=-1).reshape(-1, 3),
                                np.stack([next_ones[:-1], outer, next_ones[1:]], axis=-1).reshape(-1, 3)])
        if ring is self.outline:
            return rings, quads
        centre = np.array([[0.0, 0.0, self.outline[0, 1]]])
        fan = np.stack([np.zeros(segments, dtype=int), here[0] + 1, next_ones[0] + 1], axis=-1)
        return np.concatenate([centre, rings]), np.concatenate([fan, quads + 1])


@dataclass(frozen=True, eq=False)
class SolidSurface:
    """Deformed surface of a three-dimensional solid, in the frame of the scene; it has no outline.

    Attributes:
        geometry: geometry of the solid.
        positions: deformed positions of all nodes, m, shape (nodes, 3).
    """

    geometry: SolidGeometry
    positions: np.ndarray
    outline: None = None

    def triangles(self, segments: int = 48) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices, m, shape (v, 3), and triangles, shape (t, 3), with normals that point outwards."""
        numbers, indices = np.unique(self.geometry.surface_triangles, return_inverse=True)
        return self.positions[numbers], indices.reshape(-1, 3)
