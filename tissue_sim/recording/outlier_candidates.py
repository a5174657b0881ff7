"""Find candidates for outliers in one channel, and predict their values from their neighbours.

A running median of seven samples and a median of short linear predictions mark candidates. A candidate is contradicted
if a polynomial through its neighbours on both sides (a line on one side at the ends, and on each side of a step)
describes these neighbours, and the candidate lies many deviations of that fit, of the noise and of the resolution away
from it.

Source: Hampel, J. Am. Stat. Assoc. 69 (1974) 383, for the running median.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class OutlierSettings:
    """Thresholds of `find_outliers_of_motion_and_load`.

    Attributes:
        fewest: samples of a recording that is examined. longest: samples of a group.
        neighbours: on each side of a group inside. one_sided: neighbours of a group at an end.
        of_fit: distance from the prediction in deviations of the neighbours from their fit; at an end more.
        of_noise: distance in deviations of the noise. of_steps: distance from the running median in steps between
            neighbouring samples. of_resolution: distance in last digits.
        core: distance of the samples of a group from the running median, over that of the farthest one.
        of_range: distance as a fraction of the range of the channel.
        event: change of the motion across a group, in the largest step of its neighbours, above which a peak of the
            load belongs to the motion.
        rest: fraction of the largest value below which a first or last sample is at rest.
        like: largest first step of a motion that counts from its first sample, in the largest of the following ones.
        correlated: correlation of motion and load above which their signs are known.
        plausible: largest motion at rest over that of the test, where a machine does not start at zero.
        overshoot: largest load in a step of the motion over the range of the load: 10 where a material loses 90 % of
            its load between two samples.
        stiffness: largest ratio of the stiffness of the first step from rest to that of the test.
        most: largest fraction of outliers; more are an error.
    """

    fewest: int = 12
    longest: int = 3
    neighbours: int = 6
    one_sided: int = 8
    of_fit: float = 8.0
    of_fit_at_end: float = 10.0
    of_noise: float = 8.0
    of_steps: float = 3.0
    core: float = 0.25
    of_resolution: float = 3.5
    of_range: float = 0.01
    event: float = 2.0
    rest: float = 0.03
    like: float = 3.0
    correlated: float = 0.5
    plausible: float = 1.5
    overshoot: float = 10.0
    stiffness: float = 5.0
    most: float = 0.1


SETTINGS = OutlierSettings()


@dataclass(frozen=True)
class RobustScaleSettings:
    """Settings of the running median and of the scale estimates.

    Attributes:
        window: samples of the running median.
        block: samples of a block in which the noise and the steps are estimated.
        median_distance: median of the distances from a running median of seven, in standard deviations of Gaussian
            noise.
    """

    window: int = 7
    block: int = 32
    median_distance: float = 0.52


#: Settings that the functions of this module use.
_SCALE = RobustScaleSettings()


class ChannelOutlierSearch:
    """Search for outliers in one channel: its noise, its steps and its candidate samples, each of shape (n,)."""

    def __init__(self, values: np.ndarray, settings: OutlierSettings, *, is_counted: bool = False):
        self.values, self.settings, self.is_counted = values, settings, is_counted
        padded = np.concatenate([_evaluate_robust_line(values[:9], np.arange(-3, 0)), values,
                                 _evaluate_robust_line(values[:-10:-1], np.arange(-3, 0))[::-1]])
        self.smooth = _compute_median_of_seven_from_padded(padded)
        self.away = away = np.abs(values - self.smooth)
        local = np.abs(values - _predict_each_sample_from_padded_values(padded))
        steps = np.abs(np.diff(values))
        self.range = float(np.ptp(self.smooth))
        least = 1e-9 * float(np.abs(self.smooth).max() or 1.0)
        positive = steps[steps > least]
        if positive.size <= 2 * settings.longest:
            # The steps may be those to an outlier and back.
            positive = np.abs(np.diff(self.smooth))
            positive = positive[positive > least]
        self.resolution = float(positive.min()) if positive.size else 0.0
        self.noise = _compute_largest_nearby_block_median(away) / _SCALE.median_distance
        self.steps = _compute_largest_nearby_block_median(np.append(steps, steps[-1]))
        least = np.maximum(settings.of_range * self.range, settings.of_resolution * self.resolution)
        self.least = np.maximum(least, settings.of_noise * self.noise)
        noise = np.maximum(self.noise, _compute_largest_nearby_block_median(local) / _SCALE.median_distance)
        self.groups = (away > np.maximum(self.least, settings.of_steps * self.steps)) & (self.range > 0)
        # Predictions that use a group of outliers are wrong: they find only single samples far from groups.
        near = np.convolve(self.groups, np.ones(_SCALE.window), "same") > 0
        self.singles = (local > np.maximum(least, settings.of_noise * noise)) & ~near & (self.range > 0)

    def iterate_outlier_groups_and_predictions(self) -> Iterator[tuple[tuple[int, ...], float]]:
        """Yield groups of samples that contradict their neighbours, with the value predicted for the first sample."""
        for candidates in (self.groups, self.singles):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], candidates, [False]]).astype(int)))
            runs = [self._find_core_of_run(*run) for run in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
            bad = np.zeros(self.values.size, bool)
            for first, last in runs:
                bad[first:last] = True
            good = np.flatnonzero(~bad)
            for first, last in runs:
                if last - first > self.settings.longest:
                    continue
                predicted = self._predict_first_value_if_outliers(first, last, good)
                if predicted is None and last - first > 1:
                    # Next to an outlier a step comes early in the running median: one sample of the run may be right.
                    farthest = first + int(np.argmax(self.away[first:last]))
                    others = np.setdiff1d(np.arange(first, last), farthest)
                    first, last = farthest, farthest + 1
                    predicted = self._predict_first_value_if_outliers(first, last, np.union1d(good, others))
                if predicted is not None:
                    yield tuple(range(first, last)), predicted

    def _find_core_of_run(self, first: int, last: int) -> tuple[int, int]:
        """Return first sample and end of the part of a run that is far from the running median.

        Next to three outliers the running median is wrong by several steps.
        """
        far = first + np.flatnonzero(self.away[first:last] >= self.settings.core * self.away[first:last].max())
        return int(far[0]), int(far[-1]) + 1

    def _predict_first_value_if_outliers(self, first: int, last: int, good: np.ndarray) -> float | None:
        """Return the prediction for sample `first` if samples `first` to `last` (not included) are outliers; else None.

        Args:
            first: first sample of the group, from 0.
            last: end of the group, not included.
            good: samples that are not candidates, sorted, shape (k,).
        """
        setting, place = self.settings, int(np.searchsorted(good, first))
        before, after = good[max(place - setting.one_sided, 0):place], good[place:place + setting.one_sided]
        one_sided = min(before.size, after.size) < setting.longest
        if one_sided:
            around = after[:setting.one_sided] if after.size > before.size else before[-setting.one_sided:]
        else:
            around = np.concatenate([before[-setting.neighbours:], after[:setting.neighbours]])
        degree = 1 if one_sided else 2
        if around.size < degree + 3:
            return None
        middle, group = 0.5 * (first + last - 1), np.arange(first, last)
        coefficients = np.polynomial.polynomial.polyfit(around - middle, self.values[around], degree)
        gaps = self.values[around] - np.polynomial.polynomial.polyval(around - middle, coefficients)
        deviation = float(np.sqrt(np.sum(gaps**2) / (around.size - degree - 1)))
        predicted = np.polynomial.polynomial.polyval(group - middle, coefficients)
        limit = max(float(self.least[first]), (setting.of_fit_at_end if one_sided else setting.of_fit) * deviation,
                    float(np.ptp(self.values[around])) if one_sided else 0.0)
        if not np.all(np.abs(self.values[group] - predicted) > limit):
            beyond = None if one_sided else self._predict_first_value_if_outlying_near_step(group, around)
            if beyond is None:
                return None
            predicted = np.array([beyond])
        # Rounding errors of the fit are zero.
        return float(predicted[0]) if abs(predicted[0]) > 1e-9 * self.range else 0.0

    def _predict_first_value_if_outlying_near_step(self, group: np.ndarray, around: np.ndarray) -> float | None:
        """Return the prediction for a group of outliers near a step; None if the group belongs to the step.

        A line is fitted to the neighbours before, and one to the neighbours after their largest jump. A group on one
        side is an outlier far from the line of its side. A group between the sides is an outlier far outside of the
        interval between both lines.
        """
        split = int(np.argmax(np.abs(np.diff(self.values[around])))) + 1
        sides = [side for side in (around[:split], around[split:])
                 if not (side[-1] < group[0] and around[split] < group[0])
                 and not (side[0] > group[-1] and around[split - 1] > group[-1])]
        limits, ends = [float(self.least[group[0]])], []
        for side in sides:
            if side.size < self.settings.longest + 1:
                return None
            line = np.polynomial.polynomial.polyfit(side - group[0], self.values[side], 1)
            gaps = self.values[side] - np.polynomial.polynomial.polyval(side - group[0], line)
            limits.append(self.settings.of_fit_at_end * float(np.sqrt(np.sum(gaps**2) / (side.size - 2))))
            limits.append(float(np.ptp(self.values[side])))
            ends.append(np.polynomial.polynomial.polyval(group - group[0], line))
        low, high, values = np.min(ends, axis=0), np.max(ends, axis=0), self.values[group]
        if np.all(values < low - max(limits)):
            return float(low[0])
        return float(high[0]) if np.all(values > high + max(limits)) else None

    def compute_change_across_group(self, first: int, last: int) -> float:
        """Return the change across samples `first` to `last` (not included); at an end the step next to them."""
        before, after = first - 1, last
        if first == 0:
            before = last - 1
        elif last == self.values.size:
            after = first
        return float(self.values[after] - self.values[before])

    def compute_largest_step_near_group(self, first: int, last: int) -> float:
        """Return the largest step between neighbours on one side of samples `first` to `last` (not included)."""
        count = self.settings.neighbours
        sides = self.values[max(first - count, 0):first], self.values[last:last + count]
        return max((float(np.abs(np.diff(side)).max()) for side in sides if side.size > 1), default=0.0)


def _evaluate_robust_line(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Evaluate a robust line through the samples at positions `at`; up to half of the samples may be wrong.

    Source: Siegel, Biometrika 69 (1982) 242, repeated medians.
    """
    places = np.arange(values.size)
    gaps = places[:, None] - places[None]
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = np.where(gaps == 0, np.nan, (values[:, None] - values[None]) / gaps)
    slope = float(np.median(np.nanmedian(slopes, axis=1)))
    return float(np.median(values - slope * places)) + slope * at


