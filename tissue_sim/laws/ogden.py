"""Ogden: powers of the stretches (Ogden 1972), in the convention of the Abaqus manual."""

from functools import cached_property

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.laws.law import KernelEnergy, StretchLaw

MAX_TERMS = 3
#: Below it the difference of powers loses the digits that Newton's method needs.
SMALLEST_EXPONENT = 1e-4


class Ogden(StretchLaw):
    """W = sum over i = 1..N of 2 mu_i / alpha_i^2 (l1^alpha_i + l2^alpha_i + l3^alpha_i - 3); mu0 = sum of mu_i."""

    def __init__(self, terms: int):
        self.terms = terms
        self.name = f"ogden_{terms}"
        self.title = f"Ogden N = {terms}"
        self.units = {f"{symbol}{i}": unit for i in range(1, terms + 1)
                      for symbol, unit in (("mu", "Pa"), ("alpha", "1"))}

    def energy_of_stretch(self, stretch, *parameters):
        pairs = zip(parameters[::2], parameters[1::2], strict=True)
        return sum(2 * mu / alpha**2 * (stretch**alpha - 1) for mu, alpha in pairs)

    def as_array(self, values) -> np.ndarray:
        array = super().as_array(values)
        for i, alpha in enumerate(array[1::2], start=1):
            if abs(alpha) < SMALLEST_EXPONENT:
                raise InputError(f"alpha{i} is {alpha:g}, and the formula divides by alpha^2; give at least "
                                 f"{SMALLEST_EXPONENT:g}, where the limit is reached", field=f"parameters.alpha{i}")
        return array

    @cached_property
    def kernel_energy(self) -> KernelEnergy:
        """All orders run in the kernel of the highest one, with absent terms mu = 0."""
        own = super().kernel_energy if self.terms == MAX_TERMS else Ogden(MAX_TERMS).kernel_energy
        return KernelEnergy("ogden", own.family, own.variables, own.coefficients, own.energy)

    def kernel_coefficients(self, values) -> np.ndarray:
        coefficients = np.tile([0.0, 2.0], MAX_TERMS)
        coefficients[: 2 * self.terms] = self.as_array(values)
        return coefficients
