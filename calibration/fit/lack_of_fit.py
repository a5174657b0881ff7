"""Lack of fit of a law: by test, by region of a test, and between tests of different stiffness.

The lack of fit to one test is the part of the residuals that noise and scatter between recordings leave. With several
recordings the residual of their mean tests the law, and their deviations from the mean are pure error. Source: Draper
and Smith, Applied Regression Analysis, 3rd ed., 1998, section 2.1.

Score tests look for smooth misfit in the residuals of each test and segment. If a law describes tests of one kind one
by one, but not with common parameters, the tests differ in stiffness.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.fit import RegionMisfitTest
from calibration.fit.problem import GeneralisedProblem, LeastSquaresProblem, ProblemEvaluation
from calibration.statistics.adequacy import adjust_p_values_by_holm, compute_rao_score_test, make_cosine_modes
from calibration.statistics.sensor_noise import whiten_columns
from tissue_sim.recording.segmentation import label_samples_ramp_hold_unload

#: Names of the parts of a single loading, by displacement.
THIRDS = ("first third", "middle third", "last third")


@dataclass(frozen=True)
class RegionMisfitSettings:
    """Settings of the tests for smooth misfit.

    Attributes:
        third_modes: number of cosine modes in a third of a loading. More modes detect shorter waves of the residuals
            and long ones less reliably.
        segment_modes: number of cosine modes in a segment.
        level: adjusted p value up to which a region is inadequate.
        min_samples: smallest number of samples of a region.
    """

    third_modes: int = 3
    segment_modes: int = 5
    level: float = 0.05
    min_samples: int = 8


_REGIONS = RegionMisfitSettings()


def compute_smooth_misfit_tests_of_regions(problem: GeneralisedProblem,
                                           evaluation: ProblemEvaluation) -> list[RegionMisfitTest]:
    """Test each segment of each test, or each third of a test with a single loading, for smooth misfit.

    Args:
        problem: least-squares problem.
        evaluation: evaluation at the minimum.
    """
    residual, design = evaluation.full_residual_and_jacobian
    found = []
    for number, segment, modes, parts in _iterate_regions(problem):
        test, columns, shapes = problem.tests[number], np.zeros((residual.size, modes)), []
        own = [rows for rows, (t, _) in zip(problem.rows, problem.places, strict=True) if t == number]
        for rows, curve, (inside, along) in zip(own, test.measured, parts, strict=True):
            waves = np.zeros((inside.size, modes))
            waves[inside] = make_cosine_modes(along[inside], modes)
            shapes.append(waves[inside])
            columns[rows] = whiten_columns(waves, curve.time, curve.noise)
        answer = compute_rao_score_test(residual, design, columns)
        # Smooth part of model minus data.
        smooth = -np.concatenate(shapes) @ answer.amplitudes
        factor = 1.0 if test.measured[0].test.states_stress else 1e3
        displacement = factor * np.concatenate([curve.displacement[inside] for curve, (inside, _) in zip(
            test.measured, parts, strict=True)])
        worst = int(np.argmax(np.abs(smooth)))
        found.append(RegionMisfitTest(
            test=test.name, segment=segment, start=float(displacement.min()), end=float(displacement.max()), p=answer.p,
            statistic=answer.statistic, freedom=answer.freedom, misfit_N=float(np.sqrt(np.mean(smooth**2))),
            largest_N=float(smooth[worst]), at=float(displacement[worst]), adequate=True))
    adjusted = adjust_p_values_by_holm(np.array([region.p for region in found]))
    return [replace(region, p=float(p), adequate=bool(p > _REGIONS.level))
            for region, p in zip(found, adjusted, strict=True)]


def format_regions_with_misfit(regions: Sequence[RegionMisfitTest]) -> str:
    """Name the regions with a smooth misfit; a test with misfit in all regions by its name only. Empty if none."""
    found = []
    for test in dict.fromkeys(region.test for region in regions):
        mine = [region for region in regions if region.test == test]
        bad = [region.segment for region in mine if not region.adequate]
        if bad:
            found.append(test if len(bad) == len(mine) else f"{test} ({', '.join(bad)})")
    return ", ".join(found)


def _iterate_regions(
        problem: GeneralisedProblem) -> Iterator[tuple[int, str, int, list[tuple[np.ndarray, np.ndarray]]]]:
    """Yield the regions of all tests.

    Yields:
        Index of the test, name of the region, number of modes, and for each recording the samples of the region and the
        position of all samples in it, 0 to 1.
    """
    for number, test in enumerate(problem.tests):
        segments = dict.fromkeys(name for curve in test.measured if curve.segment is not None
                                 for name in curve.segment.tolist())
        if len(segments) > 1:
            regions = [(segment, _REGIONS.segment_modes,
                        [(inside := curve.segment == segment, _compute_relative_segment_time(curve.time, inside))
                         for curve in test.measured]) for segment in segments]
        else:
            is_modulus = bool(test.measured[0].test.modulus)
            paths = [np.log(curve.displacement) if is_modulus else curve.displacement for curve in test.measured]
            deepest, lowest = max(path.max() for path in paths), min(path.min() for path in paths)
            if not is_modulus:
                # Loading begins at rest, or at the largest compression of a gripped specimen.
                lowest = min(0.0, lowest) if test.measured[0].test.kind.has_gripped_ends else 0.0
            positions = [np.clip((path - lowest) / (deepest - lowest), 0.0, 1.0) * 3 for path in paths]
            regions = [(name, _REGIONS.third_modes, [(((s > third) | (third == 0)) & (s - third <= 1),
                                                       np.clip(s - third, 0.0, 1.0)) for s in positions])
                       for third, name in enumerate(THIRDS)]
        yield from ((number, *region) for region in regions
                    if sum(inside.sum() for inside, _ in region[2]) >= _REGIONS.min_samples)


def _compute_relative_segment_time(time: np.ndarray | None, inside: np.ndarray) -> np.ndarray:
    """Return the relative time of all samples between first and last sample of a segment, 0 to 1, shape (n,)."""
    if time is None or inside.sum() < 2:
        return np.zeros(inside.size)
    first, last = time[inside][[0, -1]]
    return np.clip((time - first) / max(last - first, 1e-300), 0.0, 1.0)


@dataclass(frozen=True)
class LackOfFitSampleCounts:
    """Settings of the lack of fit.

    Attributes:
        points: number of points at which recordings of one test are compared.
        min_samples: smallest number of moving samples for a coefficient of determination.
    """

    points: int = 64
    min_samples: int = 8


_SAMPLE_COUNTS = LackOfFitSampleCounts()


@dataclass(frozen=True)
class LackOfFitR2AndRelativeError:
    """Lack of fit in one test, over the samples in which the displacement moves.

    Attributes:
        R2: fraction of the variance of the force that the law explains, without noise and scatter between recordings;
            None with fewer than 8 such samples.
        relative_error: root mean square lack of fit, relative to the largest force; of a modulus,
            relative to its value.
    """

    R2: float | None
    relative_error: float


def get_residual_scale(curve: MeasuredCurve) -> float:
    """Return the divisor of relative residuals: the largest absolute force, N; 1 for the logarithm of a modulus."""
    return 1.0 if curve.test.modulus else float(np.abs(curve.force).max())


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
    largest = max(get_residual_scale(curve) for _, curve in rows)
    parts = [(curve, gap[place], make_mask_of_moving_samples(curve)) for place, curve in rows]
    parts = [(curve, mine, moving) for curve, mine, moving in parts if moving.sum() >= _SAMPLE_COUNTS.min_samples]
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
                       _SAMPLE_COUNTS.points)
    for course, (curve, mine, moving) in zip(courses, parts, strict=True):
        order = np.argsort(course, kind="stable")
        gaps.append(np.interp(grid, course[order], mine[moving][order]))
        forces.append(np.interp(grid, course[order], curve.force[moving][order]))
    within = float(np.mean(np.var(gaps, axis=0, ddof=1)))
    return float(np.mean(np.mean(gaps, axis=0)**2)) - within / len(parts), float(np.var(np.mean(forces, axis=0)))


#: Ratio of two stiffnesses above which the tests differ.
_DIFFERENT = 1.05


def describe_stiffness_disagreement_or_empty(problem: LeastSquaresProblem, model: np.ndarray,
                                             smallest_R2: float) -> str:
    """Describe the remedy of a misfit if the tests of one kind differ in stiffness only; empty otherwise.

    The force of the law is scaled to each test by least squares. The law has the right shape if it then explains the
    variance of the force in every test.

    Args:
        problem: least-squares problem.
        model: force of the law at all samples, N, shape (N,).
        smallest_R2: fraction of the variance that the scaled force must explain.
    """
    # The logarithm of a modulus has no factor of stiffness.
    if any(test.measured[0].test.modulus for test in problem.tests):
        return ""
    if len(problem.tests) < 2 or len({test.measured[0].test.kind.name for test in problem.tests}) > 1:
        return ""
    factors = {}
    for number, test in enumerate(problem.tests):
        rows = np.concatenate([np.arange(model.size)[rows] for rows, (t, _) in zip(problem.rows, problem.places,
                                                                                   strict=True) if t == number])
        squares = float(model[rows] @ model[rows])
        factor = float(model[rows] @ problem.data[rows]) / squares if squares > 0 else 0.0
        R2 = compute_lack_of_fit_r2_and_relative_error(problem, factor * model - problem.data, number).R2
        if factor <= 0 or R2 is None or smallest_R2 > R2:
            return ""
        factors[test.name] = factor
    if max(factors.values()) <= _DIFFERENT * min(factors.values()):
        return ""
    listed = ", ".join(f"{name} {factor:.2f}" for name, factor in factors.items())
    return (f"the tests disagree in stiffness, not in shape (stiffness over that of the fit: {listed}); different "
            "materials? Fit each material in a separate campaign; for one material check unit, sign and size of the "
            "specimens")
