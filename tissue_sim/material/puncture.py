"""Puncture under a needle as a stated drop of its force."""

from __future__ import annotations

from dataclasses import dataclass

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

    depth: float = parameter("d_p", "m", key="depth_mm", factor=1e-3, bounds=(0.0, 1.0))
    drop: float = parameter("s", "1", key="drop", bounds=(0.0, 0.99), absent=0.0)

    def __post_init__(self):
        if not 0 < self.depth < np.inf:
            raise InputError(f"{self.depth:g} m is not a positive depth", field="depth")
        if not 0 <= self.drop < 1:
            raise InputError(f"{self.drop:g} is outside 0 to 1 (1 excluded); give the share of the force that is lost",
                             field="drop")

    def share(self, history: ToolHistory) -> float:
        """What the puncture leaves of the force."""
        return 1.0 - self.drop if history.deepest > self.depth else 1.0


class PunctureHistory:
    """Force of a needle whose tip may have passed the depth of puncture.

    Args:
        puncture: of the material; None: none.

    Attributes:
        deepest: how deep the needle has been, m.
    """

    def __init__(self, puncture: Puncture | None):
        self._depth, self._drop = (puncture.depth, puncture.drop) if puncture else (np.inf, 0.0)
        self.deepest = -np.inf

    def __call__(self, depth: float, force: float) -> float:
        """The force (or its derivative) at a depth that is final."""
        self.deepest = max(self.deepest, depth)
        return self.at(depth, force)

    def at(self, depth: float, force: float) -> float:
        """The force (or its derivative) at a depth that is tried."""
        return force * (1.0 - self._drop) if max(depth, self.deepest) > self._depth else force
