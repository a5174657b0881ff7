"""Linear elastic constants with damping, by which physics engines state a soft body."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.material.material import Material


@dataclass(frozen=True)
class ElasticConstants:
    """Young's modulus, Poisson's ratio, damping and density of a soft body of a physics engine.

    Attributes:
        young: Young's modulus E at rest, Pa.
        poisson: Poisson's ratio nu at rest, 1; at least 0 and below 0.5.
        damping_time: ratio of viscous to elastic stress per strain rate (Kelvin-Voigt), s.
        density: kg/m3; None: unknown.

    Raises:
        InputError: a value outside its range.

    Examples:
        >>> round(ElasticConstants(3000.0, 0.49).mu, 1)
        1006.7
    """

    young: float
    poisson: float
    damping_time: float = 0.0
    density: float | None = None

    def __post_init__(self):
        # The numbers of a fit are NumPy's, whose text is no Python number.
        for name in ("young", "poisson", "damping_time", "density"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, float(getattr(self, name)))
        if not 0.0 < self.young < math.inf:
            raise InputError(f"must be positive and finite; got {self.young:g} Pa.", field="young")
        if not 0.0 <= self.poisson < 0.5:
            raise InputError(f"must be at least 0 and below 0.5; got {self.poisson:g}.", field="poisson")
        if not 0.0 <= self.damping_time < math.inf:
            raise InputError(f"must be 0 or positive and finite; got {self.damping_time:g} s.", field="damping_time")

    @property
    def mu(self) -> float:
        """Shear modulus at rest, Pa: E / (2 (1 + nu))."""
        return 0.5 * self.young / (1.0 + self.poisson)

    @property
    def lame(self) -> float:
        """First Lame constant lambda at rest, Pa: E nu / ((1 + nu) (1 - 2 nu))."""
        return self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))

    @property
    def bulk_ratio(self) -> float:
        """Ratio K / mu of bulk and shear modulus at rest, 1: 2 (1 + nu) / (3 (1 - 2 nu))."""
        return 2.0 * (1.0 + self.poisson) / (3.0 * (1.0 - 2.0 * self.poisson))


def linearise_material(material: Material, max_poisson: float) -> ElasticConstants:
    """Return the constants with the instantaneous shear modulus of a material at rest, without damping.

    Args:
        material: material; its law beyond small strains, relaxation and softening are not represented.
        max_poisson: largest Poisson's ratio of the program; replaces that of a less compressible material.
    """
    K, mu = material.bulk_modulus, material.mu0
    poisson = max_poisson if math.isinf(K) else min(max_poisson, (3.0 * K - 2.0 * mu) / (6.0 * K + 2.0 * mu))
    return ElasticConstants(2.0 * mu * (1.0 + poisson), poisson, density=material.density)
