"""Isotropic exponential law of soft tissue (Fung's exponential in Demiray's isotropic form)."""

import math
from collections.abc import Mapping

import numpy as np

from tissue_sim.laws.domain import MAX_EXPONENT
from tissue_sim.laws.law import InvariantLaw, ParameterRange

#: Smallest absolute value of b, 1, by which the formula divides; smaller values are replaced by it with their sign (+
#: for 0). The relative difference of the stress from that of the neo-Hookean limit is then about b (I1 - 3).
MIN_B = 1e-9


class FungDemiray(InvariantLaw):
    """W = mu/(2b) (exp(b (I1 - 3)) - 1); mu0 = mu.

    The neo-Hookean law is the limit for b to 0.

    Sources: H. Demiray, Journal of Biomechanics 5 (1972) 309; Y. C. Fung, American Journal of Physiology 213 (1967)
    1532.
    """

    name = "fung_demiray"
    title = "Fung-Demiray"
    units = {"mu": "Pa", "b": "1"}
    parameter_bounds = {"b": (0.0, math.inf)}

    def energy(self, I1, I2, mu, b):
        """Return W as an expression of the invariants, the shear modulus mu (Pa) and the stiffening b."""
        import sympy as sp  # slow to import, and the derived functions are cached

        return mu / (2 * b) * (sp.exp(b * (I1 - 3)) - 1)

    def convert_parameters_to_array(self, values) -> np.ndarray:
        """Return the values as an array; an absolute value of b below `MIN_B` is replaced by it."""
        array = np.array(super().convert_parameters_to_array(values))
        if abs(array[1]) < MIN_B:
            array[1] = np.copysign(MIN_B, array[1])
        return array

    def describe_limiting_cases(self, values) -> list[str]:
        """Return one sentence if b is 0, where the law is neo-Hookean."""
        return ["b is at its limit 0, where the law is neo-Hookean"] if abs(
            super().convert_parameters_to_array(values)[1]) <= MIN_B else []

    def compute_fit_ranges(self, largest_strain: float) -> Mapping[str, ParameterRange]:
        """Return the range of b, whose upper bound is that without overflow at the largest I1 - 3 of the data."""
        size = 1.0 / max(largest_strain, 1e-6)
        return {"b": ParameterRange(0.0, MAX_EXPONENT * size,
                                    tuple(factor * size for factor in (1.0, 0.1, 5.0, 0.5, 2.0, 0.01, 15.0)))}
