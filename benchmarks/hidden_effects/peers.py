"""Usual methods on the same recordings: least squares with R2, BIC, and a Gaussian-process discrepancy.

Each method uses the exact plain model: its force on a fine mesh, without discretisation error.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares, minimize

from benchmarks.hidden_effects.sizes import CONTACT, ZERO
from benchmarks.hidden_effects.truth import C10, SLOW, VirtualTest, lubricated, simulated

#: Values of C20 / C10 at which the plain model is known, 1.
RATIOS = (0.0, 0.15, 0.3, 0.5, 0.75, 1.0, 1.5, 2.5)
#: Number of points of a test for the Gaussian process.
POINTS = 40
#: Start values of amplitude and length of the discrepancy: logarithms of fractions of the largest force and of the
#: duration.
_STARTS = ((-5.0, -1.5), (-3.5, -2.5))

#: Recordings of a test: its motion, and forces, N, shape (replicates, n).
Recorded = Sequence[tuple[VirtualTest, np.ndarray]]


@cache
def _unit_curves(kind: str) -> tuple[CubicSpline, CubicSpline]:
    """Return splines of the force per C10 over depth for each ratio C20 / C10, and between the ratios."""
    test = VirtualTest(kind, kind, SLOW, False, 10.0)
    curves = [lubricated(test.displacement, {"C10": C10, "C20": ratio * C10}) if kind == "A" else
              simulated(test, {}, {"C10": C10, "C20": ratio * C10}) for ratio in RATIOS]
    return CubicSpline(test.displacement, np.array(curves).T / C10), CubicSpline(RATIOS, np.eye(len(RATIOS)))


def force_of(test: VirtualTest, moduli: np.ndarray, samples: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return the force of the plain model at samples of a test, N. moduli: C10 and C20, Pa."""
    curves, between = _unit_curves(test.kind)
    ratio = float(np.clip(moduli[1] / moduli[0], RATIOS[0], RATIOS[-1]))
    return moduli[0] * (curves(test.displacement[samples]) @ between(ratio))


def _jacobian(tests: Sequence[tuple[VirtualTest, np.ndarray]], moduli: np.ndarray) -> np.ndarray:
    columns = []
    for place in range(2):
        step = np.zeros(2)
        step[place] = 1e-4 * C10
        columns.append(np.concatenate([(force_of(test, moduli + step, rows) - force_of(test, moduli - step, rows))
                                       / (2 * step[place]) for test, rows in tests]))
    return np.column_stack(columns)


def ordinary(recorded: Recorded) -> dict:
    """Return the least-squares fit of all loading curves, with R2 and the usual standard errors."""
    parts = [(test, test.direction > 0, forces) for test, forces in recorded if not test.held_out]
    data = np.concatenate([forces[:, rows].ravel() for _, rows, forces in parts])

    def residual(moduli: np.ndarray) -> np.ndarray:
        return np.concatenate([np.tile(force_of(test, moduli, rows), len(forces)) for test, rows, forces in parts]
                              ) - data

    found = least_squares(residual, [1400.0, 600.0], x_scale=[1e3, 1e3], bounds=([10.0, 0.0], [1e5, 1e5]))
    left = float(np.sum(found.fun**2))
    spread = np.linalg.inv(found.jac.T @ found.jac) * left / (data.size - 2)
    return {"moduli": found.x.tolist(), "errors": np.sqrt(np.diag(spread)).tolist(),
            "R2": 1.0 - left / float(np.sum((data - data.mean()) ** 2))}


def best_by_bic(candidates: Sequence[Mapping], samples: float) -> dict:
    """Return the effect with the best BIC, without abstention and without a test of adequacy.

    The score of a candidate that the diagnosis did not fit replaces its gain of the likelihood.
    """
    gains: dict[str, float] = {}
    for row in candidates:
        if not row["testable"] or row["score"] is None:
            continue
        gain = row["delta_BIC"] if row["delta_BIC"] is not None else row["score"] ** 2 - math.log(samples)
        gains[row["effect"]] = max(gains.get(row["effect"], -math.inf), gain)
    best = max(gains, key=lambda name: gains[name], default=None)
    return {"name": best if best is not None and gains[best] > 0 else "NONE",
            "gains": dict(sorted(gains.items(), key=lambda pair: -pair[1])[:6])}


