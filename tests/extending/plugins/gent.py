"""A law in one file: Gent's, of chains that can be stretched no farther (Rubber Chem. Technol. 69 (1996) 59)."""

import sympy as sp

from tissue_sim.laws import InvariantLaw


class Gent(InvariantLaw):
    """W = -mu Jm/2 ln(1 - (I1 - 3)/Jm); mu0 = mu."""

    name = "gent"
    title = "Gent"
    units = {"mu": "Pa", "Jm": "1"}

    def energy(self, I1, I2, mu, Jm):
        return -mu * Jm / 2 * sp.log(1 - (I1 - 3) / Jm)


LAW = Gent()
