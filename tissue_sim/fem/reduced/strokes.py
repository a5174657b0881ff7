"""Motions of a tool in a box of poses, from which a reduced solid is made and on which it is tried.

A stroke of a tool that can lift off comes down somewhere, presses, is dragged and turned to another place and lifted;
one that holds tissue goes through a few poses and back. The n-th stroke is the same on every computer: its poses are
those of Sobol's sequence (Joe and Kuo, SIAM J. Sci. Comput. 30 (2008) 2635, in SciPy).

Points of a sequence do not lie on the boundary of the box. The boundary strokes do: one at each corner and one at the
middle of each edge, at the full depth of the box.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
    return _stepped(corners, reach)


def boundary_strokes(box: PoseBox, start: Pose, *, holds: bool, reach: float,
                     images: Sequence[np.ndarray] = (), fraction: float = 1.0) -> list[list[Pose]]:
    """Poses of the strokes along the boundary of a box, in order of the corners and edges.

    At a corner the tool is pressed to the full depth, leans outward by the box's turn and is dragged along an edge; at
    the middle of an edge it is pressed to the full depth, leans outward and is dragged to the middle of the box.

    Args:
        box: of poses, relative to `start`.
        start: of the tool.
        holds: whether the tool holds tissue from the start.
        reach: of the contact, m.
        images: matrices of symmetries, shape (3, 3) each; of corners that are images of each other the first is used.
        fraction: of the box's sizes; below 1 the strokes stay inside of it.
    """
    small = PoseBox(fraction * box.sideways, fraction * box.depth, fraction * box.turn)
    strokes = []
    for corner, goal in _boundary(box.sideways + box.turn > 0.0, images):
        lean = (-small.turn * corner[1] / math.hypot(*corner), small.turn * corner[0] / math.hypot(*corner), 0.0) \
            if any(corner) else (0.0, 0.0, 0.0)
        upright, end = (_at(small, start, where) for where in (corner, goal))
        leaning = turned(upright, lean)
        corners = [start, upright, leaning, end, start] if holds else [
            _beside(upright, start, -0.1 * box.depth), _beside(upright, start, 0.0), upright, leaning, end,
            _beside(end, start, 0.0)]
        strokes.append(_stepped(corners, reach))
    return strokes


def _boundary(is_wide: bool, images: Sequence[np.ndarray]) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Corners and middles of edges of a square, each with where the tool is dragged; the middle alone of a box that is
    not wide."""
    if not is_wide:
        yield (0, 0), (0, 0)
        return
    seen: set[tuple[int, int]] = set()
    for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 0), (0, 1), (-1, 0), (0, -1)):
        if (x, y) not in seen:
            seen |= {(round(a), round(b)) for a, b, _ in (matrix @ (x, y, 0.0) for matrix in images)}
            yield (x, y), ((x, 0) if x * y else (0, 0))


def _at(box: PoseBox, start: Pose, place: tuple[int, int]) -> Pose:
    """A pose at full depth, its x and y in units of the box's width."""
    x, y, z = start.position
    return Pose((x + box.sideways * place[0], y + box.sideways * place[1], z - box.depth), start.orientation)


def _stepped(corners: Sequence[Pose], reach: float) -> list[Pose]:
    """Poses on straight lines between some, a step apart."""
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
