"""Layer of another stiffness, such as skin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Layer:
    """Layer of the specimen, counted from its top face downwards; the material itself is below the last layer.

    Attributes:
        thickness: m, in the same state as the specimen's height: undeformed, or settled under its weight.
        ratio: factor on every modulus of the material, bulk included; 1 is absent.
    """

    thickness: float = parameter("h", "m", key="thickness_mm", factor=1e-3, bounds=(1e-6, 1.0), shapes_mesh=True)
    ratio: float = parameter("k", "1", key="modulus_ratio", bounds=(1e-3, 1e3), absent=1.0)

    def __post_init__(self):
        if not 0 < self.thickness < np.inf:
            raise InputError(f"must be positive and finite; got {self.thickness:g} m.", field="thickness")
        if not 0 < self.ratio < np.inf:
            raise InputError(f"must be a positive finite factor on the moduli of the material below; got "
                             f"{self.ratio:g}.", field="ratio")
