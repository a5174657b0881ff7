"""A change point in one part of a recording: zero and drift before it, a smooth law after it, by profile likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

#: Samples of a coarse search.
_COARSE = 300
#: Correlations of a sample's noise with that before it that are tried first.
_CORRELATIONS = np.array([0.0, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99])
#: What choosing the part from the same data costs: the ratio at the ends of the interval is so much higher, which
#: benchmarks/contact.py finds.
_CHOSEN = 1.15
#: Least share of the power alone in the force at the end of the part: a cone is no line with a large second term.
_LEADING = 0.3
#: Change of the power, and of contact over the length of the part, for derivatives.
_MOVED = 1e-4
#: Numbers that are worked on at once.
_TOGETHER = 150_000


@dataclass(frozen=True, eq=False)
class Part:
    """Samples before and some after contact: time, displacement, force, (n,); deviation of the sensor's rounding."""

    time: np.ndarray
    displacement: np.ndarray
    force: np.ndarray
    rounding: float
    step: float
    start: float

    def until(self, end: int) -> Part:
        return Part(self.time[:end], self.displacement[:end], self.force[:end], self.rounding, self.step, self.start)

    @cached_property
    def coarse(self) -> Part:
        """For a coarse search, some 300 samples."""
        return self.at_most(_COARSE)

    def at_most(self, samples: int) -> Part:
        """Means of neighbours, of so few that at most `samples` are left."""
        each = -(-self.time.size // samples)
        if each == 1:
            return self
        starts = np.arange(0, self.time.size - each + 1, each)
        time, displacement, force = (np.add.reduceat(values[:starts[-1] + each], starts) / each
                                     for values in (self.time, self.displacement, self.force))
        return Part(time, displacement, force, self.rounding / np.sqrt(each), each * self.step, self.start)


@dataclass(frozen=True, eq=False)
class Profile:
    """Least squares at places of the contact, sorted, with their powers."""

    places: np.ndarray
    least_squares: np.ndarray
    powers: np.ndarray
    variance: float
    limit: float

    @property
    def at(self) -> int:
        return int(np.argmin(self.least_squares))

    @property
    def best(self) -> tuple[float, float]:
        return float(self.places[self.at]), float(self.powers[self.at])

    @property
    def least(self) -> float:
        return float(self.least_squares[self.at])

    @property
    def ratio(self) -> np.ndarray:
        with np.errstate(invalid="ignore", over="ignore"):
            return (self.least_squares - self.least) / self.variance

    @property
    def interval(self) -> tuple[float, float]:
        """Where the ratio crosses its limit; infinite on a side where it does not."""
        ratio, at = self.ratio, self.at
        below, above = np.flatnonzero(ratio[:at] > self.limit), np.flatnonzero(ratio[at:] > self.limit)
        return (self._crossing(below[-1], below[-1] + 1) if below.size else -np.inf,
                self._crossing(at + above[0], at + above[0] - 1) if above.size else float(self.places[-1]))

    def _crossing(self, out: int, inside: int) -> float:
        ratio, places = self.ratio, self.places
        if not np.isfinite(ratio[out]):
            return float(places[out])
        share = (self.limit - ratio[inside]) / (ratio[out] - ratio[inside])
        return float(places[inside] + share * (places[out] - places[inside]))


class ChangePointFit:
    """Least squares of the law to one part, with the noise whitened.

    Args:
        correlation: of a sample's noise with that before it.
        half: one more term, a root of the way higher than the power.
    """

    def __init__(self, part: Part, terms: int, exponents: tuple[float, float], correlation: float = 0.0, *,
                 half: bool = False):
        self.part, self.terms, self.exponents, self.half = part, terms, exponents, half
        self.correlation = correlation
        self._scale = float(np.ptp(part.displacement)) or 1.0
        t = (part.time - part.time[0]) / ((part.time[-1] - part.time[0]) or 1.0)
        base = self._whiten(np.stack([np.ones(t.size), t]))
        self._base = np.linalg.qr(base.T)[0]
        self._data = self._project(self._whiten(part.force - part.force[0])[None])[0]
        self.freedom = max(self._data.size - terms - half - 4, 1)
        self.latest = float(part.displacement[-min(terms + 4, t.size)])

    def _whiten(self, rows: np.ndarray) -> np.ndarray:
        """What is new in each sample, shape (..., n); the first one scaled to be worth as much."""
        if not self.correlation:
            return rows
        new = np.empty_like(rows)
        new[..., 1:] = rows[..., 1:] - self.correlation * rows[..., :-1]
        new[..., 0] = np.sqrt(1 - self.correlation**2) * rows[..., 0]
        return new

    def _project(self, rows: np.ndarray) -> np.ndarray:
        """Less what zero and drift explain."""
        return rows - (rows @ self._base) @ self._base.T

    def _columns(self, places: np.ndarray, powers: np.ndarray) -> list[np.ndarray]:
        """Of the law after contact, each of shape (places * powers, n); powers: (places, m)."""
        way = np.maximum(self.part.displacement - places[:, None], 0.0)[:, None] / self._scale
        logarithm = np.log(way, where=way > 0, out=np.full(way.shape, -np.inf))
        first = np.exp(powers[:, :, None] * logarithm)
        columns = [first * way**k for k in range(self.terms)]
        columns += [first * np.sqrt(way)] if self.half else []
        return [column.reshape(-1, way.shape[-1]) for column in columns]

    def squares(self, places: np.ndarray, powers: np.ndarray, *, bounded: bool = True) -> np.ndarray:
        """Least squares, shape of `powers`, (places, m); infinite where the force would not start upwards.

        A contact before the motion has no air, and its drift and its start cannot be told apart.
        """
        together = max(1, _TOGETHER // (powers.shape[1] * self._data.size))
        if places.size > together:
            return np.concatenate([self.squares(places[k:k + together], powers[k:k + together], bounded=bounded)
                                   for k in range(0, places.size, together)])
        columns = [self._project(self._whiten(column)) for column in self._columns(places, powers)]
        answer, coefficients = _orthogonal(columns, self._data)
        answer, leading = answer.reshape(powers.shape), coefficients[0].reshape(powers.shape)
        if bounded:
            end = ((self.part.displacement[-1] - places) / self._scale)[:, None]
            force = sum(coefficients[k].reshape(powers.shape) * end**k for k in range(self.terms))
            after = (places > self.part.start + 2 * self.part.step)[:, None]
            answer[after & (leading <= _LEADING * np.maximum(force, 0.0))] = np.inf
        return answer

    def least(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least squares over the power at each place, and the power; shapes (places,)."""
        low, high = self.exponents
        rows, count = np.arange(places.size), 9 if high > low else 1
        powers = np.broadcast_to(np.linspace(low, high, count), (places.size, count))
        half, found, best = (high - low) / 8, np.full(places.size, np.inf), np.full(places.size, low)
        for level in range(4 if high > low else 1):
            squares = self.squares(places, powers)
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
            powers = (np.clip(guess, low + reach * half, high - reach * half)[:, None]
                      + half * np.arange(-reach, reach + 1))
        return found, best

    def search(self) -> tuple[float, float]:
        """Contact and power on the coarse part, over all of it."""
        coarse = ChangePointFit(self.part.coarse, self.terms, self.exponents)
        low, high = coarse.part.start, max(coarse.latest, coarse.part.start + coarse.part.step)
        samples = np.quantile(coarse.part.displacement, np.linspace(0, 1, 22), method="nearest").clip(low, high)
        return coarse.near(None, np.union1d(np.linspace(low, high, 22), samples))

    def near(self, best: tuple[float, float] | None, places: np.ndarray | None = None) -> tuple[float, float]:
        """The best contact and power among places (None: around one), then between its neighbours, twice."""
        if places is None:
            assert best is not None
            step = self.part.coarse.step
            places = np.unique((best[0] + step * np.linspace(-2, 2, 9)).clip(self.part.start, self.latest))
        for level in range(3):
            squares, powers = self.least(places)
            at = int(np.argmin(squares))
            answer = float(places[at]), float(powers[at])
            gap = places[min(at + 1, places.size - 1)] - places[max(at - 1, 0)]
            if level == 2 or gap <= 0.5 * self.part.step:
                break
            places = np.linspace(places[max(at - 1, 0)], places[min(at + 1, places.size - 1)], 9)
        return answer

    def profile(self, best: tuple[float, float]) -> Profile:
        """Least squares around the best place, as far as the interval goes, and finely inside."""
        from scipy import special

        start, latest, step = self.part.start, max(self.latest, self.part.start + self.part.step), self.part.step
        places = np.unique((best[0] + step * np.array([-3, -1, -0.3, 0, 0.3, 1, 3])).clip(start, latest))
        places = np.union1d(places, start)
        squares, powers = self.least(places)
        for _ in range(14):
            at = int(np.argmin(squares))
            variance = max(squares[at] / self.freedom, self.part.rounding**2, 1e-300)
            limit = _CHOSEN * float(special.fdtri(1, self.independent, 0.95))
            profile = Profile(places, squares, powers, variance, limit)
            near = np.flatnonzero(profile.ratio < 2.3 * profile.limit)
            width, wanted = places[near[-1]] - places[near[0]], []
            if near[-1] == places.size - 1 and places[-1] < latest:
                wanted.append(places[-1] + max(width, step) * np.array([0.5, 1.0, 2.0]))
            if near[0] == 0 and places[0] > start:
                wanted.append(places[0] - max(width, step) * np.array([0.5, 1.0, 2.0]))
            first, last = max(near[0] - 1, 0), min(near[-1] + 1, places.size - 1)
            gaps = np.diff(places[first:last + 1])
            fine = max(min(step / 6, width / 12), step / 50)
            # Finely only where the profile crosses its limit and beside the best.
            inside = profile.ratio[first:last + 1] <= profile.limit
            matters = inside[1:] != inside[:-1]
            matters[[k for k in (at - first - 1, at - first) if 0 <= k < gaps.size]] = True
            wide = np.flatnonzero(gaps > np.where(matters, fine, max(fine, width / 12)))
            if not wanted and wide.size:
                wide = wide[np.argsort(-gaps[wide])][:12] + first
                wanted.append(0.5 * (places[wide] + places[wide + 1]))
            new = np.setdiff1d(np.concatenate(wanted).clip(start, latest), places) if wanted else np.zeros(0)
            if not new.size:
                break
            more, of_more = self.least(new)
            order = np.argsort(np.append(places, new))
            places, squares, powers = (np.append(old, added)[order] for old, added in (
                (places, new), (squares, more), (powers, of_more)))
        return profile

    @property
    def independent(self) -> float:
        """Degrees of freedom that correlated samples are worth in the variance of their mean."""
        return max(self.freedom * (1 - self.correlation) / (1 + self.correlation), 5.0)

    def colour(self, place: float, power: float) -> float:
        """Correlation of the noise, with all that is fitted here counted."""
        self.coefficients(place, power)
        design = np.vstack([self._design, *self._moved(place, power)]).T
        return _correlation(self.part.force - self.part.force[0], design)

    def without_contact(self) -> float:
        """Sum of squares of zero and drift alone."""
        return float(self._data @ self._data)

    def coefficients(self, place: float, power: float) -> np.ndarray:
        """Zero less the first force, drift over the part, and those of the law."""
        columns = [column[0] for column in self._columns(np.array([place]), np.array([[power]]))]
        t = (self.part.time - self.part.time[0]) / ((self.part.time[-1] - self.part.time[0]) or 1.0)
        self._design = np.stack([np.ones(t.size), t, *columns])
        wanted = self._whiten(self.part.force - self.part.force[0])
        return np.linalg.lstsq(self._whiten(self._design).T, wanted, rcond=None)[0]

    def drift_error(self, place: float, power: float, variance: float) -> float:
        """Standard error of the drift over the part, N, where contact and power are fitted too.

        Args:
            variance: of the whitened residual, N2.
        """
        self.coefficients(place, power)
        moved = [each - self._design[2] for each in self._moved(place, power)]
        weighed = self._whiten(np.vstack([self._design, *moved]))
        size = np.linalg.norm(weighed, axis=1).clip(1e-150)
        covariance = np.linalg.pinv((weighed / size[:, None]) @ (weighed / size[:, None]).T)
        return float(np.sqrt(max(variance * covariance[1, 1], 0.0)) / size[1])

    def zero_without_drift(self, place: float, power: float) -> float:
        """Zero less the first force, N, of the law without a drift."""
        self.coefficients(place, power)
        design = np.delete(self._design, 1, axis=0)
        wanted = self._whiten(self.part.force - self.part.force[0])
        return float(np.linalg.lstsq(self._whiten(design).T, wanted, rcond=None)[0][0])

    def _moved(self, place: float, power: float) -> list[np.ndarray]:
        """The leading term at a contact and with a power that are slightly different, shapes (n,)."""
        return [self._columns(np.array([place - _MOVED * self._scale]), np.array([[power]]))[0][0],
                self._columns(np.array([place]), np.array([[power + _MOVED]]))[0][0]]

    def residual(self, place: float, power: float) -> np.ndarray:
        """Force less the law, not whitened, N, shape (n,)."""
        coefficients = self.coefficients(place, power)
        return self.part.force - self.part.force[0] - coefficients @ self._design


def _orthogonal(columns: list[np.ndarray], data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of data (n,) on columns, each (m, n): sums of squares, (m,), and coefficients, (columns, m).

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


def _correlation(data: np.ndarray, design: np.ndarray) -> float:
    """Correlation of a sample's noise with that before it, at least 0, by the restricted likelihood.

    Args:
        data: (n,). design: columns that are fitted to it, (n, k).

    Source: Patterson and Thompson, Biometrika 58 (1971) 545.
    """
    columns = np.column_stack([design / np.linalg.norm(design, axis=0).clip(1e-150), data])
    freedom, known = data.size - design.shape[1], design.shape[1]

    def criterion(share: float) -> float:
        new = np.vstack([np.sqrt(1 - share**2) * columns[:1], columns[1:] - share * columns[:-1]])
        size = np.abs(np.diag(np.linalg.qr(new, mode="r"))).clip(1e-150)
        return 2 * freedom * np.log(size[-1]) + 2 * float(np.log(size[:known]).sum()) - np.log(1 - share**2)

    shares = _CORRELATIONS
    for _ in range(3):
        at = int(np.argmin([criterion(share) for share in shares]))
        low, high = shares[max(at - 1, 0)], shares[min(at + 1, shares.size - 1)]
        shares = np.linspace(low, high, 5)
    return float(shares[int(np.argmin([criterion(share) for share in shares]))])
