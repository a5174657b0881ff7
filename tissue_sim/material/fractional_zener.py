"""Fractional Zener model: relaxation by a Mittag-Leffler function, represented by a Prony series over a time window.

G(t)/G(0) = 1 - g + g E_alpha(-(t/tau)^alpha). The kernels of the solvers have exponentials only. The series has fixed,
log-spaced relaxation times and non-negative weights, so that it depends continuously on alpha, tau and g.

Source: Mainardi, Fractional Calculus and Waves in Linear Viscoelasticity (2010), chapter 3 and appendix E.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.material.viscoelasticity import PronyTerm, RelaxationSeries
from tissue_sim.parameters import choice, parameter

#: Largest relative error of the relaxation modulus of the Prony series within the window, 1.
MAX_EXPANSION_ERROR = 0.01


@dataclass(frozen=True)
class QuadratureSettings:
    """Quadrature of the spectral integral of the Mittag-Leffler function.

    Attributes:
        step: step of the trapezoidal rule per unit of alpha, 1. The error decreases exponentially with 1 / step.
        range: largest absolute value of alpha ln r in the integral, 1; the rest is below exp(-range).
        largest: largest exponent, 1; exp(-exp(largest)) is 0.
        block: number of arguments that are evaluated at once, which limits memory.
    """

    step: float = 0.0137
    range: float = 60.0
    largest: float = 700.0
    block: int = 256


@dataclass(frozen=True)
class ExpansionSettings:
    """Prony series of a fractional Zener model.

    Attributes:
        below: decades by which the shortest relaxation time is below the window, 1.
        above: decades by which the second longest relaxation time is above the window, 1.
        longest_above: decades by which the longest relaxation time is above the window, 1.
        samples: times per decade, 1, at which the error is evaluated.
        fitted: every how many of these times is fitted, 1.
        start_weight: weight of the condition G(0) = 1 relative to that of a fitted time, 1.
        refits: maximum number of fits with larger weights at the largest errors, if the largest error is too large.
        smallest: smallest weight of a term relative to g, 1, so that the number of terms does not change in a fit.
    """

    below: float = 1.0
    above: float = 0.2
    longest_above: float = 1.8
    samples: int = 60
    fitted: int = 4
    start_weight: float = 100.0
    refits: int = 20
    smallest: float = 1e-9


#: Settings of every evaluation of the Mittag-Leffler function.
_QUADRATURE = QuadratureSettings()
#: Settings of every Prony series.
_EXPANSION = ExpansionSettings()


def evaluate_mittag_leffler(alpha: float, x) -> np.ndarray:
    """Return the Mittag-Leffler function E_alpha(-x) = sum (-x)^k / Gamma(alpha k + 1) for x >= 0, shape of `x`.

    E_1(-x) = exp(-x), E_1/2(-x) = exp(x^2) erfc(x). The relative error is about 1e-14.

    Args:
        alpha: order, above 0, at most 1.
        x: argument with its sign reversed, 0 or more, 1, any shape.

    Raises:
        InputError: alpha is not above 0 and at most 1, or an x is negative or not finite.

    Source: spectral integral E_alpha(-t^alpha) = int exp(-r t) K(r) dr with the positive spectrum
    K(r) = sin(pi alpha) / pi r^(alpha - 1) / (r^(2 alpha) + 2 r^alpha cos(pi alpha) + 1) (Mainardi 2010, appendix E),
    by the trapezoidal rule in y with alpha ln r = pi (1 - alpha) sinh y. In y the poles of K are at +- i pi/2.
    """
    if not 0.0 < alpha <= 1.0:
        raise InputError(f"must be above 0 and at most 1; got {alpha:g}.", field="alpha")
    x = np.asarray(x, dtype=float)
    if not (np.isfinite(x).all() and (x >= 0.0).all()):
        raise InputError("must be finite and 0 or more.", field="x")
    width = math.pi * (1.0 - alpha)
    if width == 0.0:
        return np.exp(-x)
    step = _QUADRATURE.step * alpha
    count = math.ceil(math.asinh(_QUADRATURE.range / width) / step)
    y = step * np.arange(-count, count + 1)
    log_rate = width * np.sinh(y)
    # cosh w + cos(pi alpha) = 2 (sinh^2(w/2) + sin^2(width/2)) without cancellation.
    weights = (math.sin(width) / (4.0 * math.pi * alpha) * step * width * np.cosh(y)
               / (np.sinh(0.5 * log_rate)**2 + math.sin(0.5 * width)**2))
    with np.errstate(divide="ignore"):
        log_x = np.log(x.ravel())
    found = [np.exp(-np.exp(np.minimum((part[:, None] + log_rate) / alpha, _QUADRATURE.largest))) @ weights
             for part in np.split(log_x, range(_QUADRATURE.block, log_x.size, _QUADRATURE.block))]
    return np.concatenate(found).reshape(x.shape)


@dataclass(frozen=True)
class FractionalZener:
    """Fractional Zener model (fractional standard linear solid) with the window in which it is represented.

    Attributes:
        alpha: order of the fractional derivative, 0.01 to 1; 1 is the standard linear solid.
        g: fraction of the instantaneous modulus that relaxes, above 0 and below 1.
        tau: relaxation time, s.
        shortest: start of the time window, s. Before it, the series relaxes from G(0) to G(shortest).
        longest: end of the time window, s. After it, the series relaxes to (1 - g) G(0); its longest relaxation time is
            63 times `longest`.
        term_count: number of terms of the series; a smaller number makes a simulation faster.

    Raises:
        InputError: an invalid value, or a series whose error in the window is above `MAX_EXPANSION_ERROR`.

    Examples:
        >>> model = FractionalZener(alpha=0.5, g=0.6, tau=1.0, shortest=1e-2, longest=1e2)
        >>> model.expansion_error < 2e-4
        True
    """

    alpha: float = parameter("alpha", "1", key="alpha", bounds=(0.01, 1.0))
    g: float = parameter("g", "1", key="g", bounds=(1e-6, 0.99), absent=0.0)
    tau: float = parameter("tau", "s", key="tau_s", bounds=(1e-4, 1e6))
    shortest: float = parameter("t_min", "s", key="from_s", bounds=(1e-4, 1e6))
    longest: float = parameter("t_max", "s", key="to_s", bounds=(1e-4, 1e6))
    term_count: Literal[12, 11, 10, 9, 8, 7, 6, 5, 4] = choice(12, 11, 10, 9, 8, 7, 6, 5, 4)

    def __post_init__(self):
        if not 0.01 <= self.alpha <= 1.0:
            raise InputError(f"must be 0.01 to 1; got {self.alpha:g}.", field="alpha")
        if not 0.0 < self.g < 1.0:
            raise InputError(f"must be a fraction of the instantaneous modulus between 0 and 1; got {self.g:g}.",
                             field="g")
        if not 0.0 < self.tau < np.inf:
            raise InputError(f"must be a positive relaxation time; got {self.tau:g} s.", field="tau")
        if not 0.0 < self.shortest < np.inf:
            raise InputError(f"must be positive and finite; got {self.shortest:g} s.", field="shortest")
        if not self.shortest < self.longest < np.inf:
            raise InputError(f"must be longer than the begin of the window, {self.shortest:g} s; got "
                             f"{self.longest:g} s.", field="longest")
        if self.term_count not in range(4, 13):
            raise InputError(f"must be an integer from 4 to 12; got {self.term_count}.", field="term_count")
        if not self.expansion_error <= MAX_EXPANSION_ERROR:
            raise InputError(f"the relative error of the series must be at most {MAX_EXPANSION_ERROR:.0%} from "
                             f"{self.shortest:g} to {self.longest:g} s; {self.term_count} terms have "
                             f"{self.expansion_error:.2%}. Use more terms, at most 12, a shorter window, or a Prony "
                             "series",
                             field="term_count")

    def compute_relative_relaxation_modulus(self, time) -> np.ndarray:
        """Return G(t) / G(0) of the model itself, without the error of the series, at `time` s, shape of `time`."""
        return 1.0 - self.g + self.g * evaluate_mittag_leffler(self.alpha, (np.asarray(time) / self.tau)**self.alpha)

    def compute_relative_complex_modulus(self, frequency) -> np.ndarray:
        """Return G*/G(0) = 1 - g / (1 + (i omega tau)^alpha) of the model itself at `frequency` Hz, complex."""
        omega = 2.0 * np.pi * np.asarray(frequency, dtype=float)
        return 1.0 - self.g / (1.0 + (1j * omega * self.tau)**self.alpha)

    def describe_expansion(self) -> str:
        """Return a sentence with the number of terms of the series, the window, and the error in the window."""
        return (f"A Prony series of {self.term_count} terms represents the fractional Zener model from "
                f"{self.shortest:g} to {self.longest:g} s; the relative error of the relaxation modulus is at most "
                f"{self.expansion_error:.2g}.")

    @property
    def expansion_error(self) -> float:
        """Largest relative error of the relaxation modulus of the series within the window, 1."""
        return self._expansion[1]

    @property
    def terms(self) -> tuple[PronyTerm, ...]:
        """Terms of the Prony series, with the sum of their fractions g."""
        return self._expansion[0]

    @property
    def _expansion(self) -> tuple[tuple[PronyTerm, ...], float]:
        """Terms and error of the series."""
        return _expand(self.alpha, self.g, self.tau, self.shortest, self.longest, self.term_count)


@lru_cache(maxsize=256)
def _expand(alpha: float, g: float, tau: float, shortest: float, longest: float,
            count: int) -> tuple[tuple[PronyTerm, ...], float]:
    """Return the Prony series of a model and its largest relative error in the window; arguments: `FractionalZener`.

    The weights minimise the sum of the squared relative errors at log-spaced times. If the largest error is above
    `MAX_EXPANSION_ERROR`, the errors are weighted towards the smallest largest error (Lawson's algorithm; Rice and
    Usow, Mathematics of Computation 22 (1968) 118).
    """
    from scipy.optimize import nnls

    low, high = math.log10(shortest), math.log10(longest)
    times = 10.0**np.append(np.linspace(low - _EXPANSION.below, high + _EXPANSION.above, count - 1),
                            high + _EXPANSION.longest_above)
    t = np.append(0.0, np.geomspace(shortest, longest, math.ceil(_EXPANSION.samples * (high - low)) + 2))
    relaxing = g * evaluate_mittag_leffler(alpha, (t / tau)**alpha)
    modulus, matrix = 1.0 - g + relaxing, np.exp(-t[:, None] / times)
    rows = np.append(0, np.arange(1, t.size, _EXPANSION.fitted))
    weights = np.append(_EXPANSION.start_weight, np.ones(rows.size - 1))
    best, best_error = np.zeros(count), math.inf
    for _ in range(_EXPANSION.refits):
        scale = weights / modulus[rows]
        found, _ = nnls(matrix[rows] * scale[:, None], relaxing[rows] * scale, maxiter=100 * count)
        found = np.maximum(found, _EXPANSION.smallest * g)
        found *= g / found.sum()
        error = np.abs(matrix @ found - relaxing) / modulus
        if error.max() < best_error:
            best, best_error = found, float(error.max())
        if best_error <= MAX_EXPANSION_ERROR:
            break
        weights[1:] *= np.sqrt(error[rows[1:]] / error.max() + _EXPANSION.smallest)
        weights[1:] /= weights[1:].mean()
    terms = tuple(PronyTerm(float(fraction), float(time)) for fraction, time in zip(best, times, strict=True))
    return terms, best_error


@dataclass(frozen=True)
class FractionalRelaxation(RelaxationSeries):
    """Relaxation by the Prony series of a fractional Zener model; the material file keeps the model.

    Attributes:
        fractional_zener: the model and its window.
        moduli: meaning of the law's parameters, see `Prony`.
    """

    fractional_zener: FractionalZener
    moduli: Literal["instantaneous", "long_term"] = "instantaneous"

    @staticmethod
    def describe_or_none(series: RelaxationSeries | None) -> str | None:
        """Return `FractionalZener.describe_expansion` of a relaxation of this class; None for another."""
        return series.fractional_zener.describe_expansion() if isinstance(series, FractionalRelaxation) else None

    def require_represented_frequencies(self, frequency: np.ndarray) -> None:
        """Raise an `InputError` for a frequency, Hz, with 1 / omega outside of the time window of the model."""
        model, times = self.fractional_zener, 1.0 / (2.0 * np.pi * np.asarray(frequency))
        if (times < model.shortest).any() or (times > model.longest).any():
            low, high = 1.0 / (2.0 * np.pi * model.longest), 1.0 / (2.0 * np.pi * model.shortest)
            raise InputError(f"must be {low:.3g} to {high:.3g} Hz, where the series represents the fractional Zener "
                             f"model; got {np.min(frequency):.3g} to {np.max(frequency):.3g} Hz. Widen its time window",
                             field="frequency")

    def __post_init__(self):
        object.__setattr__(self, "terms", self.fractional_zener.terms)
        self._require_known_moduli()
