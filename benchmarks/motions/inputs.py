"""Arguments of `step` that must be refused, and orientations that must not."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tissue_sim.pose import Pose

#: Not a number.
NAN = math.nan
#: Infinity.
INF = math.inf


def bad_poses(chance: np.random.Generator, pose: Pose) -> list[tuple[Any, Any]]:
    """Return poses and time steps that contain a number that is not finite."""
    bad = float(chance.choice([NAN, INF, -INF]))
    place, quaternion = int(chance.integers(3)), int(chance.integers(4))
    x = list(pose.position)
    x[place] = bad
    q = list(pose.orientation)
    q[quaternion] = bad
    return [(lambda: Pose(tuple(x), pose.orientation), 1e-3), (lambda: Pose(pose.position, tuple(q)), 1e-3),
            (lambda: Pose((bad,) * 3, (bad,) * 4), 1e-3), (pose, bad), (pose, -1e-3), (bad, 1e-3),
            (lambda: Pose(tuple(x), tuple(q)), bad)]


def wild_poses(chance: np.random.Generator, pose: Pose) -> list[tuple[Any, Any]]:
    """Return inputs of the wrong type, poses far outside any scene, and quaternions without unit length."""
    far = float(chance.choice([1e3, 1e12, 1e200, 1.7e308])) * float(chance.choice([-1.0, 1.0]))
    x = list(pose.position)
    x[int(chance.integers(3))] = far
    scale = float(chance.choice([0.0, 0.5, 0.99, 1.01, 2.0, 1e200]))
    return [(lambda: Pose(tuple(x), pose.orientation), 1e-3), (None, 1e-3), ("0.001", 1e-3), (pose, None),
            (lambda: Pose(pose.position, (scale, 0.0, 0.0, 0.0)), 1e-3), ([0.0, 0.0, -1e-3], 1e-3),
            (lambda: Pose(pose.position[:2], pose.orientation), 1e-3), (pose, 1e-3j), (-far, 1e-3)]


def rounded(pose: Pose, chance: np.random.Generator) -> Pose:
    """Return the pose with an orientation of four or five decimals, or with a length error of at most 9e-4.

    Raises:
        InputError: `Pose` refuses it.
    """
    q = [float(value) for value in pose.orientation]
    kind = int(chance.integers(3))
    if kind < 2:
        q = [round(value, 5 - kind) for value in q]
    else:
        q = [value * (1.0 + float(chance.uniform(-9e-4, 9e-4))) for value in q]
    return Pose(pose.position, (q[0], q[1], q[2], q[3]))
