"""Where a specimen failed: the force drops, or stops to rise, while the tool still goes on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.resolution import rounding_step
from tissue_sim.recording.segmentation import STRAIGHT, corners_of, label_motion

#: Least share of the force that is lost, and least loss in deviations of the noise.
LEAST_DROP, _LEAST_NOISE = 0.05, 8.0
#: A failure happens at a force that has risen by at least this share of the test's range: no snap into contact.
_RISEN = 0.03
#: Slower than this share of the speed before, a tissue that relaxes loses force and is intact.
_SAME_SPEED = 0.7
#: Samples before, whose speed is compared at least.
_BEFORE = 4
#: A sudden drop takes so many samples, and is so many times the loss of as many samples before.
_SUDDEN, _FASTER = 3, 4.0
#: A loss that takes more than this share of the way is gradual; a force that loses more than half is a rupture.
_GRADUAL, _RUPTURE = 0.02, 0.5
#: Samples over which the noise is told from the curve.
_SMOOTH = 31


@dataclass(frozen=True)
class Failure:
    """Where a specimen failed.

    Attributes:
        mode: ``"rupture"`` (more than half of the force is lost, and does not come back), ``"drop"`` (a sudden part of
            it: a tear, a slip, a puncture) or ``"softening"`` (the tangent is lost little by little).
        index: of the last sample before the loss, where the force was largest. displacement: m, and force: N, there.
        lost: share of the force. recovered: whether the force later rises beyond it.
    """

    mode: str
    index: int
    displacement: float
    force: float
    lost: float
    recovered: bool

    @property
    def sentence(self) -> str:
        """`in_words`, in mm and N."""
        return self.in_words()

    def in_words(self, *, stressed: bool = False) -> str:
        """What happened, in mm and N; in strain and kPa where the recording is of stress."""
        words = {"rupture": "the specimen ruptures", "drop": "the force drops (a tear, a slip or a puncture)",
                 "softening": "the tangent is lost, the force falls while the motion goes on"}[self.mode]
        after = ", and rises beyond it later" if self.recovered else ""
        place = f"strain {self.displacement:.4g} and {1e-3 * self.force:.4g} kPa" if stressed else \
            f"{1e3 * self.displacement:.4g} mm and {self.force:.4g} N"
        return f"{words} at {place}: {100 * self.lost:.0f} % of the {'stress' if stressed else 'force'} is lost{after}"


def find_failure(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None = None, *,
                 least_drop: float = LEAST_DROP) -> Failure | None:
    """The first failure of a test in tension, compression or indentation; None where it stays intact.

    Unloading, relaxation in a hold or after a ramp that becomes slower, and noise are none.

    Args:
        displacement, force: m and N (or strain and stress), positive under load, in the order of time, shape (n,).
        time: s; None: even steps. least_drop: share of the force that must be lost.

    Raises:
        InputError: arrays of different length.
    """
    displacement, force = np.asarray(displacement, float), np.asarray(force, float)
    timed = time is not None
    time = np.asarray(time, float) if time is not None else np.arange(displacement.size, dtype=float)
    if not displacement.shape == force.shape == time.shape:
        raise InputError(f"displacement {displacement.shape}, force {force.shape} and time {time.shape} differ in "
                         "shape; give one of each for every sample", field="force")
    if displacement.size < 5 or not np.ptp(displacement) > 0:
        return None
    noise = _noise_of(force)
    labels = label_motion(time, displacement)
    edges = np.append(np.flatnonzero(np.append(True, labels[1:] != labels[:-1])), labels.size)
    speed = _speeds(time, displacement) if timed else np.ones(force.size)
    # What relaxes pulls at its tool at the end of a return, which is no zero of the cycles after it.
    way_in = int(np.argmax(labels == "unload")) if np.any(labels == "unload") else force.size
    for first, last in pairwise(edges.tolist()):
        zero = float(force[:min(first, way_in) + 1].min())
        while first < last and labels[first] != "unload":
            test = _Stretch(displacement[first:last], force[first:last], speed[first:last],
                            speed[max(first - _BEFORE, 0):first], zero, float(np.ptp(force)), noise, least_drop,
                            STRAIGHT * float(np.ptp(displacement)))
            peaks = [peak for peak in (test.peak_of_ramp() if labels[first] == "ramp" else None, test.sudden()) if
                     peak is not None]
            if not peaks:
                break
            failure, after = _describe(displacement, force, first + min(peaks), zero, labels)
            if not (failure.recovered and failure.mode == "softening"):
                return failure
            # A tissue that relaxes on the plateau of its law loses force for a while and is intact.
            first = after
    return None


@dataclass(frozen=True, eq=False)
class _Stretch:
    """A ramp or a hold.

    speed: m/s; 1 where it is not known. before: of the samples before. zero: least force before, N. range: of the whole
    test, N. least: share that must be lost. tremble: of the motion, m.
    """

    displacement: np.ndarray
    force: np.ndarray
    speed: np.ndarray
    before: np.ndarray
    zero: float
    range: float
    noise: float
    least: float
    tremble: float

    def _enough(self, peak: np.ndarray) -> np.ndarray:
        """Force that must be lost from a peak, N; infinite where that is nothing yet."""
        risen = peak - min(self.zero, float(self.force[0]))
        return np.where(risen > max(_RISEN * self.range, 2 * _LEAST_NOISE * self.noise),
                        np.maximum(self.least * risen, _LEAST_NOISE * self.noise), np.inf)

    def peak_of_ramp(self) -> int | None:
        """The sample with the largest force before one that is lower, farther in and reached as fast; None: none."""
        if self.force.size < 4:
            return None
        smooth = _median_of_three(self.force)
        highest = np.maximum.accumulate(smooth)
        peak = np.maximum.accumulate(np.where(smooth >= highest, np.arange(smooth.size), 0))
        lower = (highest - smooth > self._enough(highest)) & (self.displacement >= self.displacement[peak])
        speed = np.append(self.before, self.speed)
        for place in np.flatnonzero(lower).tolist():
            last = self.before.size + peak[place]
            before = speed[max(last - max(peak[place] // 5, _BEFORE), 0):last + 1]
            if self.speed[place] >= _SAME_SPEED * np.median(before):
                return int(max(range(max(peak[place] - 1, 0), min(peak[place] + 2, place)),
                               key=lambda k: self.force[k], default=peak[place]))
        return None

    def sudden(self) -> int | None:
        """The sample before the first drop within three samples that no relaxation makes: its rate rises."""
        n = self.force.size
        if n < 2 * _SUDDEN + 2:
            return None
        at = np.arange(_SUDDEN + 1, n - _SUDDEN)
        lost = self.force[at] - self.force[at + _SUDDEN]
        before = np.maximum(self.force[at - _SUDDEN] - self.force[at], 0.0)
        forward = self.displacement[at + _SUDDEN] >= self.displacement[at] - self.tremble
        # Where the motion slows down, a tissue that relaxes loses force at once.
        after, speed = self.speed[at + _SUDDEN], self.speed[at - _SUDDEN]
        forward &= (after >= _SAME_SPEED * speed) | (speed <= 0)
        drops = np.flatnonzero((lost > self._enough(self.force[at])) & forward
                               & (lost > _FASTER * before + _LEAST_NOISE * self.noise))
        if not drops.size:
            return None
        near = at[drops[0]] + np.arange(_SUDDEN + 1)
        steps = np.diff(self.force[near])
        return int(near[int(np.argmin(steps))])


def _describe(displacement: np.ndarray, force: np.ndarray, index: int, zero: float, labels: np.ndarray
              ) -> tuple[Failure, int]:
    """What happens after the sample `index`, and where the force has come back, if it does."""
    after = np.flatnonzero(labels[index:] == "unload")
    end = index + (after[0] if after.size else labels.size - index)
    risen = force[index] - zero
    rest = force[index:end]
    beyond = force[index:] > force[index] + 0.02 * risen
    recovered = bool(np.any(beyond))
    # Until the force begins to rise again.
    low = np.minimum.accumulate(rest)
    again = np.flatnonzero(rest > low + 0.1 * risen)
    bottom = int(np.argmin(rest[:again[0]] if again.size else rest))
    lost = float((force[index] - rest[bottom]) / risen)
    half = int(np.argmax(rest < force[index] - 0.5 * lost * risen))
    way = displacement[index + half] - displacement[index]
    gradual = half > 2 * _SUDDEN and way > _GRADUAL * float(np.ptp(displacement))
    mode = "softening" if gradual else "rupture" if lost > _RUPTURE and not recovered else "drop"
    return Failure(mode, index, float(displacement[index]), float(force[index]), min(lost, 1.0), recovered), \
        index + int(np.argmax(beyond))


def _noise_of(force: np.ndarray) -> float:
    """Deviation of the noise from smooth curves, also of one with a colour, and of the rounding of the sensor, N."""
    bend = (force[1:-1] - 0.5 * (force[:-2] + force[2:])) / np.sqrt(1.5)
    deviations = [np.median(np.abs(bend)) / 0.6745, rounding_step(force) / np.sqrt(12.0)]
    if force.size > 2 * _SMOOTH:
        # The middle of a cubic through its neighbours: Savitzky and Golay, Anal. Chem. 36 (1964) 1627.
        around = np.vander(np.arange(_SMOOTH) - _SMOOTH // 2, 4)
        rest = force[_SMOOTH // 2:-(_SMOOTH // 2)] - np.convolve(force, np.linalg.pinv(around)[-1], "valid")
        deviations.append(np.median(np.abs(rest)) / 0.6745)
    return float(max(*deviations, 1e-9 * np.abs(force).max(), 1e-300))


def _median_of_three(values: np.ndarray) -> np.ndarray:
    padded = np.pad(values, 1, mode="edge")
    return np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)


def _speeds(time: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Of the straight parts of a motion, at each sample, m/s."""
    corners = corners_of(time, displacement, STRAIGHT * float(np.ptp(displacement)))
    duration = np.diff(time[corners])
    speed = np.diff(displacement[corners]) / np.where(duration > 0, duration, 1.0)
    return speed[np.clip(np.searchsorted(corners, np.arange(time.size), side="left") - 1, 0, speed.size - 1)]
