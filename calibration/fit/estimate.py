"""From the fast mesh's minimum to the estimate: mesh difference and jitter settle together with the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.campaign.campaign import Noise
from calibration.fit.fit import Iteration, Minimum
from calibration.fit.problem import Evaluation, Problem
from calibration.fit.trust_region import Descent, Listener, descend
from calibration.forward.contract import InfeasibleError
from calibration.forward.forms import mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS, FAST_MESH_ERRORS
from calibration.statistics.jitter import Jitter, estimate_jitter

#: The difference of the meshes is computed again until that moves no parameter by more than this share of its size;
#: the next move is taken for the last one times the relative difference, times a factor for safety.
SETTLED, SAFETY = 5e-4, 5.0
#: The same for a change of the jitter, relative.
JITTER_SETTLED = 0.05
MOST_REFRESHES = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(Descent):
    """The minimum of the corrected problem.

    Attributes:
        problem: `Problem` with its corrections and jitter, or `OrdinaryProblem`.
        differences: accurate against fast mesh for each test, relative to the largest force; NaN where the accurate
            mesh did not get through. refreshes: how often they were computed.
        minima: distinct ends of the starts, best first.
    """

    problem: Any
    differences: tuple[float, ...] = ()
    refreshes: int = 0
    warnings: tuple[str, ...] = ()
    minima: tuple[Minimum, ...] = ()

    @property
    def evaluation(self) -> Evaluation:
        """Everything at the minimum."""
        return self.problem.evaluate(self.theta)


def settle(problem: Problem, theta: np.ndarray, stated: Noise, start: int = 1, past: int = 0,
           listen: Listener | None = None) -> Estimate:
    """Refresh the difference of the meshes and the jitter until neither moves the parameters.

    Args:
        problem: uncorrected. theta: its minimum. stated: jitter; None of it: to be estimated.
        start, past, listen: as in `descend`.
    """
    spent = problem.solves.meter()
    history: list[Iteration] = []
    differences: tuple[float, ...] = ()
    warnings: list[str] = []
    if None in (stated.contact_jitter, stated.zero_jitter):
        _estimate_jitter(problem, theta, stated)
        descent = descend(problem, theta, start=start, listen=listen, past=past)
        history += descent.history
        theta = descent.theta
    refreshes = 0
    while True:
        differences = _refine(problem, theta, warnings)
        refreshes += 1
        jitter = problem.jitter
        if None in (stated.contact_jitter, stated.zero_jitter):
            _estimate_jitter(problem, theta, stated)
        problem.forget()
        descent = descend(problem, theta, start=start, corrected=True, listen=listen,
                          past=past + len(history))
        history += descent.history
        if not np.isfinite(descent.error):
            break
        moved = np.abs(descent.theta - theta) / problem.space.sizes(problem.space.values(theta))
        theta = descent.theta
        # The difference changes as the parameters do, so that the next move is this one times the difference.
        share = max((difference for difference in differences if np.isfinite(difference)), default=0.0)
        if moved.max(initial=0.0) * min(1.0, SAFETY * share) < SETTLED and _alike(jitter, problem.jitter):
            break
        if refreshes == MOST_REFRESHES:
            warnings.append(f"the parameters still moved after {MOST_REFRESHES} refreshes of the mesh difference")
            break
    return Estimate(start, theta, descent.error, descent.converged, descent.failure, tuple(history), *spent(),
                    problem=problem, differences=differences, refreshes=refreshes, warnings=tuple(warnings))


def _refine(problem: Problem, theta: np.ndarray, warnings: list[str]) -> tuple[float, ...]:
    """New corrections; a test whose accurate mesh fails keeps the fast one, and carries its error."""
    found, errors = [], []
    for test in problem.tests:
        try:
            found.append(test.update_correction(problem.space, theta, problem.solves))
            errors.append(mesh_uncertainty(test, ACCURATE_MESH_ERRORS))
        except InfeasibleError:
            test.drop_correction()
            found.append(float("nan"))
            errors.append(mesh_uncertainty(test, FAST_MESH_ERRORS))
            warning = f"{test.name}: the accurate mesh does not get through, so the fast one's error is carried"
            if warning not in warnings:
                warnings.append(warning)
    problem.mesh_error = tuple(errors)
    return tuple(found)


def _estimate_jitter(problem: Problem, theta: np.ndarray, stated: Noise) -> None:
    """New jitter; where no test has two recordings the first guess stays, with freedom 0."""
    if all(len(test.measured) < 2 for test in problem.tests):
        return
    problem.forget()
    replicates = problem.replicates(theta)
    problem.jitter = estimate_jitter(replicates, contact=stated.contact_jitter, zero=stated.zero_jitter)
    problem.forget()


def _alike(one: Jitter, other: Jitter) -> bool:
    return all(abs(a - b) <= JITTER_SETTLED * max(a, b) for a, b in ((one.contact, other.contact),
                                                                     (one.zero, other.zero)))
