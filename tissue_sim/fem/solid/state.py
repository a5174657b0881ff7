"""Saved states and samples of a solid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.pose import Pose


@dataclass(frozen=True, eq=False)
class FieldSample:
    """Committed state from which `SolidSolver.fields` computes fields.

    Attributes:
        displacement: displacement of the nodes, m, shape (nodes, 3).
        pressures: pressure amplitudes of the elements, Pa, shape (elements, modes).
        stresses: isochoric stresses, see `SolidFields.stresses`; None if the material has no history.
    """

    displacement: np.ndarray
    pressures: np.ndarray
    stresses: np.ndarray | None


@dataclass(frozen=True, eq=False)
class SavedState:
    """Copy of everything on which the next step of a solver depends; see `SolidSolver.save`.

    Attributes:
        arrays: copies of the state arrays of solver, contact and material history.
        pose: pose of the tool.
        largest_force: largest force so far, N.
        start: pose of the tool at its first touch, for which the mesh was made; None: the position of the model.
    """

    arrays: tuple[np.ndarray, ...]
    pose: Pose
    largest_force: float
    start: Pose | None = None
