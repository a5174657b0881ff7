"""From a start to the nearest minimum, and from the fast mesh's minimum to the accurate one's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.optimize import least_squares

from calibration.fit.fit import Iteration
from calibration.fit.problem import Evaluation, LeastSquares, Problem
from calibration.forward.contract import InfeasibleError

#: A step that lowers the sum of squares by less than this share of it ends the descent.
TOLERANCE = 1e-7
#: A step that would lower the sum of squares by less than this is not made: it is a fraction sqrt(ENOUGH) of a standard
#: error. A start is only to tell its minimum from others.
ENOUGH, ENOUGH_OF_A_START = 1e-3, 3e-2
MOST_SOLVES = 60
#: An unknown this near to its bound, relative to itself, is on it.
_ON_BOUND = 1e-3
#: Rounding of unknowns that become variables and unknowns again, relative.
_ROUNDING = 1e-12
#: Of scipy's test of the gradient, which the gain replaces.
GRADIENT = 1e-14

Listener = Callable[[Iteration], None]


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a start led.

    Attributes:
        start: its number, from 1. theta: the end, SI, shape (p,). error: sum of squares there, inf where the start has
            no force. converged: whether the optimiser said so. failure: why not.
        history: every solve. simulations: (test, resolution) -> simulations that were done. cpu_s: processor seconds.
    """

    start: int
    theta: np.ndarray
    error: float
    converged: bool
    failure: str
    history: tuple[Iteration, ...]
    simulations: dict[tuple[str, str], int]
    cpu_s: float


