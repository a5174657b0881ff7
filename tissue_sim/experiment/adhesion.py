"""Adhesion: a pull that falls as the surfaces part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, require_length
from tissue_sim.experiment.contact_law import ContactLaw, Traction
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Adhesion(ContactLaw):
    """Pull between the tool and tissue that has touched it.

    Attributes:
        force: N, of the whole face at once, spread evenly over it.
        length: m, over which the pull falls to zero as the surfaces part.
    """

    name = "adhesion"
    title = "adhesion"

    force: float = parameter("F_ad", "N", key="adhesion_N", bounds=(0.0, 1e3), absent=0.0)
    length: float = parameter("l_ad", "m", key="adhesion_length_mm", factor=1e-3, bounds=(1e-7, 1.0))

    def __post_init__(self):
        if not (np.isfinite(self.force) and self.force >= 0):
            raise InputError(f"{self.force:g} N is not a pull-off force; give 0 or more", field="adhesion.force")
        require_length(self.length, "adhesion.length")

    @property
    def acts(self) -> bool:
        return self.force > 0.0

    @property
    def reach(self) -> float:
        return self.length

    def traction(self, gap, pressure, slip, face):
        # Its falling with the gap stays out of the tangent: beyond the pull-off the iteration then runs away to where
        # the surfaces have parted.
        return Traction(self.force / face * (1.0 - np.maximum(gap, 0.0) / self.length))
