"""A needle with a flat face."""

from __future__ import annotations

from dataclasses import dataclass

from tissue_sim.experiment.tools.outline import SHAFT_LENGTH, Profile, edge_radius, radius
from tissue_sim.experiment.tools.tool import Tool


@dataclass(frozen=True)
class Flat(Tool):
    """A flat punch with a rounded edge.

    Attributes:
        radius: of the shaft, m.
        edge_radius: radius of the rounding between face and shaft, m.
    """

    name = "flat"
    radius: float = radius()
    edge_radius: float = edge_radius()

    def __post_init__(self):
        self.require_valid_radius_and_roundings("edge_radius")

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        face, rounding = self.face_radius, self.edge_radius
        return Profile([(0.0, rounding), (face, rounding), (face, SHAFT_LENGTH * self.radius)], rounding, 1)

    @property
    def face_radius(self) -> float:
        """Radius of the flat part of the face, without the rounding, m."""
        return self.radius - self.edge_radius

    @property
    def has_sharp_edge(self) -> bool:
        """Whether the edge between face and shaft has no rounding."""
        return self.edge_radius == 0

    def contact_radius(self, depth: float, specimen_radius: float = float("inf")) -> float:
        """Return the radius of the contact, that of the shaft, m."""
        return self.radius
