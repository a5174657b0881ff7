"""Influence of single recordings and of the strain range on the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from scipy import special

from calibration.fit.fit import Fit, WindowFit
from calibration.fit.problem import LeastSquaresProblem, ProblemEvaluation
from calibration.fit.trust_region import minimise_from_start
from calibration.statistics.uncertainty import get_inverse_root_and_undetermined_mask
from tissue_sim.recording.recording import MIN_POINTS


@dataclass(frozen=True)
class OutlierTestAndWindowFitSettings:
    """Settings of the test for outlying recordings and of the fits in windows.

    Attributes:
        min_recordings: smallest number of recordings among which an outlier can be identified.
        level: significance level of the test for outlying recordings, over all recordings and parameters.
        min_deviation: smallest relative deviation of an outlying recording. A smaller value also names recordings
            without consequence for the parameters.
        window_gain: predicted decrease of the sum of squares at which the descent in a window ends; windows differ by
            little.
        window_solves: maximum number of evaluations in a window; more are needed only if the window does not determine
            the parameters.
    """

    min_recordings: int = 3
    level: float = 0.05
    min_deviation: float = 0.05
    window_gain: float = 1e-4
    window_solves: int = 30


_SETTINGS = OutlierTestAndWindowFitSettings()
#: Fractions of the largest displacement for which the parameters are estimated again.
WINDOWS = (0.4, 0.6, 0.8)


def add_influence_to_fit(fit: Fit, problem: LeastSquaresProblem, evaluation: ProblemEvaluation) -> Fit:
    """Return the fit with the influence of recordings and windows, and with a warning for outlying recordings."""
    influence = estimate_without_each_recording_in_one_step(problem, evaluation)
    odd = find_outlying_recordings(influence, fit)
    single = len(odd) == 1
    words = [f"{', '.join(odd)} disagree{'s' if single else ''} with the other recordings: without "
             f"{'it' if single else 'the first of them'} "
             f"{_describe_parameter_changes(fit, influence[odd[0]])}"] if odd else []
    return replace(fit, influence=influence, odd_recordings=odd,
                   windows=fit_displacement_windows(problem, evaluation.theta),
                   warnings=[*fit.warnings, *words], message="; ".join([fit.message, *words]))


def _describe_parameter_changes(fit: Fit, without: Mapping[str, float]) -> str:
    """Describe the parameters without a recording, such as ``C10 is 1400 instead of 1600 Pa``."""
    changes = (
        f"{fit.symbols[name]} is {value:.4g} instead of {fit.parameters[name]:.4g} "
        f"{fit.get_unit_or_empty_if_dimensionless(name)}"
        for name, value in without.items() if _is_parameter_changed_above_rounding(fit.parameters[name], value))
    return ", ".join(map(str.rstrip, changes))


def estimate_without_each_recording_in_one_step(problem: LeastSquaresProblem,
                                                evaluation: ProblemEvaluation) -> dict[str, dict[str, float]]:
    """Estimate the parameters without each recording by one linear step from the estimate (deletion diagnostics).

    Args:
        problem: least-squares problem.
        evaluation: evaluation at the minimum.

    Returns:
        Recording -> name -> value of the free parameters without it, SI; for tests with at least three recordings.

    Source: Cook and Weisberg, Residuals and Influence in Regression, 1982, section 3.4.
    """
    residual, design = evaluation.full_residual_and_jacobian
    free, sizes = len(problem.space.free), np.linalg.norm(design, axis=0)
    design = design / np.where(sizes > 0, sizes, 1.0)
    found: dict[str, dict[str, float]] = {}
    if not free:
        return found
    for rows, curve, (number, _) in zip(problem.rows, problem.measured, problem.places, strict=True):
        if len(problem.tests[number].measured) < _SETTINGS.min_recordings:
            continue
        rest, gap = np.delete(design, np.r_[rows], axis=0), np.delete(residual, np.r_[rows])
        root, _ = get_inverse_root_and_undetermined_mask(rest.T @ rest)
        step = -(root @ (root.T @ (rest.T @ gap)))[:free] / np.where(sizes > 0, sizes, 1.0)[:free]
        values = np.clip(evaluation.theta[:free] + step, problem.space.low, problem.space.high)
        found[curve.name] = dict(zip(problem.space.free, values.tolist(), strict=True))
    return found


def find_outlying_recordings(influence: Mapping[str, Mapping[str, float]], fit: Fit) -> list[str]:
    """Return the names of recordings whose parameters disagree with those of the other recordings.

    The value of a recording is the jackknife pseudo-value n theta - (n - 1) theta_(-i). It is compared with mean
    and scatter of the other recordings by Student's t with Bonferroni's correction.

    Args:
        influence: recording -> parameters without it, from `estimate_without_each_recording_in_one_step`.
        fit: fit of all recordings.

    Source: Tukey, Annals of Mathematical Statistics 29 (1958) 614; Cook and Weisberg, Residuals and Influence in
    Regression, 1982 (deleted residual).
    """
    # Recordings of one test are compared, for the parameters that they influence.
    asked: dict[tuple[str, str], list[str]] = {}
    for name, parameters in influence.items():
        for parameter, value in parameters.items():
            if _is_parameter_changed_above_rounding(fit.parameters[parameter], value):
                asked.setdefault((name.rpartition("/")[0], parameter), []).append(name)
    asked = {place: names for place, names in asked.items() if len(names) >= _SETTINGS.min_recordings}
    questions, odd = sum(map(len, asked.values())), []
    for (_, parameter), names in asked.items():
        count = len(names)
        quantile = -special.stdtrit(count - 2, 0.5 * _SETTINGS.level / questions)
        without = np.array([influence[name][parameter] for name in names])
        value = fit.parameters[parameter]
        # Deviations are relative to the largest parameter of the same unit, since a small modulus contributes little.
        size = max(abs(fit.parameters[name]) for name in influence[names[0]] if fit.units[name] == fit.units[parameter])
        own = count * value - (count - 1) * without
        for i, name in enumerate(names):
            others = np.delete(own, i)
            deviation, scatter = own[i] - others.mean(), others.std(ddof=1) * np.sqrt(1.0 + 1.0 / others.size)
            limit = max(quantile * scatter, _SETTINGS.min_deviation * size)
            if abs(deviation) > limit and name not in odd:
                odd.append(name)
    return odd


def _is_parameter_changed_above_rounding(value: float, without: float) -> bool:
    """Return whether a parameter without a recording differs from its value by more than rounding (1e-9)."""
    return abs(without - value) > 1e-9 * abs(value)


def fit_displacement_windows(problem: LeastSquaresProblem, theta: np.ndarray) -> list[WindowFit]:
    """Estimate the parameters from the samples up to fractions of the largest displacement, smallest fraction first.

    The last window contains all samples. The list is empty if a test is path-dependent.

    Args:
        problem: least-squares problem.
        theta: unknowns at the minimum, SI, shape (k,).
    """
    if any(test.has_reversals_or_holds for test in problem.tests):
        return []
    free = len(problem.space.free)

    def make_window_record(fraction: float, values: np.ndarray) -> WindowFit:
        """Return the record of a window from its fitted unknowns `values`; nothing is fitted here."""
        return WindowFit(share=fraction, parameters=dict(zip(problem.space.free, values[:free].tolist(), strict=True)))

    found = []
    for fraction in WINDOWS:
        narrow = problem.with_samples_up_to_displacement_fraction(fraction)
        if min(curve.force.size for curve in narrow.measured) < MIN_POINTS or narrow.samples <= theta.size:
            continue
        descent = minimise_from_start(narrow, theta, corrected=True, enough=_SETTINGS.window_gain,
                                      max_solves=_SETTINGS.window_solves)
        if descent.converged:
            found.append(make_window_record(fraction, descent.theta))
    return [*found, make_window_record(1.0, theta)]
