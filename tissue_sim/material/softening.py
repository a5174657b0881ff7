"""Softening on first load (the Mullins effect)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import choice, parameter

#: Name of the function f of the softening factor.
SofteningForm = Literal["tanh", "erf"]
#: Names of the functions f, in the order of their numbers in the kernels.
SOFTENING_FORMS: tuple[SofteningForm, ...] = get_args(SofteningForm)


@dataclass(frozen=True)
class Softening:
    """Pseudo-elastic softening of the isochoric stress: S -> eta S.

    eta = 1 - loss f((Wm - W) / (modulus + share Wm)) with f = tanh or the error function erf, the isochoric energy
    density W and its largest value so far Wm. On first load eta is 1; below the largest load the stress is lower; it
    returns to the first curve when W reaches Wm again.

    Attributes:
        loss: largest fraction of the stress that is lost, 0 (absent) to below 1.
        modulus: Pa; the larger, the less softening after small loads.
        share: coefficient of Wm, 1; with modulus 0 the loss after unloading to rest is loss f(1/share).
        form: name of f, ``"tanh"`` or ``"erf"``. ``"erf"`` is the Mullins effect of Abaqus with R = 1/loss, M = modulus
            and BETA = share.

    Source: erf: Ogden and Roxburgh, Proc. R. Soc. A 455 (1999) 2861; tanh: Dorfmann and Ogden, IJSS 40 (2003) 2699;
    coefficient of Wm: Mullins effect of Abaqus.
    """

    loss: float = parameter("r", "1", key="loss", bounds=(1e-6, 0.99), absent=0.0)
    modulus: float = parameter("m", "Pa", key="modulus_Pa", bounds=(0.0, 1e9), default=0.0)
    share: float = parameter("beta", "1", key="share", bounds=(1e-3, 1e3), default=1.0)
    form: Literal["tanh", "erf"] = choice(*SOFTENING_FORMS)

    def __post_init__(self):
        if not 0 <= self.loss < 1:
            raise InputError(f"must be a fraction of the stress from 0 to below 1; got {self.loss:g}.", field="loss")
        for name in ("modulus", "share"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"must be finite and 0 or more; got {getattr(self, name):g}.", field=name)
        if self.modulus == 0 and self.share == 0:
            raise InputError("modulus and share must not both be 0; together they scale the lost energy",
                             field="modulus")
        if self.form not in SOFTENING_FORMS:
            raise InputError(f"must be {' or '.join(SOFTENING_FORMS)}; got {self.form!r}.", field="form")

    def factor(self, energy, largest) -> np.ndarray:
        """Return the factor eta on the stress, 1, for W and its largest value so far Wm, J/m3; shapes broadcast."""
        energy, largest = np.broadcast_arrays(np.asarray(energy, dtype=float), np.asarray(largest, dtype=float))
        scale = self.modulus + self.share * largest
        # Before the first load W, Wm and the scale are zero.
        ratio = np.divide(np.maximum(largest - energy, 0.0), scale, out=np.zeros(scale.shape), where=scale > 0)
        if self.form == "tanh":
            return 1.0 - self.loss * np.tanh(ratio)
        from scipy.special import erf

        return 1.0 - self.loss * erf(ratio)
