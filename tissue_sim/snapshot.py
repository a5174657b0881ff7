"""The whole tissue at one moment, for programs that draw more than its surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.pose import Pose

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver


@dataclass(frozen=True, eq=False)
class Snapshot:
    """An equilibrium.

    Attributes:
        pose: of the tool.
        datum: height at which the tool first touches, m: 0 but for a specimen that sags under its own weight.
        fields: of this one sample.
    """

    pose: Pose
    datum: float
    fields: Fields

    @property
    def depth(self) -> float:
        """Tool displacement, m."""
        return self.pose.depth

    @property
    def place(self) -> np.ndarray:
        """Where the nodes are (r, z), m, in the frame of the scene, shape (nodes, 2)."""
        return self.fields.mesh.nodes + self.fields.displacement() - [0.0, self.datum]


def snapshot(solver: AxisymmetricSolver) -> Snapshot:
    """The last committed state of a solver."""
    stresses = [solver.memory.total()] if solver.memory.works else []
    return Snapshot(Pose.at_depth(solver.depth), solver.datum, Fields.of(solver, [solver.state], stresses))
