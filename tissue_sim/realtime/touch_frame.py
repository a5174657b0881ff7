"""Poses of a bonded tool relative to the pose of its first touch."""

from __future__ import annotations

from dataclasses import replace

from tissue_sim.pose import Pose, compute_rigid_motion, interpolate_pose, rotate_pose_about_its_position


class TouchFrame:
    """Map poses in the scene to poses of a bulk whose mesh was made for one pose of first touch.

    A bonded tool adheres to the tissue at the pose of its first touch. The bulk is the same for all positions of the
    touch, because the tissue is assumed to be wide. The motion since the touch is therefore applied to the pose for
    which the bulk was made, and a touch at another position or inclination causes no shear.

    Args:
        start: pose of first touch for which the bulk was made.
        touch: actual pose of first touch.
    """

    def __init__(self, start: Pose, touch: Pose):
        self._start, self._touch = start, touch
        self._is_identity = start == touch

    def pose_in_bulk(self, pose: Pose) -> Pose:
        """Convert a pose in the scene to the frame of the bulk."""
        return pose if self._is_identity else _apply_motion_between_poses(self._touch, pose, self._start)

    def pose_in_scene(self, pose: Pose) -> Pose:
        """Convert a pose in the frame of the bulk to the scene."""
        return pose if self._is_identity else _apply_motion_between_poses(self._start, pose, self._touch)


def interpolate_pose_at_surface(before: Pose | None, pose: Pose, height: float) -> Pose:
    """Interpolate the pose, between two steps, at which a tool reaches the height of a tissue's surface.

    Args:
        before: last pose in the air; None if the first step is in the tissue, which counts as a vertical approach.
        pose: pose at or below the surface.
        height: height of the surface, m.
    """
    touch = pose
    if before is not None and before.position[2] > height:
        above = before.position[2] - height
        touch = interpolate_pose(before, pose, above / (before.position[2] - pose.position[2]))
    return replace(touch, position=(*touch.position[:2], height))


def _apply_motion_between_poses(start: Pose, end: Pose, other: Pose) -> Pose:
    """Return the pose `other`, moved by the translation and rotated by the rotation from `start` to `end`."""
    x, y, z, *rotation = compute_rigid_motion(start, end)
    a, b, c = other.position
    moved = Pose((a + x, b + y, c + z), other.orientation)
    u, v, w = rotation
    return rotate_pose_about_its_position(moved, (u, v, w))