def _covariance(test: VirtualTest, rows: np.ndarray, largest: float, noise: float, replicates: int, scale: float,
                length: float) -> np.ndarray:
    """Return the covariance of the mean of the replicates, N2: discrepancy, noise, contact jitter and zero jitter."""
    time = test.time[rows] / test.time[-1]
    discrepancy = (scale * largest) ** 2 * np.exp(-0.5 * ((time[:, None] - time[None]) / length) ** 2)
    step = 1e-6
    moved = np.gradient(force_of(test, np.array([C10, 0.5 * C10])), np.arange(test.time.size))
    way = np.gradient(test.displacement, np.arange(test.time.size))
    slope = np.where(np.abs(way) > step * 1e-3, moved / np.where(way == 0, 1.0, way), 0.0)[rows]
    jitter = (CONTACT**2 * np.outer(slope, slope) + ZERO**2) / replicates
    return discrepancy + jitter + noise**2 / replicates * np.eye(rows.size)


def gaussian_process(recorded: Recorded, noise: float) -> dict:
    """Fit the moduli with a smooth marginalised discrepancy in every test.

    Kennedy and O'Hagan, J. R. Statist. Soc. B 63 (2001) 425.

    Each test has one squared-exponential process. All have the same relative amplitude and length in time, which
    maximise the likelihood profiled over the moduli. The data are the means of the replicates.

    Args:
        recorded: tests and their forces, N. noise: standard deviation of a sample, N.
    """
    parts = []
    for test, forces in recorded:
        if not test.held_out:
            rows = np.unique(np.linspace(0, test.time.size - 1, POINTS).round().astype(int))
            parts.append((test, rows, forces.mean(axis=0)[rows], float(np.abs(forces).max()), len(forces)))
    places = [(test, rows) for test, rows, *_ in parts]

    def solve(hyper: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        scale, length = np.exp(np.clip(hyper, [-12.0, -4.0], [0.0, 1.5]))
        factors = [cho_factor(_covariance(test, rows, largest, noise, replicates, scale, length), lower=True)
                   for test, rows, _, largest, replicates in parts]
        moduli = np.array([1400.0, 600.0])
        for _ in range(6):
            design = _jacobian(places, moduli)
            residuals = [data - force_of(test, moduli, rows) for test, rows, data, *_ in parts]
            ends = np.cumsum([0, *(rows.size for _, rows in places)])
            blocks = [design[a:b] for a, b in itertools.pairwise(ends)]
            information = sum(block.T @ cho_solve(factor, block) for block, factor in zip(blocks, factors, strict=True))
            pull = sum(block.T @ cho_solve(factor, residual)
                       for block, factor, residual in zip(blocks, factors, residuals, strict=True))
            step = np.linalg.solve(information, pull)
            moduli = np.array([max(moduli[0] + step[0], 10.0), max(moduli[1] + step[1], 1e-3)])
            if np.all(np.abs(step) < 1e-3):
                break
        fit = sum(float(residual @ cho_solve(factor, residual))
                  for residual, factor in zip(residuals, factors, strict=True))
        size = sum(2.0 * float(np.sum(np.log(np.diag(factor[0])))) for factor in factors)
        return fit + size, moduli, np.linalg.inv(information)

    found = min((minimize(lambda hyper: solve(hyper)[0], start, method="Nelder-Mead",
                          options={"maxiter": 60, "xatol": 0.05, "fatol": 0.1}) for start in _STARTS),
                key=lambda one: one.fun)
    _, moduli, spread = solve(found.x)
    return {"moduli": moduli.tolist(), "errors": np.sqrt(np.diag(spread)).tolist(),
            "scale": float(np.exp(found.x[0])), "length": float(np.exp(found.x[1]))}
