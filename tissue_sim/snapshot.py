"""The whole tissue at one moment, for programs that draw more than its surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.solver import Fields, SharedFields, Solver
from tissue_sim.pose import Pose
from tissue_sim.tool_force import Tissue


@dataclass(frozen=True, eq=False)
class Skin:
    """The triangles of a surface.

    Attributes:
        vertices: in the frame of the scene, m, shape (vertices, 3).
        triangles: vertex numbers, shape (triangles, 3); they stay as they are.
    """

    vertices: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True, eq=False)
class Snapshot:
    """An equilibrium.

    Attributes:
        pose: of the tool.
        datum: height at which the tool first touches, m: 0 but for a specimen that sags under its own weight.
        fields: of this one sample; None of a tissue that has none.
        skin: the surface, of a tissue in space whose fields cannot be drawn.
    """

    pose: Pose
    datum: float
    fields: Fields | None
    skin: Skin | None = None

    @property
    def depth(self) -> float:
        """Tool displacement, m."""
        return self.pose.depth

    @property
    def in_space(self) -> bool:
        """Whether the tissue has no axis, so that the tool may go aside."""
        return self.skin is not None or (self.fields is not None and _mesh_in_space(self.fields))

    @property
    def place(self) -> np.ndarray:
        """Where the nodes are, the height last, m, in the frame of the scene, shape (nodes, 2) or (nodes, 3).

        Raises:
            InputError: a tissue that has no fields.
        """
        if self.fields is None:
            raise InputError("this solver has no fields, so nobody knows where its nodes are; draw its surface")
        place = self.fields.mesh.nodes + self.fields.displacement()
        place[:, -1] -= self.datum
        return place

    def arrays(self) -> tuple[np.ndarray, ...]:
        """What is another one in another snapshot of this tissue, beside pose and datum; empty where nothing is."""
        if self.skin is not None:
            return (self.skin.vertices,)
        return self.fields.arrays() if _are_shared(self.fields) else ()

    def at(self, pose: Pose, datum: float, arrays: Sequence[np.ndarray]) -> Snapshot:
        """Another snapshot of this tissue, with its `arrays`."""
        fields, skin = self.fields, self.skin
        if skin is not None:
            skin = replace(skin, vertices=arrays[0])
        elif _are_shared(fields):
            fields = fields.with_arrays(arrays)
        return Snapshot(pose, datum, fields, skin)

    def of_the_material(self) -> dict[str, Any]:
        """What another material of the same make changes beside the arrays."""
        return self.fields.of_the_material() if _are_shared(self.fields) else {}

    def with_material(self, changed: Mapping[str, Any]) -> Snapshot:
        """This snapshot with what `of_the_material` of another material gave."""
        fields = self.fields
        return replace(self, fields=fields.with_material(changed)) if _are_shared(fields) else self


def _are_shared(fields: Any) -> TypeGuard[SharedFields]:
    # Asking the protocol each time costs more than all else that is done with a snapshot.
    kind: Any = type(fields)
    return _is_shared(kind)


@cache
def _is_shared(kind: Any) -> bool:
    return all(hasattr(kind, name) for name in ("arrays", "with_arrays", "of_the_material", "with_material"))


@runtime_checkable
class ShownTissue(Tissue, Protocol):
    """A tissue that others may look at between its steps: a `Simulator`, or what stands in for one."""

    def snapshot(self) -> Snapshot:
        """The whole tissue at the last equilibrium, with its fields."""


def snapshot(solver: Solver) -> Snapshot:
    """The last committed state of a solver."""
    surface, skin = solver.surface(), None
    fields = solver.fields([solver.sample()])
    if surface.outline is None and not (_are_shared(fields) and _mesh_in_space(fields)):
        vertices, triangles = surface.triangles()
        skin = Skin(np.asarray(vertices, dtype=float).reshape(-1, 3), np.asarray(triangles).reshape(-1, 3))
    return Snapshot(solver.pose, solver.datum, fields, skin)


def _mesh_in_space(fields: Fields) -> bool:
    """Whether fields belong to elements in space, with the sides that are their surface; see `SolidMesh`."""
    mesh = fields.mesh
    return hasattr(mesh, "faces") and mesh.nodes.shape[1] == 3
