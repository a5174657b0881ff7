"""Motions of a tool in a box of poses, from which a reduced solid is made and on which it is tried.

A stroke of a tool that can lift off comes down somewhere, presses, is dragged and turned to another place and lifted;
one that holds tissue goes through a few poses and back. The n-th stroke is the same on every computer: its poses are
those of Sobol's sequence (Joe and Kuo, SIAM J. Sci. Comput. 30 (2008) 2635, in SciPy).
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from tissue_sim.fem.reduced.model import PoseBox
from tissue_sim.pose import Pose, between, motion, turned

#: Dimensions of the sequence: two poses of place, depth and turn.
_NUMBERS = 12
#: A pressed tool is at least so deep, in depths of the box; a step goes at most this share of the contact's reach.
_LEAST_DEPTH, _STEP = 0.15, 1.0 / 16.0


def stroke(number: int, box: PoseBox, start: Pose, *, holds: bool, reach: float) -> list[Pose]:
    """Poses of a stroke, a step apart.

    Args:
        number: which, from 0 on.
        box: of poses, beside `start`.
        holds: whether the tool holds tissue from the start.
        reach: of the contact, m.
    """
    from scipy.stats import qmc

    shares = qmc.Sobol(_NUMBERS, scramble=False).fast_forward(number + 1).random(1)[0]
    first, second = (_pose(part, box, start, holds) for part in (shares[:6], shares[6:]))
    if holds:
        corners = [start, first, second, start]
    else:
        above = _beside(first, start, 0.0)
        corners = [_beside(first, start, -0.1 * box.depth), above, first, second, _beside(second, start, 0.0)]
    poses = [corners[0]]
    for one, other in pairwise(corners):
        x, y, z, *turn = motion(one, other)
        count = math.ceil((math.hypot(x, y, z) + reach * math.hypot(*turn)) / (_STEP * reach) - 1e-9)
        poses += [between(one, other, (k + 1) / count) for k in range(count)]
    return poses


def _pose(shares: np.ndarray, box: PoseBox, start: Pose, holds: bool) -> Pose:
    """A pose of the box, as six numbers from 0 to 1 say."""
    x, y, z, angle, a, b = shares
    least = 0.0 if holds else _LEAST_DEPTH
    depth = box.depth * (least + (1.0 - least) * z)
    x0, y0, z0 = start.position
    place = (x0 + box.sideways * (2.0 * x - 1.0), y0 + box.sideways * (2.0 * y - 1.0), z0 - depth)
    # A direction on the sphere, and how far about it.
    height, around = 2.0 * a - 1.0, 2.0 * math.pi * b
    flat = math.sqrt(max(0.0, 1.0 - height * height))
    size = box.turn * angle
    vector = (size * flat * math.cos(around), size * flat * math.sin(around), size * height)
    return turned(Pose(place, start.orientation), vector)


def _beside(pose: Pose, start: Pose, depth: float) -> Pose:
    """The same pose at another depth, m."""
    x, y, _ = pose.position
    return Pose((x, y, start.position[2] - depth), pose.orientation)
