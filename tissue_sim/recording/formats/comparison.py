"""Compare two readings of a table at the samples that are valid in both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.cleaning import clean
from tissue_sim.recording.recording import Recording


def shared_values(first: Sequence[Recording], second: Sequence[Recording], channel: str
                  ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Values of a channel in two readings, without the samples that either of them leaves out.

    Outliers and saturated samples of either reading count in no comparison: one lost value of 9999 would decide it.

    Args:
        first, second: readings of the same table with other columns, in the same order. channel: that both have.

    Returns:
        Of each recording the values of both readings, of equal shape (k,); empty if the readings differ in their
        number of samples, or if one of them has too many outliers.
    """
    if [len(each) for each in first] != [len(each) for each in second]:
        return []
    try:
        masks = [_kept(one) & _kept(other) for one, other in zip(first, second, strict=True)]
    except InputError:
        return []
    return [(one.channel(channel)[mask], other.channel(channel)[mask])
            for one, other, mask in zip(first, second, masks, strict=True)]


def _kept(recording: Recording) -> np.ndarray:
    return ~np.isin(np.arange(1, len(recording) + 1), clean(recording)[1].samples)
