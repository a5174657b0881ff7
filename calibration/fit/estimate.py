"""Estimate of an inverse fit: fixed-point iteration of parameters, mesh correction and jitter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.campaign.campaign import Noise
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.fit import DescentEvaluation, Minimum
from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation
from calibration.fit.trust_region import DescentResult, Listener, minimise_from_start
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.forms import compute_mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS, FAST_MESH_ERRORS
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter, estimate_jitter


@dataclass(frozen=True)
class MeshIterationSettings:
    """Settings of the fixed-point iteration of parameters, mesh correction and jitter.

    Attributes:
        parameter_tolerance: expected relative change of the parameters by a further mesh correction at which the
            iteration ends. A smaller value needs more simulations on the accurate mesh.
        safety: safety factor of the expected change, which is the last change times the relative mesh difference.
        jitter_tolerance: relative change of the jitter at which the iteration ends.
        max_refreshes: maximum number of mesh corrections.
    """

    parameter_tolerance: float = 5e-4
    safety: float = 5.0
    jitter_tolerance: float = 0.05
    max_refreshes: int = 8


_SETTINGS = MeshIterationSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(DescentResult):
    """Estimate of the parameters: minimum of a least-squares problem with mesh correction and jitter.

    Attributes:
        problem: `GeneralisedProblem` with its corrections and jitter, or `OrdinaryProblem`.
        differences: for each test the difference of the accurate and the fast mesh relative to the largest force; NaN
            if the accurate mesh did not converge.
        refreshes: number of computations of these differences.
        warnings: warnings of the iteration.
        minima: distinct minima of all starts, best first.
    """

    problem: Any
    differences: tuple[float, ...] = ()
    refreshes: int = 0
    warnings: tuple[str, ...] = ()
    minima: tuple[Minimum, ...] = ()

    @property
    def evaluation(self) -> ProblemEvaluation:
        """Residuals and derivatives at the minimum."""
        return self.problem.evaluate(self.theta)


def iterate_mesh_correction_and_jitter(problem: GeneralisedProblem, theta: np.ndarray, stated: Noise, start: int = 1,
                                       past: int = 0, listen: Listener | None = None) -> Estimate:
    """Repeat mesh correction, jitter estimate and descent until the parameters no longer change.

    Args:
        problem: problem without mesh correction.
        theta: minimum of the problem, SI, shape (p,).
        stated: stated jitter; None values are estimated.
        start: see `calibration.fit.trust_region.minimise_from_start`.
        past: see `calibration.fit.trust_region.minimise_from_start`.
        listen: see `calibration.fit.trust_region.minimise_from_start`.
    """
    spent = problem.solves.make_effort_since_now_function()
    history: list[DescentEvaluation] = []
    differences: tuple[float, ...] = ()
    warnings: list[str] = []
    if None in (stated.contact_jitter, stated.zero_jitter):
        problem = _derive_problem_with_estimated_jitter(problem, theta, stated)
        descent = minimise_from_start(problem, theta, start=start, listen=listen, past=past)
        history += descent.history
        theta = descent.theta
    refreshes = 0
    while True:
        problem, differences = _derive_problem_with_mesh_correction(problem, theta, warnings)
        refreshes += 1
        jitter = problem.jitter
        if None in (stated.contact_jitter, stated.zero_jitter):
            problem = _derive_problem_with_estimated_jitter(problem, theta, stated)
        descent = minimise_from_start(problem, theta, start=start, corrected=True, listen=listen,
                                      past=past + len(history))
        history += descent.history
        if not np.isfinite(descent.error):
            break
        moved = np.abs(descent.theta
                       - theta) / problem.space.compute_typical_parameter_sizes(problem.space.get_values_by_name(theta))
        theta = descent.theta
        # The correction is nearly proportional to the parameters, so the next change is about this one times the
        # relative difference of the meshes.
        largest = max((difference for difference in differences if np.isfinite(difference)), default=0.0)
        expected = moved.max(initial=0.0) * min(1.0, _SETTINGS.safety * largest)
        if expected < _SETTINGS.parameter_tolerance and _are_jitters_equal(jitter, problem.jitter):
            break
        if refreshes == _SETTINGS.max_refreshes:
            warnings.append(f"the parameters still changed after {_SETTINGS.max_refreshes} mesh corrections")
            break
    return Estimate(start, theta, descent.error, descent.converged, descent.failure, tuple(history), *spent(),
                    problem=problem, differences=differences, refreshes=refreshes, warnings=tuple(warnings))


def make_test_with_mesh_correction(test: ForwardTest, space: ParameterSpace, theta: np.ndarray,
                                   solves: SimulationCache) -> tuple[ForwardTest, float, float]:
    """Return a copy of a test with the mesh correction at the given parameters.

    Args:
        test: forward model; unchanged.
        space: parameter space.
        theta: free parameters, SI, shape (p,).
        solves: cache of simulations.

    Returns:
        The copy; the difference of the accurate and the fast mesh relative to the largest force; the relative standard
        deviation of the remaining mesh error. If the accurate mesh fails, the copy has no correction, the difference is
        NaN, and the error is that of the fast mesh.
    """
    corrected = replace(test)
    try:
        difference = corrected.update_mesh_force_difference_and_get_ratio(space, theta, solves)
    except InfeasibleError:
        corrected.discard_mesh_correction()
        return corrected, float("nan"), compute_mesh_uncertainty(corrected, FAST_MESH_ERRORS)
    return corrected, difference, compute_mesh_uncertainty(corrected, ACCURATE_MESH_ERRORS)


def _derive_problem_with_mesh_correction(problem: GeneralisedProblem, theta: np.ndarray, warnings: list[str]
                                         ) -> tuple[GeneralisedProblem, tuple[float, ...]]:
    """Return the problem with the mesh correction of each test at `theta`, and the relative differences of the meshes.

    A test whose accurate mesh fails has no correction and the larger error of the fast mesh.
    """
    found = [make_test_with_mesh_correction(test, problem.space, theta, problem.solves) for test in problem.tests]
    for test, difference, _ in found:
        warning = f"{test.name}: the accurate mesh does not converge, so the error of the fast mesh is used"
        if np.isnan(difference) and warning not in warnings:
            warnings.append(warning)
    tests, differences, errors = zip(*found, strict=True)
    return replace(problem, tests=tests, mesh_error=errors), differences


def _derive_problem_with_estimated_jitter(problem: GeneralisedProblem, theta: np.ndarray,
                                          stated: Noise) -> GeneralisedProblem:
    """Return the problem with the jitter estimated at `theta`; without repeated recordings the first guess stays."""
    if all(len(test.measured) < 2 for test in problem.tests):
        return problem
    replicates = problem.linearise_replicates(theta)
    contact = stated.contact_jitter if any(curve.has_contact_offset for curve in problem.measured) else 0.0
    return replace(problem, jitter=estimate_jitter(replicates, contact=contact, zero=stated.zero_jitter))


def _are_jitters_equal(one: ContactAndForceZeroJitter, other: ContactAndForceZeroJitter) -> bool:
    """Return whether two jitters agree within `MeshIterationSettings.jitter_tolerance`."""
    pairs = (one.contact, other.contact), (one.zero, other.zero)
    return all(abs(a - b) <= _SETTINGS.jitter_tolerance * max(a, b) for a, b in pairs)
