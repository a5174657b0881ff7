"""Broyden (secant) correction of the stiffness of a linearised bulk, learned from successive models."""

from __future__ import annotations

from typing import cast

import numpy as np

from tissue_sim.pose import Pose, Screw, motion
from tissue_sim.tool_force import Matrix

#: Relaxation factor of the secant update; about half of a difference belongs to motions that are not repeated.
_RELAXATION = 0.5
#: Shortest motion from which the correction is learned, as a fraction of the contact radius.
_MIN_MOTION = 0.01


class BroydenCorrection:
    """Correction of the stiffness that linearised models omit, by relaxed secant updates.

    The update for a motion s with the difference of wrenches y is R += c (y - R s) s^T W^2 / (s^T W^2 s) with the
    relaxation factor c and the weights W of `radius` (Broyden, Math. Comp. 19 (1965) 577).

    Args:
        radius: radius of the contact, m, which converts rotations to displacements.

    Attributes:
        rates: derivative R of the omitted wrench with respect to the motion of the tool, N/m, N, N m, shape (6, 6).
    """

    def __init__(self, radius: float):
        self._scale = np.array([1.0, 1.0, 1.0, radius, radius, radius])
        self._min_square = (_MIN_MOTION * radius) ** 2
        self.rates = np.zeros((6, 6))

    def reset(self) -> None:
        """Set the correction to zero."""
        self.rates[:] = 0.0

    def learn(self, missed: Screw, last: Pose, pose: Pose) -> None:
        """Update the correction with the difference of two models.

        Args:
            missed: wrench of the new model minus that of the last model, N and N m.
            last: pose of the last model.
            pose: pose of the new model.
        """
        step = np.array(motion(last, pose))
        scaled = self._scale * step
        square = float(scaled @ scaled)
        if square > self._min_square:
            residual = np.array(missed) - self.rates @ step
            self.rates += _RELAXATION / square * np.outer(residual, self._scale * scaled)

    def wrench(self, model: Pose, pose: Pose) -> Screw:
        """Return the wrench that a model omits at another pose, N and N m.

        Args:
            model: pose of the model.
            pose: pose of the tool.
        """
        return cast("Screw", tuple((self.rates @ np.array(motion(model, pose))).tolist()))

    def corrected_stiffness(self, of_model: Matrix) -> Matrix:
        """Return the stiffness of a model with the correction, shape (6, 6)."""
        return cast("Matrix", tuple(map(tuple, (np.array(of_model) - self.rates).tolist())))
