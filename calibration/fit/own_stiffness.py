"""Tests of one kind that a law describes one by one, but not with common parameters."""

from __future__ import annotations

import numpy as np

from calibration.fit.lack_of_fit import compute_lack_of_fit_r2_and_relative_error
from calibration.fit.problem import LeastSquaresProblem

#: Ratio of two stiffnesses above which the tests differ.
_DIFFERENT = 1.05


def describe_stiffness_disagreement_or_empty(problem: LeastSquaresProblem, model: np.ndarray,
                                             smallest_R2: float) -> str:
    """Describe the remedy of a misfit if the tests of one kind differ in stiffness only; empty otherwise.

    The force of the law is scaled to each test by least squares. The law has the right shape if it then explains the
    variance of the force in every test.

    Args:
        problem: least-squares problem.
        model: force of the law at all samples, N, shape (N,).
        smallest_R2: fraction of the variance that the scaled force must explain.
    """
    if len(problem.tests) < 2 or len({test.measured[0].test.kind.name for test in problem.tests}) > 1:
        return ""
    factors = {}
    for number, test in enumerate(problem.tests):
        rows = np.concatenate([np.arange(model.size)[rows] for rows, (t, _) in zip(problem.rows, problem.places,
                                                                                   strict=True) if t == number])
        squares = float(model[rows] @ model[rows])
        factor = float(model[rows] @ problem.data[rows]) / squares if squares > 0 else 0.0
        R2 = compute_lack_of_fit_r2_and_relative_error(problem, factor * model - problem.data, number).R2
        if factor <= 0 or R2 is None or smallest_R2 > R2:
            return ""
        factors[test.name] = factor
    if max(factors.values()) <= _DIFFERENT * min(factors.values()):
        return ""
    listed = ", ".join(f"{name} {factor:.2f}" for name, factor in factors.items())
    return (f"the tests disagree in stiffness, not in shape (stiffness over that of the fit: {listed}); different "
            "materials? Fit each material in a separate campaign; for one material check unit, sign and size of the "
            "specimens")
