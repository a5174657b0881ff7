"""Lack of fit of a law to one test: the part of the residuals that noise and scatter between recordings leave.

With several recordings the residual of their mean tests the law, and their deviations from the mean are pure error.
Source: Draper and Smith, Applied Regression Analysis, 3rd ed., 1998, section 2.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.problem import LeastSquaresProblem
from tissue_sim.recording.segmentation import label_samples_ramp_hold_unload


@dataclass(frozen=True)
class LackOfFitSampleCounts:
    """Settings of the lack of fit.

    Attributes:
        points: number of points at which recordings of one test are compared.
        min_samples: smallest number of moving samples for a coefficient of determination.
    """

    points: int = 64
    min_samples: int = 8


_SETTINGS = LackOfFitSampleCounts()


@dataclass(frozen=True)
class LackOfFitR2AndRelativeError:
    """Lack of fit in one test, over the samples in which the displacement moves.

    Attributes:
        R2: fraction of the variance of the force that the law explains, without noise and scatter between recordings;
            None with fewer than 8 such samples.
        relative_error: root mean square lack of fit, relative to the largest force.
    """

    R2: float | None
    relative_error: float


def compute_lack_of_fit_r2_and_relative_error(problem: LeastSquaresProblem, gap: np.ndarray,
                                              number: int) -> LackOfFitR2AndRelativeError:
    """Compute the lack of fit in one test of a problem.

    Args:
        problem: least-squares problem.
        gap: model minus data at all samples, N, shape (N,).
        number: index of the test in the problem.
    """
    rows = [(rows, problem.tests[number].measured[r]) for rows, (t, r) in zip(problem.rows, problem.places, strict=True)
            if t == number]
    largest = max(float(np.abs(curve.force).max()) for _, curve in rows)
    parts = [(curve, gap[place], make_mask_of_moving_samples(curve)) for place, curve in rows]
    parts = [(curve, mine, moving) for curve, mine, moving in parts if moving.sum() >= _SETTINGS.min_samples]
    if not parts:
        return LackOfFitR2AndRelativeError(None, 0.0)
    if len(parts) == 1:
        curve, mine, moving = parts[0]
        squares = float(np.mean(mine[moving]**2)) - curve.noise.deviation**2
        variance = float(np.var(curve.force[moving]))
    else:
        squares, variance = _compute_mean_curve_lack_and_force_variance(parts,
                                                                        problem.tests[number].has_reversals_or_holds)
    squares = max(squares, 0.0)
    R2 = 1.0 - squares / variance if variance > 0 else None
    return LackOfFitR2AndRelativeError(R2, float(np.sqrt(squares)) / largest)


def make_mask_of_moving_samples(curve: MeasuredCurve) -> np.ndarray:
    """Return the mask of the samples outside holds, shape (n,); all true without increasing time or motion."""
    if curve.time is None or np.ptp(curve.sample_times) == 0 \
        or bool(np.any(np.diff(curve.sample_times) < 0)):
        return np.ones(curve.force.size, bool)
    moving = label_samples_ramp_hold_unload(curve.sample_times, curve.displacement) != "hold"
    return moving if moving.any() else np.ones(curve.force.size, bool)


def _compute_mean_curve_lack_and_force_variance(parts: list[tuple[MeasuredCurve, np.ndarray, np.ndarray]],
                                                timed: bool) -> tuple[float, float]:
    """Return the mean square lack of fit of the mean recording, N^2, and the variance of its force, N^2."""
    gaps, forces = [], []
    courses = [curve.sample_times[moving] - curve.sample_times[0] if timed
               else curve.displacement[moving] for curve, _, moving in parts]
    grid = np.linspace(max(course.min() for course in courses), min(course.max() for course in courses),
                       _SETTINGS.points)
    for course, (curve, mine, moving) in zip(courses, parts, strict=True):
        order = np.argsort(course, kind="stable")
        gaps.append(np.interp(grid, course[order], mine[moving][order]))
        forces.append(np.interp(grid, course[order], curve.force[moving][order]))
    within = float(np.mean(np.var(gaps, axis=0, ddof=1)))
    return float(np.mean(np.mean(gaps, axis=0)**2)) - within / len(parts), float(np.var(np.mean(forces, axis=0)))
