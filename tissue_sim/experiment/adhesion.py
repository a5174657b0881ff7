"""Adhesion: attraction that decreases linearly as the surfaces separate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, require_positive_length
from tissue_sim.experiment.contact_law import ContactLaw, Traction
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Adhesion(ContactLaw):
    """Contact law: attraction between the tool and tissue that has touched the tool.

    The traction is p = force / face (1 - gap / length) for 0 <= gap <= length, a linear cohesive law.

    Attributes:
        force: pull-off force of the whole face at zero gap, N, spread evenly over the face.
        length: gap at which the traction reaches zero, m.
    """

    name = "adhesion"
    title = "adhesion"

    force: float = parameter("F_ad", "N", key="adhesion_N", bounds=(0.0, 1e3), absent=0.0)
    length: float = parameter("l_ad", "m", key="adhesion_length_mm", factor=1e-3, bounds=(1e-7, 1.0))

    def __post_init__(self):
        if not (np.isfinite(self.force) and self.force >= 0):
            raise InputError(f"must be 0 or more; got {self.force:g} N.", field="adhesion.force")
        require_positive_length(self.length, "adhesion.length")

    @property
    def acts(self) -> bool:
        """Whether the pull-off force is positive."""
        return self.force > 0.0

    @property
    def reach(self) -> float:
        """Gap at which the traction ends, m."""
        return self.length

    def traction(self, gap, pressure, slip, face):
        """Return the traction, which decreases linearly with the gap; see `ContactLaw.traction`."""
        # The slope with respect to the gap is not part of the tangent: it is negative, and after the pull-off Newton's
        # method would diverge until the surfaces have separated.
        return Traction(self.force / face * (1.0 - np.maximum(gap, 0.0) / self.length))
