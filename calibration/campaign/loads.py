"""Motion and loads of a recording, from the channels that a kind of test names.

A test of a kind with several loads belongs to one of them; its recordings contain the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Test
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import TestKind
from tissue_sim.laws import find_law
from tissue_sim.recording.measures import MEASURES, get_original_measures
from tissue_sim.recording.recording import Recording
from tissue_sim.specimen.specimen import add_indefinite_article

#: Correlation with the load of a neo-Hookean material below which one of several loads has the wrong sign.
_WRONG_SIGN_CORRELATION = -0.5
#: Strain below which the neo-Hookean loads, which vanish at zero, are those of this strain.
_UNDEFORMED = 1e-6


@dataclass(frozen=True, eq=False)
class MotionAndLoads:
    """Motion and loads of a recording in the coordinates of a fit.

    Attributes:
        displacement: displacement, m, positive under load, shape (n,); the equivalent strain of several motions.
        loads: forces, N, positive under load, each of shape (n,); that of the test first.
        stressed: whether strain and stress were recorded.
        motions: see `calibration.campaign.measured.MeasuredCurve`.
    """

    displacement: np.ndarray
    loads: list[np.ndarray]
    stressed: bool = True
    motions: np.ndarray | None = None


def read_motion_and_loads(recording: Recording, test: Test, path: Path, laws: Sequence[str]) -> MotionAndLoads:
    """Return the motion and the loads of a recording.

    Args:
        recording: recording of the test.
        test: test of the campaign.
        path: file of the recording, for messages.
        laws: names of the laws of the fit.

    Raises:
        InputError: missing channels, one of several loads that is zero at all samples, sizes of the specimen that do
            not convert the channels, or a true stress that was converted at constant volume but must not be.
    """
    _require_true_stress_at_constant_volume(recording, test, path, laws)
    found = _read_motion_and_loads(recording, test, path)
    if len(found.loads) > 1 and not found.loads[0].any():
        raise InputError(f"{path.name} must have a load in {test.kind.channels[-1][1]!r}; all samples are 0. Fit the "
                         "other load by a kind with one load, such as uniaxial_tension", field="recordings")
    return found


def _require_true_stress_at_constant_volume(recording: Recording, test: Test, path: Path, laws: Sequence[str]) -> None:
    """Raise an `InputError` if true stress over stretch is not the nominal stress: the volume or the area differs.

    Simple shear needs no conversion, and the second Piola-Kirchhoff stress times the stretch is exact at any volume.
    """
    axes = [channel[len("nominal stress"):] for channel, measure in get_original_measures(recording).items()
            if measure is MEASURES["true"]]
    if not any(f"stretch{axis}" in recording for axis in axes):
        return
    if test.kind.has_lateral_wall:
        raise InputError(f"{path.name} must have nominal stress, which equals the true one between walls; got measure "
                         "= \"true\". Leave measure out (import: --measure stress=engineering)", field="recordings")
    name = next((name for name in laws if find_law(name).is_compressible), None)
    if name is not None:
        raise InputError(f"{path.name} must have nominal stress with {name}; got true stress, whose "
                         "conversion assumes constant volume. Record force over undeformed area, or leave out the law",
                         field="recordings")


def _read_motion_and_loads(recording: Recording, test: Test, path: Path) -> MotionAndLoads:
    """Return the motion and the loads of a recording; see `read_motion_and_loads`."""
    mechanical, *direct = test.kind.channels
    of_machine = " and ".join(dict.fromkeys(mechanical))
    stated = next((names for names in direct if all(name in recording for name in names)), None)
    if all(name in recording for name in mechanical) and (test.specimen is not None or stated is None):
        if test.specimen is None:
            raise InputError(f"{path.name} contains {of_machine}, which require a [[specimen]] to compute stress",
                             field="specimen")
        values = [np.array(recording.channel(name)) for name in mechanical]
        pairs = [_convert_motion_and_load_or_none(test, number, motion, load)
                 for number, (motion, load) in enumerate(zip(values[::2], values[1::2], strict=True))]
        converted = [pair for pair in pairs if pair is not None]
        if test.kind.load_count > 1 and not converted:
            raise InputError(f"{path.name} contains {of_machine}, which {test.kind.name} does not convert to stress; "
                             "record strain and stress", field="recordings")
        if converted:
            return _combine_motions(test, [pair[0] for pair in converted], [pair[1] for pair in converted])
        return MotionAndLoads(np.array(recording.displacement), [np.array(recording.force)], stressed=False)
    if stated is None:
        required = ", or ".join(" and ".join(dict.fromkeys(names)) for names in test.kind.channels)
        raise InputError(f"{path.name} has {', '.join(recording.channels)}; {test.kind.name} requires {required}",
                         field="recordings")
    names = " and ".join(dict.fromkeys(stated))
    if test.specimen is not None and test.specimen.specific_weight:
        raise InputError(f"{path.name} contains {names}, which vary over the height with gravity = true; use "
                         f"{of_machine}, or set gravity = false", field="recordings")
    if test.specimen is not None and not test.specimen.is_prism:
        raise InputError(f"{path.name} contains {names}, and {test.specimen.name!r} is "
                         f"{add_indefinite_article(test.specimen.shape)} without constant cross-section; use "
                         f"{of_machine}", field="recordings")
    height, area = test.reference_height, test.reference_area
    return _combine_motions(
        test, [height * test.kind.convert_abscissa_to_nominal_strain(recording.channel(name)) for name in stated[::2]],
        [test.kind.sign * area * recording.channel(name) for name in stated[1::2]])


def _convert_motion_and_load_or_none(test: Test, number: int, motion: np.ndarray,
                                     load: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return strain and stress of one pair of channels of the machine; None: they are displacement and force.

    Args:
        test: test with a specimen.
        number: index of the pair, counted from that of the test.
        motion: values of the motion, shape (n,).
        load: values of the load, shape (n,).
    """
    form = test.kind.select_load(number).closed_form
    assert test.specimen is not None
    return None if form is None else form.convert_motion_and_load(test.specimen, motion, load)


