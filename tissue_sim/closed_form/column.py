"""Lubricated compression of an incompressible column under its own weight, between frictionless plates.

A slice at the undeformed depth s below the top carries the pressure p of the plate and the weight above it:
P(stretch) = -(p + w s), per undeformed area, with the specific weight w. The height of the column is the integral of
the stretches; the displacement of the plate is measured from the height of the column under its weight alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from tissue_sim.errors import InputError
from tissue_sim.laws import Law
from tissue_sim.specimen import Specimen


@dataclass(frozen=True)
class ColumnSettings:
    """Settings of the division of a column into slices.

    Measured errors of the force: 3e-9 for the study's specimen to strain 0.14, 5e-7 for its laws to strain 0.5, 1e-5
    for Ogden's law with exponent 50; the contribution of the slices is below 1e-10.

    Attributes:
        slices: number of points of the Gauss-Legendre rule between top and base.
        states: number of states on the curve of pressure against displacement.
        smallest_stretch: smallest stretch of a slice, 1.
        table_points: points of the table of pressure against stretch from which Newton's method starts.
        max_iterations: limit of Newton's method.
        tolerance: relative change, 1, after which the next iteration is below the rounding error.
    """

    slices: int = 8
    states: int = 129
    smallest_stretch: float = 0.01
    table_points: int = 241
    max_iterations: int = 50
    tolerance: float = 1e-9


_SETTINGS = ColumnSettings()
#: Gauss-Legendre nodes (row 0) and weights (row 1) on the interval -1 to 1.
_LEGENDRE = np.array(np.polynomial.legendre.leggauss(_SETTINGS.slices))
#: Gauss-Legendre nodes on the interval 0 to 1.
_NODES = 0.5 * (1.0 + _LEGENDRE[0])
#: Gauss-Legendre weights on the interval 0 to 1.
_WEIGHTS = 0.5 * _LEGENDRE[1]


@dataclass(frozen=True)
class SettledColumn:
    """Column in equilibrium under its own weight, without the plate.

    Attributes:
        moulded_height: undeformed height, m.
        height: height under the weight, m.
        base_stretch: stretch of the slice on the base, 1.
    """

    moulded_height: float
    height: float
    base_stretch: float

    @property
    def sag(self) -> float:
        """Loss of height by the weight, m."""
        return self.moulded_height - self.height


@dataclass(frozen=True)
class Column:
    """Lubricated compression with self-weight; without weight the results are those of `Law.nominal_stress`.

    The methods take a law, displacements of the plate (m, any shape) and the parameters of the law (mapping or array).
    The results are NaN if no stable equilibrium is found: the pressure of the law does not increase with compression up
    to that at the base, or the stretch at the base is below `ColumnSettings.smallest_stretch`. At negative
    displacements the force is 0.

    Attributes:
        specimen: height, meaning of the height, and specific weight.

    Source: equilibrium of a bar in its reference configuration, dP/dZ = w (Holzapfel, Nonlinear Solid Mechanics, 2000,
    section 4.3).

    Examples:
        >>> from tissue_sim import Specimen, find_law
        >>> column = Column(Specimen(0.040, 0.070, density=1040.0, gravity=9.81))
        >>> sag = column.settle(find_law("neo_hooke"), {"C10": 1000.0}).sag  # m
        >>> round(1e3 * sag, 2)
        3.85
    """

    specimen: Specimen

    def settle(self, law: Law, values) -> SettledColumn:
        """Compute the equilibrium under the own weight, which is the state at the start of the test.

        Raises:
            InputError: no stable equilibrium under the weight exists.
        """
        curve = self._compute_curve(law, values, 0.0)
        if not curve.states:
            weight = self.specimen.specific_weight * self.specimen.height
            raise InputError(f"{law.name} with these parameters does not carry the specimen's weight, {weight:.4g} Pa "
                             "at its base; check the units of density, height and parameters",
                             field="specimen.density")
        return SettledColumn(curve.moulded_height, float(curve.height[0]), float(curve.base_stretch[0]))

    def nominal_stress(self, law: Law, displacement, values) -> np.ndarray:
        """Return minus the force of the plate over the undeformed cross-section, Pa, shape of `displacement`."""
        return self._evaluate_curve_or_nan(law, displacement, values, lambda curve: curve.nominal_stress_spline)

    def stress_displacement_slope(self, law: Law, displacement, values) -> np.ndarray:
        """Return d(nominal stress)/d(displacement), Pa/m, shape of `displacement`."""
        return self._evaluate_curve_or_nan(law, displacement, values,
                                           lambda curve: curve.nominal_stress_spline.derivative())

    def nominal_stress_parameter_derivatives(self, law: Law, displacement, values) -> np.ndarray:
        """Return d(nominal stress)/d(parameter) at constant displacement, shape (*displacement.shape, m).

        The sag depends on the parameters, and so does the undeformed height if the settled height is given.
        """
        return self._evaluate_curve_or_nan(law, displacement, values,
                                           lambda curve: curve.stress_parameter_derivative_spline, len(law.parameters))

    def base_stretch_at_displacement(self, law: Law, displacement, values) -> np.ndarray:
        """Return the stretch of the slice on the base, the smallest of all slices, shape of `displacement`."""
        return self._evaluate_curve_or_nan(law, np.maximum(displacement, 0.0), values,
                                           lambda curve: CubicSpline(curve.displacement, curve.base_stretch))

    def _compute_curve(self, law: Law, values, depth: float) -> _CompressionCurve:
        """Return the cached compression curve, which reaches at least `depth`, m, if the column is stable."""
        return _curve(self.specimen, law, tuple(law.convert_parameters_to_array(values).tolist()), depth)

    def _evaluate_curve_or_nan(self, law: Law, displacement, values, choose, *width: int) -> np.ndarray:
        """Evaluate the spline that `choose` returns: 0 at negative displacements, NaN beyond the stable branch."""
        displacement = np.asarray(displacement, dtype=float)
        curve = self._compute_curve(law, values, float(displacement.max(initial=0.0)))
        touching = displacement >= 0
        reached = touching & (displacement <= curve.largest_displacement)
        result = np.zeros((*displacement.shape, *width))
        result[touching & ~reached] = np.nan
        if reached.any():
            result[reached] = choose(curve)(displacement[reached])
        return result


class _CompressionCurve:
    """States of the column from rest to at least `depth`, m, or to the end of the stable branch.

    Attributes:
        states: number n of states; 0 if the column has no equilibrium under its weight.
        pressure: of the plate, Pa, shape (n,).
        displacement, height: m, shape (n,).
        base_stretch: 1, shape (n,).
    """

    def __init__(self, specimen: Specimen, law: Law, values: tuple[float, ...], depth: float):
        self.specimen, self.law, self.values = specimen, law, np.array(values)
        # Extreme parameters overflow; the curve ends at the first value that is not finite.
        with np.errstate(all="ignore"):
            branch = _CompressiveBranch(law, self.values)
            self.moulded_height, settled = self._find_undeformed_and_settled_height(branch)
            # The top carries less than the mean of the slices, so that its stretch exceeds the mean stretch. The factor
            # 1.001 keeps the last displacement inside of the curve despite rounding.
            end = (settled - 1.001 * max(depth, 0.01 * specimen.height)) / self.moulded_height
            top = np.linspace(0.0, np.log(np.fmax(end, _SETTINGS.smallest_stretch)), _SETTINGS.states)
            self.pressure = -law.nominal_stress(np.exp(top), self.values)
            self.pressure[0] = 0.0
            base = branch.log_stretch_at_pressure_or_nan(self.pressure + specimen.specific_weight * self.moulded_height)
            self.stretches, weights, softness = _compute_slice_stretches_weights_softness(law, self.values, top, base)
            self.base_stretch = np.exp(base)
            self.height = self.moulded_height * np.sum(weights * self.stretches, axis=1)
            self.displacement = self.height[0] - self.height
            is_stable = np.isfinite(self.displacement)
            is_stable[1:] &= (np.diff(self.displacement) > 0) & (np.diff(self.pressure) > 0)
        count = _count_true_before_first_false(is_stable)
        # d(displacement)/d(pressure) of each slice, m/Pa.
        self.softness = self.moulded_height * softness
        # Cubic splines need four points.
        self.states = count if count >= 4 else 0
        for name in ("pressure", "base_stretch", "height", "displacement", "stretches", "softness"):
            setattr(self, name, getattr(self, name)[: self.states])

    @property
    def largest_displacement(self) -> float:
        """Largest displacement, m; minus infinity if the column has no equilibrium under its weight."""
        return float(self.displacement[-1]) if self.states else -np.inf

    def _find_undeformed_and_settled_height(self, branch: _CompressiveBranch) -> tuple[float, float]:
        """Find the undeformed height and the height under the weight, m; NaN if no equilibrium is found."""
        given = height = self.specimen.height
        # The settled height is a concave function of the undeformed one: Newton's method from below does not overshoot.
        for _ in range(_SETTINGS.max_iterations):
            base = branch.log_stretch_at_pressure_or_nan(np.array([self.specimen.specific_weight * height]))
            stretches, weights, _ = _compute_slice_stretches_weights_softness(self.law, self.values, np.zeros(1), base)
            settled = height * float(np.sum(weights * stretches))
            if self.specimen.height_is == "moulded":
                return height, settled
            step = (given - settled) / float(np.exp(base[0]))
            if not abs(step) > _SETTINGS.tolerance * height:
                return height + step, given
            height += step
        return np.nan, np.nan

    @cached_property
    def nominal_stress_spline(self) -> CubicHermiteSpline:
        """Nominal stress against displacement, with the exact slope at each state."""
        return CubicHermiteSpline(self.displacement, 0.0 - self.pressure, -1.0 / self.softness.sum(axis=1))

    @cached_property
    def stress_parameter_derivative_spline(self) -> CubicSpline:
        """Derivatives of the nominal stress with respect to the parameters, by implicit differentiation; (n, m)."""
        # Loss of height at constant pressure and undeformed height.
        lost = np.sum(self.softness[:, :, None]
                      * self.law.nominal_stress_parameter_derivatives(self.stretches, self.values),
                      axis=1)
        if self.specimen.height_is == "moulded":
            moved = lost[0]
        else:
            # The settled height is given, so that the undeformed height depends on the parameters.
            moved = np.outer(self.base_stretch, lost[0] / self.base_stretch[0])
        return CubicSpline(self.displacement, (lost - moved) / self.softness.sum(axis=1)[:, None])


#: Cached because a fit evaluates stress, derivatives and slope at the same parameters in turn.
_curve = lru_cache(maxsize=8)(_CompressionCurve)


class _CompressiveBranch:
    """Compressive branch of a law, inverted as far as its pressure increases from rest."""

    def __init__(self, law: Law, values: np.ndarray):
        self.law, self.values = law, values
        points = np.linspace(0.0, np.log(_SETTINGS.smallest_stretch), _SETTINGS.table_points)
        pressure = -law.nominal_stress(np.exp(points), values)
        pressure[0] = 0.0
        rising = np.isfinite(pressure) & (law.nominal_stress_slope(np.exp(points), values) > 0)
        rising[1:] &= np.diff(pressure) > 0
        count = _count_true_before_first_false(rising)
        self.points, self.pressure = points[:count], pressure[:count]

    def log_stretch_at_pressure_or_nan(self, pressure: np.ndarray) -> np.ndarray:
        """Return the logarithm of the stretch at nominal pressures, Pa, shape (n,); NaN beyond the branch."""
        result = np.full(pressure.shape, np.nan)
        if self.pressure.size < 2:
            return result
        inside = (pressure >= 0) & (pressure <= self.pressure[-1])
        target = pressure[inside]
        # Newton's method, limited to one cell of the table.
        cell = np.clip(np.searchsorted(self.pressure, target), 1, self.pressure.size - 1)
        x = np.interp(target, self.pressure, self.points)
        change = np.full(x.shape, np.inf)
        for _ in range(_SETTINGS.max_iterations):
            if (np.abs(change) <= _SETTINGS.tolerance).all():
                break
            stretch = np.exp(x)
            gap = self.law.nominal_stress(stretch, self.values) + target
            slope = stretch * self.law.nominal_stress_slope(stretch, self.values)
            moved = np.clip(x - gap / slope, self.points[cell], self.points[cell - 1])
            x, change = moved, moved - x
        result[inside] = np.where(np.abs(change) <= _SETTINGS.tolerance, x, np.nan)
        return result


def _compute_slice_stretches_weights_softness(law: Law, values: np.ndarray, top: np.ndarray,
                                              base: np.ndarray) -> tuple[np.ndarray, ...]:
    """Compute the stretches of the slices and their quadrature weights.

    Args:
        law: strain energy.
        values: parameters of the law.
        top: logarithms of the stretch at the top, shape (n,).
        base: logarithms of the stretch at the base, shape (n,).

    Returns:
        Stretches of the slices; weights, as fractions of the undeformed height; weights over P', 1/Pa; each of shape
        (n, slices).

    The rule is applied in x = log(stretch): with dP = -w ds an interval dx is a depth proportional to stretch P' dx,
    which is a smooth function, so that no stretch at a given depth has to be computed.
    """
    stretches = np.exp(top[:, None] + (base - top)[:, None] * _NODES)
    weights, slopes = _WEIGHTS * stretches, law.nominal_stress_slope(stretches, values)
    softness = weights / np.sum(weights * slopes, axis=1, keepdims=True)
    return stretches, softness * slopes, softness


def _count_true_before_first_false(flags: np.ndarray) -> int:
    """Return the number of true values before the first false value."""
    return flags.size if flags.all() else int(np.argmin(flags))
