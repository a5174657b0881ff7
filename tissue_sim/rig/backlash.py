"""Backlash: a nut with play on its screw."""

from __future__ import annotations

import numpy as np


def follow(screw: np.ndarray, play: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the nut is, and when the screw was there.

    The screw pushes the nut downwards (to larger values) at once, upwards only after `play`, which is taken up
    downwards at the first sample (the play operator of Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989).

    Args:
        screw: positions in the order of time, m, shape (n,).
        play: m, not negative.

    Returns:
        Positions of the nut, m, shape (n,); and the sample, with its fraction, at which the screw last stood where the
        nut is, on straight lines between its samples, shape (n,).
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
