"""Tilt of a flat face in reduced form: the force of an upright face, averaged over strips of the tilted face."""

from __future__ import annotations

import numpy as np

from tissue_sim.recording.recording import Recording
from tissue_sim.rig.loading_curve import FirstLoadingCurveWithHistory

#: Number of strips.
_POINTS = 32


def compute_tilted_recording(recording: Recording, tilt: float, depth: np.ndarray) -> Recording:
    """Compute the recording of a test with a tilted face from the recording with an upright face.

    The tool touches on its lower side first. A strip of the face at the distance x from the axis, in radii, is
    tilt (1 - x)/2 behind the side that touches first, so that

        F(d) = integral of F0(max(d - tilt (1 - x)/2, 0)) 2/pi sqrt(1 - x^2) dx over -1 to 1.

    The strips are independent, and the history of each is that of the upright face. For a force in proportion to the
    depth the result is a toe region of about the tilt, and then a constant lag of half the tilt.

    Args:
        recording: recording of the upright face.
        tilt: height difference across the face, m; 0 returns the recording itself.
        depth: displacement of the tool from the touch, m, shape (n,); the reported displacement may have another zero.
    """
    if not tilt:
        return recording
    curve = FirstLoadingCurveWithHistory(recording.with_channels(displacement=depth))
    samples = np.arange(recording.force.size, dtype=float)
    force = sum(share * curve.solve_force_on_compliant_rig(_compute_depth_after_lag(depth, lag), 0.0, samples)
                for lag, share in split_tilted_face_into_strips(tilt))
    return recording.with_channels(force=force)


def split_tilted_face_into_strips(tilt: float) -> list[tuple[float, float]]:
    """Return lag behind the side that touches first, m, and fraction of the area, for each strip of a tilted face."""
    # Gauss-Chebyshev quadrature of the second kind, whose weight is the width of the disc.
    angle = np.arange(1, _POINTS + 1) * np.pi / (_POINTS + 1)
    shares = 2.0 / (_POINTS + 1) * np.sin(angle) ** 2
    return list(zip((0.5 * tilt * (1.0 - np.cos(angle))).tolist(), shares.tolist(), strict=True))


def _compute_depth_after_lag(displacement: np.ndarray, lag: float) -> np.ndarray:
    """Return the depth, m, of a strip that touches the tissue later; above the touch all strips are in the air."""
    return np.where(displacement > 0, np.maximum(displacement - lag, 0.0), displacement)
