"""Mooney-Rivlin law: linear in both invariants (Mooney 1940, Rivlin 1948)."""

from tissue_sim.laws.law import InvariantLaw


class MooneyRivlin(InvariantLaw):
    """W = C10 (I1 - 3) + C01 (I2 - 3)."""

    name = "mooney_rivlin"
    title = "Mooney-Rivlin"
    units = {"C10": "Pa", "C01": "Pa"}

    def energy(self, I1, I2, C10, C01):
        """Return W as an expression of the invariants and the coefficients, Pa."""
        return C10 * (I1 - 3) + C01 * (I2 - 3)
