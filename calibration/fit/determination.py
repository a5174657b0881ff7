"""Determination of the shear modulus of a fit by the tests, and its dependence on bounds that were not stated.

The modulus decides, since one parameter of a law may be undetermined where the modulus is known: C20 on the data of a
neo-Hookean solid, or C10 and C01 in simple shear, where their sum acts.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from calibration.fit.estimate import Estimate
from calibration.statistics.uncertainty import COVARIANCE, ParameterUncertainty


@dataclass(frozen=True)
class ModulusPrecisionSettings:
    """Limits of the clauses `determined` and `bounds`.

    Attributes:
        relative_error: largest standard error of the shear modulus, relative to it: the 95 % interval then reaches from
            half the value to 1.5 times it.
        change: largest relative change of the shear modulus by the release of a bound that was not stated.
        significance: least decrease of the sum of squares by that release, in units of the variance of the residuals:
            the 95 % quantile of chi-square with one degree of freedom.
        relative_step: step of central differences of the shear modulus, relative to the size of a parameter.
        rounding: relative change of the modulus along a direction without information up to which the change counts as
            rounding.
    """

    relative_error: float = 0.25
    change: float = 0.05
    significance: float = 3.84
    relative_step: float = 1e-6
    rounding: float = 1e-6


SETTINGS = ModulusPrecisionSettings()


@dataclass(frozen=True)
class ShearModulusPrecision:
    """Precision of the shear modulus mu0 (the instantaneous one, if the material has a memory).

    Attributes:
        relative_error: standard error of mu0 divided by mu0, with parameters on bounds fixed; inf if the samples
            contain no information on mu0.
        held: names of the parameters on bounds that were not stated, if mu0 depends on these bounds.
        change: relative change of mu0 in the first Newton step without these bounds.
    """

    relative_error: float
    held: tuple[str, ...] = ()
    change: float = 0.0

    @property
    def is_precise_enough(self) -> bool:
        """Whether the standard error of mu0 is within the limit."""
        return self.relative_error <= SETTINGS.relative_error


def assess_modulus_error_and_bound_dependence(estimate: Estimate, spread: ParameterUncertainty,
                                              modulus: Callable[[np.ndarray], float],
                                              stated: Collection[str]) -> ShearModulusPrecision:
    """Compute the standard error of the shear modulus, and its dependence on bounds.

    Args:
        estimate: minimum of the sum of squares.
        spread: uncertainty of the estimate.
        modulus: shear modulus, Pa, of the free parameters, shape (p,).
        stated: names of the parameters whose bounds the campaign states; these bounds count as known.
    """
    space = estimate.problem.space
    count = len(space.free)
    theta = estimate.theta[:count]
    sizes = space.compute_typical_parameter_sizes(space.get_values_by_name(theta))
    slope = np.zeros(estimate.theta.size)
    slope[:count] = _differentiate_shear_modulus(modulus, theta, sizes) / abs(modulus(theta))
    residual, jacobian = estimate.evaluation.projected_residual_and_jacobian
    slope = slope[: jacobian.shape[1]]
    held = spread.on_bound[: jacobian.shape[1]]
    _, flat = _solve_step_and_undetermined_modulus_change(jacobian[:, ~held], np.zeros(residual.size), slope[~held])
    variance = float(slope[:count] @ spread.covariance[:count, :count] @ slope[:count])
    error = np.inf if flat > SETTINGS.rounding else float(np.sqrt(max(variance, 0.0)))
    suspects = [i for i in range(count) if held[i] and space.free[i] not in stated]
    if not suspects:
        return ShearModulusPrecision(error)
    released = ~held
    released[suspects] = True
    columns = jacobian[:, released]
    step, flat = _solve_step_and_undetermined_modulus_change(columns, residual, slope[released])
    change = float("inf") if flat > SETTINGS.rounding else float(slope[released] @ step)
    decrease = float(residual @ residual - np.sum((residual + columns @ step)**2))
    depends = abs(change) > SETTINGS.change and decrease > SETTINGS.significance * max(spread.ratio, 1.0)**2
    return ShearModulusPrecision(error, tuple(space.free[i] for i in suspects) if depends else (), change)


def _differentiate_shear_modulus(modulus: Callable[[np.ndarray], float], theta: np.ndarray,
                                 sizes: np.ndarray) -> np.ndarray:
    """Return the gradient of the modulus with respect to the parameters by central differences, shape (p,)."""
    steps = np.diag(SETTINGS.relative_step * sizes)
    return np.array([(modulus(theta + step) - modulus(theta - step)) / (2.0 * step.max()) for step in steps])


def _solve_step_and_undetermined_modulus_change(jacobian: np.ndarray, residual: np.ndarray,
                                                slope: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve the linearised least-squares problem.

    Args:
        jacobian: derivatives of the residual with respect to the parameters, shape (n, p).
        residual: residual, shape (n,).
        slope: relative derivative of the modulus with respect to the parameters, shape (p,).

    Returns:
        Gauss-Newton step, shape (p,), and the largest relative change of the modulus along a direction without
        information, for a change of each parameter in inverse proportion to the norm of its column.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    if not jacobian.shape[1]:
        return np.zeros(0), 0.0
    _, values, rows = np.linalg.svd(jacobian / scale, full_matrices=False)
    known = values**2 > values.max(initial=0.0)**2 / COVARIANCE.singular_condition
    root = rows[known] / values[known, None]
    step = -(root.T @ (root @ ((jacobian / scale).T @ residual))) / scale
    flat = np.abs(rows[~known] @ (slope / scale)) / max(np.linalg.norm(slope / scale), 1e-300)
    return step, float(flat.max(initial=0.0))
