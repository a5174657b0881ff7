"""Where a test touches: the change point between air and the first rise of the force, with its interval.

Before contact the force is a zero with a drift in time; from contact on a smooth law starts there, a power between 1
(plates, flat punches) and 2 (cones) times a polynomial. The noise may have a colour: it is taken as autoregressive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.change_point import ChangePointFit, Part, Profile
from tissue_sim.recording.resolution import rounding_step
from tissue_sim.recording.segmentation import label_motion

#: Powers with which the force may start: plates and flat punches, balls (3/2), cones.
EXPONENTS = (1.0, 2.0)
#: Ends of the part that is fitted, as shares of the rise of the force, and least rise in deviations of the noise.
_RISES, _LEAST_RISE = (1.0, 0.6, 0.35, 0.2, 0.12, 0.07, 0.04, 0.025, 0.015, 0.008, 0.004, 0.002), 15.0
#: Terms of the polynomial with which a part is judged; one more is fitted, so that what goes unseen is small beside it.
_TERMS = 1
#: A part is short enough where three more terms improve it no more than chance does with this probability.
_ADEQUATE = 0.5
#: Below this the law does not describe even the shortest part.
_DOUBTFUL = 1e-3
#: A shorter part with less than this share of a part's residual is fitted in its place.
_SMALLER = 0.7
#: A rise in the air that is steeper than this share of the rise after it, and more than so many deviations of the
#: noise, is no drift; nor is one of more than a share of the largest force.
_DRIFT, _DRIFT_RISE, _DRIFT_SHARE = 0.2, 5.0, 0.05
#: A drift of less than this many standard errors is taken as zero: the few samples in air that show it would be
#: extrapolated over the whole test.
_DRIFT_ERRORS = 4.0
#: Most samples that are worked on; more are averaged.
_MOST = 4000
#: Fewest samples of a part, fewest that are not in contact, and fewest in all.
_FEWEST, _FEWEST_AIR, _FEWEST_ALL = 30, 4, 12
#: Nothing was touched where chance makes such a rise with this probability.
_NO_FORCE = 1e-4
#: The force rises at once where it does so by this many deviations of the noise within the first moves.
_AT_ONCE = 20.0
#: Contact that is known no better than to this share of the way is not known.
_UNKNOWN = 0.3


@dataclass(frozen=True)
class Contact:
    """Where the tool touched, or the slack ended.

    Attributes:
        status: ``"found"``; ``"before"``, no air: it touched with or before the first sample, and `interval` ends with
            the latest place; ``"unclear"``: the interval is wide as a third of the way, or the law describes nothing;
            ``"none"``: no force.
        displacement: best estimate, m; NaN where there is none. interval: 95 %, m.
        force_zero: of the sensor at the first sample, N. drift: N/s (N a sample where there is no time); 0 where it is
            not significant. drift_error: its standard error, N/s; 0 without a drift.
        index: of the first sample in contact; 0 where there was no air.
        exponent: power with which the force starts. noise: standard deviation, N.
        step: between two samples on the way, m. air, loading: samples before and after contact that it stands on.
        adequate: whether the law describes these; otherwise (adhesion, a step in the force) the interval may be short.
    """

    status: str
    displacement: float
    interval: tuple[float, float]
    force_zero: float = 0.0
    drift: float = 0.0
    index: int = 0
    exponent: float = float("nan")
    noise: float = float("nan")
    step: float = float("nan")
    air: int = 0
    loading: int = 0
    adequate: bool = True
    drift_error: float = 0.0

    @property
    def found(self) -> bool:
        """Whether there is air, and contact after it."""
        return self.status == "found"

    @property
    def sentence(self) -> str:
        """`in_words`, in mm and N."""
        return self.in_words()

    def counted_from(self, displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None = None
                     ) -> tuple[np.ndarray, np.ndarray]:
        """The displacement from contact on, m, and the force less zero and drift, N, of the recording it was found
        in, shapes (n,)."""
        clock = np.arange(force.size, dtype=float) if time is None else time
        return displacement - self.displacement, force - self.force_zero - self.drift * (clock - clock[0])

    def in_words(self, *, stressed: bool = False) -> str:
        """What is known, in mm and N; in strain and kPa where the recording is of stress."""
        scale, unit, load, of = (1.0, "", 1e-3, "kPa") if stressed else (1e3, " mm", 1.0, "N")
        low, high = (scale * end for end in self.interval)
        if self.status == "none":
            return "no contact: the force never leaves its zero by more than its noise"
        if self.status == "before":
            return ("no air is seen: contact was with the first motion or before it, at "
                    f"{high:.4g}{unit} at the latest")
        stands = (f"it stands on {self.air} samples before and {self.loading} after, noise {load * self.noise:.2g} "
                  f"{of}, zero {load * self.force_zero:.4g} {of}")
        if self.status == "unclear":
            reach = f"up to {high:.4g}{unit}" if np.isneginf(low) else f"from {low:.4g} to {high:.4g}{unit}"
            return f"contact cannot be told, it may be anywhere {reach}; {stands}"
        doubt = "" if self.adequate else "; the rise after it is not smooth (adhesion?), so the interval may be short"
        return (f"contact at {scale * self.displacement:.4g}{unit} (95 %: {low:.4g} to {high:.4g}{unit}); "
                f"{stands}{doubt}")


def find_contact(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None = None, *,
                 exponents: tuple[float, float] = EXPONENTS) -> Contact:
    """Find where the first loading touches.

    Only the way in to the first stop under load is looked at, and of it as much after contact as the law describes.

    Args:
        displacement, force: m and N (or strain and stress), positive under load, in the order of time, shape (n,).
        time: s; None: even steps.
        exponents: between which the force starts; narrower where the tool is known: (1.5, 1.5) for a ball.

    Raises:
        InputError: fewer than 12 samples, arrays of different length.

    Source: profile likelihood of a change point, Seber and Wild, Nonlinear Regression (1989) section 9.3.
    """
    displacement, force = np.asarray(displacement, float), np.asarray(force, float)
    time = np.arange(displacement.size, dtype=float) if time is None else np.asarray(time, float)
    if not displacement.shape == force.shape == time.shape:
        raise InputError(f"displacement {displacement.shape}, force {force.shape} and time {time.shape} differ in "
                         "shape; give one of each for every sample", field="force")
    if displacement.size < _FEWEST_ALL:
        raise InputError(f"{displacement.size} samples; contact needs at least {_FEWEST_ALL}", field="force")
    way = _WayIn.of(time, displacement, force)
    if (latest := way.rises_at_once()) is not None:
        return Contact("before", way.start, (-np.inf, latest), way.zero, noise=way.noise, step=way.step)
    recorded, way = way, way.fewer
    part, terms, chance = way.whole, _TERMS, 0.0
    parts = way.parts()
    judged = None
    for number, part in enumerate(parts):
        chance, noise = judged or _judge(part, terms, exponents)
        judged = _judge(parts[number + 1], terms, exponents) if chance > _ADEQUATE and part is not parts[-1] else None
        # A law that misses something slowly varying makes it look like a coloured noise, which a shorter part has not.
        if chance > _ADEQUATE and (judged is None or judged[1] > _SMALLER * noise):
            break
    fitted = ChangePointFit(part, terms + 1, exponents)
    best = fitted.near(fitted.search())
    fitted = ChangePointFit(part, terms + 1, exponents, fitted.colour(*best))
    found = _answer(way, fitted, fitted.profile(best), adequate=chance > _DOUBTFUL)
    each = round(way.step / recorded.step)
    index = int(np.argmax(displacement > found.displacement)) if found.index else 0
    return replace(found, index=index, step=recorded.step, air=each * found.air, loading=each * found.loading,
                   noise=found.noise * float(np.sqrt(each)))


def _judge(part: Part, terms: int, exponents: tuple[float, float]) -> tuple[float, float]:
    """The probability that the misfit of a part is chance, and the deviation of its residual, N."""
    from scipy import special

    part = part.coarse
    fitted = ChangePointFit(part, terms, exponents)
    best = fitted.search()
    fitted = ChangePointFit(part, terms, exponents, ChangePointFit(part, terms + 2, exponents, half=True).colour(*best))
    best = fitted.near(best)
    place, power = np.array([best[0]]), np.array([[best[1]]])
    larger = ChangePointFit(part, terms + 2, exponents, fitted.correlation, half=True)
    least, more = (fit.squares(place, power, bounded=False)[0, 0] for fit in (fitted, larger))
    ratio = max(least - more, 0.0) / 3 / max(more / larger.freedom, part.rounding**2, 1e-300)
    return float(special.fdtrc(3, larger.freedom, ratio)), float(np.std(fitted.residual(*best)))


def _answer(way: _WayIn, fitted: ChangePointFit, profile: Profile, adequate: bool) -> Contact:
    from scipy import special

    part, (place, power) = fitted.part, profile.best
    straight, freedom = fitted.without_contact(), fitted.freedom
    ratio = max(straight - profile.least, 0.0) / (fitted.terms + 2) / profile.variance
    low, high = profile.interval
    coefficients = fitted.coefficients(place, power)
    deviation = float(np.std(fitted.residual(place, power)))
    first = int(np.argmax(part.displacement > place)) if part.displacement[-1] > place else part.displacement.size
    span = (part.time[-1] - part.time[0]) or 1.0
    zero, drift = float(coefficients[0] + part.force[0]), float(coefficients[1] / span)
    error = fitted.drift_error(place, power, profile.variance) / span
    if abs(drift) < _DRIFT_ERRORS * error:
        zero, drift, error = fitted.zero_without_drift(place, power) + float(part.force[0]), 0.0, 0.0
    found = Contact("found", float(place), (float(low), float(high)), zero, drift,
                    int(np.argmax(way.whole.displacement > place)), float(power), deviation, way.step, first,
                    part.displacement.size - first, adequate, error)
    if special.fdtrc(fitted.terms + 2, freedom, ratio) > _NO_FORCE:
        rises = float(way.smooth.max()) - way.zero > _LEAST_RISE * max(way.noise, deviation)
        latest = float(way.whole.displacement.max()) if rises else np.inf
        return replace(found, status="unclear" if rises else "none", displacement=np.nan, interval=(-np.inf, latest),
                       index=0, exponent=np.nan)
    reach = float(np.ptp(way.whole.displacement))
    # A drift and a law together can bend where there is air: only a clear rise bounds a contact without air.
    risen = way.smooth - way.zero > _DRIFT_RISE * max(way.noise, deviation)
    latest = way.whole.displacement[min(int(np.flatnonzero(~risen).max(initial=-1)) + 1, risen.size - 1)]
    no_air = replace(found, status="before", interval=(-np.inf, max(float(high), float(latest))), index=0)
    in_air, after = place - way.start, part.displacement[-1] - place
    rise = coefficients[1] * (part.time[min(first, part.time.size - 1)] - part.time[0]) / span
    gain = float(np.mean(part.force[-3:])) - part.force[0] - coefficients[0] - rise
    steep = in_air > 0 and after > 0 and rise / in_air > _DRIFT * gain / after
    if rise > _DRIFT_RISE * deviation and (steep or rise > _DRIFT_SHARE * float(np.ptp(way.smooth))):
        found = replace(no_air, displacement=way.start, drift=0.0, drift_error=0.0, exponent=np.nan)
    elif np.isneginf(low) or first < _FEWEST_AIR:
        found = no_air
    low, high = found.interval
    unclear = high - (low if found.found else way.start) > _UNKNOWN * reach or not (found.found or adequate)
    return replace(found, status="unclear") if unclear else found


@dataclass(frozen=True, eq=False)
class _WayIn:
    """The way in to the first stop under load. start: of the motion, m. zero, noise: first guesses, N."""

    whole: Part
    smooth: np.ndarray
    zero: float
    noise: float

    @property
    def step(self) -> float:
        return self.whole.step

    @property
    def start(self) -> float:
        return self.whole.start

    @classmethod
    def of(cls, time: np.ndarray, displacement: np.ndarray, force: np.ndarray) -> _WayIn:
        labels = label_motion(time, displacement)
        rounding = rounding_step(force) / np.sqrt(12.0)
        bend = (force[1:-1] - 0.5 * (force[:-2] + force[2:])) / np.sqrt(1.5)
        noise = max(float(np.median(np.abs(bend))) / 0.6745, rounding, 1e-9 * float(np.abs(force).max()), 1e-300)
        smooth = np.convolve(np.pad(force, 1, mode="edge"), np.full(3, 1 / 3), "valid")
        zero = float(np.median(force[:max(3, min(8, force.size // 20))]))
        edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
        ramps = np.flatnonzero(labels == "ramp")
        # What follows a stop under load has relaxed.
        end = next((int(last) for first, last in pairwise(edges) if labels[first] == "ramp" and last >= _FEWEST_ALL
                    and smooth[last - 1] - zero > 2 * _LEAST_RISE * noise and last - first > 8), labels.size)
        steps = np.abs(np.diff(displacement[:end]))
        moved = steps[steps > 0.2 * np.median(steps[steps > 0])] if np.any(steps > 0) else np.ones(1)
        start = displacement[ramps[0] if ramps.size and ramps[0] < end else 0]
        whole = Part(time[:end], displacement[:end], force[:end], rounding, float(np.median(moved)), float(start))
        return cls(whole, smooth[:end], zero, noise)

    @cached_property
    def fewer(self) -> _WayIn:
        """The same in no more samples than take a moment."""
        part = self.whole.at_most(_MOST)
        share = np.sqrt(part.time.size / self.whole.time.size)
        smooth = np.convolve(np.pad(part.force, 1, mode="edge"), np.full(3, 1 / 3), "valid")
        return self if part is self.whole else _WayIn(part, smooth, self.zero, max(self.noise * share, part.rounding))

    def rises_at_once(self) -> float | None:
        """Displacement where the force has clearly risen, m, where that is within the first moves; else None."""
        first = int(np.argmax(self.whole.displacement > self.start)) - 1
        risen = self.whole.force[max(first, 0):][:_FEWEST_AIR + 1] - np.median(self.whole.force[:max(first, 0) + 1])
        clear = risen > _AT_ONCE * self.noise
        return float(self.whole.displacement[max(first, 0) + int(np.argmax(clear))]) if clear[-2:].all() else None

    def parts(self) -> list[Part]:
        """From the whole to the shortest that holds a clear rise."""
        rise, parts = float(self.smooth.max()) - self.zero, [self.whole]
        for share in _RISES[1:]:
            if share * rise < _LEAST_RISE * self.noise:
                break
            end = int(np.argmax(self.smooth - self.zero >= share * rise)) + 1
            if end < _FEWEST:
                break
            if end < parts[-1].time.size:
                parts.append(self.whole.until(end))
        return parts
