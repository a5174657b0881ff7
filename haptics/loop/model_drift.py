"""How the forces of successive models of a bulk go apart with the way of the tool, and what the newest will miss."""

from __future__ import annotations

from typing import cast

import numpy as np

from tissue_sim.pose import Pose, Screw, motion
from tissue_sim.tool_force import Matrix

#: Share of what is new that is believed: half of it is of a way that the tool does not go again.
_BELIEVED = 0.5
#: Ways shorter than this share of the contact's radius say nothing.
_SHORT = 0.01


class ModelDrift:
    """The part of the stiffness that linearisations leave out, by secants (Broyden, Math. Comp. 19 (1965) 577).

    Args:
        radius: of the contact, m: a turn counts as the way of a point so far from the axis.

    Attributes:
        rates: of the wrench with the tool's motion, N/m, N, N m, shape (6, 6).
    """

    def __init__(self, radius: float):
        self._scale = np.array([1.0, 1.0, 1.0, radius, radius, radius])
        self._least = (_SHORT * radius) ** 2
        self.rates = np.zeros((6, 6))

    def forget(self) -> None:
        """Nothing is known."""
        self.rates[:] = 0.0

    def learn(self, missed: Screw, last: Pose, pose: Pose) -> None:
        """Take in by how much a model at a pose differs from the last one."""
        way = np.array(motion(last, pose))
        scaled = self._scale * way
        square = float(scaled @ scaled)
        if square > self._least:
            surprise = np.array(missed) - self.rates @ way
            self.rates += _BELIEVED / square * np.outer(surprise, self._scale * scaled)

    def beyond(self, model: Pose, pose: Pose) -> Screw:
        """What a model at a pose misses where the tool is."""
        return cast("Screw", tuple((self.rates @ np.array(motion(model, pose))).tolist()))

    def stiffness(self, of_model: Matrix) -> Matrix:
        """The whole stiffness, from that of a model."""
        return cast("Matrix", tuple(map(tuple, (np.array(of_model) - self.rates).tolist())))
