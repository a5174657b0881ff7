"""A specimen: what is tested."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, require_length
from tissue_sim.parameters import parameter

#: Gravity where nothing else is said, m/s2.
STANDARD_GRAVITY = 9.81
HEIGHTS = ("moulded", "placed")


@dataclass(frozen=True)
class Specimen:
    """A cylinder of the material, standing on its base.

    Attributes:
        radius, height: m; the radius is that of the undeformed cylinder, the height is what `height_is` says.
        name: for people and campaign files.
        density: kg/m3, or None where nobody said.
        gravity: m/s2, along the axis and towards the base; 0 leaves self-weight out.
        height_is: ``"moulded"``, the undeformed height, or ``"placed"``, measured on its base after it has settled.

    Raises:
        InputError: a size that is not positive, gravity without a density.
    """

    radius: float = parameter("R", "m", key="radius_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)
    height: float = parameter("H", "m", key="height_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)
    name: str = "specimen"
    density: float | None = parameter("rho", "kg/m3", key="density_kg_m3", bounds=(1.0, 1e5), default=None)
    gravity: float = parameter("g0", "m/s2", key="gravity_m_s2", bounds=(0.0, 100.0), absent=0.0, default=0.0)
    height_is: str = "moulded"

    def __post_init__(self):
        require_length(self.radius, "specimen.radius")
        require_length(self.height, "specimen.height")
        if self.density is not None and not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"{self.density:g} is not a positive density; give kg/m3", field="specimen.density")
        if not (np.isfinite(self.gravity) and self.gravity >= 0):
            raise InputError(f"{self.gravity:g} m/s2 is not a gravity towards the base; give 0 or {STANDARD_GRAVITY}",
                             field="specimen.gravity")
        if self.gravity and self.density is None:
            raise InputError("gravity needs a density; give density in kg/m3", field="specimen.density")
        if self.height_is not in HEIGHTS:
            raise InputError(f"{self.height_is!r} is not a way to measure a height; use 'moulded' or 'placed'",
                             field="specimen.height_is")

    @property
    def area(self) -> float:
        """Undeformed cross-section, m2."""
        return np.pi * self.radius**2

    @property
    def specific_weight(self) -> float:
        """Density times gravity, N/m3; 0 where self-weight is left out."""
        return self.density * self.gravity if self.density else 0.0
