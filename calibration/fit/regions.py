"""Tests for smooth misfit in the residuals of each test and segment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from calibration.fit.fit import RegionMisfitTest
from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation
from calibration.statistics.adequacy import adjust_p_values_by_holm, compute_rao_score_test, make_cosine_modes
from calibration.statistics.sensor_noise import whiten_columns

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


_SETTINGS = RegionMisfitSettings()


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
        factor = 1.0 if test.measured[0].test.specimen is None else 1e3
        displacement = factor * np.concatenate([curve.displacement[inside] for curve, (inside, _) in zip(
            test.measured, parts, strict=True)])
        worst = int(np.argmax(np.abs(smooth)))
        found.append(RegionMisfitTest(
            test=test.name, segment=segment, start=float(displacement.min()), end=float(displacement.max()), p=answer.p,
            statistic=answer.statistic, freedom=answer.freedom, misfit_N=float(np.sqrt(np.mean(smooth**2))),
            largest_N=float(smooth[worst]), at=float(displacement[worst]), adequate=True))
    adjusted = adjust_p_values_by_holm(np.array([region.p for region in found]))
    return [replace(region, p=float(p), adequate=bool(p > _SETTINGS.level))
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
            regions = [(segment, _SETTINGS.segment_modes,
                        [(inside := curve.segment == segment, _compute_relative_segment_time(curve.time, inside))
                         for curve in test.measured]) for segment in segments]
        else:
            deepest = max(curve.displacement.max() for curve in test.measured)
            # Loading begins at rest, or at the largest compression of a gripped specimen.
            lowest = min(0.0, *(curve.displacement.min() for curve in test.measured)) \
                if test.measured[0].test.kind.has_gripped_ends else 0.0
            positions = [np.clip((curve.displacement - lowest) / (deepest - lowest), 0.0, 1.0) * 3
                         for curve in test.measured]
            regions = [(name, _SETTINGS.third_modes, [(((s > third) | (third == 0)) & (s - third <= 1),
                                                       np.clip(s - third, 0.0, 1.0)) for s in positions])
                       for third, name in enumerate(THIRDS)]
        yield from ((number, *region) for region in regions
                    if sum(inside.sum() for inside, _ in region[2]) >= _SETTINGS.min_samples)


def _compute_relative_segment_time(time: np.ndarray | None, inside: np.ndarray) -> np.ndarray:
    """Return the relative time of all samples between first and last sample of a segment, 0 to 1, shape (n,)."""
    if time is None or inside.sum() < 2:
        return np.zeros(inside.size)
    first, last = time[inside][[0, -1]]
    return np.clip((time - first) / max(last - first, 1e-300), 0.0, 1.0)
