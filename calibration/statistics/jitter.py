"""Jitter between the replicates of a test: standard deviations of contact offset and zero, by restricted likelihood."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize


@dataclass(frozen=True)
class JitterEstimateSettings:
    """Settings of the search for the jitter (scatter of contact point and force zero between replicates).

    Attributes:
        rank_tolerance: smallest relative eigenvalue for which a direction of the fixed effects counts as independent.
        smallest: lower limit of the search, as a fraction of the standard error of a replicate's offset.
        largest: upper limit of the search, in units of the largest offset of a replicate.
        grid: number of trial values of each kind of jitter before the best one is refined.
        step: step of the logarithm of a standard deviation in finite differences of the criterion.
        gain: smallest decrease of -2 log likelihood that counts as an improvement.
    """

    rank_tolerance: float = 1e-10
    smallest: float = 1e-2
    largest: float = 10.0
    grid: int = 9
    step: float = 1e-8
    gain: float = 1e-6


_SETTINGS = JitterEstimateSettings()


@dataclass(frozen=True)
class ContactAndForceZeroJitter:
    """Jitter: standard deviations of contact point and force zero between the replicates of a test.

    Attributes:
        contact: standard deviation of the displacement at first contact, m.
        zero: standard deviation of the zero of the force, N.
        freedom: degrees of freedom of the estimate; None: both values are stated.
    """

    contact: float
    zero: float
    freedom: int | None


@dataclass(frozen=True, eq=False)
class WhitenedReplicate:
    """Linearised residuals of one replicate near the fit, in units of the sensor's noise.

    Attributes:
        residual: model minus data without contact offset, zero and mesh error, shape (n,).
        contact: derivative dF/da with respect to the contact offset a, 1/m, shape (n,).
        zero: derivative dF/db with respect to the zero b, 1/N, shape (n,).
        parameters: derivatives dF/dtheta with respect to the unknowns that all tests share, shape (n, p).
        shared: effects that all replicates of the test share, per standard deviation (mesh error), shape (n, m).
    """

    residual: np.ndarray
    contact: np.ndarray
    zero: np.ndarray
    parameters: np.ndarray
    shared: np.ndarray


def estimate_jitter(tests: Sequence[Sequence[WhitenedReplicate]], *, contact: float | None = None,
                    zero: float | None = None) -> ContactAndForceZeroJitter:
    """Estimate the jitter by restricted maximum likelihood (REML) in a linear mixed-effects model.

    The model of the residuals of a test has fixed effects (the parameters, and an offset and a zero of the whole test)
    and random effects: the shared columns with N(0, 1) weights, an offset N(0, contact^2) and a zero N(0, zero^2) of
    each replicate, and N(0, 1) noise. Since each test has its own fixed offset and zero, a misfit that resembles an
    offset of the whole test does not count as scatter, and R replicates have R - 1 degrees of freedom. With the
    covariance V, the fixed effects X and the residuals r, the criterion is

        -2 log L_R = log det V + log det X'V^-1 X + r'V^-1 r - r'V^-1 X (X'V^-1 X)^-1 X'V^-1 r.

    Woodbury's identity reduces each evaluation to small matrices.

    Args:
        tests: replicates of each test; the number of shared columns may differ between tests.
        contact: stated standard deviation of the contact, m, which is kept; None: it is estimated.
        zero: stated standard deviation of the zero, N, which is kept; None: it is estimated.

    Returns:
        The jitter; estimates are 0 with 0 degrees of freedom if no test has two replicates.

    Source: Patterson and Thompson, Biometrika 58 (1971) 545.
    """
    if contact is not None and zero is not None:
        return ContactAndForceZeroJitter(contact, zero, None)
    freedom = sum(len(test) - 1 for test in tests if test)
    if not freedom:
        return ContactAndForceZeroJitter(contact or 0.0, zero or 0.0, 0)
    repeated = [test for test in tests if len(test) > 1]
    grams = [_GramMatricesOfTest(test) for test in repeated]
    fixed = _find_independent_fixed_effects(grams)
    unknown = [kind for kind, stated in enumerate((contact, zero)) if stated is None]

    def insert_stated_values(values: np.ndarray) -> np.ndarray:
        """Return pairs (contact, zero) of standard deviations: stated values, and `values` for the unknown ones."""
        result = np.broadcast_to([contact or 0.0, zero or 0.0], (*values.shape[:-1], 2)).copy()
        result[..., unknown] = values
        return result

    def evaluate_reml_criteria(values: np.ndarray) -> np.ndarray:
        """Return -2 log restricted likelihood for unknown standard deviations, shape (..., unknowns) -> (...)."""
        return _evaluate_reml_criteria(grams, fixed, insert_stated_values(values))

    ranges = [_find_deviation_search_range(repeated, kind) for kind in unknown]
    best, lowest = np.zeros(len(unknown)), float(evaluate_reml_criteria(np.zeros(len(unknown))))
    # A standard deviation may be 0, where its logarithm is infinite: each subset of nonzero ones is minimised.
    for present in [[0]] if len(unknown) == 1 else [[0], [1], [0, 1]]:
        value, candidate = _find_least_criterion_and_deviations(evaluate_reml_criteria, len(unknown), present,
                                                                [ranges[k] for k in present])
        if value < lowest - _SETTINGS.gain:
            best, lowest = candidate, value
    found = insert_stated_values(best)
    return ContactAndForceZeroJitter(float(found[0]), float(found[1]), freedom)


class _GramMatricesOfTest:
    """Gram matrices (products of all pairs of columns) of the replicates of one test.

    Column blocks: offset and zero of each replicate (2), shared effects (m), fixed effects (p + 2), residual (1).
    """

    def __init__(self, test: Sequence[WhitenedReplicate]):
        grams = []
        for replicate in test:
            own = np.column_stack([replicate.contact, replicate.zero])
            columns = np.column_stack([own, replicate.shared, replicate.parameters, own, replicate.residual])
            grams.append(columns.T @ columns)
        gram = np.array(grams)
        self.shared, self.parameters = test[0].shared.shape[1], test[0].parameters.shape[1]
        self.own, self.cross, self.rest = gram[:, :2, :2], gram[:, :2, 2:], gram[:, 2:, 2:].sum(axis=0)

    def compute_normal_matrix_and_log_determinant(self, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return X'V^-1 X with the columns X of fixed effects and residual, and log det V, for this test.

        Args:
            deviations: pairs of standard deviations of contact, m, and zero, N, shape (..., 2).

        Returns:
            Matrices, shape (..., p + 3, p + 3), and log determinants, shape (...).
        """
        inner = np.eye(2) + self.own * (deviations[..., None, :, None] * deviations[..., None, None, :])
        cross = deviations[..., None, :, None] * self.cross
        rest = self.rest - (cross.swapaxes(-1, -2) @ np.linalg.solve(inner, cross)).sum(axis=-3)
        logarithm = np.log(np.linalg.det(inner)).sum(axis=-1)
        m = self.shared
        if not m:
            return rest, logarithm
        block = np.eye(m) + rest[..., :m, :m]
        return (rest[..., m:, m:] - rest[..., m:, :m] @ np.linalg.solve(block, rest[..., :m, m:]),
                logarithm + np.linalg.slogdet(block)[1])


