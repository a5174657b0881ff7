"""Several optima of one law: parameters that fit the recordings equally well and predict other tests differently.

Ogden's energy in simple shear is an example: the principal stretches are l, 1/l and 1, so that alpha and -alpha give
the same stress in shear and different stresses in compression.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from calibration.fit.fit import Minimum
from calibration.fit.usability_records import AlternativeMinimum
from tissue_sim.laws import Law

if TYPE_CHECKING:
    from calibration.campaign.parameter_space import ParameterSpace
    from calibration.statistics.uncertainty import ParameterUncertainty


@dataclass(frozen=True)
class AlternativeMinimaSettings:
    """Limits of the search for several optima.

    Attributes:
        rise: two optima fit equally well where their sums of squares differ by less than this, in units of the
            variance of the residuals: the 95 % quantile of chi-square with one degree of freedom, as in a profile
            likelihood.
        difference: two optima are different materials where their nominal stress in a further test differs by more
            than this fraction of the smaller stress. For smaller differences the choice has no consequence.
        lowest_stretch: the further tests are evaluated up to this stretch in compression and its reciprocal in
            tension, or up to the stretches of the data where these are closer to 1.
        promising_ratio: a start with other signs of the exponents is followed where its sum of squares is below this
            many times the best one, or this many per sample. A larger value costs more descents.
        equal_rise: sums of squares that differ by less than this, in units of the variance of the residuals, are
            numerically equal.
    """

    rise: float = 3.841
    difference: float = 0.05
    lowest_stretch: float = 0.7
    promising_ratio: float = 2.0
    equal_rise: float = 1e-3


SETTINGS = AlternativeMinimaSettings()


def list_sign_flipped_starts(space: ParameterSpace, theta: np.ndarray) -> list[np.ndarray]:
    """Return starts in the other basins of a law with exponents: every other combination of their signs.

    Args:
        space: parameter space.
        theta: unknowns at a minimum, shape (k,); the free parameters come first.

    Returns:
        Unknowns inside their bounds, each of shape (k,); empty for a law without free exponents.
    """
    varied = space.free_parameters
    paths = list(dict.fromkeys(each.path for each in varied if each.is_dimensionless_law_parameter))
    found = []
    for signs in product((1.0, -1.0), repeat=len(paths)):
        if all(sign > 0 for sign in signs):
            continue
        start = np.array(theta, dtype=float)
        for place, each in enumerate(varied):
            if each.is_dimensionless_law_parameter:
                start[place] *= signs[paths.index(each.path)]
        start[: len(varied)] = np.clip(start[: len(varied)], space.low, space.high)
        if not np.allclose(start, theta):
            found.append(start)
    return found


def find_index_of_preferred_minimum(space: ParameterSpace,
                                    minima: Sequence[tuple[float, np.ndarray]]) -> int:
    """Return the index of the minimum to report first: of equally good ones, that with most positive exponents.

    The choice is a convention, so that the same data always give the same first parameters.

    Args:
        space: parameter space.
        minima: sum of squares in units of the variance of the residuals, and unknowns, best first.
    """
    exponents = [place for place, each in enumerate(space.free_parameters) if each.is_dimensionless_law_parameter]
    equal = [i for i, (error, _) in enumerate(minima) if error - minima[0][0] < SETTINGS.equal_rise]
    return max(equal, key=lambda i: (int(np.sum(minima[i][1][exponents] > 0)), -i))


def find_equally_good_different_materials(law: Law, parameters: Mapping[str, float],
                                          minima: Sequence[tuple[Minimum, Mapping[str, float]]],
                                          stretches: tuple[float, float]) -> list[AlternativeMinimum]:
    """Return the minima that fit as well as the estimate and describe another material.

    Args:
        law: fitted law.
        parameters: parameters of the law at the estimate, SI.
        minima: distinct minima, each with the parameters of the law, SI.
        stretches: smallest and largest principal stretch of the data.
    """
    found: list[AlternativeMinimum] = []
    for minimum, other in minima:
        if minimum.rise >= SETTINGS.rise or not law.mu0(other) > 0:
            continue
        known = [parameters, *(one.parameters_of_law for one in found)]
        if all(_find_largest_stress_difference_and_test(law, one, other, stretches)[0] > SETTINGS.difference
               for one in known):
            _, test, stretch, (own, theirs) = _find_largest_stress_difference_and_test(law, parameters, other,
                                                                                       stretches)
            found.append(AlternativeMinimum(
                parameters=minimum.parameters, parameters_of_law=dict(other), R2=minimum.R2, rise=minimum.rise,
                separated_by=test, at=stretch, stress_Pa=own, alternative_stress_Pa=theirs))
    return found


def describe_alternative_minima(alternatives: Sequence[AlternativeMinimum], symbols: Mapping[str, str],
                                units: Mapping[str, str]) -> str:
    """Describe the alternatives of a fit; empty if there are none."""
    parts = []
    for each in alternatives:
        values = ", ".join(f"{symbols[name]} {value:.4g}{'' if units[name] == '1' else ' ' + units[name]}"
                           for name, value in each.parameters.items())
        parts.append(f"{values} fits the data equally well (R2 {each.R2:.5f}); in {each.separated_by} the two differ: "
                     f"nominal stress {each.stress_Pa:.4g} Pa here, {each.alternative_stress_Pa:.4g} Pa there"
                     f"{each.stress_ratio_suffix_or_empty}")
    return "; ".join(parts)


def replace_misleading_standard_errors(space: ParameterSpace, spread: ParameterUncertainty, theta: np.ndarray,
                                       alternatives: Sequence[AlternativeMinimum]) -> ParameterUncertainty:
    """Replace misleading standard errors by infinity.

    These are the standard errors of parameters that differ between equally good optima, and of parameters with two
    bounds whose standard error exceeds the distance of the bounds.

    Args:
        space: parameter space.
        spread: uncertainty of the estimate.
        theta: free parameters at the estimate, SI, shape (p,).
        alternatives: other optima that fit equally well.
    """
    errors = spread.standard_errors.copy()
    for place, name in enumerate(space.free):
        differs = any(not abs(each.parameters[name] - theta[place]) <= errors[place] for each in alternatives)
        if differs or errors[place] > space.high[place] - space.low[place]:
            errors[place] = np.inf
    return replace(spread, standard_errors=errors)


def _find_largest_stress_difference_and_test(
        law: Law, one: Mapping[str, float], other: Mapping[str, float],
        stretches: tuple[float, float]) -> tuple[float, str, float, tuple[float, float]]:
    """Return the largest relative difference of the nominal stresses of two materials over several tests.

    Returns:
        The difference, the test in words, its stretch or shear strain, and both stresses there, Pa.
    """
    low = max(stretches[0], SETTINGS.lowest_stretch)
    high = min(stretches[1], 1.0 / SETTINGS.lowest_stretch)
    tests = [(f"simple shear to {high - 1.0 / high:.3g}", "simple_shear", high - 1.0 / high)]
    tests += [(f"uniaxial compression to stretch {low:.3g}", "uniaxial", low)] if low < 1.0 else []
    tests += [(f"uniaxial tension to stretch {high:.3g}", "uniaxial", high)] if high > 1.0 else []
    rated = []
    for words, mode, place in tests:
        with np.errstate(all="ignore"):
            pair = tuple(float(law.nominal_stress(place, values, mode)) for values in (one, other))
        smaller = min(map(abs, pair))
        difference = abs(pair[0] - pair[1]) / smaller if smaller > 0 and np.isfinite(pair).all() else np.inf
        rated.append((difference, words, place, (pair[0], pair[1])))
    return max(rated, key=lambda item: item[0])
