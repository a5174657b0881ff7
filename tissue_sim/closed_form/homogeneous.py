"""Homogeneous deformations: nominal stress in closed form, of an incompressible material or a compressible law."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    import numpy as np

    from tissue_sim.laws import Law
    from tissue_sim.material.material import Material
    from tissue_sim.specimen import Specimen


@dataclass(frozen=True)
class ClosedForm:
    """Closed form of the stress in a kind of test.

    Attributes:
        law_mode: mode of `Law.nominal_stress`.
        mode: mode of `tissue_sim.laws.StabilityRange.limits` along which a law may lose its stability.
        rest: abscissa of the undeformed specimen: 1 for a stretch, 0 for a shear strain of either sign.
        label: label of the abscissa, for tables and axes.
        lateral: exponent: the principal stretch farthest from a stretch l is l^-lateral.
    """

    law_mode: str
    mode: str
    rest: float = 1.0
    label: str = "stretch [-]"
    lateral: float = 0.5

    #: Whether the stress depends on the bulk modulus, so that it is a function of the material and not of the law.
    needs_bulk: ClassVar[bool] = False
    #: Whether `stress` and `stress_history` of a subclass return the first stress of a mode that has several stresses.
    is_first_load_of_mode: ClassVar[bool] = False
    #: Whether the closed form holds for a law of full stretches, whose volume may change.
    includes_change_of_volume: ClassVar[bool] = True

    @property
    def has_column(self) -> bool:
        """Whether a column under its own weight has a closed form; see `tissue_sim.closed_form.column`."""
        return self.law_mode == "uniaxial"

    @property
    def has_history(self) -> bool:
        """Whether `stress_history` exists."""
        return True

    def select_load(self, number: int) -> ClosedForm:
        """Return the closed form of one of several loads; see `tissue_sim.TestKind.select_load`.

        Args:
            number: index of the load, from 0.
        """
        return self

    def stress(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the nominal stress without history, Pa, negative in compression, shape of `abscissa`.

        A form of k motions gets an abscissa of shape (n, k), that of the load first, and returns the shape (n,).

        Examples:
            >>> from tissue_sim import KINDS, find_law
            >>> tension = KINDS["uniaxial_tension"].require_closed_form()
            >>> float(tension.stress(find_law("neo_hooke"), 1.1, {"C10": 1000.0}).round(1))
            547.1
        """
        return law.nominal_stress(abscissa, values, self.law_mode)

    def slope(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivative of the nominal stress with respect to the abscissa, Pa, shape of `abscissa`."""
        return law.nominal_stress_slope(abscissa, values, self.law_mode)

    def stress_parameter_derivatives(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivatives of the nominal stress with respect to m parameters, shape (*abscissa.shape, m)."""
        return law.nominal_stress_parameter_derivatives(abscissa, values, self.law_mode)

    def convert_motion_and_load(self, specimen: Specimen, motion: np.ndarray,
                                load: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Convert the channels of the machine to strain and nominal stress, positive under load.

        Args:
            specimen: specimen of the test.
            motion: motion of the machine, such as an angle, rad, shape (n,).
            load: load, such as a torque, N m, shape (n,).

        Returns:
            Strain, 1, and stress, Pa, shapes (n,); None: the model uses displacement and force.

        Raises:
            InputError: the conversion does not hold for the specimen.
        """
        return None

    def stress_history(self, material: Material, time: np.ndarray, abscissa: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Return the nominal stress of a motion with relaxation, drainage and softening, Pa, shape (n,).

        Args:
            material: the material.
            time: s, shape (n,).
            abscissa: stretch or shear strain, shape (n,).
            contact_radius: m, for the time of drainage.

        Raises:
            InputError: the material has no closed form.
        """
        from tissue_sim.closed_form.histories import compute_stress_history

        return compute_stress_history(self.law_mode, material, time, abscissa, contact_radius)

    def complex_modulus(self, material: Material, frequency: np.ndarray, abscissa: float | None = None,
                        contact_radius: float | None = None) -> np.ndarray:
        """Return storage modulus + i loss modulus of small oscillations, Pa, complex, shape (n,).

        Args:
            material: the material.
            frequency: Hz, shape (n,).
            abscissa: stretch or shear strain about which the specimen oscillates, fully relaxed; None: undeformed.
            contact_radius: m, for the time of drainage.

        Raises:
            InputError: see `tissue_sim.complex_modulus`.
        """
        from tissue_sim.closed_form.oscillation import complex_modulus

        return complex_modulus(material, frequency, self.law_mode, abscissa, contact_radius)

    def strain_history(self, material: Material, time: np.ndarray, nominal_stress: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Return stretch or shear strain of a test with a prescribed nominal stress: the inverse of `stress_history`.

        Args:
            material: the material.
            time: s, shape (n,).
            nominal_stress: Pa, shape (n,), linear between the points.
            contact_radius: m, for the time of drainage.

        Returns:
            Shape (n,).

        Raises:
            InputError: the material has no closed form, or does not reach the stress.
        """
        from tissue_sim.closed_form.creep import compute_strain_history

        return compute_strain_history(self.law_mode, material, time, nominal_stress, contact_radius)

    def compute_first_invariant(self, abscissa: Any) -> Any:
        """Return the isochoric invariant I1, shape of `abscissa`."""
        from tissue_sim.laws.law import compute_first_invariant

        return compute_first_invariant(abscissa, self.law_mode)

    def find_extreme_stretches(self, low: float, high: float) -> tuple[float, float]:
        """Return the smallest and largest principal stretch between two abscissas and the undeformed state."""
        if self.rest == 0.0:
            # A planar deformation and a rotation; principal stretches l and 1/l with l - 1/l = gamma.
            shear = max(abs(low), abs(high))
            largest = shear / 2 + math.sqrt(1 + shear**2 / 4)
            return 1 / largest, largest
        every = [stretch for end in (low, high, 1.0) for stretch in (end, end**-self.lateral)]
        return min(every), max(every)


#: Lubricated compression and uniaxial tension; equations 4 to 7 of the reference study.
UNIAXIAL = ClosedForm("uniaxial", "uniaxial")
#: Simple shear.
SIMPLE_SHEAR = ClosedForm("simple_shear", "planar", rest=0.0, label="shear strain [-]")
#: Tension of a wide sheet at constant width (pure shear).
PLANAR = ClosedForm("planar", "planar", lateral=1.0)
#: Equal tension in two directions of a sheet; the stress is that of one direction.
EQUIBIAXIAL = ClosedForm("equibiaxial", "equibiaxial", lateral=2.0)
