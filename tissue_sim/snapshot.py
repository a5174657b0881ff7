"""The whole tissue at one moment, for programs that draw more than its surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.solver import Fields, Solver
from tissue_sim.pose import Pose
from tissue_sim.tool_force import Tissue


@dataclass(frozen=True, eq=False)
class Snapshot:
    """An equilibrium.

    Attributes:
        pose: of the tool.
        datum: height at which the tool first touches, m: 0 but for a specimen that sags under its own weight.
        fields: of this one sample; None of a tissue that has none.
    """

    pose: Pose
    datum: float
    fields: Fields | None

    @property
    def depth(self) -> float:
        """Tool displacement, m."""
        return self.pose.depth

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


@runtime_checkable
class ShownTissue(Tissue, Protocol):
    """A tissue that others may look at between its steps: a `Simulator`, or what stands in for one."""

    def snapshot(self) -> Snapshot:
        """The whole tissue at the last equilibrium, with its fields."""


def snapshot(solver: Solver) -> Snapshot:
    """The last committed state of a solver."""
    return Snapshot(solver.pose, solver.datum, solver.fields([solver.sample()]))
