"""Approach of the tool: offset from the axis of the specimen, and angle."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter
from tissue_sim.pose import Pose, Screw, Vector
from tissue_sim.public_names import OldName


@dataclass(frozen=True)
class Approach:
    """Straight path of a tool that is off the axis of the specimen, or tilted.

    Attributes:
        offset: distance from the axis, along x, of the deepest point of the upright tool, m.
        angle: between the axes of tool and specimen, rad; a positive angle moves the tool towards +x as it goes in. The
            tool is rotated about its deepest point.

    Raises:
        InputError: a number that is not finite, or an angle of more than 80 degrees.
    """

    offset: float = parameter("x0", "m", key="offset_mm", factor=1e-3, bounds=(-1.0, 1.0), absent=0.0, default=0.0,
                              shapes_mesh=True)
    angle: float = parameter("theta", "rad", key="tilt_deg", factor=math.pi / 180.0, bounds=(-1.4, 1.4), absent=0.0,
                             default=0.0)

    def __post_init__(self):
        if not math.isfinite(self.offset):
            raise InputError(f"must be finite; got {self.offset} m.", field="approach.offset")
        if not abs(self.angle) <= 1.4:
            raise InputError(f"must be at most 80 degrees; got {math.degrees(self.angle):g} degrees.",
                             field="approach.angle")

    def pose(self, displacement: float) -> Pose:
        """Return the pose of the tool at a displacement, m, from its first touch, positive into the tissue."""
        sine, cosine = math.sin(self.angle), math.cos(self.angle)
        half = 0.5 * self.angle
        return Pose((self.offset + sine * displacement, 0.0, -cosine * displacement),
                    (math.cos(half), 0.0, -math.sin(half), 0.0))

    #: Old name.
    against = OldName("direction_against_motion")

    @property
    def direction_against_motion(self) -> Vector:
        """Unit vector opposite to the tool's direction of motion, in the frame of the scene."""
        return -math.sin(self.angle), 0.0, math.cos(self.angle)

    def compute_force_against_motion(self, wrench: Screw) -> float:
        """Return the component of a wrench's force opposite to the tool's direction of motion, N."""
        return sum(one * other for one, other in zip(self.direction_against_motion, wrench, strict=False))
