"""A needle with a conical tip."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.outline import SHAFT_LENGTH, Profile, radius
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.parameters import parameter

#: Smallest half angle of a cone, rad.
_SHARPEST = 0.01


@dataclass(frozen=True)
class Cone(Tool):
    """A cone on a shaft, with rounded tip and shoulder.

    Attributes:
        radius: of the shaft, m.
        half_angle: between the axis and the side, rad.
        tip_radius: radius of the rounding of tip and shoulder, m.
    """

    name = "cone"
    radius: float = radius()
    half_angle: float = parameter("theta", "rad", key="half_angle_deg", factor=math.pi / 180,
                                  bounds=(_SHARPEST, 1.57))
    tip_radius: float = parameter("r_t", "m", key="tip_radius_mm", factor=1e-3, bounds=(0.0, 1.0), absent=0.0,
                                  default=0.0)

    def __post_init__(self):
        self.require_valid_radius_and_roundings("tip_radius")
        if not _SHARPEST <= self.half_angle < math.pi / 2:
            raise InputError("must be at least 0.6 degrees and below 90 degrees, between the axis and the side of "
                             f"the cone; got {math.degrees(self.half_angle):g} degrees.", field="tool.half_angle")

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        a, tip = self.radius, self.tip_radius
        shoulder = tip + (a - tip) / math.tan(self.half_angle)
        return Profile([(0.0, tip), (a - tip, shoulder), (a - tip, shoulder + SHAFT_LENGTH * a)], tip, 1)

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        """Estimate the radius of the contact at a depth, m: 2/pi depth tan(half angle) (Sneddon), at most `radius`."""
        pointed = 2.0 / math.pi * depth * math.tan(self.half_angle)
        return min(self.radius, max(pointed, math.sqrt(self.tip_radius * depth)))
