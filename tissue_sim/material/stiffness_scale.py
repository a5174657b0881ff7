"""Tissue that is stiffer or softer as a whole: on a warm day, in another session, of another animal."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from tissue_sim.errors import InputError
from tissue_sim.material.effect import ReducedEffect, ToolHistory
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class StiffnessScale(ReducedEffect):
    """Every force is `ratio` times what it would be.

    Exact where nothing beside the tissue resists: all moduli, bulk included, times the ratio. A specimen that weighs
    sags as it did.

    Attributes:
        ratio: 1 is absent.
    """

    name = "stiffness_scale"
    title = "stiffness as a whole"

    ratio: float = parameter("k_s", "1", key="ratio", bounds=(1e-3, 1e3), absent=1.0)

    def __post_init__(self):
        if not 0 < self.ratio < inf:
            raise InputError(f"{self.ratio:g} is not a positive ratio of stiffness", field="ratio")

    def share(self, history: ToolHistory) -> float:
        """The ratio."""
        return self.ratio
