"""Reduced polynomial in the first invariant; N = 3 is Yeoh's law (Yeoh 1993)."""

from tissue_sim.laws.law import InvariantLaw


class ReducedPolynomial(InvariantLaw):
    """W = sum over i = 1..N of Ci0 (I1 - 3)^i."""

    def __init__(self, order: int):
        self.name = f"reduced_polynomial_{order}"
        self.title = "Reduced polynomial N = 3 (Yeoh)" if order == 3 else f"Reduced polynomial N = {order}"
        self.units = {f"C{i}0": "Pa" for i in range(1, order + 1)}

    def energy(self, I1, I2, *C):
        """Return W as an expression of the invariants and the coefficients, Pa."""
        return sum(Ci0 * (I1 - 3)**i for i, Ci0 in enumerate(C, start=1))
