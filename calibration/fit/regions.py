"""Where a smooth misfit is left: residual tests by test and segment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec.structs import replace

from calibration.fit.fit import Region
from calibration.fit.problem import Evaluation, Problem
from calibration.statistics.adequacy import cosine_modes, holm, misfit
from calibration.statistics.sensor_noise import whiten

#: Parts of a single loading, by displacement, and cosine modes in each and in a whole segment.
THIRDS = ("first third", "middle third", "last third")
THIRD_MODES, SEGMENT_MODES = 3, 5
LEVEL = 0.05
_FEWEST = 8


def judge_regions(problem: Problem, evaluation: Evaluation) -> list[Region]:
    """A region for each segment of each test, and for each third of a test that only loads.

    Args:
        problem, evaluation: at the minimum.
    """
    residual, design = evaluation.design
    found = []
    for number, segment, modes, place, inside in _regions(problem):
        columns = np.zeros((residual.size, modes))
        shapes = np.zeros((problem.samples, modes))
        for rows, (t, r), mine, along in zip(problem.rows, problem.places, inside, place, strict=True):
            if t != number or not mine.any():
                continue
            measured = problem.tests[t].measured[r]
            waves = np.zeros((mine.size, modes))
            waves[mine] = cosine_modes(along[mine], modes)
            shapes[rows] = waves
            columns[rows] = whiten(waves, measured.time, measured.noise)
        answer = misfit(residual, design, columns)
        # Model minus data, of what is smooth.
        smooth = -shapes @ answer.amplitudes
        places = np.concatenate([np.arange(rows.start, rows.stop)[mine]
                                 for rows, mine in zip(problem.rows, inside, strict=True)])
        displacement = np.concatenate([curve.displacement for curve in problem.measured])[places]
        worst = int(np.argmax(np.abs(smooth[places])))
        factor = 1.0 if problem.tests[number].measured[0].test.specimen is None else 1e3
        found.append(Region(
            test=problem.tests[number].name, segment=segment, start=float(displacement.min() * factor),
            end=float(displacement.max() * factor), p=answer.p, statistic=answer.statistic, freedom=answer.freedom,
            misfit_N=float(np.sqrt(np.mean(smooth[places]**2))), largest_N=float(smooth[places][worst]),
            at=float(displacement[worst] * factor), adequate=True))
    adjusted = holm(np.array([region.p for region in found]))
    return [replace(region, p=float(p), adequate=bool(p > LEVEL))
            for region, p in zip(found, adjusted, strict=True)]


def name_misfits(regions: Sequence[Region]) -> str:
    """Where a smooth misfit is left, in words: whole tests by their name; empty where none is."""
    found = []
    for test in dict.fromkeys(region.test for region in regions):
        mine = [region for region in regions if region.test == test]
        bad = [region.segment for region in mine if not region.adequate]
        if bad:
            found.append(test if len(bad) == len(mine) else f"{test} ({', '.join(bad)})")
    return ", ".join(found)


def _regions(problem: Problem) -> Iterator[tuple]:
    """Test, name, modes, and for each recording of the problem the place (0 to 1) and the samples of a region."""
    for number, test in enumerate(problem.tests):
        segments = dict.fromkeys(name for curve in test.measured if curve.segment is not None
                                 for name in curve.segment.tolist())
        if len(segments) > 1:
            for segment in segments:
                inside = [curve.segment == segment if t == number else np.zeros(curve.force.size, bool)
                          for curve, (t, _) in zip(problem.measured, problem.places, strict=True)]
                place = [_along(curve.time, mine) for curve, mine in zip(problem.measured, inside, strict=True)]
                if sum(mine.sum() for mine in inside) >= _FEWEST:
                    yield number, segment, SEGMENT_MODES, place, inside
            continue
        deepest = max(curve.displacement.max() for curve in test.measured)
        for third, name in enumerate(THIRDS):
            share = [np.clip(curve.displacement / deepest, 0.0, 1.0) * 3 - third for curve in problem.measured]
            inside = [((s > 0) | (third == 0)) & (s <= 1) if t == number else np.zeros(s.size, bool)
                      for s, (t, _) in zip(share, problem.places, strict=True)]
            if sum(mine.sum() for mine in inside) >= _FEWEST:
                yield number, name, THIRD_MODES, [np.clip(s, 0.0, 1.0) for s in share], inside


def _along(time: np.ndarray | None, inside: np.ndarray) -> np.ndarray:
    """Place in time between the first and the last sample of a segment, 0 to 1, shape (n,)."""
    if time is None or inside.sum() < 2:
        return np.zeros(inside.size)
    first, last = time[inside][[0, -1]]
    return np.clip((time - first) / max(last - first, 1e-300), 0.0, 1.0)
