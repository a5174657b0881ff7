"""How the tool comes to the specimen: where on its top, and at what angle."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter
from tissue_sim.pose import Pose, Screw, Vector


@dataclass(frozen=True)
class Approach:
    """The straight way of a tool that is off the axis of the specimen, or leans.

    Attributes:
        offset: how far from the axis, along x, the tool's deepest point is when it is upright, m.
        angle: between the tool's axis and that of the specimen, rad; the tool goes towards +x as it goes in. It turns
            about its deepest point.

    Raises:
        InputError: a number that is not finite, or an angle of more than 80 degrees.
    """

    offset: float = parameter("x0", "m", key="offset_mm", factor=1e-3, bounds=(-1.0, 1.0), absent=0.0, default=0.0,
                              shapes_mesh=True)
    angle: float = parameter("theta", "rad", key="tilt_deg", factor=math.pi / 180.0, bounds=(-1.4, 1.4), absent=0.0,
                             default=0.0)

    def __post_init__(self):
        if not math.isfinite(self.offset):
            raise InputError(f"{self.offset} m is no place on the specimen", field="approach.offset")
        if not abs(self.angle) <= 1.4:
            raise InputError(f"{math.degrees(self.angle):g} degrees is no way into the specimen; give at most 80",
                             field="approach.angle")

    def pose(self, displacement: float) -> Pose:
        """Where the tool is after this way, m, from where it first touches."""
        sine, cosine = math.sin(self.angle), math.cos(self.angle)
        half = 0.5 * self.angle
        return Pose((self.offset + sine * displacement, 0.0, -cosine * displacement),
                    (math.cos(half), 0.0, -math.sin(half), 0.0))

    @property
    def against(self) -> Vector:
        """Unit vector against the tool's way, in the frame of the scene."""
        return -math.sin(self.angle), 0.0, math.cos(self.angle)

    def resistance(self, wrench: Screw) -> float:
        """Share of a force on the tool against its way, N."""
        return sum(one * other for one, other in zip(self.against, wrench, strict=False))
