"""What a committed state of a solid leaves behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.pose import Pose


@dataclass(frozen=True, eq=False)
class Sample:
    """Of what is drawn: displacements, m, shape (nodes, 3), pressure amplitudes, Pa, (elements, modes), and the
    isochoric stresses of its memory where it has one; see `SolidFields`."""

    displacement: np.ndarray
    pressures: np.ndarray
    stresses: np.ndarray | None


@dataclass(frozen=True, eq=False)
class SavedState:
    """Of all that the next step depends on; see `SolidSolver.save`."""

    arrays: tuple[np.ndarray, ...]
    pose: Pose
    largest_force: float
