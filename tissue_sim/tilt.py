"""A tilted face as a reduced form: the average of the straight test over the face."""

from __future__ import annotations

import numpy as np

from tissue_sim.recording.recording import Recording
from tissue_sim.rig.loading_curve import LoadingCurve

_POINTS = 32


def tilted(recording: Recording, tilt: float, depth: np.ndarray) -> Recording:
    """The recording of a face that leans, from that of a straight one.

    The tool touches on the high side first. A strip of the face at the distance x from the axis, in radii, is
    tilt (1 - x)/2 behind the side that touches first, so that

        F(d) = integral of F0(max(d - tilt (1 - x)/2, 0)) 2/pi sqrt(1 - x^2) dx over -1 to 1:

    strips do not hinder each other, and the history of each is that of the straight face. For a force in proportion to
    the depth this is a toe of about the tilt and then a constant lag of half of it.

    Args:
        recording: of the straight face.
        tilt: height difference across the face, m; 0 returns the recording itself.
        depth: of the tool from the touch on, m, shape (n,); what the rig reports may count from elsewhere.
    """
    if not tilt:
        return recording
    curve = LoadingCurve(recording.with_channels(displacement=depth))
    samples = np.arange(recording.force.size, dtype=float)
    force = sum(share * curve.force_behind(_behind(depth, lag), 0.0, samples) for lag, share in strips(tilt))
    return recording.with_channels(force=force)


def strips(tilt: float) -> list[tuple[float, float]]:
    """How far each strip of a face that leans is behind the side that touches first, m, and its share of the face."""
    # Gauss-Chebyshev quadrature of the second kind: the disc's width is its weight.
    angle = np.arange(1, _POINTS + 1) * np.pi / (_POINTS + 1)
    shares = 2.0 / (_POINTS + 1) * np.sin(angle) ** 2
    return list(zip((0.5 * tilt * (1.0 - np.cos(angle))).tolist(), shares.tolist(), strict=True))


def _behind(displacement: np.ndarray, lag: float) -> np.ndarray:
    """Depth of a strip that touches later; above the touch it is in the air like the face."""
    return np.where(displacement > 0, np.maximum(displacement - lag, 0.0), displacement)
