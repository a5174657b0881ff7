"""Law of compressible elastomeric foams (Ogden 1972, Storakers 1986), in the convention of the Abaqus manual."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tissue_sim.laws.compressible import CompressibleLaw
from tissue_sim.laws.law import KernelEnergy, ParameterRange
from tissue_sim.laws.ogden import SHARED_TERMS, describe_small_exponents, replace_small_exponents


@dataclass(frozen=True)
class PoissonRatioSettings:
    """Range of the Poisson's ratios nu_i.

    Attributes:
        lowest: smallest value in a material, 1.
        highest: largest value in a material, 1; displacement elements become too stiff near 0.5.
        smallest: smallest absolute value, 1, because the energy is divided by beta. A smaller value is replaced by this
            one, with its sign. The relative error of the stress is about 1e-6; the energy loses 6 of its 16 digits.
    """

    lowest: float = -0.9
    highest: float = 0.49
    smallest: float = 1e-6


#: Settings of all orders.
POISSON = PoissonRatioSettings()
#: Number of terms -> starts of nu_1, nu_2, ... in a fit, 1; the last ones hold for all further terms.
_STARTS_BY_TERMS = {1: ((0.1, 0.3, 0.02, 0.45, -0.2),), 2: ((0.05, 0.35),)}


class Hyperfoam(CompressibleLaw):
    """Hyperfoam law of Ogden and Storakers with N terms.

    W = sum over i of 2 mu_i / alpha_i^2 (l1^a + l2^a + l3^a - 3 + (J^(-a b) - 1) / b), a = alpha_i, b = beta_i.

    beta_i = nu_i / (1 - 2 nu_i); mu0 = sum of mu_i; K0 = sum of 2 mu_i (1/3 + beta_i). If all nu_i are equal to nu, the
    lateral stretch in uniaxial loading is l^(-nu) at every strain.

    Sources: B. Storakers, Journal of the Mechanics and Physics of Solids 34 (1986) 125; Abaqus Analysis User's Guide,
    "Hyperelastic behavior in elastomeric foams".
    """

    def __init__(self, terms: int):
        self.terms = terms
        self.name = f"hyperfoam_{terms}"
        self.title = f"Hyperfoam N = {terms}"
        self.units = {f"{symbol}{i}": unit for i in range(1, terms + 1)
                      for symbol, unit in (("mu", "Pa"), ("alpha", "1"), ("nu", "1"))}
        self.parameter_bounds = {f"nu{i}": (POISSON.lowest, POISSON.highest) for i in range(1, terms + 1)}

    def energy_of_stretch(self, stretch, *parameters):
        """Return w as an expression of one stretch, the moduli mu_i (Pa), exponents alpha_i and ratios nu_i."""
        terms = zip(parameters[::3], parameters[1::3], strict=True)
        return sum(2 * mu / alpha**2 * (stretch**alpha - 1) for mu, alpha in terms)

    def energy_of_volume(self, J, *parameters):
        """Return u as an expression of the volume ratio, the moduli mu_i (Pa), exponents alpha_i and ratios nu_i."""
        terms = zip(parameters[::3], parameters[1::3], parameters[2::3], strict=True)
        return sum(2 * mu / alpha**2 * (1 - 2 * nu) / nu * (J**(-alpha * nu / (1 - 2 * nu)) - 1)
                   for mu, alpha, nu in terms)

    def convert_parameters_to_array(self, values) -> np.ndarray:
        """Return the values as an array; exponents and Poisson's ratios near 0 are replaced by their smallest value."""
        array = np.array(super().convert_parameters_to_array(values))
        array[1::3] = replace_small_exponents(array[1::3])
        small = np.abs(array[2::3]) < POISSON.smallest
        array[2::3][small] = np.copysign(POISSON.smallest, array[2::3][small])
        return array

    def describe_limiting_cases(self, values) -> list[str]:
        """Return one sentence for each exponent at its limit 0."""
        return describe_small_exponents(super().convert_parameters_to_array(values)[1::3],
                                        "mu{i} (ln^2 l1 + ln^2 l2 + ln^2 l3 + beta{i} ln^2 J)")

    def compute_fit_ranges(self, largest_strain: float) -> Mapping[str, ParameterRange]:
        """Return the range of Poisson's ratios, with values of foams as starts; fewer for laws of several terms."""
        starts = _STARTS_BY_TERMS.get(self.terms, ((0.05, 0.35), (0.2,)))
        return {f"nu{i}": ParameterRange(POISSON.lowest, POISSON.highest, starts[min(i, len(starts)) - 1])
                for i in range(1, self.terms + 1)}

    @cached_property
    def kernel_energy(self) -> KernelEnergy:
        """Energy of the kernel; up to `SHARED_TERMS` terms use one kernel, with mu = 0 in absent terms."""
        if self.terms < SHARED_TERMS:
            return Hyperfoam(SHARED_TERMS).kernel_energy
        own = super().kernel_energy
        return own if self.terms > SHARED_TERMS else replace(own, key="hyperfoam")

    def kernel_coefficients(self, values) -> np.ndarray:
        """Return mu_i, alpha_i and nu_i of the terms of the kernel, with mu_i = 0 in absent terms."""
        coefficients = np.tile([0.0, 2.0, 0.25], max(self.terms, SHARED_TERMS))
        coefficients[: 3 * self.terms] = self.convert_parameters_to_array(values)
        return coefficients
