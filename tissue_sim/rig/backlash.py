"""Backlash: motion of a nut with play on its screw."""

from __future__ import annotations

import numpy as np


def compute_nut_positions_and_screw_samples(screw: np.ndarray, play: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the motion of the nut (play operator).

    The screw moves the nut downwards (to larger values) at once, and upwards only after `play`; at the first sample the
    play is taken up in the downward direction.

    Args:
        screw: positions in order of time, m, shape (n,).
        play: m, not negative.

    Returns:
        Positions of the nut, m, shape (n,); and the fractional sample number at which the screw was last at the
        position of the nut, by linear interpolation, shape (n,).

    Source: Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989.
    """
    nut, since = screw.copy(), np.arange(screw.size, dtype=float)
    if not play:
        return nut, since
    positions = screw.tolist()
    for sample in range(1, screw.size):
        nut[sample] = min(max(nut[sample - 1], positions[sample]), positions[sample] + play)
        if nut[sample] == positions[sample]:
            continue
        since[sample] = since[sample - 1]
        if nut[sample] < nut[sample - 1]:
            before = int(since[sample])
            while positions[before + 1] >= nut[sample]:
                before += 1
            since[sample] = before + (positions[before] - nut[sample]) / (positions[before] - positions[before + 1])
    return nut, since
