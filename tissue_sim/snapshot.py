"""Snapshot of the tissue at one equilibrium, for programs that draw its fields or surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.result_views import (
    DrawableFields,
    Fields,
    SharedFields,
    get_drawable_fields_or_none,
    has_shared_fields_interface,
)
from tissue_sim.fem.solver import Solver
from tissue_sim.pose import Pose
from tissue_sim.public_names import OldName, with_old_names
from tissue_sim.tool_force import Tissue


@dataclass(frozen=True, eq=False)
class TriangulatedSurface:
    """Triangulated surface of the tissue, for drawing.

    Attributes:
        vertices: in the frame of the scene, m, shape (vertices, 3).
        triangles: indices of vertices, shape (triangles, 3); they do not change with the deformation.
        is_axisymmetric: whether the tissue is axisymmetric, so that the tool moves along the axis only.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    is_axisymmetric: bool = False


@with_old_names(at="with_pose_and_arrays")
@dataclass(frozen=True, eq=False)
class Snapshot:
    """Tissue and tool at one equilibrium.

    Attributes:
        pose: pose of the tool.
        datum: height of the tool at its first touch, m; not 0 if the specimen sags under its weight.
        fields: fields of this sample; None if the solver has none.
        skin: surface of a tissue whose fields cannot be drawn; None if `drawable_fields` can.
    """

    place = OldName("node_positions")

    pose: Pose
    datum: float
    fields: Fields | None
    skin: TriangulatedSurface | None = None

    @property
    def depth(self) -> float:
        """Depth of the tool, m."""
        return self.pose.depth

    in_space = OldName("is_three_dimensional")

    @property
    def is_three_dimensional(self) -> bool:
        """Whether the tissue is three-dimensional, so that the tool may move sideways."""
        if self.skin is not None:
            return not self.skin.is_axisymmetric
        return self.fields is not None and self.fields.displacement().shape[1] == 3

    @property
    def drawable_fields(self) -> DrawableFields | None:
        """Fields for a coloured picture; None if the solver has no fields, or fields without a geometry."""
        return get_drawable_fields_or_none(self.fields)

    @property
    def node_positions(self) -> np.ndarray:
        """Deformed positions of the nodes in the frame of the scene, height last, m, shape (nodes, 2) or (nodes, 3).

        Raises:
            InputError: the solver has no fields, or fields without a geometry.
        """
        fields = self.drawable_fields
        if fields is None:
            raise InputError("this solver has no fields with a geometry, and no node positions. Draw its surface")
        positions = fields.geometry().nodes + fields.displacement()
        positions[:, -1] -= self.datum
        return positions

    def arrays(self) -> tuple[np.ndarray, ...]:
        """Return the arrays that differ between snapshots of one tissue; empty if the fields cannot share data."""
        if self.skin is not None:
            return (self.skin.vertices,)
        return self.fields.arrays() if _has_shared_fields_interface(self.fields) else ()

    def with_pose_and_arrays(self, pose: Pose, datum: float, arrays: Sequence[np.ndarray]) -> Snapshot:
        """Make a snapshot of the same tissue at another equilibrium from the `arrays` of that snapshot."""
        fields, skin = self.fields, self.skin
        if skin is not None:
            skin = replace(skin, vertices=arrays[0])
        elif _has_shared_fields_interface(fields):
            fields = fields.with_arrays(arrays)
        return Snapshot(pose, datum, fields, skin)

    def material_data(self) -> dict[str, Any]:
        """Return name -> data, other than `arrays`, that change with the parameters of the material."""
        return self.fields.material_data() if _has_shared_fields_interface(self.fields) else {}

    def with_material(self, changed: Mapping[str, Any]) -> Snapshot:
        """Return this snapshot with the data of `material_data` of another material."""
        fields = self.fields
        return replace(self, fields=fields.with_material(changed)) if _has_shared_fields_interface(fields) else self


def _has_shared_fields_interface(fields: Any) -> TypeGuard[SharedFields]:
    """Return whether an object has the methods of `SharedFields`, without isinstance, which takes longer."""
    kind: Any = type(fields)
    return has_shared_fields_interface(kind)


@runtime_checkable
class DisplayableTissue(Tissue, Protocol):
    """Tissue that can be displayed between its steps: a `Simulator` or an equivalent."""

    def snapshot(self) -> Snapshot:
        """Return a snapshot of the last equilibrium."""


def snapshot(solver: Solver) -> Snapshot:
    """Make a snapshot of the last committed state of a solver."""
    fields, skin = solver.fields([solver.field_sample()]), None
    if get_drawable_fields_or_none(fields) is None:
        surface = solver.deformed_surface()
        vertices, triangles = surface.triangles()
        skin = TriangulatedSurface(np.asarray(vertices, dtype=float).reshape(-1, 3),
                                   np.asarray(triangles).reshape(-1, 3), surface.outline is not None)
    return Snapshot(solver.pose, solver.datum, fields, skin)
