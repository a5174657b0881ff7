"""Detect the failure of a specimen: the force drops or softens while the displacement still grows."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.curve_units import FORCE_UNITS, CurveUnits
from tissue_sim.recording.saturation import find_rounding_step_or_zero
from tissue_sim.recording.segmentation import MOTION_SETTINGS, find_motion_corners, label_samples_ramp_hold_unload


@dataclass(frozen=True)
class FailureSettings:
    """Settings of `find_failure`.

    Attributes:
        least_drop: least fraction of the force that is lost in a failure.
        least_noise: least loss of force, in standard deviations of the noise.
        least_rise: least force before a failure, as a fraction of the range of the test. A smaller loss may be a snap
            into contact.
        same_speed: ratio of the speed to the speed before, below which a loss of force may be relaxation.
        samples_before: fewest samples before the loss that give the speed before.
        sudden_samples: samples in which a sudden drop takes place.
        sudden_ratio: least ratio of a sudden loss to the loss in the same number of samples before.
        gradual: displacement in which half of the loss takes place, as a fraction of the range; above this value the
            loss is gradual (softening).
        rupture: fraction of the force that is lost, above which the failure is a rupture.
        smooth_samples: samples of the cubic polynomial from which the noise is estimated.
    """

    least_drop: float = 0.05
    least_noise: float = 8.0
    least_rise: float = 0.03
    same_speed: float = 0.7
    samples_before: int = 4
    sudden_samples: int = 3
    sudden_ratio: float = 4.0
    gradual: float = 0.02
    rupture: float = 0.5
    smooth_samples: int = 31


#: Settings that the functions of this module use.
_SETTINGS = FailureSettings()


@dataclass(frozen=True)
class Failure:
    """Failure of a specimen.

    Attributes:
        mode: ``"rupture"`` (more than half of the force is lost for good), ``"drop"`` (a sudden loss: a tear, a slip, a
            puncture) or ``"softening"`` (the tangent decreases gradually).
        index: number of the last sample before the loss, from 0, at the peak of the force.
        displacement: displacement at the peak, m.
        force: force at the peak, N.
        lost: fraction of the force that is lost.
        recovered: whether the force later exceeds the peak.
    """

    mode: str
    index: int
    displacement: float
    force: float
    lost: float
    recovered: bool

    @property
    def sentence(self) -> str:
        """Result as a sentence for the user, in mm and N; see `in_words`."""
        return self.in_words()

    def in_words(self, units: CurveUnits = FORCE_UNITS) -> str:
        """Describe the failure in one sentence, in these units of motion and load."""
        words = {"rupture": "the specimen ruptures", "drop": "the force drops (a tear, a slip or a puncture)",
                 "softening": "the tangent is lost, the force falls while the motion continues"}[self.mode]
        after = ", and rises beyond it later" if self.recovered else ""
        motion = units.format_motion(self.displacement)
        place = f"{motion if units.motion_unit else f'strain {motion}'} and {units.format_load(self.force)}"
        return f"{words} at {place}: {100 * self.lost:.0f} % of the {units.load_name} is lost{after}"


def find_failure(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None = None, *,
                 least_drop: float = _SETTINGS.least_drop) -> Failure | None:
    """Find the first failure of a test in tension, compression or indentation.

    Unloading, relaxation in a hold or after a ramp that becomes slower, and noise do not count as failures.

    Args:
        displacement: displacement, m (or strain), positive under load, in the order of time, shape (n,).
        force: force, N (or stress, Pa), positive under load, shape (n,).
        time: time, s, shape (n,); None: even steps.
        least_drop: least fraction of the force that is lost in a failure.

    Returns:
        The failure; None for an intact specimen.

    Raises:
        InputError: arrays of different length.
    """
    displacement, force = np.asarray(displacement, float), np.asarray(force, float)
    timed = time is not None
    time = np.asarray(time, float) if time is not None else np.arange(displacement.size, dtype=float)
    if not displacement.shape == force.shape == time.shape:
        raise InputError(f"displacement {displacement.shape}, force {force.shape} and time {time.shape} differ in "
                         "shape; give one value of each per sample", field="force")
    if displacement.size < 5 or not np.ptp(displacement) > 0:
        return None
    noise = _estimate_noise_deviation(force)
    labels = label_samples_ramp_hold_unload(time, displacement)
    edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
    speed = _compute_sample_speeds_by_straight_part(time, displacement) if timed else np.ones(force.size)
    # A relaxed specimen can pull at the tool at the end of an unloading: only the first loading shows the zero.
    first_unloading = int(np.argmax(labels == "unload")) if np.any(labels == "unload") else force.size
    for first, last in pairwise(edges.tolist()):
        zero = float(force[:min(first, first_unloading) + 1].min())
        while first < last and labels[first] != "unload":
            test = _RampOrHold(displacement[first:last], force[first:last], speed[first:last],
                               speed[max(first - _SETTINGS.samples_before, 0):first], zero, float(np.ptp(force)), noise,
                               least_drop, MOTION_SETTINGS.straightness * float(np.ptp(displacement)))
            candidates = (test.find_peak_before_force_loss() if labels[first] == "ramp" else None,
                          test.find_sudden_drop())
            peaks = [peak for peak in candidates if peak is not None]
            if not peaks:
                break
            failure, after = _build_failure_and_recovery_sample(displacement, force, first + min(peaks), zero, labels)
            if not (failure.recovered and failure.mode == "softening"):
                return failure
            # A tissue that relaxes on a plateau of its law loses force for a while without a failure.
            first = after
    return None


@dataclass(frozen=True, eq=False)
class _RampOrHold:
    """A ramp or a hold of a test, in which a failure is searched.

    Attributes:
        displacement: m, shape (n,).
        force: N, shape (n,).
        speed: m/s, shape (n,); 1 without a time.
        before: speed in the samples before, m/s.
        zero: least force before, N.
        range: range of the force of the whole test, N.
        noise: standard deviation of the noise, N.
        least: least fraction of the force that is lost.
        tremor: largest displacement of a motion at rest, m.
    """

    displacement: np.ndarray
    force: np.ndarray
    speed: np.ndarray
    before: np.ndarray
    zero: float
    range: float
    noise: float
    least: float
    tremor: float

    def _compute_failure_thresholds_of_peaks(self, peak: np.ndarray) -> np.ndarray:
        """Return for each peak the least loss of force, N, that is a failure; infinite for a peak that is too low."""
        risen = peak - min(self.zero, float(self.force[0]))
        return np.where(risen > max(_SETTINGS.least_rise * self.range, 2 * _SETTINGS.least_noise * self.noise),
                        np.maximum(self.least * risen, _SETTINGS.least_noise * self.noise), np.inf)

    def find_peak_before_force_loss(self) -> int | None:
        """Return the index of the peak before a loss of force in a motion that continues; None without such a peak."""
        if self.force.size < 4:
            return None
        smooth = _running_median_of_three(self.force)
        highest = np.maximum.accumulate(smooth)
        peak = np.maximum.accumulate(np.where(smooth >= highest, np.arange(smooth.size), 0))
        lower = highest - smooth > self._compute_failure_thresholds_of_peaks(highest)
        lower &= self.displacement >= self.displacement[peak]
        speed = np.append(self.before, self.speed)
        for place in np.flatnonzero(lower).tolist():
            last = self.before.size + peak[place]
            before = speed[max(last - max(peak[place] // 5, _SETTINGS.samples_before), 0):last + 1]
            if self.speed[place] >= _SETTINGS.same_speed * np.median(before):
                return int(max(range(max(peak[place] - 1, 0), min(peak[place] + 2, place)),
                               key=lambda k: self.force[k], default=peak[place]))
        return None

    def find_sudden_drop(self) -> int | None:
        """Return the sample before the first sudden drop; None without a drop.

        A sudden drop is faster than the loss before; the rate of a relaxation decreases.
        """
        n = self.force.size
        if n < 2 * _SETTINGS.sudden_samples + 2:
            return None
        at = np.arange(_SETTINGS.sudden_samples + 1, n - _SETTINGS.sudden_samples)
        lost = self.force[at] - self.force[at + _SETTINGS.sudden_samples]
        before = np.maximum(self.force[at - _SETTINGS.sudden_samples] - self.force[at], 0.0)
        forward = self.displacement[at + _SETTINGS.sudden_samples] >= self.displacement[at] - self.tremor
        # A tissue that relaxes loses force as soon as the motion slows down.
        after, speed = self.speed[at + _SETTINGS.sudden_samples], self.speed[at - _SETTINGS.sudden_samples]
        forward &= (after >= _SETTINGS.same_speed * speed) | (speed <= 0)
        drops = np.flatnonzero((lost > self._compute_failure_thresholds_of_peaks(self.force[at])) & forward
                               & (lost > _SETTINGS.sudden_ratio * before + _SETTINGS.least_noise * self.noise))
        if not drops.size:
            return None
        near = at[drops[0]] + np.arange(_SETTINGS.sudden_samples + 1)
        steps = np.diff(self.force[near])
        return int(near[int(np.argmin(steps))])


def _build_failure_and_recovery_sample(displacement: np.ndarray, force: np.ndarray, index: int, zero: float,
                                       labels: np.ndarray) -> tuple[Failure, int]:
    """Return the `Failure` after the peak at `index`, and the sample of larger force after it (else `index`)."""
    after = np.flatnonzero(labels[index:] == "unload")
    end = index + (after[0] if after.size else labels.size - index)
    risen = force[index] - zero
    rest = force[index:end]
    beyond = force[index:] > force[index] + 0.02 * risen
    recovered = bool(np.any(beyond))
    # The loss ends where the force rises again.
    low = np.minimum.accumulate(rest)
    again = np.flatnonzero(rest > low + 0.1 * risen)
    bottom = int(np.argmin(rest[:again[0]] if again.size else rest))
    lost = float((force[index] - rest[bottom]) / risen)
    half = int(np.argmax(rest < force[index] - 0.5 * lost * risen))
    travel = displacement[index + half] - displacement[index]
    gradual = half > 2 * _SETTINGS.sudden_samples and travel > _SETTINGS.gradual * float(np.ptp(displacement))
    mode = "softening" if gradual else "rupture" if lost > _SETTINGS.rupture and not recovered else "drop"
    return Failure(mode, index, float(displacement[index]), float(force[index]), min(lost, 1.0), recovered), \
        index + int(np.argmax(beyond))


def _estimate_noise_deviation(force: np.ndarray) -> float:
    """Return the standard deviation of the noise, N: white noise, correlated noise or rounding, the largest of them."""
    bend = (force[1:-1] - 0.5 * (force[:-2] + force[2:])) / np.sqrt(1.5)
    deviations = [np.median(np.abs(bend)) / 0.6745, find_rounding_step_or_zero(force) / np.sqrt(12.0)]
    if force.size > 2 * _SETTINGS.smooth_samples:
        # Value of a cubic through the neighbours: Savitzky and Golay, Anal. Chem. 36 (1964) 1627.
        around = np.vander(np.arange(_SETTINGS.smooth_samples) - _SETTINGS.smooth_samples // 2, 4)
        half = _SETTINGS.smooth_samples // 2
        residual = force[half:-half] - np.convolve(force, np.linalg.pinv(around)[-1], "valid")
        deviations.append(np.median(np.abs(residual)) / 0.6745)
    return float(max(*deviations, 1e-9 * np.abs(force).max(), 1e-300))


def _running_median_of_three(values: np.ndarray) -> np.ndarray:
    """Return the running median of three values, shape (n,)."""
    padded = np.pad(values, 1, mode="edge")
    return np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)


def _compute_sample_speeds_by_straight_part(time: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return for each sample the mean speed, m/s, of the straight part of the motion that contains it, shape (n,)."""
    corners = find_motion_corners(time, displacement, MOTION_SETTINGS.straightness * float(np.ptp(displacement)))
    duration = np.diff(time[corners])
    speed = np.diff(displacement[corners]) / np.where(duration > 0, duration, 1.0)
    return speed[np.clip(np.searchsorted(corners, np.arange(time.size), side="left") - 1, 0, speed.size - 1)]
