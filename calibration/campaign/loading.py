"""Select the samples of the first loading of a recording and check its motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Test
from tissue_sim.errors import InputError
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.recording.screening import Screening

#: Minimum displacement to the opposite side of a specimen loaded in both directions, as a fraction of the largest.
OTHER_SIDE = 0.05
#: Displacement and load of the first sample that is kept, as a fraction of their ranges, above which the loading before
#: it changes the relaxation after it.
_FAR = 0.1


def select_sample_indices_for_elastic_law(samples: np.ndarray, displacement: np.ndarray, screening: Screening,
                                          path: Path, *, both_sides: bool) -> np.ndarray:
    """Select the samples to which a law without memory is fitted: the first loading, or all of an oscillation.

    Samples after the first saturated one and after the start of creep under constant load are left out.

    Args:
        samples: indices of the usable samples, shape (k,).
        displacement: displacement of all samples, m, shape (n,).
        screening: findings about the signals.
        path: file of the recording, for messages.
        both_sides: whether the specimen is loaded in both directions.

    Returns:
        Indices of the selected samples.

    Raises:
        InputError: fewer than five samples, or an oscillation with a phase lag.
    """
    control = screening.control
    samples = samples[samples < screening.kept_count_before_saturation_or_infinity]
    if control is not None and control.has_dissipative_oscillation:
        raise InputError(f"{path.name}: {control.sentence}", field="recordings")
    if control is not None and control.pattern == "oscillation":
        return samples
    if control is not None and control.pattern == "creep":
        samples = samples[samples < control.loading]
        if samples.size < MIN_POINTS:
            raise InputError(f"{path.name} must have at least {MIN_POINTS} samples of loading before its creep; got "
                             f"{samples.size}. {control.sentence}", field="recordings")
    loads = find_loading_indices_of_one_or_both_sides(displacement[samples], both_sides=both_sides) if samples.size \
        else samples
    if loads.size < MIN_POINTS:
        raise InputError(f"{path.name} must have at least {MIN_POINTS} samples of loading; its largest strain is in "
                         f"sample {loads.size}, and later samples count as unloading. Sort the file by time",
                         field="recordings")
    return samples[loads]


def reject_left_out_start_of_loading(displacement: np.ndarray, force: np.ndarray, screening: Screening,
                                     path: Path) -> None:
    """Raise an error if the loading from rest is missing in a recording of a material with memory.

    The force of a material with memory depends on the complete history; the rate of an unrecorded loading is unknown.

    Args:
        displacement: displacement of the kept samples, m, positive under load, shape (n,).
        force: force of the kept samples, N, positive under load, shape (n,).
        screening: findings about the signals.
        path: file of the recording, for messages.

    Raises:
        InputError: sample 1 is left out and the next sample is far from rest.
    """
    starts_loaded = displacement[0] > _FAR * np.ptp(displacement) and force[0] > _FAR * np.ptp(force)
    if 1 in screening.left_out_sample_numbers and starts_loaded:
        lost = next((each.sentence for each in screening.left_out if 1 in each.samples), "sample 1 left out")
        raise InputError(f"{path.name}: the loading from rest must be recorded for a material with a memory. {lost}, "
                         "and the next sample is under load. Correct that sample in the file", field="recordings")


def find_loading_indices_of_one_or_both_sides(displacement: np.ndarray, both_sides: bool) -> np.ndarray:
    """Return the indices of the samples of the first loading, which ends at the largest displacement.

    A specimen loaded in both directions has a second loading from rest to the opposite extreme, which is included. The
    unloading between the two loadings is left out.

    Args:
        displacement: displacement, m, shape (n,).
        both_sides: whether the specimen is loaded in both directions.
    """
    last, other = int(np.argmax(displacement)), int(np.argmin(displacement))
    if not both_sides or -displacement[other] < OTHER_SIDE * displacement[last]:
        return np.arange(last + 1)
    first, second = sorted((last, other))
    # The unloading ends at the last change of sign of the displacement before the second extreme.
    turned = np.flatnonzero(displacement[first:second] * displacement[second] <= 0)
    if first + 1 < MIN_POINTS:
        # The recording begins at one extreme: the motion to the other extreme is one loading.
        return np.arange(first, second + 1)
    return np.append(np.arange(first + 1), np.arange(first + turned[-1] + 1, second + 1))


def check_displacement_range(displacement: np.ndarray, height: float, test: Test, path: Path) -> None:
    """Raise an `InputError` for a constant displacement, or one that exceeds the height of the specimen.

    Args:
        displacement: displacement of the loading, m, positive under load, shape (n,).
        height: height of the specimen, m.
        test: test of the recording.
        path: file of the recording, for messages.
    """
    if np.ptp(displacement) == 0:
        raise InputError(f"{path.name} has a constant displacement in all {displacement.size} samples of loading; "
                         "check which column is read as displacement", field="recordings")
    largest = float(displacement.max())
    if not test.kind.has_gripped_ends and largest >= height:
        raise InputError(f"{path.name}: the stretch must be above zero; got {1 - largest:g}"
                         if test.specimen is None else
                         f"{path.name}: the displacement must be smaller than the height {height * 1e3:g} mm of the "
                         f"specimen {test.specimen.name!r}; got {largest * 1e3:g} mm", field="recordings")
    # A gripped specimen in tension has the length height + displacement, which must be positive.
    if test.kind.has_gripped_ends and not test.kind.loads_in_both_directions and float(displacement.min()) <= -height:
        number = int(np.argmin(displacement)) + 1
        shortest = 1.0 + float(displacement.min()) / height
        raise InputError(f"{path.name}: the stretch must be above zero; got {shortest:g} in sample {number} of the "
                         "loading. Check that sample and the size of the specimen, or leave the sample out with "
                         "leave_out", field="recordings")
    if largest <= 0:
        raise InputError(f"{path.name} contains no loading: its largest strain is {largest / height:g}. Check the kind "
                         "of test, or change the sign of the column with sign = -1", field="recordings")
