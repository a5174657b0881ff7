"""Torsion of a cylinder in closed form: torque and axial force at a held or prescribed axial stretch.

A cylinder of radius a is twisted by psi per undeformed length at the axial stretch l; its radius becomes a l^(-1/2).
The deformation is a simple shear that grows with the radius. Sections do not warp and keep their radius, so that held
ends change nothing at l = 1.

Source: R. S. Rivlin, Phil. Trans. R. Soc. A 242 (1949) 173; Ogden, Non-linear Elastic Deformations, 1984, section 5.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from tissue_sim.laws import Law
    from tissue_sim.material.material import Material
    from tissue_sim.specimen import Specimen

#: Number of Gauss points along the radius; the stress of the laws is smooth in it.
RADIAL_POINTS = 12
#: Step of the shear strain in the derivative of the axial stress.
SHEAR_STEP = 1e-5


@lru_cache
def _make_radial_rule() -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points and weights on the radius from 0 to 1, shapes (points,)."""
    import numpy as np

    points, weights = np.polynomial.legendre.leggauss(RADIAL_POINTS)
    return 0.5 * (1.0 + points), 0.5 * weights


@dataclass(frozen=True)
class TorsionForm(ClosedForm):
    """Closed form of torsion at constant length.

    The abscissa is the shear strain at the rim, gamma = psi a. The nominal stress is 2 M / (pi a^3), the mean of the
    shear stress tau over the section with the weight of its lever arm: 4 int_0^1 tau(gamma x) x^2 dx. At small strain
    it is mu0 gamma, as in simple shear. The volume is constant. A compressible cylinder would change its
    radius, and every method refuses a compressible law.
    """

    includes_change_of_volume: ClassVar[bool] = False

    def _average(self, law: Law, evaluate: Callable[[np.ndarray], np.ndarray], abscissa: np.ndarray,
                 power: int) -> np.ndarray:
        """Return 4 int_0^1 evaluate(abscissa x) x^power dx; `evaluate` may append axes to its argument's shape.

        Raises:
            InputError: a compressible law.
        """
        import numpy as np

        _require_constant_volume(law)
        points, weights = _make_radial_rule()
        values = [evaluate(x * np.asarray(abscissa, dtype=float)) for x in points]
        return np.tensordot(4.0 * weights * points**power, np.array(values), axes=1)

    def stress(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return 2 M / (pi a^3), Pa, shape of `abscissa`; raise an `InputError` for a compressible law."""
        return self._average(law, lambda shear: law.nominal_stress(shear, values, self.law_mode), abscissa, 2)

    def slope(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivative of `stress` with respect to the abscissa, Pa, shape of `abscissa`."""
        return self._average(law, lambda shear: law.nominal_stress_slope(shear, values, self.law_mode), abscissa, 3)

    def stress_parameter_derivatives(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivatives of `stress` with respect to m parameters, shape (*abscissa.shape, m)."""
        return self._average(
            law, lambda shear: law.nominal_stress_parameter_derivatives(shear, values, self.law_mode), abscissa, 2)

    def stress_history(self, material: Material, time: np.ndarray, abscissa: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Return 2 M / (pi a^3) of a motion with relaxation and softening, Pa; see `ClosedForm.stress_history`."""
        history = super().stress_history
        return self._average(material.energy_law, lambda shear: history(material, time, shear, contact_radius),
                             abscissa, 2)

    def complex_modulus(self, material: Material, frequency: np.ndarray, abscissa: float | None = None,
                        contact_radius: float | None = None) -> np.ndarray:
        """Return the complex modulus of 2 M / (pi a^3) over the shear strain at the rim, Pa; see the base class."""
        import numpy as np

        at_shear = super().complex_modulus
        return self._average(material.energy_law,
                             lambda shear: at_shear(material, frequency, float(shear), contact_radius),
                             np.array(abscissa or 0.0), 3)

    def strain_history(self, material: Material, time: np.ndarray, nominal_stress: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Raise an `InputError`: creep under a torque is not implemented, because the strain varies with the radius."""
        raise InputError("must prescribe an angle in torsion; got a torque. Prescribe the angle", field="protocol")

    def convert_motion_and_load(self, specimen: Specimen, motion: np.ndarray,
                                load: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return shear strain at the rim and 2 M / (pi a^3), Pa, of an angle, rad, and a torque, N m.

        Raises:
            InputError: the specimen is not a cylinder.
        """
        import numpy as np

        from tissue_sim.specimen.cylinder import Cylinder

        if not isinstance(specimen, Cylinder):
            raise InputError("must be a cylinder in torsion, whose shear strain depends on the radius; got "
                             f"{specimen.in_words}. State radius_mm.", field="specimen")
        return motion * specimen.radius / specimen.height, 2.0 * load / (np.pi * specimen.radius**3)


@dataclass(frozen=True)
class AxialForceForm(TorsionForm):
    """Torque and axial force of a twisted cylinder, as stresses over the shear strain at the rim.

    Load 0 is 2 M / (pi a^3). Load 1 is -N / (pi a^2), positive if the cylinder pushes the ends apart.

    Load 1 is int_0^1 (s_tt - 2 s_zz) x dx, with the normal stresses s minus the radial one in a simple shear gamma x.
    For Mooney-Rivlin it is gamma^2 (C10 + 2 C01) / 2.

    Attributes:
        load: index of the load, 0 or 1.
    """

    load: int = 0

    @property
    def has_history(self) -> bool:
        """Whether `stress_history` exists: that of the torque."""
        return self.load == 0

    def select_load(self, number: int) -> AxialForceForm:
        """Return the closed form of the load that follows this one by `number`."""
        return replace(self, load=(self.load + number) % 2)

    def _average_normal_stress(self, law: Law, evaluate: Callable, shear: np.ndarray) -> np.ndarray:
        """Return load 1 of the nominal stresses `evaluate(stretches)`, of shapes (..., 2) or (..., 2, m)."""
        import numpy as np

        def compute_difference(shear: np.ndarray) -> np.ndarray:
            """Return s_tt - 2 s_zz; the principal stretches are l, 1/l and, radially, 1."""
            largest = np.hypot(1.0, shear / 2.0) + shear / 2.0
            stretch = np.stack([largest, 1.0 / largest], axis=-1)
            nominal = np.asarray(evaluate(stretch))
            first, second = np.moveaxis(nominal.reshape(*stretch.shape, -1) * stretch[..., None], -2, 0)
            cosine = (shear / np.hypot(2.0, shear))[..., None]  # of twice the angle of the first principal axis
            found = 1.5 * cosine * (first - second) - 0.5 * (first + second)
            return found if nominal.ndim > stretch.ndim else found[..., 0]

        return 0.25 * self._average(law, compute_difference, shear, 1)

    def stress(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the stress of the load, Pa, shape of `abscissa`."""
        return super().stress(law, abscissa, values) if self.load == 0 else self._average_normal_stress(
            law, lambda both: law.nominal_stress(both, values, "biaxial"), abscissa)

    def slope(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivative of `stress` with respect to the abscissa, Pa; of load 1 by central differences."""
        return super().slope(law, abscissa, values) if self.load == 0 else (
            self.stress(law, abscissa + SHEAR_STEP, values)
            - self.stress(law, abscissa - SHEAR_STEP, values)) / (2.0 * SHEAR_STEP)

    def stress_parameter_derivatives(self, law: Law, abscissa: np.ndarray, values: Any) -> np.ndarray:
        """Return the derivatives of `stress` with respect to m parameters, shape (..., m)."""
        return super().stress_parameter_derivatives(law, abscissa, values) if self.load == 0 else \
            self._average_normal_stress(
                law, lambda both: law.nominal_stress_parameter_derivatives(both, values, "biaxial"), abscissa)

    def stress_history(self, material: Material, time: np.ndarray, abscissa: np.ndarray,
                       contact_radius: float) -> np.ndarray:
        """Return 2 M / (pi a^3) with memory; raise an `InputError` for the axial force, which has no such model."""
        self._require_torque()
        return super().stress_history(material, time, abscissa, contact_radius)

    def complex_modulus(self, material: Material, frequency: np.ndarray, abscissa: float | None = None,
                        contact_radius: float | None = None) -> np.ndarray:
        """Return the complex modulus of 2 M / (pi a^3); raise an `InputError` for the axial force."""
        self._require_torque()
        return super().complex_modulus(material, frequency, abscissa, contact_radius)

    def _require_torque(self) -> None:
        """Raise an `InputError` for the axial force, which has no model of relaxation."""
        if self.load != 0:
            raise InputError("must be 'torsion' for a material with memory; got 'torsion_axial_force'. Use torsion, or "
                             "remove relaxation and softening", field="kind")

    def convert_motion_and_load(self, specimen: Specimen, motion: np.ndarray,
                                load: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return shear strain at the rim and the stress of the load, Pa, of an angle, rad, and a load, N m or N."""
        found = super().convert_motion_and_load(specimen, motion, load)
        return found if self.load == 0 or found is None else (found[0], load / specimen.area)


def _require_constant_volume(law: Law) -> None:
    """Raise an `InputError` for a compressible law, whose radius is not known in advance."""
    if law.is_compressible:
        raise InputError(f"must be a law without volumetric response in torsion; got {law.name}. Use another law or "
                         "test", field="law")


#: Torsion of a cylinder at constant length.
TORSION = TorsionForm("simple_shear", "planar", rest=0.0, label="shear strain at the rim [-]")
#: Torsion of a cylinder at constant length, with torque and axial force.
TORSION_WITH_AXIAL_FORCE = AxialForceForm("simple_shear", "planar", rest=0.0, label="shear strain at the rim [-]")


def compute_torque_and_axial_force(law: Law, values: Any, twist: Any, radius: float,
                                   stretch: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the torque, N m, and the axial force, N (tension positive), of a twisted cylinder; shapes of `twist`.

    M = 2 pi int sigma_tz r^2 dr, and with the radial stress from equilibrium
    N = pi int (2 (sigma_zz - sigma_rr) - (sigma_tt - sigma_rr)) r dr, over the deformed section.

    Args:
        law: strain energy of an incompressible material.
        values: parameters, SI.
        twist: angle per undeformed length psi, rad/m, any shape.
        radius: undeformed radius a, m.
        stretch: axial stretch, which the ends hold.

    Raises:
        InputError: a compressible law.

    Examples:
        >>> from tissue_sim.laws import find_law
        >>> torque, force = compute_torque_and_axial_force(find_law("mooney_rivlin"), {"C10": 1000.0, "C01": 500.0},
        ...                                                50.0, 0.01)
        >>> round(1e3 * float(torque), 4), round(float(force), 5)  # mN m, N
        (2.3562, -0.07854)
    """
    import numpy as np

    _require_constant_volume(law)
    points, weights = _make_radial_rule()
    outer, twist = radius * stretch**-0.5, np.asarray(twist, dtype=float)
    r = outer * points
    shear = twist[..., None] * r  # u_t / dZ at the deformed radius
    # F = [[l^-1/2, shear], [0, l]] in (theta, z); b = F F^T; the radial direction has the stretch l^-1/2.
    b_tt, b_tz, b_zz = 1.0 / stretch + shear**2, stretch * shear, np.full_like(shear, stretch**2)
    mean, half = 0.5 * (b_tt + b_zz), np.hypot(0.5 * (b_tt - b_zz), b_tz)
    stretches = np.stack([np.sqrt(mean + half), np.sqrt(stretch) / np.sqrt(mean + half),
                          np.full_like(shear, stretch**-0.5)], axis=-1)
    _, tau = law.compute_energy_and_kirchhoff_stresses(stretches, values)
    centre, amplitude = 0.5 * (tau[..., 0] + tau[..., 1]), 0.5 * (tau[..., 0] - tau[..., 1])
    scale = np.divide(1.0, half, out=np.zeros_like(half), where=half > 0)
    tz, difference = amplitude * scale * b_tz, amplitude * scale * 0.5 * (b_tt - b_zz)
    tt, zz, rr = centre + difference, centre - difference, tau[..., 2]
    torque = 2.0 * np.pi * outer * np.sum(weights * tz * r**2, axis=-1)
    force = np.pi * outer * np.sum(weights * (2.0 * (zz - rr) - (tt - rr)) * r, axis=-1)
    return torque, force
