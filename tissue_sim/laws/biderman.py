"""Biderman's law: polynomial of third order in the first invariant, linear in the second (Biderman 1958)."""

from tissue_sim.laws.law import InvariantLaw


class Biderman(InvariantLaw):
    """W = C10 (I1 - 3) + C01 (I2 - 3) + C20 (I1 - 3)^2 + C30 (I1 - 3)^3.

    Neo-Hooke, Mooney-Rivlin, Isihara and the reduced polynomials to N = 3 are special cases with some coefficients 0.

    Source: V. L. Biderman, Calculation of rubber parts, in: Rascheti na prochnost, Moscow (1958) 40.
    """

    name = "biderman"
    title = "Biderman"
    units = {"C10": "Pa", "C01": "Pa", "C20": "Pa", "C30": "Pa"}

    def energy(self, I1, I2, C10, C01, C20, C30):
        """Return W as an expression of the invariants and the coefficients, Pa."""
        return C10 * (I1 - 3) + C01 * (I2 - 3) + C20 * (I1 - 3)**2 + C30 * (I1 - 3)**3
