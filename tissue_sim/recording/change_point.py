"""Fit a change point by profile likelihood: zero and drift before the change, a smooth law after it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class ChangePointSettings:
    """Settings of `ChangePointFit`.

    Attributes:
        coarse_samples: samples of the coarse search.
        limit_factor: factor of the likelihood ratio at the ends of the interval. It corrects for the choice of the part
            from the same data; benchmarks/inverse/contact.py determines its value.
        leading_fraction: least fraction of the force at the end of the part that the leading power contributes. It
            excludes a line with a large second term as an approximation of a cone.
        difference_step: step of finite differences: change of the power, and of contact over the length of the part.
        chunk_numbers: largest number of array elements that are processed together.
    """

    coarse_samples: int = 300
    limit_factor: float = 1.15
    leading_fraction: float = 0.3
    difference_step: float = 1e-4
    chunk_numbers: int = 150_000


#: Settings that the functions of this module use.
_SETTINGS = ChangePointSettings()
#: First trial values of the correlation of the noise between neighbouring samples.
_CORRELATIONS = np.array([0.0, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99])


@dataclass(frozen=True, eq=False)
class LoadingWindow:
    """Samples of a loading before contact and some samples after contact, to which a contact law is fitted.

    Attributes:
        time, displacement, force: s, m and N, shapes (n,).
        rounding: standard deviation of the rounding of the sensor, N.
        displacement_step: displacement between two samples, m.
        start_displacement: displacement at the start of the motion, m.
    """

    time: np.ndarray
    displacement: np.ndarray
    force: np.ndarray
    rounding: float
    displacement_step: float
    start_displacement: float

    def truncate_at_index(self, end: int) -> LoadingWindow:
        """Return the window with only the samples before index `end`."""
        return replace(self, time=self.time[:end], displacement=self.displacement[:end], force=self.force[:end])

    @cached_property
    def coarse_window(self) -> LoadingWindow:
        """This window averaged to at most `ChangePointSettings.coarse_samples` samples, for the coarse search."""
        return self.average_down_to_sample_count(_SETTINGS.coarse_samples)

    def average_down_to_sample_count(self, samples: int) -> LoadingWindow:
        """Return a window of at most `samples` samples, each the mean of neighbouring samples of this window."""
        each = -(-self.time.size // samples)
        if each == 1:
            return self
        starts = np.arange(0, self.time.size - each + 1, each)
        time, displacement, force = (np.add.reduceat(values[:starts[-1] + each], starts) / each
                                     for values in (self.time, self.displacement, self.force))
        return LoadingWindow(time, displacement, force, self.rounding / np.sqrt(each), each * self.displacement_step,
                             self.start_displacement)


@dataclass(frozen=True, eq=False)
class LikelihoodProfile:
    """Likelihood profile of the displacement of contact.

    Attributes:
        places: trial displacements of contact, m, sorted, shape (n,).
        least_squares: smallest sum of squares at each of them, N2, shape (n,).
        powers: exponent of the law at each of them, shape (n,).
        variance: variance of the residual, N2.
        limit: likelihood ratio at the ends of the interval.
    """

    places: np.ndarray
    least_squares: np.ndarray
    powers: np.ndarray
    variance: float
    limit: float

    @property
    def best_index(self) -> int:
        """Index of the trial displacement with the smallest sum of squares."""
        return int(np.argmin(self.least_squares))

    @property
    def best_contact_and_exponent(self) -> tuple[float, float]:
        """Displacement of contact, m, and exponent of the law, of the least-squares fit."""
        return float(self.places[self.best_index]), float(self.powers[self.best_index])

    @property
    def smallest_sum_of_squares(self) -> float:
        """Smallest sum of squares over all trial displacements, N2."""
        return float(self.least_squares[self.best_index])

    @property
    def likelihood_ratio_statistics(self) -> np.ndarray:
        """Likelihood ratio at each trial displacement: (squares - smallest squares) / variance, shape (n,)."""
        with np.errstate(invalid="ignore", over="ignore"):
            return (self.least_squares - self.smallest_sum_of_squares) / self.variance

    @property
    def confidence_interval(self) -> tuple[float, float]:
        """Displacements, m, at which the ratio equals `limit`; without a crossing -inf and the last of `places`."""
        ratio, at = self.likelihood_ratio_statistics, self.best_index
        below, above = np.flatnonzero(ratio[:at] > self.limit), np.flatnonzero(ratio[at:] > self.limit)
        return (self._interpolate_crossing(below[-1], below[-1] + 1) if below.size else -np.inf,
                self._interpolate_crossing(at + above[0], at + above[0] - 1) if above.size else float(self.places[-1]))

    def _interpolate_crossing(self, out: int, inside: int) -> float:
        """Interpolate the displacement, m, at which the ratio equals `limit`; `out`, `inside`: neighbouring indices."""
        ratio, places = self.likelihood_ratio_statistics, self.places
        if not np.isfinite(ratio[out]):
            return float(places[out])
        fraction = (self.limit - ratio[inside]) / (ratio[out] - ratio[inside])
        return float(places[inside] + fraction * (places[out] - places[inside]))


class ChangePointFit:
    """Least-squares fit of a power law of contact with zero and drift to a loading window, with whitened noise.

    Args:
        part: samples that are fitted.
        terms: terms of the polynomial.
        exponents: limits of the exponent.
        correlation: correlation of the noise between neighbouring samples.
        half: whether the law has one more term, whose exponent is larger by 1/2.
    """

    def __init__(self, part: LoadingWindow, terms: int, exponents: tuple[float, float], correlation: float = 0.0, *,
                 half: bool = False):
        self.part, self.terms, self.exponents, self.half, self.correlation = part, terms, exponents, half, correlation
        self._scale = float(np.ptp(part.displacement)) or 1.0
        t = (part.time - part.time[0]) / ((part.time[-1] - part.time[0]) or 1.0)
        base = self._whiten_noise(np.stack([np.ones(t.size), t]))
        self._base = np.linalg.qr(base.T)[0]
        self._data = self._remove_constant_and_drift(self._whiten_noise(part.force - part.force[0])[None])[0]
        self.freedom = max(self._data.size - terms - half - 4, 1)
        self.latest = float(part.displacement[-min(terms + 4, t.size)])

    def _whiten_noise(self, rows: np.ndarray) -> np.ndarray:
        """Return rows with whitened noise: innovations of a first-order autoregressive process, shape (..., n)."""
        if not self.correlation:
            return rows
        new = np.empty_like(rows)
        new[..., 1:] = rows[..., 1:] - self.correlation * rows[..., :-1]
        new[..., 0] = np.sqrt(1 - self.correlation**2) * rows[..., 0]
        return new

    def _remove_constant_and_drift(self, rows: np.ndarray) -> np.ndarray:
        """Remove from whitened rows, shape (m, n), their projection on a constant and a drift linear in time."""
        return rows - (rows @ self._base) @ self._base.T

    def _evaluate_law_terms(self, places: np.ndarray, powers: np.ndarray) -> list[np.ndarray]:
        """Return the power-law terms, without factors at trial contacts `places` and exponents `powers` (places, m)."""
        depth = np.maximum(self.part.displacement - places[:, None], 0.0)[:, None] / self._scale
        logarithm = np.log(depth, where=depth > 0, out=np.full(depth.shape, -np.inf))
        first = np.exp(powers[:, :, None] * logarithm)
        columns = [first * depth**k for k in range(self.terms)]
        columns += [first * np.sqrt(depth)] if self.half else []
        return [column.reshape(-1, depth.shape[-1]) for column in columns]

    def compute_sums_of_squares(self, places: np.ndarray, powers: np.ndarray, *, bounded: bool = True) -> np.ndarray:
        """Return the sums of squares, N2, shape of `powers`, (places, m); infinite if the force does not start upwards.

        Before the start of the motion there are no samples in the air, and a drift and a start of the law have the same
        effect: the condition on the force does not apply there.
        """
        together = max(1, _SETTINGS.chunk_numbers // (powers.shape[1] * self._data.size))
        if places.size > together:
            blocks = [slice(k, k + together) for k in range(0, places.size, together)]
            return np.concatenate([self.compute_sums_of_squares(places[k], powers[k], bounded=bounded) for k in blocks])
        terms = self._evaluate_law_terms(places, powers)
        columns = [self._remove_constant_and_drift(self._whiten_noise(column)) for column in terms]
        answer, coefficients = _solve_for_squares_and_coefficients(columns, self._data)
        answer, leading = answer.reshape(powers.shape), coefficients[0].reshape(powers.shape)
        if bounded:
            end = ((self.part.displacement[-1] - places) / self._scale)[:, None]
            force = sum(coefficients[k].reshape(powers.shape) * end**k for k in range(self.terms))
            after = (places > self.part.start_displacement + 2 * self.part.displacement_step)[:, None]
            answer[after & (leading <= _SETTINGS.leading_fraction * np.maximum(force, 0.0))] = np.inf
        return answer

    def minimize_over_exponent(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return at each trial contact in `places`, m, the smallest sum of squares, N2, and its exponent, (places,)."""
        low, high = self.exponents
        rows, count = np.arange(places.size), 9 if high > low else 1
        powers = np.broadcast_to(np.linspace(low, high, count), (places.size, count))
        half, found, best = (high - low) / 8, np.full(places.size, np.inf), np.full(places.size, low)
        for level in range(4 if high > low else 1):
            squares = self.compute_sums_of_squares(places, powers)
            at = squares.argmin(1)
            better = squares[rows, at] < found
            found, best = np.where(better, squares[rows, at], found), np.where(better, powers[rows, at], best)
            if count == 1:
                break
            middle = np.clip(at, 1, powers.shape[1] - 2)
            left, centre, right = (squares[rows, middle + k] for k in (-1, 0, 1))
            with np.errstate(invalid="ignore", divide="ignore"):
                shift = 0.5 * (left - right) / (left - 2 * centre + right)
                inside = (left - 2 * centre + right > 0) & (np.abs(shift) <= 1)
            guess = np.where(inside, powers[rows, middle] + np.where(inside, shift, 0.0) * half, best)
            half, reach = (half / 4, 2) if level == 0 else (half / 8, 1)
            guess = np.clip(guess, low + reach * half, high - reach * half)
            powers = guess[:, None] + half * np.arange(-reach, reach + 1)
        return found, best

    def estimate_contact_and_exponent_coarsely(self) -> tuple[float, float]:
        """Return displacement of contact, m, and exponent of the law, of the best fit of the averaged samples."""
        coarse = ChangePointFit(self.part.coarse_window, self.terms, self.exponents)
        low = coarse.part.start_displacement
        high = max(coarse.latest, low + coarse.part.displacement_step)
        samples = np.quantile(coarse.part.displacement, np.linspace(0, 1, 22), method="nearest").clip(low, high)
        return coarse.fit_contact_and_exponent(None, np.union1d(np.linspace(low, high, 22), samples))

    def fit_contact_and_exponent(self, best: tuple[float, float] | None,
                                 places: np.ndarray | None = None) -> tuple[float, float]:
        """Return displacement of contact, m, and exponent of the law, of the best fit near an estimate.

        The best of the trial places is refined twice between its neighbours.

        Args:
            best: estimate of contact, m, and exponent.
            places: trial displacements of contact, m, shape (k,); None: around the estimate.
        """
        if places is None:
            assert best is not None
            step = self.part.coarse_window.displacement_step
            places = np.unique((best[0] + step * np.linspace(-2, 2, 9)).clip(self.part.start_displacement, self.latest))
        for level in range(3):
            squares, powers = self.minimize_over_exponent(places)
            at = int(np.argmin(squares))
            answer = float(places[at]), float(powers[at])
            gap = places[min(at + 1, places.size - 1)] - places[max(at - 1, 0)]
            if level == 2 or gap <= 0.5 * self.part.displacement_step:
                break
            places = np.linspace(places[max(at - 1, 0)], places[min(at + 1, places.size - 1)], 9)
        return answer

    def compute_likelihood_profile(self, best: tuple[float, float]) -> LikelihoodProfile:
        """Return the likelihood profile around the best fit, fine at the ends of the 95 % interval."""
        from scipy import special

        start, step = self.part.start_displacement, self.part.displacement_step
        latest = max(self.latest, start + step)
        places = np.union1d((best[0] + step * np.array([-3, -1, -0.3, 0, 0.3, 1, 3])).clip(start, latest), start)
        squares, powers = self.minimize_over_exponent(places)
        for _ in range(14):
            at = int(np.argmin(squares))
            variance = max(squares[at] / self.freedom, self.part.rounding**2, 1e-300)
            limit = _SETTINGS.limit_factor * float(special.fdtri(1, self.effective_degrees_of_freedom, 0.95))
            profile = LikelihoodProfile(places, squares, powers, variance, limit)
            near = np.flatnonzero(profile.likelihood_ratio_statistics < 2.3 * profile.limit)
            width, wanted = places[near[-1]] - places[near[0]], []
            if near[-1] == places.size - 1 and places[-1] < latest:
                wanted.append(places[-1] + max(width, step) * np.array([0.5, 1.0, 2.0]))
            if near[0] == 0 and places[0] > start:
                wanted.append(places[0] - max(width, step) * np.array([0.5, 1.0, 2.0]))
            first, last = max(near[0] - 1, 0), min(near[-1] + 1, places.size - 1)
            gaps = np.diff(places[first:last + 1])
            fine = max(min(step / 6, width / 12), step / 50)
            # The profile is fine only at the crossings of its limit and next to the best place.
            inside = profile.likelihood_ratio_statistics[first:last + 1] <= profile.limit
            matters = inside[1:] != inside[:-1]
            matters[[k for k in (at - first - 1, at - first) if 0 <= k < gaps.size]] = True
            wide = np.flatnonzero(gaps > np.where(matters, fine, max(fine, width / 12)))
            if not wanted and wide.size:
                wide = wide[np.argsort(-gaps[wide])][:12] + first
                wanted.append(0.5 * (places[wide] + places[wide + 1]))
            new = np.setdiff1d(np.concatenate(wanted).clip(start, latest), places) if wanted else np.zeros(0)
            if not new.size:
                break
            more, of_more = self.minimize_over_exponent(new)
            order = np.argsort(np.append(places, new))
            places, squares, powers = (np.append(old, added)[order] for old, added in (
                (places, new), (squares, more), (powers, of_more)))
        return profile

    @property
    def effective_degrees_of_freedom(self) -> float:
        """Number of independent samples with the same variance of the mean as these correlated samples; at least 5."""
        return max(self.freedom * (1 - self.correlation) / (1 + self.correlation), 5.0)

    def estimate_noise_correlation(self, place: float, power: float) -> float:
        """Return noise correlation of adjacent samples, 0 to 1; contact `place`, m, and exponent `power` are fitted."""
        self.store_design_and_fit_coefficients(place, power)
        design = np.vstack([self._design, *self._leading_terms_at_shifted_parameters(place, power)]).T
        return _estimate_correlation_by_reml(self.part.force - self.part.force[0], design)

    def compute_sum_of_squares_without_contact(self) -> float:
        """Return the sum of squares, N2, of a fit of a constant and a linear drift, without a contact force."""
        return float(self._data @ self._data)

    def store_design_and_fit_coefficients(self, place: float, power: float) -> np.ndarray:
        """Store the design in `_design`; return coefficients, N: zero minus first force, drift in the window, terms."""
        columns = [column[0] for column in self._evaluate_law_terms(np.array([place]), np.array([[power]]))]
        t = (self.part.time - self.part.time[0]) / ((self.part.time[-1] - self.part.time[0]) or 1.0)
        self._design = np.stack([np.ones(t.size), t, *columns])
        wanted = self._whiten_noise(self.part.force - self.part.force[0])
        return np.linalg.lstsq(self._whiten_noise(self._design).T, wanted, rcond=None)[0]

    def compute_drift_standard_error(self, place: float, power: float, variance: float) -> float:
        """Return the standard error of the drift over the whole window, N; contact and exponent are fitted, too.

        Args:
            place: displacement of contact, m.
            power: exponent of the force after contact.
            variance: variance of the whitened residual, N2.
        """
        self.store_design_and_fit_coefficients(place, power)
        moved = [each - self._design[2] for each in self._leading_terms_at_shifted_parameters(place, power)]
        weighed = self._whiten_noise(np.vstack([self._design, *moved]))
        size = np.linalg.norm(weighed, axis=1).clip(1e-150)
        covariance = np.linalg.pinv((weighed / size[:, None]) @ (weighed / size[:, None]).T)
        return float(np.sqrt(max(variance * covariance[1, 1], 0.0)) / size[1])

    def fit_zero_minus_first_force_without_drift(self, place: float, power: float) -> float:
        """Return the fitted zero of the force minus the first force, N, of a fit without drift."""
        self.store_design_and_fit_coefficients(place, power)
        design = np.delete(self._design, 1, axis=0)
        wanted = self._whiten_noise(self.part.force - self.part.force[0])
        return float(np.linalg.lstsq(self._whiten_noise(design).T, wanted, rcond=None)[0][0])

    def _leading_terms_at_shifted_parameters(self, place: float, power: float) -> list[np.ndarray]:
        """Return two arrays (n,) for derivatives: the leading term at a shifted contact, and at a shifted exponent."""
        shifted = place - _SETTINGS.difference_step * self._scale
        return [self._evaluate_law_terms(np.array([shifted]), np.array([[power]]))[0][0],
                self._evaluate_law_terms(np.array([place]), np.array([[power + _SETTINGS.difference_step]]))[0][0]]

    def compute_force_residual(self, place: float, power: float) -> np.ndarray:
        """Return the measured minus the fitted force, N, without whitening, shape (n,)."""
        coefficients = self.store_design_and_fit_coefficients(place, power)
        return self.part.force - self.part.force[0] - coefficients @ self._design


