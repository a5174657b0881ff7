"""The whole tissue at one moment, for programs that draw more than its surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tissue_sim.fem.axisymmetric.fields import Fields

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver


@dataclass(frozen=True, eq=False)
class Snapshot:
    """An equilibrium.

    Attributes:
        depth: tool displacement, m.
        datum: height at which the tool first touches, m: 0 but for a specimen that sags under its own weight.
        fields: of this one sample.
    """

    depth: float
    datum: float
    fields: Fields

    @property
    def place(self) -> np.ndarray:
        """Where the nodes are (r, z), m, in the frame of the scene, shape (nodes, 2)."""
        return self.fields.mesh.nodes + self.fields.displacement() - [0.0, self.datum]


def snapshot(solver: AxisymmetricSolver) -> Snapshot:
    """The last committed state of a solver."""
    stresses = [solver.memory.total()] if solver.memory.works else []
    return Snapshot(solver.depth, solver.datum, Fields.of(solver, [solver.state], stresses))
