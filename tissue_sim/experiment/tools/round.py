"""A needle with a hemispherical tip."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.experiment.tools.outline import SHAFT_LENGTH, Profile, radius
from tissue_sim.experiment.tools.tool import Tool


@dataclass(frozen=True)
class HemisphericalNeedle(Tool):
    """A needle with a hemispherical tip.

    Attributes:
        radius: of tip and shaft, m.
    """

    name = "round"
    radius: float = radius()

    def __post_init__(self):
        self.require_valid_radius_and_roundings()

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        a = self.radius
        return Profile([(0.0, a), (0.0, SHAFT_LENGTH * a)], a, 0)

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        """Estimate the radius of the contact at a depth, m: sqrt(radius depth) (Hertz), at most `radius`."""
        return min(self.radius, math.sqrt(self.radius * depth))
