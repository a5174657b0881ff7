"""Motion of the upper grip of a specimen that rigid grips hold at both ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.pose import Pose, Screw, Vector, compute_rigid_motion


@dataclass(frozen=True)
class GripMotion:
    """Motion of the upper grip: translation along an axis, or rotation about an axis through the centre of the top.

    The lower grip is at rest. The finite elements bond the ends of the specimen to the grips. The load is the force, or
    the torque, that the specimen opposes to the motion.

    Attributes:
        axis: unit vector in the frame of the scene; z is the axis of the specimen.
        is_rotation: whether the grip rotates, so that the protocol prescribes angles and the load is a torque.

    Examples:
        >>> AXIAL_PULL.pose(0.002).position
        (0.0, 0.0, 0.002)
        >>> AXIAL_PULL.compute_force_against_motion((0.0, 0.0, -3.0, 0.0, 0.0, 0.0))
        3.0
    """

    axis: Vector
    is_rotation: bool = False

    def pose(self, amount: float) -> Pose:
        """Return the pose of the grip after a displacement, m, or an angle, rad."""
        if not self.is_rotation:
            x, y, z = (amount * part for part in self.axis)
            return Pose((x, y, z))
        x, y, z = (math.sin(0.5 * amount) * part for part in self.axis)
        return Pose((0.0, 0.0, 0.0), (math.cos(0.5 * amount), x, y, z))

    def compute_force_against_motion(self, wrench: Screw) -> float:
        """Return minus the component along the axis of the force, N, or of the torque, N m, of a wrench on the grip."""
        return 0.0 - self._project(wrench)

    def compute_amount(self, pose: Pose, near: float) -> float:
        """Return the displacement, m, or the angle, rad, at a pose on the path; an angle within half a turn of `near`.

        This is the inverse of `pose`.
        """
        return near + self._project(compute_rigid_motion(self.pose(near), pose))

    def _project(self, screw: Screw) -> float:
        """Return the component along the axis of the translation, or of the rotation, of a screw."""
        vector = screw[3:] if self.is_rotation else screw[:3]
        return sum(one * other for one, other in zip(self.axis, vector, strict=True))


#: The upper grip moves away from the lower one.
AXIAL_PULL = GripMotion((0.0, 0.0, 1.0))
#: The upper grip moves along x at constant distance.
LATERAL_SHIFT = GripMotion((1.0, 0.0, 0.0))
#: The upper grip rotates about the axis at constant distance.
TWIST = GripMotion((0.0, 0.0, 1.0), is_rotation=True)
