"""The whole tissue at one moment, for programs that draw more than its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.solver import Fields, Solver
from tissue_sim.pose import Pose


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
        """Where the nodes are, the height last, m, in the frame of the scene, shape (nodes, 2) or (nodes, 3)."""
        place = self.fields.mesh.nodes + self.fields.displacement()
        place[:, -1] -= self.datum
        return place


def snapshot(solver: Solver) -> Snapshot:
    """The last committed state of a solver."""
    return Snapshot(solver.pose, solver.datum, solver.fields([solver.sample()]))
