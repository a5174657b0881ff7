"""From a start to the nearest minimum, and from the fast mesh's minimum to the accurate one's."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from calibration.fit.fit import Iteration
from calibration.fit.problem import Evaluation, Problem
from calibration.forward.forces import InfeasibleError

#: A step that lowers the sum of squares by less than this share of it ends the descent.
TOLERANCE = 1e-7
#: A step that would lower the sum of squares by less than this is not made: it is a fraction sqrt(ENOUGH) of a standard
#: error. A start is only to tell its minimum from others.
ENOUGH, ENOUGH_OF_A_START = 1e-3, 3e-2
MOST_SOLVES = 60

Listener = Callable[[Iteration], None]


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a start led.

    Attributes:
        start: its number, from 1. theta: the end, SI, shape (p,). error: sum of squares there, inf where the start has
            no force. converged: whether the optimiser said so. problem: why not.
        history: every solve. simulations: (test, resolution) -> simulations that were done. cpu_s: processor seconds.
    """

    start: int
    theta: np.ndarray
    error: float
    converged: bool
    problem: str
    history: tuple[Iteration, ...]
    simulations: dict[tuple[str, str], int]
    cpu_s: float


class _Outer:
    """The problem as scipy sees it, in parameters relative to the start."""

    def __init__(self, problem: Problem, scale: np.ndarray, free: np.ndarray, base: np.ndarray, note: Callable,
                 enough: float):
        self.problem, self.scale, self.free, self.base, self.note = problem, scale, free, base, note
        self.enough = enough
        self.failure = ""

    def theta(self, u: np.ndarray) -> np.ndarray:
        theta = self.base.copy()
        theta[self.free] = u * self.scale[self.free]
        return theta

    def residual(self, u: np.ndarray) -> np.ndarray:
        try:
            evaluation = self.problem.evaluate(self.theta(u))
        except InfeasibleError as error:
            self.failure = str(error)
            return np.full(self.size, np.inf)
        self.note(evaluation)
        residual = evaluation.projected[0]
        self.size = residual.size
        return residual

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        theta = self.theta(u)
        evaluation = self.problem.evaluate(theta)
        residual, jacobian = evaluation.projected
        jacobian = jacobian[:, self.free] * self.scale[self.free]
        # What the best step would still gain; it is not worth a solve when it does not count.
        gain = float(np.sum((jacobian @ np.linalg.lstsq(jacobian, residual, rcond=1e-12)[0])**2))
        if gain < self.enough * max(1.0, evaluation.error / self.problem.samples):
            raise _SettledError(theta, evaluation.error)
        return jacobian

    size = 1


class _SettledError(Exception):
    """The minimum is as near as it matters."""

    def __init__(self, theta: np.ndarray, error: float):
        super().__init__()
        self.theta, self.error = theta, error


def descend(problem: Problem, theta: np.ndarray, *, start: int = 1, held: int | None = None,
            corrected: bool = False, enough: float = ENOUGH, listen: Listener | None = None,
            past: int = 0) -> Descent:
    """Trust-region Levenberg-Marquardt from `theta`.

    Where forces are proportional to the moduli and none is fixed, the first solve finds the factor that suits all of
    them; that costs no second one. A mesh difference belongs to one place, so a corrected problem goes without.

    Args:
        problem: what to fit. theta: start, SI, shape (p,).
        start: number for the history. held: index of a parameter that stays where it is.
        corrected: whether the difference to the accurate mesh is in.
        enough: gain in the sum of squares, in units of the noise or the residuals, that is not worth a solve.
        listen: called after each solve. past: solves of this start so far.

    Source: scipy's trust region reflective method, see `calibration.analytical.uniaxial.fit_law`; the step is that of
    Levenberg and Marquardt in its form of Moré, Lecture Notes in Mathematics 630 (1978) 105.
    """
    space = problem.space
    began, counted = time.process_time(), Counter(problem.solves.counts)
    history: list[Iteration] = []

    def note(evaluation: Evaluation) -> None:
        if history and history[-1].parameters == named(evaluation):
            return
        history.append(Iteration(start=start, run=past + len(history) + 1, parameters=named(evaluation),
                                 error=evaluation.error, RMSE_N=rmse(problem, evaluation), corrected=corrected))
        if listen is not None:
            listen(history[-1])

    def named(evaluation: Evaluation) -> dict[str, float]:
        return dict(zip(space.free, evaluation.theta.tolist(), strict=True))

    def done(theta: np.ndarray, error: float, converged: bool, failure: str) -> Descent:
        return Descent(start, theta, error, converged, failure, tuple(history),
                       dict(problem.solves.counts - counted), time.process_time() - began)

    theta = np.clip(theta, space.low, space.high)
    free = np.array([i for i in range(theta.size) if i != held], dtype=int)
    try:
        note(problem.evaluate(theta))
        if held is None and not corrected:
            theta = _rescaled(problem, theta)
        evaluation = problem.evaluate(theta)
    except InfeasibleError as error:
        return done(theta, np.inf, False, str(error))
    if not free.size:
        return done(theta, evaluation.error, True, "")
    scale = space.sizes(space.values(theta))
    outer = _Outer(problem, scale, free, theta, note, enough)
    try:
        result = least_squares(
            outer.residual, theta[free] / scale[free], outer.jacobian,
            bounds=(space.low[free] / scale[free], space.high[free] / scale[free]), x_scale="jac", ftol=TOLERANCE,
            xtol=TOLERANCE, gtol=1e-14, max_nfev=MOST_SOLVES)
    except _SettledError as settled:
        return done(settled.theta, settled.error, True, "")
    theta = outer.theta(result.x)
    failure = "" if result.status > 0 else \
        f"no minimum after {MOST_SOLVES} solves{f'; {outer.failure}' if outer.failure else ''}"
    return done(theta, float(2 * result.cost), result.status > 0, failure)


def rmse(problem: Problem, evaluation: Evaluation) -> float:
    """Root mean square of model minus data, with offsets and zeros, N."""
    data = np.concatenate([measured.force for measured in problem.measured])
    return float(np.sqrt(np.mean((evaluation.force - data)**2)))


def _rescaled(problem: Problem, theta: np.ndarray) -> np.ndarray:
    """The same ratios of moduli, with the factor that fits best."""
    space = problem.space
    moduli = np.array([space.is_modulus(name) for name in space.free])
    fixed = any(space.is_modulus(name) for name in space.fixed)
    if fixed or not moduli.any() or not all(test.proportional for test in problem.tests):
        return theta
    # Without offsets and zeros, which far from the minimum would make up for a wrong size.
    residual, rates = problem.bare(theta)
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
