"""Jitter between the replicates of a test: how much their contact offsets and zeros scatter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

#: Directions of the flat columns with less than this share of a column's squares are the other columns again.
INDEPENDENT = 1e-10
#: Jitter is sought from this share of what a replicate can resolve ...
SMALLEST = 1e-2
#: ... to this many times the largest offset that a replicate shows.
LARGEST = 10.0
#: Values of each kind of jitter that are tried, besides none, before the best is refined.
GRID = 9
#: Step of the logarithm of a deviation, for the slope of the criterion.
STEP = 1e-8
#: A smaller gain in -2 log likelihood is none.
GAIN = 1e-6


@dataclass(frozen=True)
class Jitter:
    """Standard deviations between the replicates of a test.

    Attributes:
        contact: of the displacement at which a replicate touches, m.
        zero: of the zero of its force, N.
        freedom: degrees of freedom behind the estimate; None where both are stated.
    """

    contact: float
    zero: float
    freedom: int | None


@dataclass(frozen=True, eq=False)
class WhitenedReplicate:
    """One replicate, linearised near the fit, every row in units of the sensor's noise.

    Attributes:
        residual: model minus data with the replicate's contact offset and zero, and all that is shared, at 0, (n,).
        contact: dF/da of the contact offset a, 1/m, shape (n,).
        zero: dF/db of the zero b, 1/N, shape (n,).
        parameters: dF/dtheta of the unknowns that all tests share, shape (n, p).
        shared: what all replicates of the test share with a known deviation, times it (mesh error), shape (n, m).
    """

    residual: np.ndarray
    contact: np.ndarray
    zero: np.ndarray
    parameters: np.ndarray
    shared: np.ndarray


def estimate_jitter(tests: Sequence[Sequence[WhitenedReplicate]], *, contact: float | None = None,
                    zero: float | None = None) -> Jitter:
    """Jitter with the largest restricted likelihood, from how replicates of one test differ.

    The residuals of a test are a linear combination of the parameters' columns, its shared columns with N(0, 1)
    weights, an offset and a zero that all its replicates have, an offset N(0, contact^2) and a zero N(0, zero^2) of
    each replicate, and N(0, 1) noise. Parameters and the test's own offset and zero are flat, so a misfit of the model
    that looks like an offset of the whole test does not count as scatter, and R replicates have R - 1 degrees of
    freedom. The work is O(n) once, then small matrices.

    Args:
        tests: replicates of each test; the number of shared columns may differ between tests.
        contact: m, where it is stated; it is held. zero: N, the same.

    Returns:
        What is sought is 0, with no degrees of freedom, where no test has two replicates.

    Source: Patterson and Thompson, Biometrika 58 (1971) 545; Woodbury's identity.
    """
    if contact is not None and zero is not None:
        return Jitter(contact, zero, None)
    freedom = sum(len(test) - 1 for test in tests if test)
    if not freedom:
        return Jitter(contact or 0.0, zero or 0.0, 0)
    repeated = [test for test in tests if len(test) > 1]
    grams = [_Gram(test) for test in repeated]
    flat = _independent(grams)
    sought = [kind for kind, stated in enumerate((contact, zero)) if stated is None]

    def deviations(values: np.ndarray) -> np.ndarray:
        result = np.broadcast_to([contact or 0.0, zero or 0.0], (*values.shape[:-1], 2)).copy()
        result[..., sought] = values
        return result

    def criterion(values: np.ndarray) -> np.ndarray:
        return _criterion(grams, flat, deviations(values))

    ranges = [_range(repeated, kind) for kind in sought]
    best, least = np.zeros(len(sought)), float(criterion(np.zeros(len(sought))))
    # A kind of jitter may be absent: refined for every choice of those that are there.
    for present in [[0]] if len(sought) == 1 else [[0], [1], [0, 1]]:
        value, candidate = _minimise(criterion, len(sought), present, [ranges[k] for k in present])
        if value < least - GAIN:
            best, least = candidate, value
    found = deviations(best)
    return Jitter(float(found[0]), float(found[1]), freedom)


class _Gram:
    """Inner products of one test's columns: own (2) of each replicate, shared (m), flat (p + 2), residual (1)."""

    def __init__(self, test: Sequence[WhitenedReplicate]):
        grams = []
        for one in test:
            own = np.column_stack([one.contact, one.zero])
            columns = np.column_stack([own, one.shared, one.parameters, own, one.residual])
            grams.append(columns.T @ columns)
        gram = np.array(grams)
        self.shared, self.parameters = test[0].shared.shape[1], test[0].parameters.shape[1]
        self.own, self.cross, self.rest = gram[:, :2, :2], gram[:, :2, 2:], gram[:, 2:, 2:].sum(axis=0)

    def reduced(self, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inner products of flat columns and residual under the covariance of this test, and its log determinant, for
        each pair of deviations, shape (..., 2)."""
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


def _assemble(grams: Sequence[_Gram], blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Inner products over all tests: parameters (p), offset and zero of each test, residual (1)."""
    p = grams[0].parameters
    total = np.zeros((*blocks[0].shape[:-2], *(p + 2 * len(grams) + 1,) * 2))
    for test, block in enumerate(blocks):
        place = np.array([*range(p), p + 2 * test, p + 2 * test + 1, total.shape[-1] - 1])
        total[..., place[:, None], place] += block
    return total


def _independent(grams: Sequence[_Gram]) -> np.ndarray:
    """Combinations of the flat columns that are independent, shape (columns, rank); the covariance leaves them so."""
    total = _assemble(grams, [gram.reduced(np.zeros(2))[0] for gram in grams])[:-1, :-1]
    scale = np.sqrt(np.diag(total))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(total / np.outer(scale, scale))
    kept = values > INDEPENDENT
    return vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]


