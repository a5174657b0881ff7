"""Force against depth on first loading: where a tool that is a little elsewhere looks its force up."""

from __future__ import annotations

import numpy as np

from tissue_sim.recording.recording import Recording

#: Depths closer than this part of the travel are one: jitter in a hold is no new depth.
_RESOLVED = 1e-3
_NO_FORCE = 1e-6
_HALVINGS = 60


class LoadingCurve:
    """The force of a computed recording when each depth was first reached, and what history has made of it since.

    On either side of the touch, at depth 0 with force 0, the curve is a monotone cubic (Fritsch and Carlson, SIAM J.
    Numer. Anal. 17 (1980) 238), straight beyond the last depth and 0 where no depth was computed. History is the
    factor by which the force of each sample differs from it.

    Args:
        recording: computed at the depths in its displacement, shape (n,). Samples labelled ``hold`` do not shape the
            curve.
    """

    def __init__(self, recording: Recording):
        depth, force = recording.displacement, recording.force
        hold = recording.labels["segment"] == "hold" if "segment" in recording.labels else np.zeros(depth.size, bool)
        step = _RESOLVED * np.ptp(depth)
        first = _first_reached(depth, hold, step)
        self._into = _from_touch(depth[first], force[first], step)
        self._out = _from_touch(-depth[first], force[first], step)
        self._extremes = force[first].min(), force[first].max()
        curve = self(depth)
        loaded = np.abs(curve) > _NO_FORCE * np.abs(force).max()
        # A ratio far from 1 comes from a curve near zero, where it says nothing: there the difference is kept instead.
        factor = np.clip(np.divide(force, curve, out=np.ones_like(force), where=loaded), 0.0, 2.0)
        # Out of contact the history is that of the last contact, and none before the first.
        last = np.maximum.accumulate(np.where(loaded, np.arange(depth.size), -1))
        self._factor = np.where(last < 0, 1.0, factor[last])
        self._rest = force - self._factor * curve

    def __call__(self, depth: np.ndarray) -> np.ndarray:
        """Force, N, at depths, m; any shape."""
        return np.where(depth > 0, self._into(np.maximum(depth, 0.0)), self._out(np.maximum(-depth, 0.0)))

    def force_behind(self, motion: np.ndarray, compliance: float, history: np.ndarray) -> np.ndarray:
        """Force F at the tool's depths d that solve d + compliance F = motion, F being the curve at d times history.

        Args:
            motion: where the tool would be with a rigid load train, m, shape (m,).
            compliance: m/N, not negative.
            history: sample of the recording, with its fraction, whose history the tissue has, shape (m,).

        Returns:
            N, shape (m,). Where a falling curve gives several solutions it is one of them.
        """
        samples = np.arange(self._factor.size)
        factor, rest = (np.interp(history, samples, values) for values in (self._factor, self._rest))

        def force_at(depth):
            return rest + factor * self(depth)

        if not compliance:
            return force_at(motion)
        # Forces that the solution cannot pass: the bracket holds a solution even where the curve falls.
        weakest, strongest = (rest + factor * bound for bound in (
            np.minimum(self(motion), self._extremes[0]), np.maximum(self(motion), self._extremes[1])))
        shallow = motion - compliance * np.maximum(strongest, 0.0)
        deep = motion - compliance * np.minimum(weakest, 0.0)
        for _ in range(_HALVINGS):
            middle = 0.5 * (shallow + deep)
            short = middle + compliance * force_at(middle) < motion
            shallow, deep = np.where(short, middle, shallow), np.where(short, deep, middle)
        return force_at(0.5 * (shallow + deep))


def _from_touch(away: np.ndarray, force: np.ndarray, step: float):
    """Force as a function of the distance from the touch to one side of it; `away` is that of the samples."""
    side = away > step
    if not side.any():
        return np.zeros_like
    order = np.argsort(away[side])
    knots, values = (np.append(0.0, samples[side][order]) for samples in (away, force))
    # Where it is needed: campaigns load without scipy.
    from scipy.interpolate import PchipInterpolator

    cubic = PchipInterpolator(knots, values)
    slope = cubic(knots[-1], 1)
    return lambda distance: cubic(np.minimum(distance, knots[-1])) + slope * np.maximum(distance - knots[-1], 0.0)


def _first_reached(depth: np.ndarray, hold: np.ndarray, step: float) -> list[int]:
    """Samples that were deeper, or shallower, by more than `step` than all before them, and the first."""
    low = high = depth[0]
    found = [0]
    for sample, value in enumerate(depth.tolist()):
        if (value > high + step or value < low - step) and not hold[sample]:
            found.append(sample)
            low, high = min(low, value), max(high, value)
    return found
