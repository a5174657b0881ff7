"""Nonlinear least squares from one start by SciPy's trust region reflective method (`scipy.optimize.least_squares`).

Descents from several starts may end in several optima of one law: parameters that fit the recordings equally well and
predict other tests differently. Ogden's energy in simple shear is an example: the principal stretches are l, 1/l and 1,
so that alpha and -alpha give the same stress in shear and different stresses in compression.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy.optimize import least_squares

from calibration.fit.fit import AlternativeMinimum, DescentEvaluation, Minimum
from calibration.fit.problem import GeneralisedProblem, LeastSquaresProblem, ProblemEvaluation
from calibration.forward.contract import InfeasibleError
from calibration.forward.modulus import ModulusTest
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


ALTERNATIVES = AlternativeMinimaSettings()


def list_sign_flipped_starts(space: ParameterSpace, theta: np.ndarray) -> list[np.ndarray]:
    """Return starts in the other basins of a law with exponents: every other combination of their signs.

    Args:
        space: parameter space.
        theta: unknowns at a minimum, shape (k,); the free parameters come first.

    Returns:
        Unknowns inside their bounds, each of shape (k,); empty for a law without free exponents.
    """
    varied = space.free_parameters
    # A parameter that must be positive has no other sign.
    signed = [each.is_dimensionless_law_parameter and space.low[place] < 0 for place, each in enumerate(varied)]
    paths = list(dict.fromkeys(each.path for each, is_signed in zip(varied, signed, strict=True) if is_signed))
    found = []
    for signs in product((1.0, -1.0), repeat=len(paths)):
        if all(sign > 0 for sign in signs):
            continue
        start = np.array(theta, dtype=float)
        for place, each in enumerate(varied):
            if signed[place]:
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
    equal = [i for i, (error, _) in enumerate(minima) if error - minima[0][0] < ALTERNATIVES.equal_rise]
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
        if minimum.rise >= ALTERNATIVES.rise or not law.mu0(other) > 0:
            continue
        known = [parameters, *(one.parameters_of_law for one in found)]
        if all(_find_largest_stress_difference_and_test(law, one, other, stretches)[0] > ALTERNATIVES.difference
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
    low = max(stretches[0], ALTERNATIVES.lowest_stretch)
    high = min(stretches[1], 1.0 / ALTERNATIVES.lowest_stretch)
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


@dataclass(frozen=True)
class DescentSettings:
    """Tolerances and limits of a descent by the trust region reflective method.

    Attributes:
        tolerance: relative decrease of the sum of squares, and relative step, at which SciPy ends a descent (``ftol``,
            ``xtol``).
        min_gain: predicted decrease of the sum of squares, in units of the variance of the noise or the residuals,
            below which a descent ends. The remaining step is about sqrt(min_gain) = 3 % of a standard error. A smaller
            value needs more evaluations.
        min_gain_of_start: the same for a descent from one of several starts, which only has to distinguish its minimum
            from others.
        max_solves: maximum number of evaluations of the model per descent.
        bound_distance: distance to a bound at which an unknown counts as on the bound, relative to the unknown.
        rounding: relative rounding error of the conversion of unknowns to variables and back.
        same_minimum: relative difference of parameters below which two minima are identical. A larger value merges
            different materials; a smaller one reports one minimum several times.
        gradient: tolerance of SciPy's test of the gradient (``gtol``); effectively off, since the predicted decrease
            decides.

    Source: Branch, Coleman and Li, SIAM J. Sci. Comput. 21 (1999) 1.
    """

    tolerance: float = 1e-7
    min_gain: float = 1e-3
    min_gain_of_start: float = 3e-2
    max_solves: int = 60
    bound_distance: float = 1e-3
    rounding: float = 1e-12
    same_minimum: float = 1e-2
    gradient: float = 1e-14


DESCENT = DescentSettings()
#: Function that receives each iteration of a descent.
Listener = Callable[[DescentEvaluation], None]


@dataclass(frozen=True, eq=False)
class DescentResult:
    """Result of a descent from one start.

    Attributes:
        start: number of the start, from 1.
        theta: unknowns at the end, SI, shape (k,).
        error: sum of squares at the end; inf if the model has no solution at the start.
        converged: whether the descent converged.
        failure: reason of a failure; empty if converged.
        history: all iterations.
        simulations: (test, resolution) -> number of simulations.
        cpu_s: processor time, s.
    """

    start: int
    theta: np.ndarray
    error: float
    converged: bool
    failure: str
    history: tuple[DescentEvaluation, ...]
    simulations: dict[tuple[str, str], int]
    cpu_s: float


class _NuisanceEliminatedProblem:
    """Residual and Jacobian for SciPy, with the nuisances eliminated (variable projection).

    Args:
        problem: least-squares problem.
        theta: start, SI, shape (k,).
        note: function that receives each evaluation.
        enough: predicted decrease of the sum of squares below which the descent ends; 0: never.
        stalled: see `minimise_from_start`.
    """

    #: Number of residuals; known after the first evaluation.
    size = 1

    def __init__(self, problem: LeastSquaresProblem, theta: np.ndarray, record_iteration: Callable, enough: float,
                 stalled: tuple[int, float] | None):
        self.problem, self.note, self.enough, self.stalled = problem, record_iteration, enough, stalled
        # Sums of squares of all evaluations, and the unknowns of the smallest one.
        self.errors: list[float] = []
        self.best = theta
        self.variables = problem.make_scaled_or_long_term_variables(theta)
        self.start = np.clip(self.variables.convert_from_unknowns(theta), *self.variables.bounds)
        self.first = theta
        self.failure = ""

    def convert_variables_to_unknowns(self, u: np.ndarray) -> np.ndarray:
        """Return the unknowns of variables `u`, shape (k,).

        For the start the original values are returned, without rounding errors, so that cached simulations are found.
        """
        unknowns = self.variables.convert_to_unknowns(u)
        same = np.array_equal(u, self.start) and np.allclose(unknowns, self.first, rtol=DESCENT.rounding, atol=0.0)
        return self.first if same else unknowns

    def compute_residual_or_end_descent(self, u: np.ndarray) -> np.ndarray:
        """Return the residual at variables `u`; infinite if the model has no solution, so that SciPy shortens the step.

        Raises:
            _NegligibleDecreaseError: the descent has stalled.
        """
        try:
            evaluation = self.problem.evaluate(self.convert_variables_to_unknowns(u))
        except InfeasibleError as error:
            self.failure = str(error)
            return np.full(self.size, np.inf)
        self.note(evaluation)
        if evaluation.penalised_sum_of_squares < min(self.errors, default=np.inf):
            self.best = evaluation.theta
        self.errors.append(evaluation.penalised_sum_of_squares)
        if self.stalled is not None:
            solves, gain = self.stalled
            before, best = self.errors[:-solves], min(self.errors)
            if before and min(before) - best < gain * max(1.0, best / self.problem.samples):
                raise _NegligibleDecreaseError(self.best, best)
        residual = evaluation.projected_residual_and_jacobian[0]
        self.size = residual.size
        return residual

    def compute_jacobian_or_end_descent(self, u: np.ndarray) -> np.ndarray:
        """Return the Jacobian at variables `u`.

        Raises:
            _NegligibleDecreaseError: the predicted decrease of a Gauss-Newton step is below the limit.
        """
        evaluation = self.problem.evaluate(self.convert_variables_to_unknowns(u))
        residual, jacobian = evaluation.projected_residual_and_jacobian
        jacobian = self.variables.convert_jacobian_to_variables(jacobian, u)
        if self.enough:
            bound = self._find_bounds_to_be_crossed_or_nan(u, jacobian.T @ residual)
            inside = jacobian[:, ~np.isfinite(bound)]
            gain = float(np.sum((inside @ np.linalg.lstsq(inside, residual, rcond=1e-12)[0])**2))
            if gain < self.enough * max(1.0, evaluation.penalised_sum_of_squares / self.problem.samples):
                raise self._make_descent_end_on_bounds(np.where(np.isfinite(bound), bound, u), evaluation)
        return jacobian

    def _find_bounds_to_be_crossed_or_nan(self, u: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the bound that each variable is close to and would cross, shape (k,); NaN: none."""
        low, high = self.variables.bounds
        near = DESCENT.bound_distance * np.maximum(np.abs(u), DESCENT.bound_distance)
        return np.where((u - low <= near) & (gradient > 0), low, np.where(
            (high - u <= near) & (gradient < 0), high, np.nan))

    def _make_descent_end_on_bounds(self, u: np.ndarray, evaluation: ProblemEvaluation) -> _NegligibleDecreaseError:
        """Return the exception that ends the descent; variables are on the bounds `u` unless the error increases."""
        try:
            on_bounds = self.problem.evaluate(np.clip(self.convert_variables_to_unknowns(u), *self.problem.bounds))
        except InfeasibleError:
            on_bounds = evaluation
        best = on_bounds if on_bounds.penalised_sum_of_squares <= evaluation.penalised_sum_of_squares else evaluation
        return _NegligibleDecreaseError(best.theta, best.penalised_sum_of_squares)