def _criterion(grams: Sequence[_Gram], flat: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """-2 log restricted likelihood, up to a constant, of each pair of deviations, shape (..., 2); infinite where
    rounding has swallowed a flat column, as under jitter many orders above the noise."""
    blocks, logarithms = zip(*(gram.reduced(deviations) for gram in grams), strict=True)
    total = _assemble(grams, blocks)
    information, score = flat.T @ total[..., :-1, :-1] @ flat, flat.T @ total[..., :-1, -1:]
    sign, logarithm = np.linalg.slogdet(information)
    good = sign > 0
    information = np.where(good[..., None, None], information, np.eye(flat.shape[1]))
    explained = (score * np.linalg.solve(information, score)).sum(axis=(-1, -2))
    return np.where(good, sum(logarithms) + logarithm + total[..., -1, -1] - explained, np.inf)


def _range(tests: Sequence[Sequence[WhitenedReplicate]], kind: int) -> tuple[float, float]:
    """Smallest and largest jitter worth trying: from what a replicate can resolve to what one shows."""
    columns = [(one.contact, one.zero)[kind] for test in tests for one in test]
    residuals = [one.residual for test in tests for one in test]
    squares = np.array([column @ column for column in columns])
    seen = squares > 0
    if not seen.any():
        return 0.0, 0.0
    shown = max(abs(float(column @ residual)) / square for column, residual, square, there in
                zip(columns, residuals, squares, seen, strict=True) if there)
    error = 1.0 / float(np.sqrt(squares.max()))
    return SMALLEST * error, LARGEST * (shown + 1.0 / float(np.sqrt(squares[seen].min())))


def _minimise(criterion: Callable[[np.ndarray], np.ndarray], size: int, present: list[int],
              ranges: list[tuple[float, float]]) -> tuple[float, np.ndarray]:
    """Least criterion, and where: on a logarithmic grid of the deviations that are present, then refined.

    Args:
        criterion: of deviations, shape (..., size), all at once.
    """
    def at(logarithms: np.ndarray) -> np.ndarray:
        values = np.zeros((*logarithms.shape[:-1], size))
        values[..., present] = np.exp(logarithms)
        return criterion(values)

    if any(high <= 0 for _, high in ranges):
        return np.inf, np.zeros(size)
    low, high = np.log(ranges).T
    grid = np.stack(np.meshgrid(*np.linspace(low, high, GRID).T), axis=-1).reshape(-1, len(present))
    values = at(grid)
    start = grid[np.argmin(values)]
    if not np.isfinite(values.min()):
        return np.inf, np.zeros(size)

    def with_slope(point: np.ndarray) -> tuple[float, np.ndarray]:
        steps = np.where(point + STEP <= high, STEP, -STEP)
        value, *others = at(np.vstack([point, point + np.diag(steps)]))
        if not np.isfinite(value):
            return np.inf, np.zeros(len(present))
        return float(value), (np.array(others) - value) / steps

    found = minimize(with_slope, start, jac=True, bounds=list(zip(low, high, strict=True)), method="L-BFGS-B")
    result = np.zeros(size)
    result[present] = np.exp(found.x)
    return float(found.fun), result