def _solve_for_squares_and_coefficients(columns: list[np.ndarray], data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve m least-squares problems of data (n,) on columns, each (m, n).

    Returns:
        Sums of squares, (m,), and coefficients, (columns, m).

    Source: Bjorck, BIT 7 (1967) 1, modified Gram-Schmidt.
    """
    m, rest = columns[0].shape[0], np.broadcast_to(data, columns[0].shape)
    triangle, right = np.zeros((m, len(columns), len(columns))), np.zeros((m, len(columns)))
    directions: list[np.ndarray] = []
    for k, column in enumerate(columns):
        for j, direction in enumerate(directions):
            triangle[:, j, k] = np.einsum("mn,mn->m", direction, column)
            column = column - triangle[:, j, k, None] * direction
        size = np.sqrt(np.einsum("mn,mn->m", column, column))
        triangle[:, k, k] = np.maximum(size, 1e-150)
        directions.append(column / triangle[:, k, k, None])
        right[:, k] = np.einsum("mn,mn->m", directions[-1], rest)
        rest = rest - right[:, k, None] * directions[-1]
    coefficients = np.zeros((len(columns), m))
    for k in reversed(range(len(columns))):
        known = sum((triangle[:, k, j] * coefficients[j] for j in range(k + 1, len(columns))), np.zeros(m))
        coefficients[k] = (right[:, k] - known) / triangle[:, k, k]
    return np.einsum("mn,mn->m", rest, rest), coefficients


def _estimate_correlation_by_reml(data: np.ndarray, design: np.ndarray) -> float:
    """Estimate the correlation of the noise of neighbouring samples, at least 0, by the restricted likelihood.

    Args:
        data: values, shape (n,).
        design: columns that are fitted to the values, shape (n, k).

    Source: Patterson and Thompson, Biometrika 58 (1971) 545.
    """
    columns = np.column_stack([design / np.linalg.norm(design, axis=0).clip(1e-150), data])
    freedom, known = data.size - design.shape[1], design.shape[1]

    def compute_minus_twice_log_likelihood(trial: float) -> float:
        """Return -2 log of the restricted likelihood of a trial correlation, up to a constant; to be minimized."""
        new = np.vstack([np.sqrt(1 - trial**2) * columns[:1], columns[1:] - trial * columns[:-1]])
        size = np.abs(np.diag(np.linalg.qr(new, mode="r"))).clip(1e-150)
        return 2 * freedom * np.log(size[-1]) + 2 * float(np.log(size[:known]).sum()) - np.log(1 - trial**2)

    trials = _CORRELATIONS
    for _ in range(3):
        at = int(np.argmin([compute_minus_twice_log_likelihood(trial) for trial in trials]))
        low, high = trials[max(at - 1, 0)], trials[min(at + 1, trials.size - 1)]
        trials = np.linspace(low, high, 5)
    return float(trials[int(np.argmin([compute_minus_twice_log_likelihood(trial) for trial in trials]))])
