"""Ogden's law: powers of the principal stretches (Ogden 1972), in the convention of the Abaqus manual."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tissue_sim.laws.law import KernelEnergy, StretchLaw

#: Largest number of terms in the kernel that the laws of fewer terms share; each larger number has its own kernel.
SHARED_TERMS = 3


@dataclass(frozen=True)
class SmallExponentSettings:
    """Treatment of exponents near 0, by which the formula cannot divide.

    The limit for alpha -> 0 is W = mu (ln^2 l1 + ln^2 l2 + ln^2 l3), the energy of Hencky (1928).

    Attributes:
        smallest: smallest absolute value of an exponent, 1; smaller ones are replaced by this value with their sign
            (+ for 0). The relative difference of the stress from the limit is then at most 5e-5 |ln l|; the difference
            of powers loses 4 of 16 digits. A smaller value loses more digits.
        limit: exponents of smaller absolute value are reported as 0, 1.
    """

    smallest: float = 1e-4
    limit: float = 1e-2


#: Settings of all orders.
EXPONENTS = SmallExponentSettings()


def replace_small_exponents(exponents: np.ndarray) -> np.ndarray:
    """Return exponents with those below `SmallExponentSettings.smallest` replaced by it, with their sign."""
    small = np.abs(exponents) < EXPONENTS.smallest
    return np.where(small, np.copysign(EXPONENTS.smallest, exponents), exponents)


def describe_small_exponents(exponents: np.ndarray, limit: str) -> list[str]:
    """Return one sentence for each exponent that is 0 within `SmallExponentSettings.limit`.

    Args:
        exponents: alpha_i, shape (terms,).
        limit: formula of the term at the limit, in which ``{i}`` is replaced by the number of the term.
    """
    return [f"alpha{i} is at its limit 0, where the term is {limit.format(i=i)}"
            for i, alpha in enumerate(exponents, start=1) if abs(alpha) < EXPONENTS.limit]


class Ogden(StretchLaw):
    """W = sum over i = 1..N of 2 mu_i / alpha_i^2 (l1^alpha_i + l2^alpha_i + l3^alpha_i - 3); mu0 = sum of mu_i."""

    def __init__(self, terms: int):
        self.terms = terms
        self.name = f"ogden_{terms}"
        self.title = f"Ogden N = {terms}"
        self.units = {f"{symbol}{i}": unit for i in range(1, terms + 1)
                      for symbol, unit in (("mu", "Pa"), ("alpha", "1"))}

    def energy_of_stretch(self, stretch, *parameters):
        """Return w as an expression of one stretch, the moduli mu_i (Pa) and the exponents alpha_i."""
        pairs = zip(parameters[::2], parameters[1::2], strict=True)
        return sum(2 * mu / alpha**2 * (stretch**alpha - 1) for mu, alpha in pairs)

    def convert_parameters_to_array(self, values) -> np.ndarray:
        """Return the values as an array; exponents below `SmallExponentSettings.smallest` are replaced by it."""
        array = np.array(super().convert_parameters_to_array(values))
        array[1::2] = replace_small_exponents(array[1::2])
        return array

    def describe_limiting_cases(self, values) -> list[str]:
        """Return one sentence for each exponent that is 0 within `SmallExponentSettings.limit`."""
        return describe_small_exponents(super().convert_parameters_to_array(values)[1::2],
                                        "mu{i} (ln^2 l1 + ln^2 l2 + ln^2 l3)")

    @cached_property
    def kernel_energy(self) -> KernelEnergy:
        """Energy of the kernel; up to `SHARED_TERMS` terms use one kernel, with mu = 0 in absent terms."""
        if self.terms < SHARED_TERMS:
            return Ogden(SHARED_TERMS).kernel_energy
        own = super().kernel_energy
        return own if self.terms > SHARED_TERMS else replace(own, key="ogden")

    def kernel_coefficients(self, values) -> np.ndarray:
        """Return mu_i and alpha_i of the terms of the kernel, with mu_i = 0 in absent terms."""
        coefficients = np.tile([0.0, 2.0], max(self.terms, SHARED_TERMS))
        coefficients[: 2 * self.terms] = self.convert_parameters_to_array(values)
        return coefficients
