"""Puncture under a needle as a stated drop of its force."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.material.effect import ReducedEffect, ToolHistory
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Puncture(ReducedEffect):
    """From the first time that the needle passes `depth` on, its force is (1 - drop) of what it would be.

    A reduced form: the tissue is not cut. Plates do not puncture.

    Attributes:
        depth: of the needle at which the surface gives way, m.
        drop: share of the force that is lost for good, 0 (absent) to below 1.
    """

    name = "puncture"
    title = "puncture"
    under_plates = False

    depth: float = parameter("d_p", "m", key="depth_mm", factor=1e-3, bounds=(0.0, 1.0))
    drop: float = parameter("s", "1", key="drop", bounds=(0.0, 0.99), absent=0.0)

    def __post_init__(self):
        if not 0 < self.depth < inf:
            raise InputError(f"{self.depth:g} m is not a positive depth", field="depth")
        if not 0 <= self.drop < 1:
            raise InputError(f"{self.drop:g} is outside 0 to 1 (1 excluded); give the share of the force that is lost",
                             field="drop")

    def share(self, history: ToolHistory) -> float:
        """What the puncture leaves of the force."""
        return 1.0 - self.drop if history.deepest > self.depth else 1.0

    def shares(self, depth: np.ndarray, deepest: np.ndarray, time: np.ndarray) -> np.ndarray:
        """As `ReducedEffect.shares`."""
        return np.where(deepest > self.depth, 1.0 - self.drop, 1.0)
