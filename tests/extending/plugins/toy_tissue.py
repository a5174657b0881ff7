"""A tissue that knows all six directions: a full 6 x 6 spring, whose foot slides along the surface."""

import math
from functools import cache

import numpy as np

from tissue_sim.pose import Pose, compute_rigid_motion
from tissue_sim.tool_force import ForceStatus, ToolForce

#: N: the lateral force that the foot bears.
GRIP = 0.8


@cache
def stiffness():
    """Symmetric and positive definite, no entry zero; N/m, N, N m."""
    mixed = np.random.default_rng(4).normal(size=(6, 6)) + 3.0 * np.eye(6)
    scale = np.array([10.0, 10.0, 15.0, 0.1, 0.1, 0.1])
    full = scale[:, None] * (mixed @ mixed.T) * scale
    assert np.linalg.eigvalsh(full).min() > 0.0 and np.abs(full).min() > 0.0
    return full


class ToyTissue:
    """Pushes back by the spring from its foot, which gives way sideways where the lateral force would exceed `GRIP`.

    The stiffness that it answers is that of the spring: the one that the tool feels during unloading.
    """

    def __init__(self, grip=GRIP):
        self._grip = grip
        self._rows = tuple(map(tuple, stiffness().tolist()))
        self.reset()

    def reset(self):
        self.foot, self.slips = np.zeros(2), 0

    def step(self, pose, dt):
        wrench = self._wrench(pose)
        lateral = wrench[:2]
        size = math.hypot(*lateral)
        if size > self._grip:
            self.foot += np.linalg.solve(stiffness()[:2, :2], lateral * (self._grip / size - 1.0))
            self.slips += 1
            wrench = self._wrench(pose)
        return ToolForce(tuple(wrench.tolist()), self._rows, ForceStatus.CONVERGED, iterations=1, pose=pose)

    def _wrench(self, pose):
        foot = Pose((*self.foot.tolist(), 0.0))
        return -stiffness() @ np.array(compute_rigid_motion(foot, pose))
