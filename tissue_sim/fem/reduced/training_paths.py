"""Training and test paths of the tool in the box of poses of a reduced solid.

On the path of a tool that can lift off, the tool indents the tissue, is dragged and rotated to a second pose and lifts
off. A bonded tool moves through two poses and returns to its start. The poses of path n are point n of the Sobol
sequence (Joe and Kuo, SIAM J. Sci. Comput. 30 (2008) 2635; in SciPy), so that the paths are reproducible.

Points of the Sobol sequence do not lie on the boundary of the box. The boundary paths do: one at each corner and one at
the midpoint of each edge, at the full depth of the box.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from tissue_sim.fem.reduced.model import PoseBox
from tissue_sim.fem.reduced.settings import TrainingPathDepthAndStepSettings
from tissue_sim.pose import Pose, compute_rigid_motion, interpolate_pose, rotate_pose_about_its_position

#: Dimension of the Sobol sequence: two poses, each of position (3) and rotation (3).
_DIMENSION = 12
_PATHS = TrainingPathDepthAndStepSettings()


def make_training_path(number: int, box: PoseBox, start: Pose, *, holds: bool, reach: float) -> list[Pose]:
    """Return the poses of a training path, at most one step apart.

    Args:
        number: number of the path in the Sobol sequence, from 0.
        box: box of poses relative to `start`.
        start: first pose of the tool.
        holds: whether the tool is bonded to the tissue from the start.
        reach: contact radius, m.
    """
    from scipy.stats import qmc

    coordinates = qmc.Sobol(_DIMENSION, scramble=False).fast_forward(number + 1).random(1)[0]
    first, second = (_map_coordinates_to_box_pose(part, box, start, holds)
                     for part in (coordinates[:6], coordinates[6:]))
    if holds:
        corners = [start, first, second, start]
    else:
        above = _move_vertically_to_depth(first, start, 0.0)
        corners = [_move_vertically_to_depth(first, start, -0.1 * box.depth), above, first, second,
                   _move_vertically_to_depth(second, start, 0.0)]
    return _interpolate_path(corners, reach)


def make_boundary_training_paths(box: PoseBox, start: Pose, *, holds: bool, reach: float,
                                 images: Sequence[np.ndarray] = (), fraction: float = 1.0) -> list[list[Pose]]:
    """Return the poses of the training paths along the boundary of a box, in order of corners and edges.

    At a corner the tool indents to the full depth, tilts outward by the largest rotation of the box and is dragged
    along an edge. At the midpoint of an edge the tool indents, tilts outward and is dragged to the centre of the box.

    Args:
        box: box of poses relative to `start`.
        start: first pose of the tool.
        holds: whether the tool is bonded to the tissue from the start.
        reach: contact radius, m.
        images: matrices of the symmetries, shape (3, 3) each. Only the first of several symmetric paths is returned.
        fraction: factor on the sizes of the box; below 1 the paths stay inside the box.
    """
    small = PoseBox(fraction * box.sideways, fraction * box.depth, fraction * box.turn)
    paths = []
    for corner, goal in _iterate_boundary_points_and_goals(box.sideways + box.turn > 0.0, images):
        lean = (-small.turn * corner[1] / math.hypot(*corner), small.turn * corner[0] / math.hypot(*corner), 0.0) \
            if any(corner) else (0.0, 0.0, 0.0)
        upright, end = (_make_deepest_pose(small, start, point) for point in (corner, goal))
        leaning = rotate_pose_about_its_position(upright, lean)
        corners = [start, upright, leaning, end, start] if holds else [
            _move_vertically_to_depth(upright, start, -0.1 * box.depth), _move_vertically_to_depth(upright, start, 0.0),
            upright, leaning,
            end, _move_vertically_to_depth(end, start, 0.0)]
        paths.append(_interpolate_path(corners, reach))
    return paths


def make_reversing_paths(box: PoseBox, start: Pose, *, reach: float, images: Sequence[np.ndarray] = (),
                         fraction: float = 1.0) -> list[list[Pose]]:
    """Return paths on which the tool moves obliquely to the boundary of a box and back along the same line.

    The lateral motion reverses in contact, which reverses the friction. The paths lead from above the start to the full
    depth at each corner and at the midpoint of each edge; the arguments are those of `make_boundary_training_paths`.
    """
    small = PoseBox(fraction * box.sideways, fraction * box.depth)
    return [_interpolate_path([_move_vertically_to_depth(start, start, -0.1 * box.depth), start,
                               _make_deepest_pose(small, start, point), start], reach)
            for point, _ in _iterate_boundary_points_and_goals(box.sideways > 0.0, images)]


def _iterate_boundary_points_and_goals(is_wide: bool, images: Sequence[np.ndarray]
                                       ) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield pairs of an indentation point, a corner or edge midpoint of a square, and the goal of the drag there.

    Coordinates are -1, 0 or 1. A box without width has only its centre.
    """
    if not is_wide:
        yield (0, 0), (0, 0)
        return
    seen: set[tuple[int, int]] = set()
    for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 0), (0, 1), (-1, 0), (0, -1)):
        if (x, y) not in seen:
            seen |= {(round(a), round(b)) for a, b, _ in (matrix @ (x, y, 0.0) for matrix in images)}
            yield (x, y), ((x, 0) if x * y else (0, 0))


def _make_deepest_pose(box: PoseBox, start: Pose, point: tuple[int, int]) -> Pose:
    """Return the upright pose at the full depth of the box; `point`: lateral position over `box.sideways`."""
    x, y, z = start.position
    return Pose((x + box.sideways * point[0], y + box.sideways * point[1], z - box.depth), start.orientation)


def _interpolate_path(corners: Sequence[Pose], reach: float) -> list[Pose]:
    """Return poses along straight motions between corner poses.

    The largest distance of two poses is `TrainingPathDepthAndStepSettings.step`.
    """
    poses = [corners[0]]
    for one, other in pairwise(corners):
        x, y, z, *turn = compute_rigid_motion(one, other)
        count = math.ceil((math.hypot(x, y, z) + reach * math.hypot(*turn)) / (_PATHS.step * reach) - 1e-9)
        poses += [interpolate_pose(one, other, (k + 1) / count) for k in range(count)]
    return poses


def _map_coordinates_to_box_pose(coordinates: np.ndarray, box: PoseBox, start: Pose, holds: bool) -> Pose:
    """Return the pose of the box with these normalised coordinates, 0 to 1, shape (6,)."""
    x, y, z, angle, a, b = coordinates
    least = 0.0 if holds else _PATHS.min_depth
    depth = box.depth * (least + (1.0 - least) * z)
    x0, y0, z0 = start.position
    position = (x0 + box.sideways * (2.0 * x - 1.0), y0 + box.sideways * (2.0 * y - 1.0), z0 - depth)
    # The rotation axis is uniform on the sphere; `angle` scales the rotation about it.
    height, around = 2.0 * a - 1.0, 2.0 * math.pi * b
    flat = math.sqrt(max(0.0, 1.0 - height * height))
    size = box.turn * angle
    vector = (size * flat * math.cos(around), size * flat * math.sin(around), size * height)
    return rotate_pose_about_its_position(Pose(position, start.orientation), vector)


def _move_vertically_to_depth(pose: Pose, start: Pose, depth: float) -> Pose:
    """Return a copy of a pose moved vertically to another depth below `start`, m."""
    x, y, _ = pose.position
    return Pose((x, y, start.position[2] - depth), pose.orientation)