class _NegligibleDecreaseError(Exception):
    """Raised to end a descent whose remaining decrease of the sum of squares is negligible.

    Args:
        theta: unknowns at the end, SI, shape (k,).
        error: sum of squares.
    """

    def __init__(self, theta: np.ndarray, error: float):
        super().__init__()
        self.theta, self.error = theta, error


def minimise_from_start(problem: LeastSquaresProblem, theta: np.ndarray, *, start: int = 1, corrected: bool = False,
                        enough: float = DESCENT.min_gain, tolerance: float = DESCENT.tolerance,
                        gradient: float = DESCENT.gradient,
                        max_solves: int = DESCENT.max_solves, stalled: tuple[int, float] | None = None,
                        listen: Listener | None = None, past: int = 0) -> DescentResult:
    """Minimise the sum of squares from a start by the trust region reflective method.

    The descent ends early if the predicted decrease of a Gauss-Newton step is below `enough`. If forces are
    proportional to free moduli, the moduli of the start are first multiplied by the common factor that minimises the
    linearised sum of squares; a problem with a mesh correction omits this step, since the correction holds for one set
    of moduli.

    Args:
        problem: least-squares problem.
        theta: start, SI, shape (k,).
        start: number of the start for the history.
        corrected: whether the problem has a mesh correction.
        enough: predicted decrease of the sum of squares, in units of the variance of the noise or the residuals, below
            which the descent ends; 0: only the tolerances of SciPy end it.
        tolerance: ``ftol`` and ``xtol`` of SciPy.
        gradient: ``gtol`` of SciPy.
        max_solves: maximum number of evaluations (``max_nfev``).
        stalled: number n and decrease d: the descent ends if n evaluations in succession lower the sum of squares by
            less than d, in the units of `enough`; None: no such test.
        listen: function that receives each iteration.
        past: number of earlier evaluations of this start.

    Source: Branch, Coleman and Li, SIAM J. Sci. Comput. 21 (1999) 1, as in scipy.optimize.least_squares.
    """
    space = problem.space
    spent = problem.solves.make_effort_since_now_function()
    history: list[DescentEvaluation] = []

    def record_iteration(evaluation: ProblemEvaluation) -> None:
        """Append an evaluation with new parameters to `history`, and send it to `listen`."""
        if history and history[-1].parameters == map_free_parameters_to_values(evaluation):
            return
        rmse = float(np.sqrt(np.mean((evaluation.force - problem.data)**2)))
        history.append(DescentEvaluation(start=start, run=past + len(history) + 1,
                                         parameters=map_free_parameters_to_values(evaluation),
                                         error=evaluation.penalised_sum_of_squares, RMSE_N=rmse, corrected=corrected))
        if listen is not None:
            listen(history[-1])

    def map_free_parameters_to_values(evaluation: ProblemEvaluation) -> dict[str, float]:
        """Return name -> value of the free parameters of an evaluation, SI."""
        return dict(zip(space.free, evaluation.theta.tolist(), strict=False))

    def build_descent_result(theta: np.ndarray, error: float, converged: bool, failure: str) -> DescentResult:
        """Return the result with the history and the effort of this descent."""
        return DescentResult(start, theta, error, converged, failure, tuple(history), *spent())

    theta = np.clip(theta, *problem.bounds)
    try:
        record_iteration(problem.evaluate(theta))
        if not corrected and enough:
            theta = _scale_moduli_by_best_factor(problem, theta)
        evaluation = problem.evaluate(theta)
    except InfeasibleError as error:
        return build_descent_result(theta, np.inf, False, str(error))
    if not theta.size:
        return build_descent_result(theta, evaluation.penalised_sum_of_squares, True, "")
    reduced = _NuisanceEliminatedProblem(problem, theta, record_iteration, enough, stalled)
    try:
        # Scaling by the columns of the Jacobian makes the method independent of the units of the unknowns.
        result = least_squares(
            reduced.compute_residual_or_end_descent, reduced.start, reduced.compute_jacobian_or_end_descent,
            x_scale="jac",
            bounds=reduced.variables.bounds, ftol=tolerance, xtol=tolerance, gtol=gradient, max_nfev=max_solves)
    except _NegligibleDecreaseError as settled:
        return build_descent_result(settled.theta, settled.error, True, "")
    theta = reduced.convert_variables_to_unknowns(result.x)
    failure = "" if result.status > 0 else \
        f"no minimum after {max_solves} solves{f'; {reduced.failure}' if reduced.failure else ''}"
    return build_descent_result(theta, float(2 * result.cost), result.status > 0, failure)