class _Outer:
    """The problem as scipy sees it."""

    def __init__(self, problem: LeastSquares, theta: np.ndarray, note: Callable, enough: float,
                 stalled: tuple[int, float] | None):
        self.problem, self.note, self.enough, self.stalled = problem, note, enough, stalled
        #: Sums of squares so far, and unknowns of the least.
        self.errors: list[float] = []
        self.best = theta
        self.variables = problem.variables(theta)
        self.start = np.clip(self.variables.of(theta), *self.variables.bounds)
        self.first = theta
        self.failure = ""

    def unknowns(self, u: np.ndarray) -> np.ndarray:
        """The unknowns of these variables, shape (k,); those that the descent starts from to the last digit, so that
        what was simulated for them is not simulated again."""
        unknowns = self.variables.unknowns(u)
        same = np.array_equal(u, self.start) and np.allclose(unknowns, self.first, rtol=_ROUNDING, atol=0.0)
        return self.first if same else unknowns

    def residual(self, u: np.ndarray) -> np.ndarray:
        try:
            evaluation = self.problem.evaluate(self.unknowns(u))
        except InfeasibleError as error:
            self.failure = str(error)
            return np.full(self.size, np.inf)
        self.note(evaluation)
        if evaluation.error < min(self.errors, default=np.inf):
            self.best = evaluation.theta
        self.errors.append(evaluation.error)
        if self.stalled is not None:
            solves, gain = self.stalled
            before, best = self.errors[:-solves], min(self.errors)
            if before and min(before) - best < gain * max(1.0, best / self.problem.samples):
                raise _SettledError(self.best, best)
        residual = evaluation.projected[0]
        self.size = residual.size
        return residual

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        evaluation = self.problem.evaluate(self.unknowns(u))
        residual, jacobian = evaluation.projected
        jacobian = self.variables.times(jacobian, u)
        if self.enough:
            # What the best step would still gain; it is not worth a solve when it does not count.
            bound = self._bound(u, jacobian.T @ residual)
            inside = jacobian[:, ~np.isfinite(bound)]
            gain = float(np.sum((inside @ np.linalg.lstsq(inside, residual, rcond=1e-12)[0])**2))
            if gain < self.enough * max(1.0, evaluation.error / self.problem.samples):
                raise self._settled(np.where(np.isfinite(bound), bound, u), evaluation)
        return jacobian

    def _bound(self, u: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """The bound that an unknown is near to and that the descent would cross, shape (k,); NaN: none."""
        low, high = self.variables.bounds
        near = _ON_BOUND * np.maximum(np.abs(u), _ON_BOUND)
        return np.where((u - low <= near) & (gradient > 0), low, np.where(
            (high - u <= near) & (gradient < 0), high, np.nan))

    def _settled(self, u: np.ndarray, evaluation: Evaluation) -> _SettledError:
        """The end of the descent: on the bounds that it would cross, unless that is no better."""
        try:
            there = self.problem.evaluate(np.clip(self.unknowns(u), *self.problem.bounds))
        except InfeasibleError:
            there = evaluation
        best = there if there.error <= evaluation.error else evaluation
        return _SettledError(best.theta, best.error)

    size = 1


class _SettledError(Exception):
    """The minimum is as near as it matters."""

    def __init__(self, theta: np.ndarray, error: float):
        super().__init__()
        self.theta, self.error = theta, error


def descend(problem: LeastSquares, theta: np.ndarray, *, start: int = 1, corrected: bool = False,
            enough: float = ENOUGH, tolerance: float = TOLERANCE, gradient: float = GRADIENT,
            most_solves: int = MOST_SOLVES, stalled: tuple[int, float] | None = None, listen: Listener | None = None,
            past: int = 0) -> Descent:
    """Trust-region Levenberg-Marquardt from `theta`.

    Where forces are proportional to the moduli and none is fixed, the first solve finds the factor that suits all of
    them; that costs no second one. A mesh difference belongs to one place, so a corrected problem goes without.

    Args:
        problem: what to fit. theta: start, SI, shape (p,).
        start: number for the history. corrected: whether the difference to the accurate mesh is in.
        enough: gain in the sum of squares, in units of the noise or the residuals, that is not worth a solve; 0: any
            gain is, and the tolerances alone end the descent. tolerance, gradient, most_solves: scipy's.
        stalled: so many solves that lower the sum of squares by less than so much, all together and in the same units,
            end it; None: none do.
        listen: called after each solve. past: solves of this start so far.

    Source: trust region reflective method of scipy.optimize.least_squares (Branch, Coleman, Li, SIAM J. Sci. Comput.
    21 (1999) 1); the step is that of Levenberg and Marquardt in its form of Moré, Lecture Notes in Mathematics 630
    (1978) 105.
    """
    space = problem.space
    spent = problem.solves.meter()
    history: list[Iteration] = []

    def note(evaluation: Evaluation) -> None:
        if history and history[-1].parameters == named(evaluation):
            return
        rmse = float(np.sqrt(np.mean((evaluation.force - problem.data)**2)))
        history.append(Iteration(start=start, run=past + len(history) + 1, parameters=named(evaluation),
                                 error=evaluation.error, RMSE_N=rmse, corrected=corrected))
        if listen is not None:
            listen(history[-1])

    def named(evaluation: Evaluation) -> dict[str, float]:
        return dict(zip(space.free, evaluation.theta.tolist(), strict=False))

    def done(theta: np.ndarray, error: float, converged: bool, failure: str) -> Descent:
        return Descent(start, theta, error, converged, failure, tuple(history), *spent())

    theta = np.clip(theta, *problem.bounds)
    try:
        note(problem.evaluate(theta))
        if not corrected and enough:
            theta = _rescaled(problem, theta)
        evaluation = problem.evaluate(theta)
    except InfeasibleError as error:
        return done(theta, np.inf, False, str(error))
    if not theta.size:
        return done(theta, evaluation.error, True, "")
    outer = _Outer(problem, theta, note, enough, stalled)
    try:
        # Scaled by the columns of the Jacobian: Pa, exponents, metres and newtons stand side by side.
        result = least_squares(
            outer.residual, outer.start, outer.jacobian, x_scale="jac", bounds=outer.variables.bounds,
            ftol=tolerance, xtol=tolerance, gtol=gradient, max_nfev=most_solves)
    except _SettledError as settled:
        return done(settled.theta, settled.error, True, "")
    theta = outer.unknowns(result.x)
    failure = "" if result.status > 0 else \
        f"no minimum after {most_solves} solves{f'; {outer.failure}' if outer.failure else ''}"
    return done(theta, float(2 * result.cost), result.status > 0, failure)


def distinct(ends: Iterable[tuple[Descent, int]],
             near: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> list[tuple[Descent, int]]:
    """Minima that differ, best first, with how many starts fell into each.

    Args:
        ends: with how many starts each stands for. near: which parameters of two ends are alike.
    """
    kept: list[tuple[Descent, int]] = []
    for end, count in sorted(ends, key=lambda item: item[0].error):
        same = next((i for i, (other, _) in enumerate(kept) if near(end.theta, other.theta).all()), None)
        if same is None:
            kept.append((end, count))
        else:
            kept[same] = kept[same][0], kept[same][1] + count
    return kept


def _rescaled(problem: LeastSquares, theta: np.ndarray) -> np.ndarray:
    """The same ratios of moduli, with the factor that fits best."""
    space = problem.space
    moduli = np.array([each.is_modulus for each in space.varied])
    fixed = any(space.unknown(name).is_modulus for name in space.fixed)
    if fixed or not moduli.any() or not space.of_material_alone or not all(test.proportional for test in problem.tests):
        return theta
    # Without offsets and zeros, which far from the minimum would make up for a wrong size.
    residual, rates = cast(Problem, problem).bare(theta)
    # Euler: what all moduli together do to the force is their sum of C dF/dC.
    direction = rates[:, moduli] @ theta[moduli]
    if not direction @ direction > 0:
        return theta
    factor = 1.0 - float(direction @ residual) / float(direction @ direction)
    scaled = theta.copy()
    scaled[moduli] *= factor
    if factor <= 0 or (scaled < space.low).any() or (scaled > space.high).any():
        return theta
    return scaled
