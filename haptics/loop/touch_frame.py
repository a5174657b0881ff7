"""Poses of a tool that holds tissue, relative to the pose at which it touched."""

from __future__ import annotations

from dataclasses import replace

from tissue_sim.pose import Pose, between, motion, turned


class TouchFrame:
    """Maps poses in the scene to poses of a bulk whose mesh was made for one pose of first touch.

    A tool that holds tissue holds it from its first touch on, at the pose of that touch. The bulk is the same for each
    place of touch: the tissue is taken to be as wide as the contact needs. So the motion from the touch on is applied
    to the pose for which the bulk was made, and nothing is sheared by a tool that touches elsewhere or leaning.

    Args:
        start: pose of first touch for which the bulk was made.
        touch: pose of the real one.
    """

    def __init__(self, start: Pose, touch: Pose):
        self._start, self._touch = start, touch
        self._is_identity = start == touch

    def into_bulk(self, pose: Pose) -> Pose:
        """The pose for the bulk at a pose in the scene."""
        return pose if self._is_identity else _moved_alike(self._touch, pose, self._start)

    def into_scene(self, pose: Pose) -> Pose:
        """The pose in the scene at a pose for the bulk."""
        return pose if self._is_identity else _moved_alike(self._start, pose, self._touch)


def first_touch(before: Pose | None, pose: Pose, height: float) -> Pose:
    """Pose at which a tool touches the surface of a tissue.

    Args:
        before: the last pose in the air; None: the first step of a tool that is in the tissue. It is then taken to have
            come straight down.
        pose: at or below the surface.
        height: of the surface, m.
    """
    touch = pose
    if before is not None and before.position[2] > height:
        above = before.position[2] - height
        touch = between(before, pose, above / (before.position[2] - pose.position[2]))
    return replace(touch, position=(*touch.position[:2], height))


def _moved_alike(start: Pose, end: Pose, other: Pose) -> Pose:
    """Where another pose goes with the translation and rotation from one pose to the next."""
    x, y, z, *rotation = motion(start, end)
    a, b, c = other.position
    moved = Pose((a + x, b + y, c + z), other.orientation)
    u, v, w = rotation
    return turned(moved, (u, v, w))
