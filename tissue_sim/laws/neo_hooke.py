"""Neo-Hookean law: linear in the first invariant (Rivlin 1948)."""

from tissue_sim.laws.law import InvariantLaw


class NeoHooke(InvariantLaw):
    """W = C10 (I1 - 3)."""

    name = "neo_hooke"
    title = "Neo-Hooke"
    units = {"C10": "Pa"}

    def energy(self, I1, I2, C10):
        """Return W as an expression of the invariants and the coefficients, Pa."""
        return C10 * (I1 - 3)
