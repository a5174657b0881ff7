"""Gent's law of chains with limited extensibility."""

import math
from collections.abc import Mapping

from tissue_sim.laws.law import InvariantLaw, ParameterRange


class Gent(InvariantLaw):
    """W = -mu J_m/2 ln(1 - (I1 - 3)/J_m); mu0 = mu.

    The stress grows without bound as I1 - 3 approaches J_m. The neo-Hookean law is the limit for J_m to infinity.

    Source: A. N. Gent, Rubber Chemistry and Technology 69 (1996) 59.
    """

    name = "gent"
    title = "Gent"
    units = {"mu": "Pa", "J_m": "1"}
    parameter_bounds = {"J_m": (1e-6, math.inf)}

    def energy(self, I1, I2, mu, J_m):
        """Return W as an expression of the invariants, the shear modulus mu (Pa) and the limit J_m of I1 - 3."""
        import sympy as sp  # slow to import, and the derived functions are cached

        return -mu * J_m / 2 * sp.log(1 - (I1 - 3) / J_m)

    def compute_fit_ranges(self, largest_strain: float) -> Mapping[str, ParameterRange]:
        """Return the range of J_m, whose lower bound is the largest I1 - 3 of the data."""
        low = max(largest_strain, self.parameter_bounds["J_m"][0])
        return {"J_m": ParameterRange(low, self.parameter_bounds["J_m"][1],
                                      tuple(factor * low for factor in (5.0, 2.0, 20.0, 1.3, 100.0, 1.05)))}
