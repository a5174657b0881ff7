"""Softening on first load (the Mullins effect)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Softening:
    """Pseudo-elastic softening of the isochoric stress by a factor eta = 1 - loss tanh((Wm - W)/(modulus + share Wm)).

    W is the isochoric energy density and Wm the largest so far: on first load eta is 1, below the largest load the
    stress is lower, and it returns to the first curve where that is reached again.

    Attributes:
        loss: largest share of the stress that can be lost, 0 (absent) to below 1.
        modulus: Pa; the larger, the less a small load softens.
        share: of Wm in the scale; with modulus 0 unloading to rest always costs loss tanh(1/share).

    Source: Ogden and Roxburgh, Proc. R. Soc. A 455 (1999) 2861; with tanh Dorfmann and Ogden, IJSS 40 (2003) 2699;
    with a share of Wm as in the Mullins effect of Abaqus.
    """

    loss: float = parameter("r", "1", key="loss", bounds=(1e-6, 0.99), absent=0.0)
    modulus: float = parameter("m", "Pa", key="modulus_Pa", bounds=(0.0, 1e9), default=0.0)
    share: float = parameter("beta", "1", key="share", bounds=(1e-3, 1e3), default=1.0)

    def __post_init__(self):
        if not 0 <= self.loss < 1:
            raise InputError(f"{self.loss:g} is outside 0 to 1 (1 excluded); give the share of the stress that can be "
                             "lost", field="loss")
        for name in ("modulus", "share"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{getattr(self, name):g} is not a number from 0 on", field=name)
        if self.modulus == 0 and self.share == 0:
            raise InputError("modulus and share are both 0, so nothing scales the lost energy; give one of them",
                             field="modulus")

    def factor(self, energy, largest) -> np.ndarray:
        """eta at an isochoric energy density W, J/m3, with the largest so far; shapes broadcast."""
        energy, largest = np.broadcast_arrays(np.asarray(energy, dtype=float), np.asarray(largest, dtype=float))
        scale = self.modulus + self.share * largest
        # Before the first load both are zero.
        ratio = np.divide(np.maximum(largest - energy, 0.0), scale, out=np.zeros(scale.shape), where=scale > 0)
        return 1.0 - self.loss * np.tanh(ratio)