def _assemble_normal_matrix_of_all_tests(grams: Sequence[_GramMatricesOfTest],
                                         blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Return X'V^-1 X over all tests: parameters (p), offset and zero of each test, residual (1)."""
    p = grams[0].parameters
    total = np.zeros((*blocks[0].shape[:-2], *(p + 2 * len(grams) + 1,) * 2))
    for test, block in enumerate(blocks):
        index = np.array([*range(p), p + 2 * test, p + 2 * test + 1, total.shape[-1] - 1])
        total[..., index[:, None], index] += block
    return total


def _find_independent_fixed_effects(grams: Sequence[_GramMatricesOfTest]) -> np.ndarray:
    """Return the coefficients of linearly independent combinations of the fixed effects, shape (fixed effects, rank).

    The rank does not depend on the covariance, so one computation serves all standard deviations.
    """
    total = _assemble_normal_matrix_of_all_tests(grams,
                                                 [gram.compute_normal_matrix_and_log_determinant(np.zeros(2))[0]
                                                  for gram in grams])[:-1, :-1]
    scale = np.sqrt(np.diag(total))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(total / np.outer(scale, scale))
    kept = values > _SETTINGS.rank_tolerance
    return vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]


def _evaluate_reml_criteria(grams: Sequence[_GramMatricesOfTest], fixed: np.ndarray,
                            deviations: np.ndarray) -> np.ndarray:
    """Return -2 log restricted likelihood, up to a constant, for pairs of standard deviations.

    The value is infinite if rounding makes a fixed effect vanish, which happens for jitter many orders of magnitude
    above the noise.

    Args:
        grams: Gram matrices of the tests.
        fixed: independent combinations of the fixed effects from `_find_independent_fixed_effects`.
        deviations: standard deviations of contact, m, and zero, N, shape (..., 2).
    """
    blocks, logarithms = zip(*(gram.compute_normal_matrix_and_log_determinant(deviations) for gram in grams),
                             strict=True)
    total = _assemble_normal_matrix_of_all_tests(grams, blocks)
    information, score = fixed.T @ total[..., :-1, :-1] @ fixed, fixed.T @ total[..., :-1, -1:]
    sign, logarithm = np.linalg.slogdet(information)
    good = sign > 0
    information = np.where(good[..., None, None], information, np.eye(fixed.shape[1]))
    explained = (score * np.linalg.solve(information, score)).sum(axis=(-1, -2))
    return np.where(good, sum(logarithms) + logarithm + total[..., -1, -1] - explained, np.inf)


