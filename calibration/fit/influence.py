"""What the parameters hang on: each recording, and how far the data go."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec.structs import replace
from scipy import special

from calibration.fit.fit import Fit, Window
from calibration.fit.problem import Evaluation, LeastSquares
from calibration.fit.trust_region import descend
from calibration.statistics.uncertainty import inverse_root
from tissue_sim.recording.recording import MIN_POINTS

#: Recordings fewer than this cannot say which of them is the odd one.
FEWEST = 3
#: A recording whose own parameter is so far from that of the others by chance, over all recordings and parameters, with
#: this probability, and by this share of it, disagrees.
LEVEL, SHARE = 0.05, 0.05
#: Shares of the largest strain that the parameters are estimated to again.
WINDOWS = (0.4, 0.6, 0.8)

#: Gain in the sum of squares that is not worth a solve here, as windows differ by little; and when a valley is so flat
#: that a window tells nothing.
_ENOUGH, _MOST_SOLVES = 1e-4, 30


def add_influence(fit: Fit, problem: LeastSquares, evaluation: Evaluation) -> Fit:
    """The fit with what its parameters hang on, and a warning where a recording disagrees."""
    influence = leave_recordings_out(problem, evaluation)
    odd = name_odd_ones(influence, fit)
    words = [f"{', '.join(odd)} disagree{'s' if len(odd) == 1 else ''} with the other recordings: without "
             f"{'it' if len(odd) == 1 else 'the first of them'} {_changes(fit, influence[odd[0]])}"] if odd else []
    return replace(fit, influence=influence, odd_recordings=odd, windows=narrow_windows(problem, evaluation.theta),
                   warnings=[*fit.warnings, *words], message="; ".join([fit.message, *words]))


def _changes(fit: Fit, without: Mapping[str, float]) -> str:
    """``C10 is 1400 instead of 1600 Pa``."""
    changes = (f"{fit.symbols[name]} is {value:.4g} instead of {fit.parameters[name]:.4g} {fit.unit(name)}"
               for name, value in without.items() if _moved(fit.parameters[name], value))
    return ", ".join(map(str.rstrip, changes))


def leave_recordings_out(problem: LeastSquares, evaluation: Evaluation) -> dict[str, dict[str, float]]:
    """Recording -> free parameters, SI, without it; empty where there are fewer than two recordings of each test.

    One linear step from the estimate, without a simulation: the problem is almost linear there.

    Source: Cook and Weisberg, Residuals and Influence in Regression, 1982, section 3.4.
    """
    residual, design = evaluation.design
    free, sizes = len(problem.space.free), np.linalg.norm(design, axis=0)
    design = design / np.where(sizes > 0, sizes, 1.0)
    found: dict[str, dict[str, float]] = {}
    if not free:
        return found
    for rows, curve, (number, _) in zip(problem.rows, problem.measured, problem.places, strict=True):
        if len(problem.tests[number].measured) < FEWEST:
            continue
        rest, gap = np.delete(design, np.r_[rows], axis=0), np.delete(residual, np.r_[rows])
        root, _ = inverse_root(rest.T @ rest)
        step = -(root @ (root.T @ (rest.T @ gap)))[:free] / np.where(sizes > 0, sizes, 1.0)[:free]
        values = np.clip(evaluation.theta[:free] + step, problem.space.low, problem.space.high)
        found[curve.name] = dict(zip(problem.space.free, values.tolist(), strict=True))
    return found


def name_odd_ones(influence: Mapping[str, Mapping[str, float]], fit: Fit) -> list[str]:
    """Recordings that disagree with the others of their campaign.

    Of each parameter a recording's own value is the pseudo-value of the jackknife; it is held against mean and scatter
    of those of the others, with Student's t and for as many questions as are asked (Bonferroni).

    Source: Tukey, Annals of Mathematical Statistics 29 (1958) 614; the deleted residual of Cook and Weisberg, 1982.
    """
    # Recordings of one test are alike, and of a parameter those count that tell it.
    asked: dict[tuple[str, str], list[str]] = {}
    for name, parameters in influence.items():
        for parameter, value in parameters.items():
            if _moved(fit.parameters[parameter], value):
                asked.setdefault((name.rpartition("/")[0], parameter), []).append(name)
    asked = {place: names for place, names in asked.items() if len(names) >= FEWEST}
    questions, odd = sum(map(len, asked.values())), []
    for (_, parameter), names in asked.items():
        count = len(names)
        quantile = -special.stdtrit(count - 2, 0.5 * LEVEL / questions)
        without = np.array([influence[name][parameter] for name in names])
        value = fit.parameters[parameter]
        # A small modulus beside a large one is no stiffness of its own.
        size = max(abs(fit.parameters[name]) for name in influence[names[0]] if fit.units[name] == fit.units[parameter])
        own = count * value - (count - 1) * without
        for i, name in enumerate(names):
            others = np.delete(own, i)
            away, scatter = own[i] - others.mean(), others.std(ddof=1) * np.sqrt(1.0 + 1.0 / others.size)
            if abs(away) > quantile * scatter and abs(away) > SHARE * size and name not in odd:
                odd.append(name)
    return odd


def _moved(value: float, without: float) -> bool:
    """Whether a recording has a say in a parameter at all."""
    return abs(without - value) > 1e-9 * abs(value)


def narrow_windows(problem: LeastSquares, theta: np.ndarray) -> list[Window]:
    """The parameters from the first parts of the strain of each test, narrowest first, all of it last.

    Empty where a force depends on how it came about: a part of a history is another test.
    """
    if any(test.is_path_dependent for test in problem.tests):
        return []
    free = len(problem.space.free)

    def window(share: float, values: np.ndarray) -> Window:
        return Window(share=share, parameters=dict(zip(problem.space.free, values[:free].tolist(), strict=True)))

    found = []
    for share in WINDOWS:
        narrow = problem.within(share)
        if min(curve.force.size for curve in narrow.measured) < MIN_POINTS or narrow.samples <= theta.size:
            continue
        descent = descend(narrow, theta, corrected=True, enough=_ENOUGH, most_solves=_MOST_SOLVES)
        if descent.converged:
            found.append(window(share, descent.theta))
    return [*found, window(1.0, theta)]
