"""Findings about the signals of one recording: outliers, saturation, preload and controlled quantity.

The load at zero displacement is a preload, or shows a load cell that was not zeroed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np


@dataclass(frozen=True)
class PreloadSettings:
    """Settings of `estimate_load_at_zero_displacement`.

    Attributes:
        starts: fractions of the largest displacement over which the start of the curve is fitted, each with the degree
            of the polynomial. A longer start is used if a shorter one is too noisy to show `fraction`. For neo-Hookean
            curves up to a stretch of 2 or down to 0.6 these polynomials err by at most 0.8 % of the range at zero.
        fewest: fewest samples of that start.
        fewest_of_first: fewest samples of the shortest start, which shows the load at zero of a curve whose slope
            changes quickly. With fewer samples that start is skipped, as its noise is not known.
        start_offset: largest first displacement, as a fraction of the range. A recording that starts farther from zero
            has a known zero.
        fraction: load at zero, as a fraction of the range, above which the moduli err by more than 4 %.
        still: largest motion between neighbouring samples of a hold, as a fraction of the range.
        hold: fewest samples of a hold.
        significant: load at zero in standard errors of its estimate, above which the load is significant.
    """

    starts: tuple[tuple[float, int], ...] = ((0.05, 2), (0.15, 2), (0.3, 2), (0.6, 2), (1.0, 3))
    fewest: int = 6
    fewest_of_first: int = 12
    start_offset: float = 0.05
    fraction: float = 0.02
    still: float = 1e-3
    hold: int = 5
    significant: float = 6.0


#: Settings that the functions of this module use.
_SETTINGS = PreloadSettings()


class LoadAtZeroAndContactShift(NamedTuple):
    """Load at zero displacement of a recording that starts under load.

    All values are negative for a load against the direction of loading.

    Attributes:
        load: load, N.
        fraction: load as a fraction of the range of the load.
        shift: distance between contact and zero displacement, m, if the load is a preload.
    """

    load: float
    fraction: float
    shift: float


def estimate_load_at_zero_displacement(motion: np.ndarray, load: np.ndarray) -> LoadAtZeroAndContactShift | None:
    """Estimate the load at the start of the first loading from a polynomial; None if the load starts at zero.

    Args:
        motion: displacement, m, positive under load, in the order of time, shape (n,).
        load: force, N, positive under load, shape (n,).
    """
    peak = _count_samples_before_relaxing_hold(motion, load, int(np.argmax(motion)) + 1)
    reach = float(np.ptp(motion))
    if (peak < _SETTINGS.fewest or not reach > 0 or not np.ptp(load) > 0
            or abs(motion[0]) > _SETTINGS.start_offset * reach):
        return None
    range_of_load = float(np.ptp(load))
    for fraction, degree in _SETTINGS.starts:
        limit = motion[0] + fraction * (motion[peak - 1] - motion[0])
        start = peak if fraction == 1.0 else max(int(np.argmax(motion[:peak] > limit)), _SETTINGS.fewest)
        if fraction == _SETTINGS.starts[0][0] and start < _SETTINGS.fewest_of_first:
            continue
        x, y = motion[:start], load[:start]
        if np.unique(x).size < degree + 2:
            continue
        at_zero, error = _fit_polynomial_intercept(x / reach, y, degree)
        slope = float(np.polyfit(x, y, 1)[0])
        if slope > 0 and abs(at_zero) >= max(_SETTINGS.fraction * range_of_load, _SETTINGS.significant * error):
            return LoadAtZeroAndContactShift(at_zero, at_zero / range_of_load, at_zero / slope)
        if _SETTINGS.significant * error <= _SETTINGS.fraction * range_of_load:
            return None
    return None


def _count_samples_before_relaxing_hold(motion: np.ndarray, load: np.ndarray, end: int) -> int:
    """Return the number of samples before the first hold in which the load relaxes; `end` without such a hold.

    After a relaxation the load is not a function of the motion alone, and a polynomial does not show the load at zero.
    """
    still = np.abs(np.diff(motion[:end])) < _SETTINGS.still * float(np.ptp(motion))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        lost = float(np.median(load[first:first + 2]) - np.median(load[last - 1:last + 1]))
        if last - first >= _SETTINGS.hold and lost > _SETTINGS.fraction * float(np.ptp(load)):
            return first + 1
    return end


def _fit_polynomial_intercept(x: np.ndarray, y: np.ndarray, degree: int) -> tuple[float, float]:
    """Return the value at zero of a least-squares polynomial, and its standard error."""
    design = np.vander(x, degree + 1, increasing=True)
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    gaps = y - design @ coefficients
    variance = float(np.sum(gaps**2)) / max(x.size - degree - 1, 1)
    return float(coefficients[0]), float(np.sqrt(variance * np.linalg.pinv(design.T @ design)[0, 0]))


@dataclass(frozen=True)
class NonElasticityThresholds:
    """Thresholds above which an elastic law does not describe a test.

    Attributes:
        relaxation: fraction of the force that is lost in a hold, above which the material relaxes.
        creep: fraction of the displacement that is gained at constant force, above which the material creeps.
        loss_factor: loss factor (tangent of the phase angle) of an oscillation, above which the material dissipates.
        rate_error: estimated relative error of an elastic modulus by relaxation or creep during the loading, above
            which the modulus is wrong.
    """

    relaxation: float = 0.05
    creep: float = 0.02
    loss_factor: float = 0.05
    rate_error: float = 0.05


#: Thresholds of `ControlledQuantityFindings`.
SCREENING = NonElasticityThresholds()
#: A load without noise, in words; {} is the number of its samples.
EQUAL_LOAD = "the load is equal to the last digit in {} samples while the displacement grows"
#: The remedy where a material relaxes, creeps or dissipates.
VISCOELASTIC_REMEDY = "state viscoelastic.terms[0].g and viscoelastic.terms[0].tau_s in [fit.start]"


@dataclass(frozen=True)
class LeftOutSamples:
    """Samples that screening leaves out of a recording for one reason.

    Attributes:
        samples: numbers of the samples in the recording, from 1.
        channel: channel that shows the fault, e.g. ``"force"``; empty if the campaign lists the samples.
        reason: one clause without its subject, e.g. ``"displacement is -0.7 mm, and its neighbours point to 0 mm"``.
    """

    samples: tuple[int, ...]
    channel: str
    reason: str

    @property
    def sentence(self) -> str:
        """Sentence with the numbers of the samples and the reason why they are left out."""
        return f"{format_sample_numbers(self.samples)} left out: {self.reason}"


@dataclass(frozen=True)
class Saturation:
    """A channel that stays at its extreme value while the other channel continues.

    Attributes:
        channel: ``"force"``, ``"nominal stress"``, ``"displacement"``, ...
        level: extreme value of the channel, SI, with its sign in the recording.
        samples: numbers of the samples that are left out, from 1: from the first saturated one to the last.
        sentence: the finding in words.
    """

    channel: str
    level: float
    samples: tuple[int, ...]
    sentence: str


@dataclass(frozen=True)
class Preload:
    """A load at zero displacement in a test without air before contact.

    Attributes:
        force: force at zero displacement, N (Pa for a recording of stress), positive under load.
        fraction: `force` over the range of the force.
        shift: distance by which contact lies before the zero of the displacement if the force is right, m (strain).
        is_settled: whether the contact offset that the campaign states or fits covers `shift`, or the zero of the force
            that it states removes `force`. False: the moduli are wrong.
        sentence: the finding in words, with the remedy where it is not settled.
    """

    force: float
    fraction: float
    shift: float
    is_settled: bool
    sentence: str


@dataclass(frozen=True)
class ControlledQuantityFindings:
    """The quantity that the machine controls, and what the material does while that quantity is constant.

    Attributes:
        quantity: ``"displacement"``, ``"force"``, or None where the signals do not decide.
        pattern: ``"ramp"``, ``"ramp and hold"``, ``"staircase"``, ``"creep"``, ``"oscillation"`` or ``"cycles"``.
        relaxation: largest fraction of the force that is lost in a hold of the displacement and in the holds before it;
            0 without a hold.
        creep: largest fraction of the displacement that is gained while the force is held; 0 without such a hold.
        loss_factor: tangent of the phase angle of an oscillation; None without an oscillation.
        frequency: frequency of the oscillation, Hz (1 / samples without time); None without an oscillation.
        loading: number of samples of the first loading before the first hold or creep.
        time_constant: time, s (samples without time), in which 63 % of the relaxation or creep takes place; None
            without relaxation or creep.
        loading_time: time, s (samples), from the first sample to the largest displacement, or to the start of the
            creep.
        equal_samples: number of samples of the longest creep whose load is equal to the last digit, where that digit is
            much finer than a controller holds a load; 0 elsewhere, and where the user states the quantity.
    """

    quantity: Literal["displacement", "force"] | None
    pattern: str
    relaxation: float = 0.0
    creep: float = 0.0
    loss_factor: float | None = None
    frequency: float | None = None
    loading: int = 0
    time_constant: float | None = None
    loading_time: float = 0.0
    equal_samples: int = 0

    @property
    def relative_modulus_error_by_relaxation(self) -> float:
        """Estimated relative error of an elastic modulus due to relaxation or creep during the loading, 1.

        A material with the relaxed fraction g and the time constant tau, loaded at a constant rate for a time T, shows
        a mean modulus that is smaller by g (1 - (tau / T) (1 - exp(-T / tau))).
        """
        lost = self.creep / (1.0 + self.creep) if self.pattern == "creep" else self.relaxation
        if not self.time_constant or not self.loading_time > 0:
            return 0.0
        ratio = self.loading_time / self.time_constant
        return lost * (1.0 - -math.expm1(-ratio) / ratio)

    @property
    def has_dissipative_oscillation(self) -> bool:
        """Whether the force of an oscillation has a phase lag to the motion, so that the material dissipates."""
        return self.loss_factor is not None and abs(self.loss_factor) > SCREENING.loss_factor

    @property
    def can_elastic_law_describe_loading(self) -> bool:
        """Whether a law without memory can describe the loading, as far as the signals show.

        The estimate of a creep test is a lower bound, because the creep during the loading and after the end of the
        recording is not seen: half of the limit applies.
        """
        limit = (0.5 if self.pattern == "creep" else 1.0) * SCREENING.rate_error
        return not self.has_dissipative_oscillation and self.relative_modulus_error_by_relaxation <= limit

    @property
    def constant_load_warning_or_empty(self) -> str:
        """Warning that a constant load is either controlled or saturated, and the remedy; empty for another load."""
        return "" if not self.equal_samples else (
            f"{EQUAL_LOAD.format(self.equal_samples)}: the force is held and the column holds its set value (control = "
            "\"force\" in the test), or the load cell is saturated (control = \"displacement\")")

    @property
    def sentence(self) -> str:
        """Behaviour that an elastic law cannot describe, and the remedy; empty without such behaviour."""
        if self.has_dissipative_oscillation:
            return (f"oscillation at {self.frequency:.3g} Hz with the loss factor {self.loss_factor:.2f}: the force is "
                    "out of phase, and an elastic law cannot describe it; measure the relaxation in a hold, and "
                    f"{VISCOELASTIC_REMEDY}")
        if self.creep > SCREENING.creep:
            return (f"the force is held and the displacement creeps by {100 * self.creep:.0f} %: an elastic law cannot "
                    f"describe it; {VISCOELASTIC_REMEDY}")
        if self.relaxation > SCREENING.relaxation and not self.can_elastic_law_describe_loading:
            return (f"the load relaxes in holds by up to {100 * self.relaxation:.0f} %: an elastic law gives neither "
                    f"the modulus at once nor that at equilibrium; {VISCOELASTIC_REMEDY}")
        if self.relaxation > SCREENING.relaxation:
            return (f"the load relaxes in holds by up to {100 * self.relaxation:.0f} %, which an elastic law leaves "
                    f"out; to fit it, {VISCOELASTIC_REMEDY}")
        return ""


@dataclass(frozen=True)
class Screening:
    """Findings about one recording, of `tissue_sim.recording.screening`.

    Attributes:
        left_out: samples that are not used, by reason; numbers from 1 in the recording as the file has it.
        saturation: one entry for each saturated channel. preload: None if the load starts from zero.
        control: findings about the controlled quantity; None for a table without an order of its samples.
        suspected: outliers that are kept, because the campaign lists the samples to leave out.
    """

    left_out: tuple[LeftOutSamples, ...] = ()
    saturation: tuple[Saturation, ...] = ()
    preload: Preload | None = None
    control: ControlledQuantityFindings | None = None
    suspected: tuple[LeftOutSamples, ...] = ()

    @property
    def left_out_sample_numbers(self) -> tuple[int, ...]:
        """Numbers of all samples that are left out, from 1, sorted, saturated ones included."""
        groups = [*(each.samples for each in self.left_out), *(each.samples for each in self.saturation)]
        return tuple(sorted({number for group in groups for number in group}))

    @property
    def kept_count_before_saturation_or_infinity(self) -> float:
        """Number of samples that are kept before the first saturated one; infinite without saturation."""
        first = min((each.samples[0] for each in self.saturation), default=None)
        if first is None:
            return float("inf")
        return first - 1 - sum(number < first for number in self.left_out_sample_numbers)

    @property
    def kept_outlier_warnings(self) -> tuple[str, ...]:
        """One sentence for each group of outliers that is kept."""
        return tuple(f"{format_sample_numbers(each.samples)} kept, as leave_out does not list it: {each.reason}"
                     for each in self.suspected)

    @property
    def finding_sentences(self) -> tuple[str, ...]:
        """One sentence for the user for each finding of the screening."""
        found = [*(each.sentence for each in self.left_out), *(each.sentence for each in self.saturation)]
        found += self.kept_outlier_warnings
        found += [each.sentence for each in (self.preload, self.control) if each is not None]
        return tuple(filter(None, found))

    @property
    def elastic_fit_contradictions(self) -> tuple[str, ...]:
        """The findings, as sentences, that make the moduli of an elastic fit wrong or doubtful."""
        found = [] if self.preload is None or self.preload.is_settled else [self.preload.sentence]
        found += self.kept_outlier_warnings
        if self.control is not None:
            found += [self.control.constant_load_warning_or_empty] if self.control.constant_load_warning_or_empty \
                else []
            found += [] if self.control.can_elastic_law_describe_loading else [self.control.sentence]
        return tuple(found)


def format_sample_numbers(samples: tuple[int, ...]) -> str:
    """Format numbers of samples: ``sample 61``, ``samples 3 and 4`` or ``samples 40 to 80``."""
    if len(samples) == 1:
        return f"sample {samples[0]}"
    if len(samples) > 2 and samples[-1] - samples[0] == len(samples) - 1:
        return f"samples {samples[0]} to {samples[-1]}"
    return f"samples {', '.join(map(str, samples[:-1]))} and {samples[-1]}"