def _compute_median_of_seven_from_padded(padded: np.ndarray) -> np.ndarray:
    """Return the median of seven samples around each sample; `padded` has three more samples at each end."""
    rows = [padded[k:padded.size - _SCALE.window + 1 + k] for k in range(_SCALE.window)]
    # Exchanges that move the median of seven to the fourth position: Devillard, Fast median search (1998).
    for low, high in ((0, 5), (0, 3), (1, 6), (2, 4), (0, 1), (3, 5), (2, 6), (2, 3), (3, 6), (4, 5), (1, 4), (1, 3),
                      (3, 4)):
        rows[low], rows[high] = np.minimum(rows[low], rows[high]), np.maximum(rows[low], rows[high])
    return rows[3]


def _predict_each_sample_from_padded_values(padded: np.ndarray) -> np.ndarray:
    """Return the median of five linear predictions of each sample; `padded` has three more samples at each end."""
    size = padded.size - _SCALE.window + 1
    by = [padded[k:k + size] for k in range(_SCALE.window)]
    rows = [0.5 * (by[2] + by[4]), 0.5 * (by[1] + by[5]), 0.5 * (by[0] + by[6]), 2 * by[2] - by[1], 2 * by[4] - by[5]]
    for low, high in ((0, 1), (3, 4), (0, 3), (1, 4), (1, 2), (2, 3), (1, 2)):
        rows[low], rows[high] = np.minimum(rows[low], rows[high]), np.maximum(rows[low], rows[high])
    return rows[2]


def _compute_largest_nearby_block_median(values: np.ndarray) -> np.ndarray:
    """Return at each sample the larger of the medians of neighbouring blocks and of all values, shape (n,)."""
    blocks = max(values.size // _SCALE.block, 1)
    whole = values[:blocks * _SCALE.block].reshape(blocks, -1) if values.size >= _SCALE.block else values[None]
    scale = np.median(whole, axis=1)
    near = np.max([np.append(scale[:1], scale[:-1]), scale, np.append(scale[1:], scale[-1:])], axis=0)
    everywhere = float(np.median(values))
    return np.maximum(near, everywhere)[np.minimum(np.arange(values.size) // _SCALE.block, blocks - 1)]
