"""Least squares with the constraint that a law is Drucker-stable over a range of stretches (``fit.stable``)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from calibration.fit.ordinary_problem import OrdinaryProblem, evaluate_or_none_if_infeasible
from calibration.fit.trust_region import DescentResult
from tissue_sim.laws import find_law, find_stability_range
from tissue_sim.laws.stability import compute_stability_margins


@dataclass(frozen=True)
class StabilityConstraintSettings:
    """Settings of the constrained descent.

    Attributes:
        points: number of stretches from 1 to each end of the range at which stability is required.
        smallest_margin: smallest margin of `compute_stability_margins`, 1; keeps the law stable between the points.
        violation: violation of the margin, 1, that a descent may leave.
        max_iterations: limit of a descent.
        tolerance: relative decrease of the sum of squares at which a descent ends.
        max_candidates: largest number of minima without the constraint from which descents start.
    """

    points: int = 24
    smallest_margin: float = 1e-4
    violation: float = 5e-5
    max_iterations: int = 100
    tolerance: float = 1e-10
    max_candidates: int = 4


_SETTINGS = StabilityConstraintSettings()


@dataclass(frozen=True, eq=False)
class StabilityConstraint:
    """Drucker stability in uniaxial, planar and equibiaxial loading over a range of stretches.

    Attributes:
        problem: least-squares problem of one law.
        theta: minimum without the constraint, from which the range of the data follows, SI, shape (k,).
    """

    problem: OrdinaryProblem
    theta: np.ndarray

    @cached_property
    def stretch_range(self) -> tuple[float, float]:
        """Stated range of stretches, or that of the data along the load in all tests."""
        stated = self.problem.settings.stable
        if not isinstance(stated, bool):
            return stated
        free = self.theta[: len(self.problem.space.free)]
        reached = [test.compute_stretch_range(self.problem.space, free) for test in self.problem.tests]
        return min(one.low for one in reached), max(one.high for one in reached)

    @cached_property
    def _stretches(self) -> np.ndarray:
        """Stretches at which stability is required."""
        low, high = self.stretch_range
        return np.concatenate([np.geomspace(1.0, end, _SETTINGS.points) for end in (low, high)])

    def _list_parameters_of_law(self, theta: np.ndarray) -> list[tuple[float, ...]]:
        """Return the distinct sets of parameters of the law in the tests."""
        space = self.problem.space
        values, law = space.get_values_by_name(theta[: len(space.free)]), find_law(space.law)
        sets = [space.select_law_parameter_values(values, test.name) for test in self.problem.tests]
        return list(dict.fromkeys(tuple(own[name] for name in law.parameters) for own in sets))

    def compute_margins(self, theta: np.ndarray) -> np.ndarray:
        """Return the margins of stability less the smallest permitted one; not negative if the constraint holds."""
        law = find_law(self.problem.space.law)
        return np.concatenate([compute_stability_margins(law, np.array(values), self._stretches).ravel()
                               for values in self._list_parameters_of_law(theta)]) - _SETTINGS.smallest_margin

    def is_satisfied(self, theta: np.ndarray) -> bool:
        """Whether the law is stable over the whole range."""
        law = find_law(self.problem.space.law)
        return bool((self.compute_margins(theta) >= -_SETTINGS.violation).all()) and all(
            find_stability_range(law, np.array(values), self.stretch_range).is_stable_in_whole_range
            for values in self._list_parameters_of_law(theta))

    def descend(self, theta: np.ndarray, start: int) -> DescentResult:
        """Minimise the sum of squares with the constraint from a start, by sequential quadratic programming.

        Source: Kraft, DFVLR-FB 88-28 (1988), as in scipy.optimize.minimize (SLSQP).
        """
        problem, spent = self.problem, self.problem.solves.make_effort_since_now_function()
        variables = problem.make_scaled_or_long_term_variables(theta)
        unit = problem.evaluate(self.theta).penalised_sum_of_squares or 1.0
        last = [unit]

        def compute_objective_and_gradient(u: np.ndarray) -> tuple[float, np.ndarray]:
            """Return the sum of squares over that without the constraint, and its gradient."""
            evaluation = evaluate_or_none_if_infeasible(problem, variables.convert_to_unknowns(u))
            if evaluation is None:
                return 10.0 * max(last), np.zeros(u.size)
            residual, jacobian = evaluation.projected_residual_and_jacobian
            last.append(float(residual @ residual) / unit)
            return last[-1], 2.0 / unit * (variables.convert_jacobian_to_variables(jacobian, u).T @ residual)

        first = np.clip(variables.convert_from_unknowns(theta), *variables.bounds)
        result = minimize(compute_objective_and_gradient, first, jac=True, method="SLSQP",
                          bounds=list(zip(*variables.bounds, strict=True)),
                          constraints={"type": "ineq",
                                       "fun": lambda u: self.compute_margins(variables.convert_to_unknowns(u))},
                          options={"maxiter": _SETTINGS.max_iterations, "ftol": _SETTINGS.tolerance})
        found = np.clip(variables.convert_to_unknowns(result.x), *problem.bounds)
        evaluation = evaluate_or_none_if_infeasible(problem, found)
        error = np.inf if evaluation is None or not self.is_satisfied(found) else evaluation.penalised_sum_of_squares
        failure = "" if result.success else str(result.message)
        return DescentResult(start, found, error, bool(result.success), failure, (), *spent())


def constrain_minima_to_stability(problem: OrdinaryProblem, minima: Sequence[tuple[DescentResult, int]],
                                  others: Iterable[np.ndarray]
                                  ) -> tuple[list[tuple[DescentResult, int]], tuple[str, ...]]:
    """Return the stable minima, best first, and one sentence if the constraint changes the best one.

    Args:
        problem: least-squares problem of one law.
        minima: minima without the constraint, best first, each with its number of starts.
        others: further starts, SI, each of shape (k,).

    Returns:
        Minima, empty if no stable parameters are found, and the sentences.
    """
    best = minima[0][0]
    constraint = StabilityConstraint(problem, best.theta)
    if constraint.is_satisfied(best.theta):
        return [item for item in minima if constraint.is_satisfied(item[0].theta)], ()
    starts = [*((each.theta, count) for each, count in minima), *((theta, 1) for theta in others)]
    found = [(constraint.descend(theta, number), count)
             for number, (theta, count) in enumerate(starts[:_SETTINGS.max_candidates], 1)]
    found = sorted((item for item in found if np.isfinite(item[0].error)), key=lambda item: item[0].error)
    low, high = constraint.stretch_range
    if not found:
        return [], ()
    ratio = float(np.sqrt(found[0][0].error / best.error)) if best.error > 0 else np.inf
    return found, (f"fit.stable is active. Without it the law is unstable between the stretches {low:.3g} and "
                   f"{high:.3g}. It increases the residual by a factor of {ratio:.3g}. The standard errors neglect "
                   "the constraint",)
