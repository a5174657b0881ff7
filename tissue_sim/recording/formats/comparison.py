"""Compare two readings of a table at the samples that are valid in both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.recording import Recording


def list_value_pairs_valid_in_both_interpretations(first: Sequence[Recording], second: Sequence[Recording], channel: str
                                                   ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return a channel of two interpretations of a table, only samples that are valid in both.

    A sample that is invalid in one reading is omitted in both, because one lost value of 9999 would determine the
    result of the comparison.

    Args:
        first: recordings of the first reading.
        second: recordings of the second reading, with other columns, in the same order.
        channel: name of a channel in both readings.

    Returns:
        For each recording, the values of both readings, each of shape (k,). The list is empty if the readings have
        different numbers of samples, or if one of them has too many outliers.
    """
    if [len(each) for each in first] != [len(each) for each in second]:
        return []
    try:
        masks = [_make_mask_without_outliers_and_saturation(one) & _make_mask_without_outliers_and_saturation(other)
                 for one, other in zip(first, second, strict=True)]
    except InputError:
        return []
    return [(one.channel(channel)[mask], other.channel(channel)[mask])
            for one, other, mask in zip(first, second, masks, strict=True)]


def _make_mask_without_outliers_and_saturation(recording: Recording) -> np.ndarray:
    """Return whether each sample is neither an outlier nor saturated, shape (n,)."""
    _, screening = remove_outliers_and_saturation(recording)
    return ~np.isin(np.arange(1, len(recording) + 1), screening.left_out_sample_numbers)
