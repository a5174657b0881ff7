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
    """State on which the next step depends; see `SolidSolver.save`.

    Attributes:
        start: pose of the tool at its first touch, for which the mesh was made; None: the place of the model.
    """

    arrays: tuple[np.ndarray, ...]
    pose: Pose
    largest_force: float
    start: Pose | None = None
