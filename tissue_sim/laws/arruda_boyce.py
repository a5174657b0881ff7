"""Arruda and Boyce's eight-chain law, with the first five terms of its series."""

import math
from collections.abc import Mapping

from tissue_sim.laws.law import InvariantLaw, ParameterRange

#: Coefficients C_i of the series of the inverse Langevin function (numerator, denominator).
COEFFICIENTS = ((1, 2), (1, 20), (11, 1050), (19, 7000), (519, 673750))


class ArrudaBoyce(InvariantLaw):
    """W = mu sum over i = 1..5 of C_i / lambda_m^(2i-2) (I1^i - 3^i), with C = 1/2, 1/20, 11/1050, 19/7000, 519/673750.

    The convention is that of the Abaqus manual: lambda_m is the locking stretch of the chains. The initial shear
    modulus is larger than mu:
    mu0 = mu (1 + 3/(5 lambda_m^2) + 99/(175 lambda_m^4) + 513/(875 lambda_m^6) + 42039/(67375 lambda_m^8)).
    The series has a finite stress at every strain, also beyond the locking stretch. The neo-Hookean law is the limit
    for lambda_m to infinity.

    Sources: E. M. Arruda and M. C. Boyce, Journal of the Mechanics and Physics of Solids 41 (1993) 389; Abaqus Theory
    Guide, "Hyperelastic material behavior".
    """

    name = "arruda_boyce"
    title = "Arruda-Boyce"
    units = {"mu": "Pa", "lambda_m": "1"}
    parameter_bounds = {"lambda_m": (0.05, math.inf)}

    def energy(self, I1, I2, mu, lambda_m):
        """Return W as an expression of the invariants, the modulus mu (Pa) and the locking stretch lambda_m."""
        import sympy as sp  # slow to import, and the derived functions are cached

        return mu * sum(sp.Rational(*c) / lambda_m**(2 * i - 2) * (I1**i - 3**i)
                        for i, c in enumerate(COEFFICIENTS, start=1))

    def compute_fit_ranges(self, largest_strain: float) -> Mapping[str, ParameterRange]:
        """Return the range of lambda_m; its starts are multiples of the largest stretch of the chains in the data."""
        chain_stretch = (1.0 + largest_strain / 3.0)**0.5
        return {"lambda_m": ParameterRange(*self.parameter_bounds["lambda_m"], tuple(
            factor * chain_stretch for factor in (1.5, 3.0, 1.0, 0.6, 10.0, 0.3)))}