def find_distinct_minima(ends: Iterable[tuple[DescentResult, int]],
                         near: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> list[tuple[DescentResult, int]]:
    """Return the distinct minima, best first, each with the number of starts that ended in it.

    Args:
        ends: descents, each with the number of starts that it represents.
        near: function that returns for two sets of unknowns which of them agree, bool, shape (k,).
    """
    kept: list[tuple[DescentResult, int]] = []
    for end, count in sorted(ends, key=lambda item: item[0].error):
        same = next((i for i, (other, _) in enumerate(kept) if near(end.theta, other.theta).all()), None)
        if same is None:
            kept.append((end, count))
        else:
            kept[same] = kept[same][0], kept[same][1] + count
    return kept


def _scale_moduli_by_best_factor(problem: LeastSquaresProblem, theta: np.ndarray) -> np.ndarray:
    """Return the unknowns with all moduli multiplied by the best common factor; unchanged if this is impossible."""
    space = problem.space
    moduli = np.array([each.is_modulus for each in space.free_parameters])
    fixed = any(space.get_parameter_by_name(name).is_modulus for name in space.fixed)
    is_logarithmic = all(isinstance(test, ModulusTest) for test in problem.tests)
    if (fixed or not moduli.any() or not space.has_only_shared_material_parameters
            or not (is_logarithmic or all(test.is_force_proportional_to_moduli for test in problem.tests))):
        return theta
    # Offsets and zeros stay 0: far from the minimum they would compensate a wrong factor.
    residual, rates = cast(GeneralisedProblem, problem).linearise_without_nuisances(theta)
    # Euler's theorem: the derivative of the force with the common factor is sum C_i dF/dC_i.
    direction = rates[:, moduli] @ theta[moduli]
    if not direction @ direction > 0:
        return theta
    change = -float(direction @ residual) / float(direction @ direction)
    factor = float(np.exp(change)) if is_logarithmic else 1.0 + change
    scaled = theta.copy()
    scaled[moduli] *= factor
    if factor <= 0 or (scaled < space.low).any() or (scaled > space.high).any():
        return theta
    return scaled
