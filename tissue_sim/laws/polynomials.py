"""Laws that are polynomials of the invariants: neo-Hooke, Mooney-Rivlin, reduced polynomial (Yeoh) and Biderman."""

from tissue_sim.laws.law import InvariantLaw


class MooneyRivlin(InvariantLaw):
    """W = C10 (I1 - 3) + C01 (I2 - 3)."""

    name = "mooney_rivlin"
    title = "Mooney-Rivlin"
    units = {"C10": "Pa", "C01": "Pa"}

    def energy(self, I1, I2, C10, C01):
        """Return W as an expression of the invariants and the coefficients, Pa."""
        return C10 * (I1 - 3) + C01 * (I2 - 3)


class ReducedPolynomial(InvariantLaw):
    """W = sum over i = 1..N of Ci0 (I1 - 3)^i."""

    def __init__(self, order: int):
        self.name = f"reduced_polynomial_{order}"
        self.title = "Reduced polynomial N = 3 (Yeoh)" if order == 3 else f"Reduced polynomial N = {order}"
        self.units = {f"C{i}0": "Pa" for i in range(1, order + 1)}

    def energy(self, I1, I2, *C):
        """Return W as an expression of the invariants and the coefficients, Pa."""
        return sum(Ci0 * (I1 - 3)**i for i, Ci0 in enumerate(C, start=1))


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


class NeoHooke(InvariantLaw):
    """W = C10 (I1 - 3)."""

    name = "neo_hooke"
    title = "Neo-Hooke"
    units = {"C10": "Pa"}

    def energy(self, I1, I2, C10):
        """Return W as an expression of the invariants and the coefficients, Pa."""
        return C10 * (I1 - 3)
