"""The unknown parameters of a material: names, bounds, priors, and the material that their values make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.effects import build_effect_parts, effect_bounds, is_effect
from tissue_sim.laws import Law, find_law
from tissue_sim.laws.ogden import SMALLEST_EXPONENT
from tissue_sim.material.material import Bulk, Material

#: Sum of the moduli, Pa, at which a material is simulated whose force is proportional to them.
REFERENCE_MODULUS = 1000.0
#: How far exponents and other numbers without unit may run where the campaign does not say.
EXPONENT_BOUND = 50.0
#: Digits of the ratios of the moduli by which a simulation is found again.
_DIGITS = 12


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """What an inverse fit of one law varies.

    Attributes:
        law: its name. names: of all parameters, those of the law first. free: of the unknown ones.
        fixed: name -> value of the others. start: name -> stated start.
        low, high, prior_mean, prior_deviation: of the free ones, SI, shape (p,); deviation inf where there is no prior.
        bulk: bulk response where no path states one.
    """

    law: str
    names: tuple[str, ...]
    free: tuple[str, ...]
    fixed: dict[str, float]
    start: dict[str, float]
    low: np.ndarray
    high: np.ndarray
    prior_mean: np.ndarray
    prior_deviation: np.ndarray
    bulk: Bulk

    @classmethod
    def of(cls, law: str, campaign: Campaign) -> ParameterSpace:
        """The parameters of a law and those that the campaign's start and fixed add to its material."""
        settings, own = campaign.fit, find_law(law)
        names = (*own.parameters, *settings.effects)
        fixed = {name: settings.fixed[name] for name in names if name in settings.fixed}
        free = tuple(name for name in names if name not in fixed)
        bounds = np.array([settings.bounds.get(name, _default_bounds(name, own)) for name in free]).reshape(-1, 2)
        prior = np.array([settings.prior.get(name, (0.0, np.inf)) for name in free], dtype=float).reshape(-1, 2)
        start = {name: settings.start[name] for name in free if name in settings.start}
        return cls(law, names, free, fixed, start, bounds[:, 0], bounds[:, 1], prior[:, 0], prior[:, 1], settings.bulk)

    @property
    def moduli(self) -> tuple[str, ...]:
        """Names of the parameters that have the unit of a pressure."""
        return tuple(name for name in self.names if self.is_modulus(name))

    def is_modulus(self, name: str) -> bool:
        """Whether a parameter is a pressure, to which all forces are proportional together with the others."""
        return name.endswith("_Pa") if is_effect(name) else find_law(self.law).units[name] == "Pa"

    def values(self, theta: np.ndarray) -> dict[str, float]:
        """All parameters by name; `theta` are the free ones, shape (p,)."""
        found = self.fixed | dict(zip(self.free, np.asarray(theta).tolist(), strict=True))
        law = find_law(self.law)
        # Formulas divide by an exponent, and their limit is reached long before.
        return {name: (float(np.copysign(SMALLEST_EXPONENT, found[name]))
                       if name in self.free and not is_effect(name) and law.units[name] == "1"
                       and abs(found[name]) < SMALLEST_EXPONENT
                       else found[name]) for name in self.names}

    def material(self, values: Mapping[str, float], density: float | None = None, name: str = "") -> Material:
        """The material of these values.

        Raises:
            InputError: values that no material has.
        """
        own = {key: value for key, value in values.items() if not is_effect(key)}
        return Material(self.law, own, density=density, name=name, **build_effect_parts(values, self.bulk))

    def normalised(self, values: Mapping[str, float]) -> tuple[dict[str, float], float]:
        """Values with moduli that add up to `REFERENCE_MODULUS`, and the factor that was taken out of them."""
        size = sum(abs(values[name]) for name in self.moduli)
        factor = size / REFERENCE_MODULUS
        if not (np.isfinite(factor) and factor > 0):
            return dict(values), 1.0
        return {name: float(f"{value / factor:.{_DIGITS}e}") if self.is_modulus(name) else value
                for name, value in values.items()}, factor

    def sizes(self, values: Mapping[str, float]) -> np.ndarray:
        """How large a change of each free parameter is a whole one, shape (p,): a modulus that happens to be small
        counts as a tenth of the shear modulus, another small number as a tenth."""
        stiffness = find_law(self.law).mu0({k: v for k, v in values.items() if not is_effect(k)})
        floor = [0.1 * abs(stiffness) if self.is_modulus(name) else 0.1 for name in self.free]
        return np.maximum([abs(values[name]) for name in self.free], floor)


def _default_bounds(name: str, law: Law) -> tuple[float, float]:
    if is_effect(name):
        return effect_bounds(name)
    return (-EXPONENT_BOUND, EXPONENT_BOUND) if law.units[name] == "1" else (-np.inf, np.inf)
