"""Broyden (secant) correction of the stiffness of a linearised bulk, learned from successive models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from tissue_sim.pose import Pose, Screw, compute_rigid_motion
from tissue_sim.tool_force import Matrix


@dataclass(frozen=True)
class BroydenSettings:
    """Settings of the secant update, chosen by this project.

    Attributes:
        relaxation: relaxation factor of the update. About half of a difference belongs to motions that are not
            repeated; a larger factor learns faster and follows these motions more.
        min_motion: shortest motion from which the correction is learned, as a fraction of the contact radius. A smaller
            motion amplifies the errors of the models.
    """

    relaxation: float = 0.5
    min_motion: float = 0.01


#: Settings of every correction.
BROYDEN = BroydenSettings()


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
        self._min_square = (BROYDEN.min_motion * radius) ** 2
        self.rates = np.zeros((6, 6))

    def reset(self) -> None:
        """Set all rates to zero, so that the correction no longer changes wrench and stiffness."""
        self.rates[:] = 0.0

    def apply_secant_update(self, missed: Screw, last: Pose, pose: Pose) -> None:
        """Update the rates with the difference of two models, unless the motion between them is too short.

        Args:
            missed: wrench of the new model minus that of the last model, N and N m.
            last: pose of the last model.
            pose: pose of the new model.
        """
        step = np.array(compute_rigid_motion(last, pose))
        scaled = self._scale * step
        square = float(scaled @ scaled)
        if square > self._min_square:
            residual = np.array(missed) - self.rates @ step
            self.rates += BROYDEN.relaxation / square * np.outer(residual, self._scale * scaled)

    def reduce_for_new_tangent(self, before: float, after: float, between: float) -> None:
        """Reduce the rates when a model has a new tangent, which includes a part of the stiffness that they describe.

        The stiffness that a tangent omits grows in proportion to the distance from its pose. The rates were learned at
        the distance of a model from its tangent plus half of the motion between two models.

        Args:
            before: distance between the poses of the old model and of its tangent, m.
            after: distance between the poses of the new model and of its tangent, m.
            between: distance between the poses of the two models, m.
        """
        if after < before:
            self.rates *= (after + 0.5 * between) / (before + 0.5 * between)

    def compute_omitted_wrench(self, model: Pose, pose: Pose) -> Screw:
        """Return the wrench to add to that of a model at another pose, N and N m: the rates times the motion.

        Args:
            model: pose of the model.
            pose: pose of the tool.
        """
        return cast("Screw", tuple((self.rates @ np.array(compute_rigid_motion(model, pose))).tolist()))

    def subtract_correction_from_stiffness(self, of_model: Matrix) -> Matrix:
        """Return the stiffness `of_model` of a model minus the learned rates: N/m, N, N m, shape (6, 6)."""
        return cast("Matrix", tuple(map(tuple, (np.array(of_model) - self.rates).tolist())))