def _find_deviation_search_range(tests: Sequence[Sequence[WhitenedReplicate]], kind: int) -> tuple[float, float]:
    """Return the smallest and largest trial value of a standard deviation (m or N); (0, 0) if it has no influence.

    Args:
        tests: replicates of each test.
        kind: 0: contact, m; 1: zero, N.
    """
    columns = [(one.contact, one.zero)[kind] for test in tests for one in test]
    residuals = [one.residual for test in tests for one in test]
    squares = np.array([column @ column for column in columns])
    active = squares > 0
    if not active.any():
        return 0.0, 0.0
    offset = max(abs(float(column @ residual)) / square for column, residual, square, is_active in
                 zip(columns, residuals, squares, active, strict=True) if is_active)
    error = 1.0 / float(np.sqrt(squares.max()))
    largest_error = 1.0 / float(np.sqrt(squares[active].min()))
    return _SETTINGS.smallest * error, _SETTINGS.largest * (offset + largest_error)


def _find_least_criterion_and_deviations(criterion: Callable[[np.ndarray], np.ndarray], size: int, present: list[int],
                                         ranges: list[tuple[float, float]]) -> tuple[float, np.ndarray]:
    """Minimise the criterion over the logarithms of nonzero standard deviations: grid search, then L-BFGS-B.

    Args:
        criterion: vectorised function of standard deviations, shape (..., size).
        size: number of unknown standard deviations.
        present: indices of the nonzero ones.
        ranges: smallest and largest trial value of each nonzero one.

    Returns:
        Smallest criterion and the standard deviations there, shape (size,); infinite if a range is empty.
    """
    def evaluate_at_log_deviations(logarithms: np.ndarray) -> np.ndarray:
        """Return the criterion for logarithms of the nonzero standard deviations, shape (..., present) -> (...)."""
        values = np.zeros((*logarithms.shape[:-1], size))
        values[..., present] = np.exp(logarithms)
        return criterion(values)

    if any(high <= 0 for _, high in ranges):
        return np.inf, np.zeros(size)
    low, high = np.log(ranges).T
    grid = np.stack(np.meshgrid(*np.linspace(low, high, _SETTINGS.grid).T), axis=-1).reshape(-1, len(present))
    values = evaluate_at_log_deviations(grid)
    start = grid[np.argmin(values)]
    if not np.isfinite(values.min()):
        return np.inf, np.zeros(size)

    def evaluate_criterion_and_gradient(point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the criterion and its gradient with respect to the logarithms, by one-sided finite differences."""
        steps = np.where(point + _SETTINGS.step <= high, _SETTINGS.step, -_SETTINGS.step)
        value, *others = evaluate_at_log_deviations(np.vstack([point, point + np.diag(steps)]))
        if not np.isfinite(value):
            return np.inf, np.zeros(len(present))
        return float(value), (np.array(others) - value) / steps

    found = minimize(evaluate_criterion_and_gradient, start, jac=True, bounds=list(zip(low, high, strict=True)),
                     method="L-BFGS-B")
    result = np.zeros(size)
    result[present] = np.exp(found.x)
    return float(found.fun), result