def _combine_motions(test: Test, strains: list[np.ndarray], loads: list[np.ndarray]) -> MotionAndLoads:
    """Return motion and loads for the strains of all axes, that of the test first.

    Raises:
        InputError: a stretch of 0 or less.
    """
    if not test.kind.has_several_motions:
        return MotionAndLoads(strains[0], loads)
    motions = test.kind.convert_nominal_strain_to_stretch_or_shear_strain(np.stack(strains, axis=-1))
    if motions.min() <= 0:
        sample = int(np.argmin(motions.min(axis=-1))) + 1
        raise InputError(f"stretch must be above zero; got {motions.min():g} in sample {sample}. Check that sample and "
                         "the sizes of the specimen", field="recordings")
    first_invariant = test.kind.require_closed_form().compute_first_invariant(motions)
    return MotionAndLoads(np.sqrt(np.maximum(first_invariant - 3.0, 0.0) / 3.0), loads, motions=motions)


def compute_neo_hookean_stress(kind: TestKind, displacement: np.ndarray, motions: np.ndarray | None) -> np.ndarray:
    """Return the nominal stress of a neo-Hookean material with the shear modulus 1 Pa, positive under load, shape (n,).

    Args:
        kind: kind with a closed form, that of the load.
        displacement: nominal strain, positive under load, shape (n,).
        motions: stretch of each axis, that of the load first, shape (n, k); None: the strain is the motion.
    """
    abscissa = kind.convert_nominal_strain_to_stretch_or_shear_strain(displacement) if motions is None else motions
    return kind.sign * kind.require_closed_form().stress(find_law("neo_hooke"), abscissa, {"C10": 0.5})


def combine_loads(read: MotionAndLoads, kind: TestKind) -> np.ndarray:
    """Return the load from which the segments of a recording are found, shape (n,).

    It is the load itself, or the equivalent stress of several loads: the strain times the shear modulus of the
    neo-Hookean material whose loads are closest to those of the sample (least squares), in units of the largest ratio
    of load to strain of that material. While the material is intact, the equivalent stress increases with the strain,
    also if one axis of a sheet is unloaded. Loads of a kind with several loads are stresses.

    Args:
        read: motion and loads of the recording.
        kind: kind of the test to which the first load belongs.
    """
    if len(read.loads) == 1:
        return read.loads[0]
    near = np.abs(read.displacement) < _UNDEFORMED
    strain = np.where(near, _UNDEFORMED, read.displacement)
    motions = None if read.motions is None else np.where(near[:, None], 1.0 + _UNDEFORMED / 2.0, read.motions)
    model = np.array([compute_neo_hookean_stress(kind.select_load(number), strain, None if motions is None else
                                                 np.roll(motions, -number, axis=-1))
                      for number in range(len(read.loads))])
    modulus = np.sum(np.array(read.loads) * model, axis=0) / np.sum(model**2, axis=0)
    return float(np.abs(model / strain).max()) * modulus * strain


def is_load_against_motion(displacement: np.ndarray, force: np.ndarray, motions: np.ndarray | None,
                           test: Test) -> bool:
    """Return whether the load of a test has the wrong sign.

    One load must do positive work. One of several loads may be zero or do negative work; its sign is wrong if it is
    opposite to that of a neo-Hookean material.
    """
    if test.kind.load_count == 1:
        return bool(np.sum(force * displacement) <= 0)
    model = compute_neo_hookean_stress(test.kind, displacement, motions)
    return bool(np.sum(force * model) < _WRONG_SIGN_CORRELATION * np.linalg.norm(force) * np.linalg.norm(model))
