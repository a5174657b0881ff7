"""Effects that scale the force: puncture by a needle, and the stiffness of the whole tissue.

The stiffness differs, for instance, between sessions, temperatures or animals.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np

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


@dataclass(frozen=True)
class Puncture(ForceScalingEffect):
    """Reduce the force of a needle to (1 - drop) of its value as soon as the needle has passed a depth.

    A reduced form: the mesh is not cut. Plates do not puncture.

    Attributes:
        depth: depth of the needle at which the surface ruptures, m.
        drop: fraction of the force that is lost permanently, 0 (absent) to below 1.
    """

    name = "puncture"
    title = "puncture"
    under_plates = False

    depth: float = parameter("d_p", "m", key="depth_mm", factor=1e-3, bounds=(0.0, 1.0))
    drop: float = parameter("s", "1", key="drop", bounds=(0.0, 0.99), absent=0.0)

    def __post_init__(self):
        if not 0 < self.depth < inf:
            raise InputError(f"must be positive and finite; got {self.depth:g} m.", field="depth")
        if not 0 <= self.drop < 1:
            raise InputError(f"must be a fraction of the force from 0 to below 1; got {self.drop:g}.", field="drop")

    def compute_force_factor(self, history: ToolHistory) -> float:
        """Return 1 - drop if the needle has passed the depth, else 1."""
        return 1.0 - self.drop if history.deepest > self.depth else 1.0

    def compute_force_factors(self, depth: np.ndarray, deepest: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Evaluate `compute_force_factor` for arrays; see `ForceScalingEffect.compute_force_factors`."""
        return np.where(deepest > self.depth, 1.0 - self.drop, 1.0)
