"""A column under its own weight between frictionless plates: lubricated compression of a specimen that weighs.

The material is incompressible. A slice at the undeformed depth s below the top carries the plate's pressure p and what
is above it, P(stretch) = -(p + w s) with the specific weight w, per undeformed area. The column's height is the
integral of the stretches; the displacement of the plate counts from the height at which the column has settled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from tissue_sim.errors import InputError
from tissue_sim.laws import Law
from tissue_sim.specimen import Specimen

#: Slices of the Gauss-Legendre rule between top and base, and states on the curve of pressure against displacement.
#: Measured force errors: 3e-9 for the study's specimen to strain 0.14, 5e-7 for its laws to 0.5; 1e-5 for Ogden with
#: exponent 50. The slices' share in them is below 1e-10.
SLICES, STATES = 8, 129
#: Smallest stretch of a slice, and points of the table in which it is looked up.
SMALLEST_STRETCH, TABLE_POINTS = 0.01, 241
#: Newton's method: steps at most, and the relative change after which the next one is below rounding.
STEPS, TOLERANCE = 50, 1e-9

_PLACES, _SHARES = np.polynomial.legendre.leggauss(SLICES)
_PLACES, _SHARES = 0.5 * (1.0 + _PLACES), 0.5 * _SHARES


@dataclass(frozen=True)
class Settled:
    """The column without the plate.

    Attributes:
        moulded_height, height: m, undeformed and settled.
        base_stretch: of the slice on the base.
    """

    moulded_height: float
    height: float
    base_stretch: float

    @property
    def sag(self) -> float:
        """By how much it is lower than it was moulded, m."""
        return self.moulded_height - self.height


@dataclass(frozen=True)
class Column:
    """Lubricated compression with self-weight: what `Law.nominal_stress` and its derivatives are without.

    Its methods take a law, displacements of the plate (m, any shape) and the law's parameters (mapping or array). Where
    no stable equilibrium is found they return NaN: the law's pressure does not rise with compression as far as the
    base needs, or the base would be below `SMALLEST_STRETCH`. At negative displacements the plate feels nothing.

    Attributes:
        specimen: its height, what that height is, and its specific weight; without weight this is the plain law.

    Source: equilibrium of a bar in its reference configuration, dP/dZ = w (Holzapfel, Nonlinear Solid Mechanics, 2000,
    section 4.3).
    """

    specimen: Specimen

    def settle(self, law: Law, values) -> Settled:
        """The state in which the test begins.

        Raises:
            InputError: the law does not carry the column's own weight.
        """
        curve = self._curve(law, values, 0.0)
        if not curve.states:
            weight = self.specimen.specific_weight * self.specimen.height
            raise InputError(f"{law.name} with these parameters does not carry the specimen's own weight, {weight:.4g} "
                             "Pa at its base; check density, height and parameters for their units",
                             field="specimen.density")
        return Settled(curve.moulded_height, float(curve.height[0]), float(curve.base_stretch[0]))

    def nominal_stress(self, law: Law, displacement, values) -> np.ndarray:
        """Minus the plate's force over the undeformed cross-section, Pa; shape of `displacement`."""
        return self._along(law, displacement, values, lambda curve: curve.stress)

    def nominal_stress_slope(self, law: Law, displacement, values) -> np.ndarray:
        """d(nominal stress)/d(displacement), Pa/m; shape of `displacement`."""
        return self._along(law, displacement, values, lambda curve: curve.stress.derivative())

    def nominal_stress_derivatives(self, law: Law, displacement, values) -> np.ndarray:
        """d(nominal stress)/d(parameter) at the same displacement; shape (*displacement.shape, m).

        The sag, and the moulded height of a specimen that was measured as placed, move with the parameters.
        """
        return self._along(law, displacement, values, lambda curve: curve.stress_derivatives, len(law.parameters))

    def base_stretch(self, law: Law, displacement, values) -> np.ndarray:
        """Stretch of the slice on the base, the lowest of all; shape of `displacement`."""
        return self._along(law, np.maximum(displacement, 0.0), values,
                           lambda curve: CubicSpline(curve.displacement, curve.base_stretch))

    def _curve(self, law: Law, values, depth: float) -> _Curve:
        return _curve(self.specimen, law, tuple(law.as_array(values).tolist()), depth)

    def _along(self, law: Law, displacement, values, choose, *width: int) -> np.ndarray:
        displacement = np.asarray(displacement, dtype=float)
        curve = self._curve(law, values, float(displacement.max(initial=0.0)))
        touching = displacement >= 0
        reached = touching & (displacement <= curve.end)
        result = np.zeros((*displacement.shape, *width))
        result[touching & ~reached] = np.nan
        if reached.any():
            result[reached] = choose(curve)(displacement[reached])
        return result


