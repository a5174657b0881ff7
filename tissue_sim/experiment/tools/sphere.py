"""Spherical tool (ball) without a shaft."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.experiment.tools.outline import Profile, radius
from tissue_sim.experiment.tools.tool import Tool


@dataclass(frozen=True)
class Sphere(Tool):
    """Spherical tool (ball) without a shaft.

    Attributes:
        radius: m.
    """

    name = "sphere"
    has_shaft = False
    radius: float = radius()

    def __post_init__(self):
        self.require_valid_radius_and_roundings()

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        a = self.radius
        # A segment of negligible length; the ball is closed above it.
        return Profile([(0.0, a), (0.0, a * (1 + 1e-9))], a, 1)

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        """Estimate the radius of the contact at a depth, m: sqrt(radius depth) (Hertz), at most `radius`."""
        return min(self.radius, math.sqrt(self.radius * depth))
