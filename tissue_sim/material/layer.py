"""A layer of another stiffness, such as skin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Layer:
    """A layer of the specimen, counted from its top face down; what is below the last one is the material itself.

    Attributes:
        thickness: m, measured as the specimen's height is: undeformed, or as placed.
        ratio: every modulus of the material, bulk included, times this; 1 is absent.
    """

    thickness: float = parameter("h", "m", key="thickness_mm", factor=1e-3, bounds=(1e-6, 1.0), shapes_mesh=True)
    ratio: float = parameter("k", "1", key="modulus_ratio", bounds=(1e-3, 1e3), absent=1.0)

    def __post_init__(self):
        if not 0 < self.thickness < np.inf:
            raise InputError(f"{self.thickness:g} m is not a positive thickness", field="thickness")
        if not 0 < self.ratio < np.inf:
            raise InputError(f"{self.ratio:g} is not a positive ratio of moduli", field="ratio")
