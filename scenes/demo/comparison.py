"""Compare a predicted test with its measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import tissue_sim as ts
from tissue_sim.experiment.kinds.kind import TestKind


@dataclass(frozen=True, eq=False)
class PredictionWithMeasuredReplicates:
    """Predicted force curve of a test and its measured replicates.

    Attributes:
        kind: kind of the test.
        measured: replicates, all at the same displacements.
        predicted: prediction with the calibrated material at these displacements.
    """

    kind: TestKind
    measured: list[ts.Recording]
    predicted: ts.Recording

    @property
    def mean_measured_force(self) -> np.ndarray:
        """Mean measured force, N, shape (samples,)."""
        return np.mean([recording.force for recording in self.measured], axis=0)

    @property
    def prediction_minus_mean_measured_force(self) -> np.ndarray:
        """Predicted force less mean measured force, N, shape (samples,)."""
        return self.predicted.force - self.mean_measured_force

    @property
    def force_prediction_rmse(self) -> float:
        """Root mean square of `prediction_minus_mean_measured_force` over the curve, N."""
        return float(np.sqrt(np.mean(self.prediction_minus_mean_measured_force**2)))
