"""A plate that covers the whole top of the specimen."""

from __future__ import annotations

from dataclasses import dataclass

from tissue_sim.experiment.tools.outline import Profile
from tissue_sim.experiment.tools.tool import Tool

#: Radius of a plate, m; wider than any specimen.
PLATE_RADIUS = 10.0


@dataclass(frozen=True)
class Plate(Tool):
    """A plate; it has no sizes."""

    name = "plate"
    is_plate = True
    has_shaft = False

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        return Profile([(0.0, 0.0), (PLATE_RADIUS, 0.0)], 0.0, 1)

    @property
    def face_radius(self) -> None:
        """None: the face of the tool covers the whole specimen and has no edge; see `Tool.face_radius`."""
        return None

    def contact_radius(self, depth: float, specimen_radius: float = float("inf")) -> float:
        """Return the radius of the contact, that of the specimen, m."""
        return specimen_radius
