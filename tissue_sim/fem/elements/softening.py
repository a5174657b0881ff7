"""Kernel functions of the softening factor eta (Mullins effect) for all solids; scalars or vectors of points."""

import math
from functools import cache

import numpy as np

from tissue_sim.fem.elements.energy import list_lower_triangle_index_pairs
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.material.softening import SOFTENING_FORMS

#: Constant k of the variable (x - k)/(x + k) of the series for the error function, 1.
_CENTRE = 3.75
#: Number of Chebyshev coefficients; with them the error function is exact to 1e-14.
_COEFFICIENTS = 22
#: Argument from which on the continued fraction of 1 - erf x is used, 1.
_SMALLEST_FRACTION_ARGUMENT = 2.0
#: Number of terms of the continued fraction.
_FRACTION_TERMS = 150
#: Argument beyond which 1 - erf x is 0 in double precision, 1.
_LARGEST = 30.0
#: Derivative of the error function at 0, 1.
_SLOPE_AT_0 = 2.0 / math.sqrt(math.pi)
#: Value of the coefficient FORM for the error function.
ERF = SOFTENING_FORMS.index("erf")


def compute_error_function_coefficients() -> np.ndarray:
    """Return the Chebyshev coefficients of (1 + 2x) exp(x^2) (1 - erf x) in (x - k)/(x + k) for x >= 0.

    Source: Shepherd and Laframboise, Mathematics of Computation 36 (1981) 249.
    """
    def evaluate(u: np.ndarray) -> np.ndarray:
        """Return the function that the series represents, for -1 < u < 1."""
        x = _CENTRE * (1.0 + u) / (1.0 - u)
        return (1.0 + 2.0 * x) * np.array([_compute_scaled_complement(each) for each in x.tolist()])

    return np.polynomial.chebyshev.chebinterpolate(evaluate, _COEFFICIENTS - 1)


def _compute_scaled_complement(x: float) -> float:
    """Return exp(x^2) (1 - erf x) for x >= 0, without SciPy, whose import is slow.

    Beyond `_SMALLEST_FRACTION_ARGUMENT` Laplace's continued fraction converges to double precision (Abramowitz and
    Stegun, Handbook of Mathematical Functions, 7.1.14).
    """
    if x < _SMALLEST_FRACTION_ARGUMENT:
        return math.exp(x * x) * math.erfc(x)
    fraction = 0.0
    for n in range(_FRACTION_TERMS, 0, -1):
        fraction = 0.5 * n / (x + fraction)
    return 1.0 / (math.sqrt(math.pi) * (x + fraction))


@cache
def make_softening_shape_function():
    """Return the Taichi function ``evaluate_softening_shape(x, form) -> (f, df/dx)`` for x >= 0.

    f is tanh x, or the error function erf x if `form` is `ERF`.
    """
    ti = get_initialised_taichi()
    coefficients = compute_error_function_coefficients().tolist()

    @ti.func
    def evaluate_softening_shape(x, form):
        """Return f and its derivative; erf by a Chebyshev series, summed with Clenshaw's recurrence."""
        f, slope = 0.0 * x, 0.0 * x
        if form == ERF:
            z = ti.min(x, _LARGEST)
            gauss = ti.exp(-z * z)
            u = 2.0 * (z - _CENTRE) / (z + _CENTRE)
            b, b1 = 0.0 * x, 0.0 * x
            for n in ti.static(range(_COEFFICIENTS - 1)):
                b, b1 = u * b - b1 + coefficients[_COEFFICIENTS - 1 - n], b
            f = 1.0 - gauss * (0.5 * u * b - b1 + coefficients[0]) / (1.0 + 2.0 * z)
            slope = _SLOPE_AT_0 * gauss
        else:
            f = ti.tanh(x)
            slope = 1.0 - f * f
        return f, slope

    return evaluate_softening_shape


@cache
def make_softening_function(size: int):
    """Return the Taichi function ``apply_softening(W, largest, loss, modulus, share, form, P, A) -> (P, A)``.

    Args:
        size: number of stress components P; A is the tangent in packed storage, see `list_lower_triangle_index_pairs`.
    """
    ti = get_initialised_taichi()
    entries, evaluate_softening_shape = list_lower_triangle_index_pairs(size), make_softening_shape_function()

    @ti.func
    def apply_softening(W, largest, loss, modulus, share, form, P, A):
        """Multiply stress and tangent by the softening factor eta at a point that had a larger energy density before.

        eta = 1 - loss f((largest - W) / (modulus + share largest)) with f = tanh or erf; see
        `tissue_sim.material.softening.Softening`.
        """
        width = ti.max(modulus + share * largest, 1e-300)  # not zero at rest
        bend, bend_slope = evaluate_softening_shape(ti.max(largest - W, 0.0) / width, form)
        eta = 1.0 - loss * bend
        slope = ti.select(largest > W, loss * bend_slope / width, 0.0 * W)
        tangent = [eta * A[n] + slope * P[ti.static(entries[n][0])] * P[ti.static(entries[n][1])]
                   for n in ti.static(range(len(entries)))]
        return [eta * P[i] for i in ti.static(range(size))], tangent

    return apply_softening
