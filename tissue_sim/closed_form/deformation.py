"""Homogeneous deformations for closed forms with history: stretches, second Piola-Kirchhoff stress, nominal stress.

The hereditary integral acts on components of the isochoric second Piola-Kirchhoff stress S. The nominal stress is
linear in these components. Along the principal axes, with the pressure from the free direction 3, the stress of the
loaded direction i is P_i = l_i S_ii - l_3^2 S_33 / l_i. In simple shear it is P12 = S12 + gamma S22, without the
pressure.

Source: Holzapfel, Nonlinear Solid Mechanics, 2000, sections 6.5 and 6.10.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.laws import Law
from tissue_sim.laws.modes import STRETCH_MODES, StretchMode


class HomogeneousDeformation(ABC):
    """Homogeneous deformation as a function of one or two abscissas.

    Attributes:
        rest: abscissa of the undeformed specimen.
        quantity: name of the abscissa, for messages.
        count: number of abscissas; each has a load.
    """

    rest: ClassVar[float]
    quantity: ClassVar[str]
    count: int = 1

    @abstractmethod
    def measure_strain(self, abscissa: np.ndarray) -> np.ndarray:
        """Return the strain whose change limits a step, shape of `abscissa` (n, count)."""

    @abstractmethod
    def compute_energy_and_stress(self, law: Law, values, abscissa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the energy density, J/m3, shape (n,), and components of S, Pa, shape (n, components).

        Args:
            law: strain energy.
            values: parameters of the law.
            abscissa: shape (n, count).
        """

    @abstractmethod
    def compute_nominal_stress_weights(self, abscissa: np.ndarray) -> np.ndarray:
        """Return the derivatives of the nominal stresses with respect to the components of S.

        Args:
            abscissa: shape (n, count).

        Returns:
            Shape (n, count, components).
        """

    def require_valid(self, abscissa: np.ndarray) -> None:
        """Raise an `InputError` for an abscissa without a deformation; every finite value is valid by default."""
        return


class _PrincipalDeformation(HomogeneousDeformation):
    """Deformation by stretches along the principal axes."""

    rest = 1.0
    quantity = "stretch"

    def measure_strain(self, abscissa: np.ndarray) -> np.ndarray:
        """Return the logarithmic strain."""
        return np.log(abscissa)

    def require_valid(self, abscissa: np.ndarray) -> None:
        """Raise an `InputError` unless every stretch is above 0."""
        if (abscissa <= 0).any():
            raise InputError(f"must be above 0 (1 is undeformed); got {abscissa.min():g}.", field=self.quantity)


class StretchDeformation(_PrincipalDeformation):
    """Deformation of constant volume; the direction 3 is free of stress. A compressible law is refused.

    The components of S are S_11 (for two abscissas S_11 and S_22) and S_33.

    Args:
        mode: principal stretches.
    """

    def __init__(self, mode: StretchMode):
        self.mode, self.count = mode, mode.stretch_count

    def _compute_loaded_and_free_stretches(self, abscissa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the principal stretches, shape (n, 3), and those of loaded directions and the free one, (n, c)."""
        stretches = self.mode.compute_principal_stretches(abscissa if self.count > 1 else abscissa[:, 0])
        return stretches, stretches[:, [*range(self.count), 2]]

    def compute_energy_and_stress(self, law: Law, values, abscissa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return energy and S_ii = tau_i / l_i^2; see the base class.

        Raises:
            InputError: a compressible law, whose free stretches follow from equilibrium.
        """
        if law.is_compressible:
            raise InputError(f"must be a law without volumetric response in a history of constant volume; got "
                             f"{law.name}. Use compute_stress_history, or law.nominal_stress", field="law")
        stretches, used = self._compute_loaded_and_free_stretches(abscissa)
        energy, tau = law.compute_energy_and_kirchhoff_stresses(stretches, values)
        return energy, tau[:, [*range(self.count), 2]] / used**2

    def compute_nominal_stress_weights(self, abscissa: np.ndarray) -> np.ndarray:
        """Return the weights l_i and -l_3^2 / l_i; see the base class."""
        _, used = self._compute_loaded_and_free_stretches(abscissa)
        weights = np.zeros((len(used), self.count, self.count + 1))
        for i in range(self.count):
            weights[:, i, i] = used[:, i]
            weights[:, i, -1] = -used[:, -1]**2 / used[:, i]
        return weights


class ConfinedDeformation(_PrincipalDeformation):
    """Uniaxial strain with J = stretch; the component of S is S_11, the nominal stress l S_11.

    With memory S_11 is that of the hereditary integral, whose Kirchhoff stress may have a trace, as in the finite
    elements. The volumetric stress is added by `tissue_sim.closed_form.confined`.
    """

    def compute_energy_and_stress(self, law: Law, values, abscissa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return energy and S_11 = tau_1 / l^2; see the base class."""
        stretches = np.ones((len(abscissa), 3))
        stretches[:, 0] = abscissa[:, 0]
        energy, tau = law.compute_energy_and_kirchhoff_stresses(stretches, values)
        return energy, tau[:, :1] / abscissa**2

    def compute_nominal_stress_weights(self, abscissa: np.ndarray) -> np.ndarray:
        """Return the weight l; see the base class."""
        return abscissa[:, :, None]


class SimpleShear(HomogeneousDeformation):
    """Simple shear gamma; the components of S are S_12 and S_22."""

    rest = 0.0
    quantity = "shear strain"

    def measure_strain(self, abscissa: np.ndarray) -> np.ndarray:
        """Return the shear strain itself."""
        return abscissa

    def compute_energy_and_stress(self, law: Law, values, abscissa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return energy and stresses; principal stretches l, 1/l with l - 1/l = gamma, first axis along (l, 1)."""
        strain = abscissa[:, 0]
        l1 = np.hypot(1.0, strain / 2.0) + strain / 2.0
        energy, tau = law.compute_energy_and_kirchhoff_stresses(np.stack([l1, 1.0 / l1, np.ones_like(l1)], axis=-1),
                                                                values)
        tau12 = (tau[:, 0] - tau[:, 1]) * l1 / (1.0 + l1**2)
        tau22 = (tau[:, 0] + tau[:, 1] * l1**2) / (1.0 + l1**2)
        return energy, np.stack([tau12 - strain * tau22, tau22], axis=-1)

    def compute_nominal_stress_weights(self, abscissa: np.ndarray) -> np.ndarray:
        """Return the weights 1 and gamma; see the base class."""
        return np.stack([np.ones_like(abscissa), abscissa], axis=-1)


#: Mode of a law -> deformation.
DEFORMATIONS: dict[str, HomogeneousDeformation] = {
    **{name: StretchDeformation(mode) for name, mode in STRETCH_MODES.items()}, "confined": ConfinedDeformation(),
    "simple_shear": SimpleShear()}
