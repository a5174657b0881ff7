"""Factor on the stiffness of the whole tissue, for instance between sessions, temperatures or animals."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from tissue_sim.errors import InputError
from tissue_sim.material.effect import ForceScalingEffect, ToolHistory
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class StiffnessScale(ForceScalingEffect):
    """Multiply every force by a constant ratio.

    Exact if only the tissue resists: all moduli, bulk included, are then multiplied by the ratio. The sag of a specimen
    under its weight does not change.

    Attributes:
        ratio: factor on the stiffness, 1; 1 if the effect is absent.
    """

    name = "stiffness_scale"
    title = "stiffness as a whole"

    ratio: float = parameter("k_s", "1", key="ratio", bounds=(1e-3, 1e3), absent=1.0)

    def __post_init__(self):
        if not 0 < self.ratio < inf:
            raise InputError(f"must be positive and finite; got {self.ratio:g}.", field="ratio")

    def compute_force_factor(self, history: ToolHistory) -> float:
        """Return the constant ratio of the force with the effect to the force without it."""
        return self.ratio
