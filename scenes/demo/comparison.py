"""A prediction of the demo beside what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import tissue_sim as ts
from tissue_sim.experiment.kinds.kind import TestKind


@dataclass(frozen=True, eq=False)
class Comparison:
    """A predicted test beside its measurement; forces in N.

    Attributes:
        kind: the test.
        measured: the replicates, all on the same displacements.
        predicted: what the calibrated material gives.
    """

    kind: TestKind
    measured: list[ts.Recording]
    predicted: ts.Recording

    @property
    def mean(self) -> np.ndarray:
        return np.mean([recording.force for recording in self.measured], axis=0)

    @property
    def error(self) -> np.ndarray:
        """Predicted minus mean measured force, N."""
        return self.predicted.force - self.mean

    @property
    def rmse(self) -> float:
        """Of the whole curve, N."""
        return float(np.sqrt(np.mean(self.error**2)))
