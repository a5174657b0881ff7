"""Detect contact as a change point of the force, with a 95 % interval, and its effect on a modulus.

Before contact the force is a constant zero with a linear drift in time. From contact on, the model adds a power of the
depth, with an exponent between 1 (plates, flat punches) and 2 (cones), times a polynomial. The noise is modelled as a
first-order autoregressive process.

The uncertainty of contact has two effects on a modulus: the displacement, and the drift of the force. Results are
cached, because a recording is analysed several times between import and calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from hashlib import blake2b
from itertools import pairwise, zip_longest
from typing import ParamSpec, TypeVar

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.public_names import OldName, with_old_names
from tissue_sim.recording.change_point import ChangePointFit, LikelihoodProfile, LoadingWindow
from tissue_sim.recording.curve_units import FORCE_UNITS, CurveUnits
from tissue_sim.recording.saturation import find_rounding_step_or_zero
from tissue_sim.recording.segmentation import label_samples_ramp_hold_unload

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def cache_by_array_content(most: int) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Return a decorator that stores the last results of a function of arrays.

    The function must be pure and its result immutable: a call with equal arguments returns the same object. The key is
    a hash of the arguments, so that the cache keeps no arrays. Errors are not stored. Arguments must be numeric arrays,
    or numbers, texts and tuples of these, whose representation is complete.

    Args:
        most: number of stored results; the oldest one is discarded first.
    """
    def decorate(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        results: dict[bytes, Result] = {}

        @wraps(function)
        def find_or_compute(*arguments: Parameters.args, **options: Parameters.kwargs) -> Result:
            key = _hash_arguments((*arguments, *(part for option in sorted(options.items()) for part in option)))
            if (stored := results.get(key)) is not None:
                return stored
            result = results[key] = function(*arguments, **options)
            for oldest in list(results)[: max(0, len(results) - most)]:
                results.pop(oldest, None)
            return result

        return find_or_compute

    return decorate


def _hash_arguments(arguments: tuple[object, ...]) -> bytes:
    """Return a hash of arrays (type, shape and content) and of other values (their representation)."""
    content = blake2b(digest_size=16)
    for each in arguments:
        if isinstance(each, np.ndarray):
            content.update(f"{each.dtype.str}{each.shape}".encode())
            content.update(np.ascontiguousarray(each).tobytes())
        else:
            content.update(repr(each).encode() + b"\0")
    return content.digest()


#: Limits of the exponent of the force after contact: 1 for plates and flat punches, 3/2 for balls, 2 for cones.
EXPONENTS = (1.0, 2.0)


@dataclass(frozen=True)
class ContactSettings:
    """Settings of `find_contact`.

    Attributes:
        rise_fractions: ends of the fitted parts, as fractions of the rise of the force; the longest part first.
        least_rise: least rise of the force in a part, in standard deviations of the noise.
        terms: terms of the polynomial that judges a part. The final fit has one more term, so that the terms that are
            left out are small.
        adequate: a part is short enough if three more terms improve its fit no more than chance does with this
            probability.
        doubtful: probability of a chance misfit below which the law does not describe the chosen part.
        smaller_residual: a shorter part replaces a part if the ratio of their residuals is below this value.
        drift_slope: largest slope of a drift in the air, as a fraction of the slope of the force after contact; a
            steeper rise belongs to contact.
        drift_rise: rise of the force in the air, in standard deviations of the noise, below which the rise is not
            examined.
        drift_fraction: largest drift in the air, as a fraction of the range of the force.
        drift_errors: a drift of less than this many standard errors is set to zero, because the few samples in the air
            would be extrapolated over the whole test.
        most_samples: largest number of samples in the fit; more samples are averaged in groups.
        fewest_in_part: fewest samples of a part.
        fewest_in_air: fewest samples before contact.
        fewest: fewest samples of a recording.
        no_contact: probability with which noise alone gives the rise of the force; above this probability there is no
            contact.
        immediate_rise: rise of the force within the first moves, in standard deviations of the noise, above which
            contact precedes the first sample.
        unclear_interval: width of the 95 % interval, as a fraction of the displacement range, above which contact is
            unclear.
        most_results: number of stored results. A recording is analysed again by the check of the imported campaign; a
            search takes up to 0.1 s.
    """

    rise_fractions: tuple[float, ...] = (1.0, 0.6, 0.35, 0.2, 0.12, 0.07, 0.04, 0.025, 0.015, 0.008, 0.004, 0.002)
    least_rise: float = 15.0
    terms: int = 1
    adequate: float = 0.5
    doubtful: float = 1e-3
    smaller_residual: float = 0.7
    drift_slope: float = 0.2
    drift_rise: float = 5.0
    drift_fraction: float = 0.05
    drift_errors: float = 4.0
    most_samples: int = 4000
    fewest_in_part: int = 30
    fewest_in_air: int = 4
    fewest: int = 12
    no_contact: float = 1e-4
    immediate_rise: float = 20.0
    unclear_interval: float = 0.3
    most_results: int = 256


#: Settings that the functions of this module use.
_SETTINGS = ContactSettings()


@with_old_names(get_motion_and_force_from_contact="subtract_contact_zero_and_drift")
@dataclass(frozen=True)
class Contact:
    """Displacement at which the tool touches the specimen, or at which the slack ends.

    Attributes:
        status: ``"found"``; ``"before"``: the tool touches with or before the first sample, and `interval` ends at the
            largest possible displacement of contact; ``"unclear"``: the interval is wider than 30 % of the range of
            the displacement, or the law does not describe the force; ``"none"``: the force does not rise.
        displacement: best estimate, m; NaN without an estimate.
        interval: 95 % interval of `displacement`, m.
        force_zero: reading of the unloaded sensor at the first sample, N.
        drift: slope of the force before contact, N/s (N per sample without time); 0 if it is not significant.
        drift_error: standard error of the drift, N/s; 0 without a drift.
        index: number of the first sample in contact, from 0; 0 if no sample is in the air.
        exponent: exponent of the force after contact.
        noise: standard deviation of the noise, N.
        step: displacement between two samples, m.
        air: number of samples before contact that the estimate uses.
        loading: number of samples after contact that the estimate uses.
        adequate: whether the law describes these samples. Otherwise (adhesion, a step in the force) the interval may be
            too short.
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

    #: Old names.
    found = OldName("has_air_before_contact")
    counted_from = OldName("subtract_contact_zero_and_drift")

    @property
    def has_air_before_contact(self) -> bool:
        """Whether the recording has samples in the air, before contact."""
        return self.status == "found"

    @property
    def sentence(self) -> str:
        """Result as a sentence for the user, in mm and N; see `in_words`."""
        return self.in_words()

    def subtract_contact_zero_and_drift(self, displacement: np.ndarray, force: np.ndarray,
                                        time: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacement from contact, m, and the force without zero and drift, N, shapes (n,).

        Args:
            displacement: displacement of the recording in which contact was found, m, shape (n,).
            force: force, N, shape (n,).
            time: time, s, shape (n,); None: even steps.
        """
        clock = np.arange(force.size, dtype=float) if time is None else time
        return displacement - self.displacement, force - self.force_zero - self.drift * (clock - clock[0])

    def in_words(self, units: CurveUnits = FORCE_UNITS) -> str:
        """Describe the result in one sentence, in these units of motion and load."""
        unit, (low, high) = units.motion_unit, (units.motion_factor * end for end in self.interval)
        if self.status == "none":
            return "no contact: the force never leaves its zero by more than its noise"
        if self.status == "before":
            return ("no samples in the air: contact was at the first motion or before it, at "
                    f"{high:.4g}{unit} at the latest")
        basis = (f"estimated from {self.air} samples before and {self.loading} after, noise "
                 f"{units.format_load(self.noise, 2)}, zero {units.format_load(self.force_zero)}")
        if self.status == "unclear":
            reach = f"up to {high:.4g}{unit}" if np.isneginf(low) else f"from {low:.4g} to {high:.4g}{unit}"
            return f"contact is unclear, it may be anywhere {reach}; {basis}"
        doubt = "" if self.adequate else "; the rise after it is not smooth (adhesion?), so the interval may be short"
        return (f"contact at {units.format_motion(self.displacement)} (95 %: {low:.4g} to {high:.4g}{unit}); "
                f"{basis}{doubt}")


def find_contact(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None = None, *,
                 exponents: tuple[float, float] = EXPONENTS) -> Contact:
    """Return the contact in the first loading; its `status` states whether contact was found.

    The search uses the loading up to the first hold under load, and after contact only the part that the law describes.

    Args:
        displacement: displacement, m (or strain), positive under load, in the order of time, shape (n,).
        force: force, N (or stress, Pa), positive under load, shape (n,).
        time: time, s, shape (n,); None: even steps.
        exponents: limits of the exponent of the force after contact. A known tool has narrower limits: (1.5, 1.5) for
            a ball.

    Raises:
        InputError: fewer than 12 samples, arrays of different length.

    Source: profile likelihood of a change point, Seber and Wild, Nonlinear Regression (1989) section 9.3.
    """
    displacement, force = np.asarray(displacement, float), np.asarray(force, float)
    time = np.arange(displacement.size, dtype=float) if time is None else np.asarray(time, float)
    if not displacement.shape == force.shape == time.shape:
        raise InputError(f"displacement {displacement.shape}, force {force.shape} and time {time.shape} differ in "
                         "shape; give one value of each per sample", field="force")
    if displacement.size < _SETTINGS.fewest:
        raise InputError(f"the search for contact needs at least {_SETTINGS.fewest} samples; got "
                         f"{displacement.size}. Record more samples", field="force")
    return _find_contact_of_arrays(displacement, force, time, (float(exponents[0]), float(exponents[1])))


@cache_by_array_content(_SETTINGS.most_results)
def _find_contact_of_arrays(displacement: np.ndarray, force: np.ndarray, time: np.ndarray,
                            exponents: tuple[float, float]) -> Contact:
    """Return the contact in float arrays of equal shape; see `find_contact`."""
    loading = _LoadingUpToFirstHold.from_arrays(time, displacement, force)
    if (latest := loading.find_displacement_of_immediate_rise()) is not None:
        return Contact("before", loading.start_displacement, (-np.inf, latest), loading.zero, noise=loading.noise,
                       step=loading.displacement_step)
    recorded, loading = loading, loading.averaged_loading
    terms = _SETTINGS.terms
    part, chance = _choose_window_and_misfit_p(loading.list_fit_windows_longest_first(), terms, exponents)
    fitted = ChangePointFit(part, terms + 1, exponents)
    best = fitted.fit_contact_and_exponent(fitted.estimate_contact_and_exponent_coarsely())
    fitted = ChangePointFit(part, terms + 1, exponents, fitted.estimate_noise_correlation(*best))
    found = _build_contact(loading, fitted, fitted.compute_likelihood_profile(best),
                           adequate=chance > _SETTINGS.doubtful)
    each = round(loading.displacement_step / recorded.displacement_step)
    index = int(np.argmax(displacement > found.displacement)) if found.index else 0
    return replace(found, index=index, step=recorded.displacement_step, air=each * found.air,
                   loading=each * found.loading,
                   noise=found.noise * float(np.sqrt(each)))


def _choose_window_and_misfit_p(parts: Sequence[LoadingWindow], terms: int,
                                exponents: tuple[float, float]) -> tuple[LoadingWindow, float]:
    """Choose the window for the final fit; return it with the p value of a chance misfit of the law.

    It is the longest window with a p value above `ContactSettings.adequate`, without one that of the largest p value
    above `ContactSettings.doubtful`, and without such a window the shortest one, in which few samples after contact may
    not determine a law. A window is left out if the next, shorter one has a much smaller residual: its law fits
    nowhere, and a slow misfit looks like correlated noise.
    """
    candidates: list[tuple[float, LoadingWindow]] = []
    judged = _compute_misfit_p_and_residual_deviation(parts[0], terms, exponents)
    for part, shorter in zip_longest(parts, parts[1:]):
        chance, noise = judged
        if shorter is not None:
            judged = _compute_misfit_p_and_residual_deviation(shorter, terms, exponents)
            if judged[1] <= _SETTINGS.smaller_residual * noise:
                candidates = []
                continue
        if chance > _SETTINGS.adequate:
            return part, chance
        candidates.append((chance, part))
    described = [each for each in candidates if each[0] > _SETTINGS.doubtful]
    chance, part = max(described, key=lambda each: each[0]) if described else candidates[-1]
    return part, chance


def _compute_misfit_p_and_residual_deviation(part: LoadingWindow, terms: int,
                                             exponents: tuple[float, float]) -> tuple[float, float]:
    """Return the p value of a chance misfit of the law in a window, and the residual's standard deviation, N."""
    from scipy import special

    part = part.coarse_window
    fitted = ChangePointFit(part, terms, exponents)
    best = fitted.estimate_contact_and_exponent_coarsely()
    richer = ChangePointFit(part, terms + 2, exponents, half=True)
    fitted = ChangePointFit(part, terms, exponents, richer.estimate_noise_correlation(*best))
    best = fitted.fit_contact_and_exponent(best)
    place, power = np.array([best[0]]), np.array([[best[1]]])
    larger = ChangePointFit(part, terms + 2, exponents, fitted.correlation, half=True)
    least, more = (fit.compute_sums_of_squares(place, power, bounded=False)[0, 0] for fit in (fitted, larger))
    ratio = max(least - more, 0.0) / 3 / max(more / larger.freedom, part.rounding**2, 1e-300)
    return float(special.fdtrc(3, larger.freedom, ratio)), float(np.std(fitted.compute_force_residual(*best)))


def _build_contact(loading: _LoadingUpToFirstHold, fitted: ChangePointFit, profile: LikelihoodProfile,
                   adequate: bool) -> Contact:
    """Return the result `Contact`, with its status, from the fit of one window and its likelihood profile."""
    from scipy import special

    part, (place, power) = fitted.part, profile.best_contact_and_exponent
    straight, freedom = fitted.compute_sum_of_squares_without_contact(), fitted.freedom
    ratio = max(straight - profile.smallest_sum_of_squares, 0.0) / (fitted.terms + 2) / profile.variance
    low, high = profile.confidence_interval
    coefficients = fitted.store_design_and_fit_coefficients(place, power)
    deviation = float(np.std(fitted.compute_force_residual(place, power)))
    first = int(np.argmax(part.displacement > place)) if part.displacement[-1] > place else part.displacement.size
    span = (part.time[-1] - part.time[0]) or 1.0
    zero, drift = float(coefficients[0] + part.force[0]), float(coefficients[1] / span)
    error = fitted.compute_drift_standard_error(place, power, profile.variance) / span
    if abs(drift) < _SETTINGS.drift_errors * error:
        zero = fitted.fit_zero_minus_first_force_without_drift(place, power) + float(part.force[0])
        drift, error = 0.0, 0.0
    found = Contact("found", float(place), (float(low), float(high)), zero, drift,
                    int(np.argmax(loading.whole.displacement > place)), float(power), deviation,
                    loading.displacement_step, first,
                    part.displacement.size - first, adequate, error)
    if special.fdtrc(fitted.terms + 2, freedom, ratio) > _SETTINGS.no_contact:
        rises = float(loading.smooth.max()) - loading.zero > _SETTINGS.least_rise * max(loading.noise, deviation)
        latest = float(loading.whole.displacement.max()) if rises else np.inf
        return replace(found, status="unclear" if rises else "none", displacement=np.nan, interval=(-np.inf, latest),
                       index=0, exponent=np.nan)
    reach = float(np.ptp(loading.whole.displacement))
    # A drift and a law together can bend where there is air: only a clear rise bounds a contact without air.
    risen = loading.smooth - loading.zero > _SETTINGS.drift_rise * max(loading.noise, deviation)
    latest = loading.whole.displacement[min(int(np.flatnonzero(~risen).max(initial=-1)) + 1, risen.size - 1)]
    no_air = replace(found, status="before", interval=(-np.inf, max(float(high), float(latest))), index=0)
    in_air, after = place - loading.start_displacement, part.displacement[-1] - place
    rise = coefficients[1] * (part.time[min(first, part.time.size - 1)] - part.time[0]) / span
    gain = float(np.mean(part.force[-3:])) - part.force[0] - coefficients[0] - rise
    steep = in_air > 0 and after > 0 and rise / in_air > _SETTINGS.drift_slope * gain / after
    if rise > _SETTINGS.drift_rise * deviation and (
            steep or rise > _SETTINGS.drift_fraction * float(np.ptp(loading.smooth))):
        found = replace(no_air, displacement=loading.start_displacement, drift=0.0, drift_error=0.0, exponent=np.nan)
    elif np.isneginf(low) or first < _SETTINGS.fewest_in_air:
        found = no_air
    low, high = found.interval
    width = high - (low if found.has_air_before_contact else loading.start_displacement)
    unclear = width > _SETTINGS.unclear_interval * reach or not (found.has_air_before_contact or adequate)
    return replace(found, status="unclear") if unclear else found


@dataclass(frozen=True, eq=False)
class _LoadingUpToFirstHold:
    """Samples of the loading up to the first hold under load, with a first estimate of zero and noise.

    Attributes:
        whole: all samples of the loading.
        smooth: running mean of three forces, N, shape (n,).
        zero: first estimate of the zero of the force, N.
        noise: first estimate of the standard deviation of the noise, N.
    """

    whole: LoadingWindow
    smooth: np.ndarray
    zero: float
    noise: float

    @property
    def displacement_step(self) -> float:
        """Displacement between two samples, m."""
        return self.whole.displacement_step

    @property
    def start_displacement(self) -> float:
        """Displacement at the start of the motion, m."""
        return self.whole.start_displacement

    @classmethod
    def from_arrays(cls, time: np.ndarray, displacement: np.ndarray, force: np.ndarray) -> _LoadingUpToFirstHold:
        """Return the loading of a recording in s, m and N, shapes (n,)."""
        labels = label_samples_ramp_hold_unload(time, displacement)
        rounding = find_rounding_step_or_zero(force) / np.sqrt(12.0)
        bend = (force[1:-1] - 0.5 * (force[:-2] + force[2:])) / np.sqrt(1.5)
        noise = max(float(np.median(np.abs(bend))) / 0.6745, rounding, 1e-9 * float(np.abs(force).max()), 1e-300)
        smooth = np.convolve(np.pad(force, 1, mode="edge"), np.full(3, 1 / 3), "valid")
        zero = float(np.median(force[:max(3, min(8, force.size // 20))]))
        edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
        ramps = np.flatnonzero(labels == "ramp")
        # After a hold under load the specimen is relaxed, and the law does not hold.
        end = next((int(last) for first, last in pairwise(edges) if labels[first] == "ramp" and last >= _SETTINGS.fewest
                    and smooth[last - 1] - zero > 2 * _SETTINGS.least_rise * noise and last - first > 8), labels.size)
        steps = np.abs(np.diff(displacement[:end]))
        moved = steps[steps > 0.2 * np.median(steps[steps > 0])] if np.any(steps > 0) else np.ones(1)
        start = displacement[ramps[0] if ramps.size and ramps[0] < end else 0]
        whole = LoadingWindow(time[:end], displacement[:end], force[:end], rounding, float(np.median(moved)),
                              float(start))
        return cls(whole, smooth[:end], zero, noise)

    @cached_property
    def averaged_loading(self) -> _LoadingUpToFirstHold:
        """This loading with neighbouring samples averaged, at most `ContactSettings.most_samples` samples."""
        part = self.whole.average_down_to_sample_count(_SETTINGS.most_samples)
        share = np.sqrt(part.time.size / self.whole.time.size)
        smooth = np.convolve(np.pad(part.force, 1, mode="edge"), np.full(3, 1 / 3), "valid")
        return self if part is self.whole else _LoadingUpToFirstHold(part, smooth, self.zero,
                                                                     max(self.noise * share, part.rounding))

    def find_displacement_of_immediate_rise(self) -> float | None:
        """Return the displacement, m, of a clear rise of the force in the first moves; None without such a rise."""
        first = int(np.argmax(self.whole.displacement > self.start_displacement)) - 1
        before = np.median(self.whole.force[:max(first, 0) + 1])
        risen = self.whole.force[max(first, 0):][:_SETTINGS.fewest_in_air + 1] - before
        clear = risen > _SETTINGS.immediate_rise * self.noise
        return float(self.whole.displacement[max(first, 0) + int(np.argmax(clear))]) if clear[-2:].all() else None

    def list_fit_windows_longest_first(self) -> list[LoadingWindow]:
        """Return windows that begin with the loading, the whole loading first, then shorter and shorter ones."""
        rise, parts = float(self.smooth.max()) - self.zero, [self.whole]
        for share in _SETTINGS.rise_fractions[1:]:
            if share * rise < _SETTINGS.least_rise * self.noise:
                break
            end = int(np.argmax(self.smooth - self.zero >= share * rise)) + 1
            if end < _SETTINGS.fewest_in_part:
                break
            if end < parts[-1].time.size:
                parts.append(self.whole.truncate_at_index(end))
        return parts


#: Half width of a 95 % interval in standard deviations of a normal distribution.
INTERVAL_DEVIATIONS = 1.96


def relative_modulus_error_from_contact(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None,
                                        contact: Contact) -> float:
    """Return the relative half width of the 95 % interval of a modulus that the uncertainty of contact causes.

    A model force k f(x) is fitted by least squares to F(x). A contact that is d farther changes the model by -d F'(x)
    and the factor k by d <F, F'> / <F, F>, where the integral of F F' over the displacement is half of the change of
    F^2. A force error e changes k by <F, e> / <F, F>.

    Args:
        motion: displacement of the fitted samples from contact, m, positive under load, shape (n,).
        load: force, N, shape (n,).
        time: time, s, shape (n,); None: even steps.
        contact: result of `find_contact`; a status other than ``"found"`` gives 0.
    """
    if not contact.has_air_before_contact:
        return 0.0
    low, high = contact.interval
    return relative_modulus_error_from_contact_range(motion, load, time, 0.5 * (high - low), contact.drift_error)


def relative_modulus_error_from_contact_range(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None,
                                              half_width: float, drift_error: float = 0.0) -> float:
    """Return the relative half width of the range of a modulus; see `relative_modulus_error_from_contact`.

    Args:
        motion: displacement of the fitted samples from contact, m, positive under load, shape (n,).
        load: force, N, shape (n,).
        time: time, s, shape (n,); None: even steps.
        half_width: half of the range in which contact may be, m.
        drift_error: standard error of the drift of the force, N/s (N per sample without time).
    """
    if motion.size < 2:
        return 0.0
    end = int(np.argmax(motion)) + 1
    motion, load = motion[:end], load[:end]
    squared = float(np.sum(0.5 * (load[1:] ** 2 + load[:-1] ** 2) * np.diff(motion)))
    if end < 2 or not squared > 0:
        return 0.0
    by_place = half_width * float(np.max(load) ** 2) / (2.0 * squared)
    clock = np.arange(end, dtype=float) if time is None else time[:end]
    drifted = INTERVAL_DEVIATIONS * drift_error * (clock - clock[0])
    return float(np.hypot(by_place, float(load @ drifted) / float(load @ load)))
