"""The samples of the first loading of a recording, and checks of its motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Test
from tissue_sim.errors import InputError
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.recording.screening import Screening

#: Fraction of the largest displacement that a specimen loaded to both sides reaches on the other side.
OTHER_SIDE = 0.05
#: Displacement and load of the first sample that is kept, as a fraction of their ranges, above which the loading before
#: it changes the relaxation after it.
_FAR = 0.1


def elastic_samples(places: np.ndarray, displacement: np.ndarray, screening: Screening, path: Path, *,
                    both_sides: bool) -> np.ndarray:
    """The samples to which a law without memory is fitted: the first loading, or all of an oscillation.

    Samples from the first saturated one on, and those from the first creep under a held load on, are left out.

    Args:
        places: samples that may be used, shape (k,). displacement: of all samples, m, shape (n,).

    Raises:
        InputError: fewer than five samples, an oscillation out of phase.
    """
    control = screening.control
    places = places[places < screening.kept_before_saturation]
    if control is not None and control.dissipates:
        raise InputError(f"{path.name}: {control.sentence}", field="recordings")
    if control is not None and control.pattern == "oscillation":
        return places
    if control is not None and control.pattern == "creep":
        places = places[places < control.loading]
        if places.size < MIN_POINTS:
            raise InputError(f"{path.name}: {control.sentence} ({places.size} samples of loading)",
                             field="recordings")
    loads = first_loading(displacement[places], both_sides=both_sides) if places.size else places
    if loads.size < MIN_POINTS:
        raise InputError(f"{path.name} has its largest strain in sample {loads.size}, and what follows counts as "
                         f"unloading; sort the file by time, so that at least {MIN_POINTS} samples load the specimen",
                         field="recordings")
    return places[loads]


def require_loading(displacement: np.ndarray, force: np.ndarray, screening: Screening, path: Path) -> None:
    """Refuse a recording whose loading from rest is lost with its first samples, for a material with a memory.

    The force of such a material depends on all of its history, and a loading that was not recorded has no rate.

    Args:
        displacement, force: of the samples that are kept, positive under load, shape (n,).

    Raises:
        InputError: sample 1 is left out, and the next one is far from rest.
    """
    if 1 in screening.samples and displacement[0] > _FAR * np.ptp(displacement) and force[0] > _FAR * np.ptp(force):
        lost = next((each.sentence for each in screening.left_out if 1 in each.samples), "sample 1 left out")
        raise InputError(f"{path.name}: the loading from rest must be recorded for a material with a memory. {lost}, "
                         "and the next sample is under load. Correct that sample in the file", field="recordings")


def first_loading(displacement: np.ndarray, both_sides: bool) -> np.ndarray:
    """Samples up to the largest displacement; of a specimen loaded to both sides also those of the second loading, from
    rest to the opposite extreme. The return between the two is left out."""
    last, other = int(np.argmax(displacement)), int(np.argmin(displacement))
    if not both_sides or -displacement[other] < OTHER_SIDE * displacement[last]:
        return np.arange(last + 1)
    first, second = sorted((last, other))
    # The return ends where the displacement has changed its sign for the last time before the second extreme.
    turned = np.flatnonzero(displacement[first:second] * displacement[second] <= 0)
    if first + 1 < MIN_POINTS:
        # The recording begins at one extreme: the whole path to the other one is one loading.
        return np.arange(first, second + 1)
    return np.append(np.arange(first + 1), np.arange(first + turned[-1] + 1, second + 1))


def check_motion(displacement: np.ndarray, height: float, test: Test, path: Path) -> None:
    """Refuse a recording that does not move, that goes deeper than the specimen is high, or that has no loading."""
    if np.ptp(displacement) == 0:
        raise InputError(f"{path.name} does not move: its displacement has the same value in all {displacement.size} "
                         "samples of loading; check which column it is read from", field="recordings")
    largest = float(displacement.max())
    if not test.kind.gripped and largest >= height:
        raise InputError(f"{path.name} reaches stretch {1 - largest:g}; a stretch is above zero"
                         if test.specimen is None else
                         f"{path.name} goes to {largest * 1e3:g} mm, deeper than the specimen {test.specimen.name!r} "
                         f"is high ({height * 1e3:g} mm)", field="recordings")
    # The other end of a specimen that is gripped: in tension its length is the height plus the displacement.
    if test.kind.gripped and not test.kind.both_ways and float(displacement.min()) <= -height:
        number = int(np.argmin(displacement)) + 1
        shortest = 1.0 + float(displacement.min()) / height
        raise InputError(f"{path.name}: the stretch must be above zero; got {shortest:g} in sample {number} of the "
                         "loading. Check that sample and the size of the specimen, or leave the sample out with "
                         "leave_out", field="recordings")
    if largest <= 0:
        raise InputError(f"{path.name} holds no loading: its largest strain is {largest / height:g}; check the kind, "
                         "or turn the column with sign = -1", field="recordings")
