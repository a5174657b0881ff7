"""Loading curve: force against depth on first loading, to find the force at a slightly different depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.recording.recording import Recording


@dataclass(frozen=True)
class LoadingCurveTolerances:
    """Tolerances of a `FirstLoadingCurveWithHistory`.

    Attributes:
        resolution: depths whose difference is below this fraction of the travel are equal, 1; small oscillations in a
            hold are ignored. A larger value ignores larger oscillations.
        no_force: force over the largest force at or below which the tool is out of contact, 1.
        bisections: number of bisections of the depth of a tool on a compliant rig; each halves the error of the depth.
    """

    resolution: float = 1e-3
    no_force: float = 1e-6
    bisections: int = 60


#: Tolerances of every curve.
_SETTINGS = LoadingCurveTolerances()


class FirstLoadingCurveWithHistory:
    """Force of a computed recording on first loading, and the effect of history as factor and difference.

    On each side of the touch, at depth 0 and force 0, the curve is a monotone cubic (Fritsch and Carlson, SIAM J.
    Numer. Anal. 17 (1980) 238), linear beyond the last depth and 0 on a side without computed depths. The effect of
    history is the ratio of the force of each sample to the curve.

    Args:
        recording: recording computed at the depths in its displacement, shape (n,). Samples labelled ``hold`` are not
            points of the curve.
    """

    def __init__(self, recording: Recording):
        depth, force = recording.displacement, recording.force
        hold = recording.labels["segment"] == "hold" if "segment" in recording.labels else np.zeros(depth.size, bool)
        step = _SETTINGS.resolution * np.ptp(depth)
        first = _find_indices_outside_previous_range(depth, hold, step)
        self._into = _make_cubic_force_interpolator_from_touch(depth[first], force[first], step)
        self._out = _make_cubic_force_interpolator_from_touch(-depth[first], force[first], step)
        self._extremes = force[first].min(), force[first].max()
        curve = self(depth)
        loaded = np.abs(curve) > _SETTINGS.no_force * np.abs(force).max()
        # A ratio far from 1 means that the curve is near zero; the difference is used in addition to a limited ratio.
        factor = np.clip(np.divide(force, curve, out=np.ones_like(force), where=loaded), 0.0, 2.0)
        # Out of contact the effect of history is that of the last contact; there is none before the first contact.
        last = np.maximum.accumulate(np.where(loaded, np.arange(depth.size), -1))
        self._factor = np.where(last < 0, 1.0, factor[last])
        self._rest = force - self._factor * curve

    def __call__(self, depth: np.ndarray) -> np.ndarray:
        """Force, N, at depths, m; any shape."""
        return np.where(depth > 0, self._into(np.maximum(depth, 0.0)), self._out(np.maximum(-depth, 0.0)))

    def solve_force_on_compliant_rig(self, motion: np.ndarray, compliance: float, history: np.ndarray) -> np.ndarray:
        """Solve d + compliance F(d) = motion for the force F, where F is the curve at d with the effect of history.

        Args:
            motion: displacement of the tool with a rigid load train, m, shape (m,).
            compliance: m/N, not negative.
            history: fractional sample number in the recording whose effect of history applies, shape (m,).

        Returns:
            N, shape (m,). If a falling curve gives several solutions, the result is one of them.
        """
        samples = np.arange(self._factor.size)
        factor, rest = (np.interp(history, samples, values) for values in (self._factor, self._rest))

        def compute_force_with_history(depth):
            """Return the force, N, at depths, m, with the effect of history."""
            return rest + factor * self(depth)

        if not compliance:
            return compute_force_with_history(motion)
        # Bounds of the force, so that the interval contains a solution also if the curve falls.
        weakest, strongest = (rest + factor * bound for bound in (
            np.minimum(self(motion), self._extremes[0]), np.maximum(self(motion), self._extremes[1])))
        shallow = motion - compliance * np.maximum(strongest, 0.0)
        deep = motion - compliance * np.minimum(weakest, 0.0)
        for _ in range(_SETTINGS.bisections):
            middle = 0.5 * (shallow + deep)
            short = middle + compliance * compute_force_with_history(middle) < motion
            shallow, deep = np.where(short, middle, shallow), np.where(short, deep, middle)
        return compute_force_with_history(0.5 * (shallow + deep))


def _make_cubic_force_interpolator_from_touch(away: np.ndarray, force: np.ndarray, step: float):
    """Return the force as a function of the distance from the touch on one side; `away`: distance of the samples."""
    side = away > step
    if not side.any():
        return np.zeros_like
    order = np.argsort(away[side])
    knots, values = (np.append(0.0, samples[side][order]) for samples in (away, force))
    # Local import: campaigns are loaded without scipy.
    from scipy.interpolate import PchipInterpolator

    cubic = PchipInterpolator(knots, values)
    slope = cubic(knots[-1], 1)
    return lambda distance: cubic(np.minimum(distance, knots[-1])) + slope * np.maximum(distance - knots[-1], 0.0)


def _find_indices_outside_previous_range(depth: np.ndarray, hold: np.ndarray, step: float) -> list[int]:
    """Return indices of the first sample and of samples more than `step` outside the range of all earlier samples."""
    low = high = depth[0]
    found = [0]
    for sample, value in enumerate(depth.tolist()):
        if (value > high + step or value < low - step) and not hold[sample]:
            found.append(sample)
            low, high = min(low, value), max(high, value)
    return found
