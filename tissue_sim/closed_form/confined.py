"""Confined compression in closed form: rigid walls without friction hold the cross-section."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from tissue_sim.laws import Law
    from tissue_sim.material.material import Material


@dataclass(frozen=True)
class ConfinedForm(ClosedForm):
    """Closed form of uniaxial strain, J = stretch: the nominal stress is that of the law plus K (J - 1).

    The isochoric stretches are those of uniaxial loading by s = l^(2/3), so that P = P_uniaxial(s) 2/3 l^(-1/3)
    + K (l - 1). At small strain the slope is the aggregate modulus K + 4/3 mu0. The law and the bulk modulus are
    identified together with another test; alone, the test determines the aggregate modulus. Only the isochoric stress
    relaxes and softens. `stress`, `slope` and `stress_parameter_derivatives` are those of the isochoric part; for a
    compressible law they are those of the whole stress.
    """

    needs_bulk: ClassVar[bool] = True

    def stress(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the isochoric part of the nominal stress without history, Pa, shape of `abscissa`."""
        if law.is_compressible:
            return super().stress(law, abscissa, values)
        return law.nominal_stress(abscissa**(2.0 / 3.0), values) * self._uniaxial_rate(abscissa)

    def slope(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivative of `stress` with respect to the stretch, Pa, shape of `abscissa`."""
        if law.is_compressible:
            return super().slope(law, abscissa, values)
        uniaxial, rate = abscissa**(2.0 / 3.0), self._uniaxial_rate(abscissa)
        return law.nominal_stress_slope(uniaxial, values) * rate**2 - law.nominal_stress(
            uniaxial, values) * rate / (3.0 * abscissa)

    def stress_parameter_derivatives(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivatives of `stress` with respect to m parameters, shape (*abscissa.shape, m)."""
        if law.is_compressible:
            return super().stress_parameter_derivatives(law, abscissa, values)
        derivatives = law.nominal_stress_parameter_derivatives(abscissa**(2.0 / 3.0), values)
        return derivatives * self._uniaxial_rate(abscissa)[..., None]

    @staticmethod
    def _uniaxial_rate(abscissa: np.ndarray) -> np.ndarray:
        """Return ds/dl = 2/3 l^(-1/3) of the isochoric uniaxial stretch s."""
        return 2.0 / 3.0 * abscissa**(-1.0 / 3.0)

    def stress_history(self, material: Material, time: np.ndarray, abscissa: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Return the nominal stress, Pa, shape (n,); arguments as in `ClosedForm.stress_history`.

        Raises:
            InputError: the material is incompressible, or has no closed form.
        """
        import numpy as np

        bulk_modulus = self._require_added_bulk_modulus(material)
        isochoric = super().stress_history(material, time, abscissa, contact_radius)
        return isochoric + bulk_modulus * (np.asarray(abscissa, dtype=float) - 1.0)

    def complex_modulus(self, material: Material, frequency: np.ndarray, abscissa: float | None = None,
                        contact_radius: float | None = None) -> np.ndarray:
        """Return the complex modulus, Pa, with the bulk modulus, which does not relax; see the base class.

        Raises:
            InputError: as in `stress_history`, or an invalid frequency or stretch.
        """
        isochoric = super().complex_modulus(material, frequency, abscissa, contact_radius)
        return isochoric + self._require_added_bulk_modulus(material)

    def strain_history(self, material: Material, time: np.ndarray, nominal_stress: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Return the stretch under a prescribed stress, shape (n,); see `ClosedForm.strain_history`.

        Raises:
            InputError: as in `stress_history`, or a stress that the material does not reach.
        """
        from tissue_sim.closed_form.creep import compute_strain_history

        return compute_strain_history(self.law_mode, material, time, nominal_stress, contact_radius,
                                      self._require_added_bulk_modulus(material))

    @staticmethod
    def _require_added_bulk_modulus(material: Material) -> float:
        """Return the bulk modulus that the law does not contain, Pa: 0 for a compressible law.

        Raises:
            InputError: the bulk modulus is infinite.
        """
        if material.energy_law.is_compressible:
            return 0.0
        if math.isinf(material.bulk_modulus):
            raise InputError("must be finite in confined compression, which changes the volume; got an incompressible "
                             "material. State bulk.K_Pa or another bulk response", field="bulk")
        return material.bulk_modulus

    def compute_first_invariant(self, abscissa: Any) -> Any:
        """Return the isochoric invariant I1 = l^(4/3) + 2 l^(-2/3), shape of `abscissa`."""
        return abscissa**(4.0 / 3.0) + 2.0 * abscissa**(-2.0 / 3.0)

    def find_extreme_stretches(self, low: float, high: float) -> tuple[float, float]:
        """Return the smallest and largest isochoric principal stretch, l^(2/3) and l^(-1/3); see the base class."""
        every = [stretch**power for stretch in (low, high, 1.0) for power in (2.0 / 3.0, -1.0 / 3.0)]
        return min(every), max(every)


#: Confined compression.
CONFINED = ConfinedForm("confined", "uniaxial")