class _Curve:
    """States of the column from rest to at least `depth` (m), or to where its law carries no more.

    Attributes:
        states: their number n; 0 where the column does not even settle.
        pressure: of the plate, Pa. displacement, height: m. base_stretch. All of shape (n,).
    """

    def __init__(self, specimen: Specimen, law: Law, values: tuple[float, ...], depth: float):
        self.specimen, self.law, self.values = specimen, law, np.array(values)
        # Wild parameters overflow; what is not finite ends the curve.
        with np.errstate(all="ignore"):
            branch = _Branch(law, self.values)
            self.moulded_height, settled = self._settle(branch)
            # The top carries less than the mean of the slices, so it ends above the mean stretch; a little farther, so
            # that rounding does not leave the last displacement out.
            end = (settled - 1.001 * max(depth, 0.01 * specimen.height)) / self.moulded_height
            top = np.linspace(0.0, np.log(np.fmax(end, SMALLEST_STRETCH)), STATES)
            self.pressure = -law.nominal_stress(np.exp(top), self.values)
            self.pressure[0] = 0.0
            base = branch.log_stretch(self.pressure + specimen.specific_weight * self.moulded_height)
            self.stretches, shares, softness = _slices(law, self.values, top, base)
            self.base_stretch = np.exp(base)
            self.height = self.moulded_height * np.sum(shares * self.stretches, axis=1)
            self.displacement = self.height[0] - self.height
            going_on = np.isfinite(self.displacement)
            going_on[1:] &= (np.diff(self.displacement) > 0) & (np.diff(self.pressure) > 0)
        count = _leading(going_on)
        # d(displacement)/d(pressure on it) of each slice, m/Pa.
        self.softness = self.moulded_height * softness
        # Cubic splines need four points.
        self.states = count if count >= 4 else 0
        for name in ("pressure", "base_stretch", "height", "displacement", "stretches", "softness"):
            setattr(self, name, getattr(self, name)[: self.states])

    @property
    def end(self) -> float:
        """Largest displacement, m; minus infinity where the column does not settle."""
        return float(self.displacement[-1]) if self.states else -np.inf

    def _settle(self, branch: _Branch) -> tuple[float, float]:
        """Moulded and settled height, m; NaN where there is none."""
        given = height = self.specimen.height
        # The settled height is a concave function of the moulded one: Newton's method from below does not overshoot.
        for _ in range(STEPS):
            base = branch.log_stretch(np.array([self.specimen.specific_weight * height]))
            stretches, shares, _ = _slices(self.law, self.values, np.zeros(1), base)
            settled = height * float(np.sum(shares * stretches))
            if self.specimen.height_is == "moulded":
                return height, settled
            step = (given - settled) / float(np.exp(base[0]))
            if not abs(step) > TOLERANCE * height:
                return height + step, given
            height += step
        return np.nan, np.nan

    @cached_property
    def stress(self) -> CubicHermiteSpline:
        """Nominal stress as a function of the displacement, with the exact slope at each state."""
        return CubicHermiteSpline(self.displacement, 0.0 - self.pressure, -1.0 / self.softness.sum(axis=1))

    @cached_property
    def stress_derivatives(self) -> CubicSpline:
        """Its derivatives with respect to the parameters, by implicit differentiation of the height; (n, m)."""
        # Height lost at the same pressure and moulded height.
        lost = np.sum(self.softness[:, :, None] * self.law.nominal_stress_derivatives(self.stretches, self.values),
                      axis=1)
        if self.specimen.height_is == "moulded":
            moved = lost[0]
        else:
            # The settled height is the measured one, so the moulded height moves: a slice more at the base.
            moved = np.outer(self.base_stretch, lost[0] / self.base_stretch[0])
        return CubicSpline(self.displacement, (lost - moved) / self.softness.sum(axis=1)[:, None])


#: The fit asks for stress, derivatives and slope at the same parameters in turn.
_curve = lru_cache(maxsize=8)(_Curve)


class _Branch:
    """The law in compression, inverted as far as its pressure rises from rest."""

    def __init__(self, law: Law, values: np.ndarray):
        self.law, self.values = law, values
        places = np.linspace(0.0, np.log(SMALLEST_STRETCH), TABLE_POINTS)
        pressure = -law.nominal_stress(np.exp(places), values)
        pressure[0] = 0.0
        rising = np.isfinite(pressure) & (law.nominal_stress_slope(np.exp(places), values) > 0)
        rising[1:] &= np.diff(pressure) > 0
        count = _leading(rising)
        self.places, self.pressure = places[:count], pressure[:count]

    def log_stretch(self, pressure: np.ndarray) -> np.ndarray:
        """Logarithm of the stretch under pressures, Pa per undeformed area; NaN where none carries it; shape (n,)."""
        result = np.full(pressure.shape, np.nan)
        if self.pressure.size < 2:
            return result
        inside = (pressure >= 0) & (pressure <= self.pressure[-1])
        target = pressure[inside]
        # Newton's method that stays in its cell of the table.
        cell = np.clip(np.searchsorted(self.pressure, target), 1, self.pressure.size - 1)
        x = np.interp(target, self.pressure, self.places)
        change = np.full(x.shape, np.inf)
        for _ in range(STEPS):
            if (np.abs(change) <= TOLERANCE).all():
                break
            stretch = np.exp(x)
            gap = self.law.nominal_stress(stretch, self.values) + target
            slope = stretch * self.law.nominal_stress_slope(stretch, self.values)
            moved = np.clip(x - gap / slope, self.places[cell], self.places[cell - 1])
            x, change = moved, moved - x
        result[inside] = np.where(np.abs(change) <= TOLERANCE, x, np.nan)
        return result


def _slices(law: Law, values: np.ndarray, top: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, ...]:
    """Stretches of the slices, their shares of the undeformed height, and these over P' in 1/Pa; shape (n, slices).

    `top` and `base` are logarithms x of stretches, shape (n,). The rule is laid over x, not over the depth s: with
    dP = -w ds a dx stands for a depth proportional to stretch P' dx, which is smooth, and no slice in between has to
    be solved for.
    """
    stretches = np.exp(top[:, None] + (base - top)[:, None] * _PLACES)
    weights, slopes = _SHARES * stretches, law.nominal_stress_slope(stretches, values)
    softness = weights / np.sum(weights * slopes, axis=1, keepdims=True)
    return stretches, softness * slopes, softness


def _leading(flags: np.ndarray) -> int:
    """How many are true before the first that is not."""
    return flags.size if flags.all() else int(np.argmin(flags))
