"""A law in one file: that of Pucci and Saccomandi (Rubber Chem. Technol. 75 (2002) 839), Gent's with a term of I2."""

import sympy as sp

from tissue_sim.laws import InvariantLaw


class PucciSaccomandi(InvariantLaw):
    """W = -mu Jm/2 ln(1 - (I1 - 3)/Jm) + C2 ln(I2/3); mu0 = mu + 2 C2/3."""

    name = "pucci_saccomandi"
    title = "Pucci-Saccomandi"
    units = {"mu": "Pa", "Jm": "1", "C2": "Pa"}

    def energy(self, I1, I2, mu, Jm, C2):
        return -mu * Jm / 2 * sp.log(1 - (I1 - 3) / Jm) + C2 * sp.log(I2 / 3)


LAW = PucciSaccomandi()
