"""Recordings of a campaign as curves of force against displacement."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import tissue_sim
from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.force_control import estimate_force_control_noise, is_force_controlled
from calibration.campaign.loads import combine_loads, is_load_against_motion, read_motion_and_loads
from calibration.campaign.modulus_tables import estimate_noise_of_moduli, get_frequency_and_log_modulus
from calibration.campaign.parameters import OFFSET_DEFAULTS
from calibration.campaign.sample_selection import (
    SegmentedRecording,
    add_controlled_quantity_to_screening,
    add_load_at_zero_to_screening,
    check_displacement_range,
    check_recording_names_of_leave_out,
    get_notes_with_fit_before_contact_warning,
    make_kind_and_tool_mismatch_notes,
    make_screening_notes_by_subject,
    reject_left_out_start_of_loading,
    remove_left_out_and_outlier_samples,
    segment_recording_from_contact,
    select_sample_indices_for_elastic_law,
)
from calibration.campaign.schema import PRISM
from calibration.statistics.sensor_noise import (
    ForceControlNoise,
    SensorNoise,
    estimate_pooled_sensor_noise,
    spread_time_stamps,
)
from calibration.statistics.statistics import estimate_white_noise, find_quantisation_step
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol_waves import WAVE_KINDS
from tissue_sim.material.material import Material
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.recording import MIN_POINTS, Recording
from tissue_sim.recording.screening import Screening
from tissue_sim.recording.segmentation import (
    append_numbers_to_repeated_runs,
    compute_corner_tolerance_of_force,
    label_samples_ramp_hold_unload,
)
from tissue_sim.specimen.specimen import add_indefinite_article

if TYPE_CHECKING:
    from scipy.sparse import csr_array

def require_closed_form_support_if_used(test: Test, material: Material, stressed: bool, closed: bool,
                                        path: Path) -> None:
    """Reject parts of the model that the closed form of a homogeneous test does not support.

    Args:
        test: test of the campaign.
        material: material of the fit.
        stressed: whether stress was recorded, which only the closed form describes.
        closed: whether method or kind of the test require the closed form.
        path: file of the recording.
    """
    if not (stressed or closed):
        return
    if material.layers:
        remedy = ("use displacement and force of a compression or a needle test" if stressed or test.experiment is None
                  else "set fit.method = 'inverse_fem'")
        raise InputError(f"{path.name} is computed by a closed form, which requires a homogeneous specimen; for a "
                         f"layered specimen {remedy}", field="kind")
    form = test.kind.closed_form
    if form is not None and material.is_history_dependent and not form.has_history:
        raise InputError(f"{test.name} requires a material without memory, because its closed form has none. Leave out "
                         "relaxation, softening and drainage, or use a kind without this load", field="kind")
    if test.specimen is None and material.poroelasticity is not None:
        raise InputError("a poroelastic material requires the size of the specimen; add a [[specimen]]",
                         field="specimen")
    if test.specimen is not None and test.specimen.specific_weight and material.is_history_dependent:
        raise InputError("the closed form does not support gravity for a material with memory; set gravity = false, or "
                         "fit.method = 'inverse_fem'", field="specimen")
    if not test.rig.is_ideal:
        raise InputError(f"{path.name} contains stress, to which a rig does not apply; leave rig out", field="rig")


#: Largest relative difference between the specimen size in a recording and in the campaign.
SIZE_TOLERANCE = 0.02


def require_matching_specimen_metadata(recording: Recording, test: Test, campaign: Campaign, path: Path) -> None:
    """Check that the metadata of a recording state the shape and sizes of the specimen in the campaign.

    Metadata with ``radius_mm`` and without a shape mean a cylinder (older files). The shape is not compared if the test
    depends on the cross-section only.

    Raises:
        InputError: shape or size differ; the error states the field of the specimen.
    """
    if test.specimen is None or not isinstance(metadata := recording.metadata.get("specimen"), Mapping):
        return
    field = f"specimen[{list(campaign.specimens).index(test.specimen.name)}]"
    shape = test.specimen.shape
    recorded = metadata.get("shape", "cylinder" if "radius_mm" in metadata else None)
    any_shape = (test.kind.has_gripped_ends or campaign.fit.method == "analytical"
                 or test.specimen.name in campaign.prisms)
    if not any_shape and isinstance(recorded, str) and recorded not in (shape, PRISM):
        raise InputError(f"shape must agree with the recordings; the campaign states {add_indefinite_article(shape)} "
                         f"and "
                         f"{path.name} states {add_indefinite_article(recorded)}. Correct the wrong statement.",
                         file=campaign.path, field=f"{field}.shape")
    for key, size in test.specimen.sizes.items():
        stated = metadata.get(key)
        if isinstance(stated, int | float) and abs(stated - size) > SIZE_TOLERANCE * size:
            raise InputError(f"{key} must agree with the recordings within {100 * SIZE_TOLERANCE:g} %; the campaign "
                             f"states {size:g} mm and {path.name} states {stated:g} mm. Correct the wrong statement.",
                             file=campaign.path, field=f"{field}.{key}")


#: Segments that are not part of the first loading; an elastic law is not fitted to them.
NOT_LOADING = ("approach", "preconditioning", "hold", "unload", "reload", "retract", *WAVE_KINDS)
#: Loading ends when this fraction of the largest displacement is reached.
LOADED = 0.98
#: Largest relative difference between replicates of one test in speed and in largest displacement.
REPLICATE_TOLERANCE = 0.2


@dataclass(frozen=True, eq=False)
class MeasuredCurve:
    """The samples of one recording that are compared with a model.

    A test without a specimen was recorded as stretch (or shear strain) and nominal stress. It is treated as a test of a
    cube with 1 m edges: the displacement in m equals the strain and the force in N equals the stress in Pa. In a table
    of moduli the displacement is the frequency, Hz, and the force the logarithm of a modulus in Pa.

    Attributes:
        name: name of the recording, unique in the campaign.
        test: the test to which the recording belongs.
        time: time, s, shape (n,), or None.
        displacement: displacement, m, positive under load, shape (n,).
        force: force, N, positive under load, shape (n,).
        segment: label of the segment of each sample, shape (n,); None if all samples are one loading.
        motions: stretch of each axis, that of the force first, shape (n, k), if several motions determine the force.
            The displacement is then the equivalent strain sqrt((I1 - 3) / 3); None: the displacement is the motion.
        file: path of the recording.
        sha256: SHA-256 of the file.
        stressed: whether strain and stress were recorded.
        later: number of samples after the loading (holds, unloading) that are left out for a model without memory.
        noise: noise of the force at the measured displacement: noise of the sensor, and of the displacement if the
            force is controlled; None only while the test is being read.
        interpolation: matrix that interpolates the samples of the file to these points, shape (n, samples); None: no
            interpolation.
        whole: all samples of the recording with their segments; None for a synthetic recording.
        notes: subject -> note for the user.
        screening: findings about the signals: samples left out, saturation, preload, controlled quantity.
        force_control: noise of both channels if the force is controlled; None: the displacement is controlled.
    """

    name: str
    test: Test
    time: np.ndarray | None
    displacement: np.ndarray
    force: np.ndarray
    segment: np.ndarray | None
    file: Path
    sha256: str
    stressed: bool = False
    later: int = 0
    noise: SensorNoise = None  # type: ignore[assignment]  # until all recordings of the test are read
    interpolation: csr_array | None = None
    whole: SegmentedRecording | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    screening: Screening = field(default_factory=Screening)
    motions: np.ndarray | None = None
    force_control: ForceControlNoise | None = None

    def select(self, samples) -> MeasuredCurve:
        """Return the curve with the samples of a mask, slice or index array."""
        def select_or_none(values):
            """Return the samples of an array; None without the array."""
            return None if values is None else values[samples]

        return replace(self, displacement=self.displacement[samples], force=self.force[samples],
                       time=select_or_none(self.time), segment=select_or_none(self.segment),
                       interpolation=select_or_none(self.interpolation), motions=select_or_none(self.motions))

    def subtract_contact_offset(self, offset: float) -> MeasuredCurve:
        """Return the curve with its motion measured from another contact.

        Args:
            offset: contact offset, m.

        Raises:
            InputError: an offset of a curve that has no contact offset.
        """
        if not offset:
            return self
        if not self.has_contact_offset:
            raise InputError(f"the contact offset of {self.name} must be 0; got {offset:g}. Several motions of "
                             f"{self.test.kind.name} have no common contact offset", field="offset")
        return replace(self, displacement=self.displacement - offset)

    @property
    def has_zero(self) -> bool:
        """Whether the curve has a zero of the load; a modulus over frequency has none."""
        return not self.test.modulus

    @property
    def has_contact_offset(self) -> bool:
        """Whether the curve has a contact offset: one motion determines its load."""
        return not self.test.modulus and self.motions is None

    @property
    def sample_times(self) -> np.ndarray:
        """Time of the samples, s, shape (n,).

        Raises:
            InputError: the recording has no time.
        """
        if self.time is None:
            raise InputError(f"{self.name} has no time; state a time column, or speed_mm_s", field="recordings")
        return self.time

    @property
    def mean_loading_speed(self) -> float | None:
        """Mean speed of the loading, m/s; None without time."""
        if self.time is None:
            return None
        # Noise and drift in a hold: the largest displacement may occur anywhere in the hold.
        last = int(np.argmax(self.displacement >= LOADED * self.displacement.max()))
        travel, duration = self.displacement[last] - self.displacement[0], self.time[last] - self.time[0]
        return float(travel / duration) if duration > 0 else None


def is_test_force_history_dependent(test: Test, material: Material) -> bool:
    """Return whether the force of a test depends on the previous motion; if so, holds and unloading are fitted too."""
    return material.is_history_dependent or (test.experiment is not None and test.experiment.is_path_dependent)


def read_measured_curves(campaign: Campaign) -> dict[str, tuple[MeasuredCurve, ...]]:
    """Read and check all recordings of a campaign, including those of held-out tests.

    Returns:
        The recordings of each test by the name of the test.

    Raises:
        InputError: an unreadable recording; columns that do not match the kind of test; a recording deeper than its
            specimen or of a specimen of another size; a force of the wrong sign; too few points; no time for a material
            with memory; for an inverse fit also replicates that differ in speed or depth.
    """
    analytical = campaign.fit.method == "analytical"
    found: dict[str, tuple[MeasuredCurve, ...]] = {}
    names: set[str] = set()
    for test in campaign.tests:
        curves: list[MeasuredCurve] = []
        for path in test.recordings:
            try:
                recordings = read_recordings(path, kind=test.kind.name, **test.reading)
                curves += [_make_curve_of_moduli(recording, name, path, test, campaign) if test.modulus
                           else _make_curve_from_recording(*remove_left_out_and_outlier_samples(recording, name, test),
                                                           name, path, test, campaign)
                           for recording,
                           name in zip(recordings, make_names_of_recordings_in_file(recordings, path, test),
                                       strict=True)]
            except InputError as error:
                field = test.place if error.file is None else None
                raise error.with_location(file=campaign.path, field=field) from None
        check_recording_names_of_leave_out(test, [curve.name for curve in curves], campaign)
        for curve in curves:
            if curve.name in names:
                raise InputError(f"names of recordings must be unique; got {curve.name!r} twice. Give their tests "
                                 "different names", file=campaign.path, field=f"{test.place}.recordings")
            names.add(curve.name)
        if not analytical:
            if not test.modulus:
                _require_similar_speeds_and_depths(curves, test, campaign)
            stated = _find_stated_force_noise_or_none(curves[0], campaign)
            noise = estimate_noise_of_moduli([(curve.displacement, curve.force) for curve in curves], stated) \
                if test.modulus else estimate_pooled_sensor_noise(
                    [(curve.force, curve.time, curve.segment) for curve in curves], deviation=stated,
                    correlation_time=campaign.noise.correlation_time)
            curves = [replace(curve, noise=noise) for curve in curves]
        found[test.name] = tuple(_add_noise_of_force_control(curves, campaign))
    fitted = [curve for test in campaign.tests if not test.hold_out for curve in found[test.name]]
    if analytical and campaign.fit.offset == "fit" and all(curve.stressed for curve in fitted):
        raise InputError('offset = "fit" requires tests recorded as displacement and force; set offset = "none"',
                         file=campaign.path, field="fit.offset")
    _require_a_contact_offset_if_stated(campaign, fitted)
    return found


def _require_a_contact_offset_if_stated(campaign: Campaign, curves: Sequence[MeasuredCurve]) -> None:
    """Raise an `InputError` for a stated contact offset if the only fitted motions are several motions at once."""
    several = next((curve.test.kind.name for curve in curves if curve.motions is not None), "")
    if not several or any(curve.has_contact_offset for curve in curves):
        return
    reason = f"{several} has a motion for each axis and no contact offset that both loads share"
    if campaign.fit.offset == "fit":
        raise InputError(f'offset must be "none", because {several} is the only motion; got "fit". {reason}. State '
                         "noise.zero_jitter_N for the zero of the loads", file=campaign.path, field="fit.offset")
    if campaign.noise.contact_jitter:
        raise InputError(f"contact_jitter_mm must be left out; got {1e3 * campaign.noise.contact_jitter:g}. {reason}. "
                         "Leave it out", file=campaign.path, field="noise.contact_jitter_mm")


def _add_noise_of_force_control(curves: Sequence[MeasuredCurve], campaign: Campaign) -> list[MeasuredCurve]:
    """Return the recordings of a test, with the noise of both channels where the force is controlled.

    A recording without time, or with interpolated points, is not changed: its noises cannot be separated. A recording
    of several motions is not changed either: each load would be a function of all displacements.
    """
    found = list(curves)
    driven = [i for i, curve in enumerate(curves) if is_force_controlled(curve.screening, curve.test, curve.time)
              and curve.interpolation is None and curve.motions is None]
    if driven:
        first = curves[driven[0]]
        stated = None if first.stressed else campaign.noise.displacement
        control, noises = estimate_force_control_noise(
            [(curves[i].displacement, curves[i].time, curves[i].segment) for i in driven],
            [(curves[i].force, curves[i].time, curves[i].segment) for i in driven],
            (stated, _find_stated_force_noise_or_none(first, campaign)),
            0.0 if campaign.fit.method == "analytical" else campaign.noise.correlation_time)
        for i, noise in zip(driven, noises, strict=True):
            found[i] = replace(curves[i], force_control=control, noise=noise)
    return found


def compute_default_contact_offset_deviation(curves: Sequence[MeasuredCurve]) -> float:
    """Return the default standard deviation of the contact offsets of all these recordings, m.

    The value is `OffsetDefaults.contact_prior` or a fraction of the displacement of the shortest test, whichever is
    smaller. For tests recorded as strain the value is a fraction of the strain.
    """
    usual = OFFSET_DEFAULTS
    curves = [curve for curve in curves if curve.has_contact_offset]
    if not curves:
        return usual.contact_prior
    return min(usual.strain_fraction * reach if stressed else min(usual.contact_fraction * reach, usual.contact_prior)
               for reach, stressed in ((float(np.abs(curve.displacement).max()), curve.stressed) for curve in curves))


def make_campaign_with_scaled_offset_defaults(campaign: Campaign,
                                              measured: Mapping[str, Sequence[MeasuredCurve]]) -> Campaign:
    """Return the campaign with default priors and bounds of contact offsets scaled to the displacements of its tests.

    Priors and bounds that the campaign states stay unchanged.
    """
    curves = [curve for test in campaign.tests if not test.hold_out for curve in measured[test.name]]
    contact = compute_default_contact_offset_deviation(curves)
    # If the displacement was zeroed at a preload, contact occurred before the zero by this distance.
    preloads = [abs(curve.screening.preload.shift) for curve in curves if curve.screening.preload is not None]
    contact = max([contact, *preloads])
    fit = campaign.fit
    if "offset_prior" in fit.offset_usual:
        fit = replace(fit, offset_prior=contact)
    if "offset_bound" in fit.offset_usual:
        fit = replace(fit, offset_bound=contact * OFFSET_DEFAULTS.contact_bound / OFFSET_DEFAULTS.contact_prior)
    return replace(campaign, fit=fit)


def make_names_of_recordings_in_file(recordings: Sequence[Recording], path: Path, test: Test) -> list[str]:
    """Return the names ``test/recording`` of the recordings in one file.

    A single recording is named after its file; several recordings have the names in the file.
    """
    return [f"{test.name}/{path.stem if len(recordings) == 1 else recording.name}" for recording in recordings]


def _make_curve_from_recording(recording: Recording, screening: Screening, name: str, path: Path, test: Test,
                               campaign: Campaign) -> MeasuredCurve:
    """Return the fitted samples of a cleaned recording: segmented, from contact, and within ``max_strain``."""
    material, closed = campaign.fit.placeholder_material_with_effects, campaign.fit.method == "analytical" \
        or test.experiment is None
    require_matching_specimen_metadata(recording, test, campaign, path)
    read = read_motion_and_loads(recording, test, path, campaign.fit.laws)
    loads, stressed, motions = read.loads, read.stressed, read.motions
    displacement, force = read.displacement, combine_loads(read, test.kind)
    require_closed_form_support_if_used(test, material, stressed, closed, path)
    time = np.array(recording.time) if "time" in recording else None
    if time is None and test.rig.needs_time:
        raise InputError(f"{path.name} has no time, and the rig of the test requires time (latency, damping or drift); "
                         "state a time column, or speed_mm_s", field="recordings")
    remembering = is_test_force_history_dependent(test, material) or (campaign.fit.whole and time is not None)
    height = test.reference_height
    screening = add_controlled_quantity_to_screening(screening, displacement, force, time, test)
    if remembering:
        reject_left_out_start_of_loading(displacement, force, screening, path)
    labels = np.char.lower(recording.labels["segment"].astype(str)) if "segment" in recording.labels else None
    whole = segment_recording_from_contact(test, displacement, force, time, labels, stressed=stressed,
                                           remembering=remembering,
                                           path=path)
    displacement, keep = whole.displacement, whole.used
    force = whole.force if len(loads) == 1 else loads[0]
    if not whole.segmentation.has_air:
        screening = add_load_at_zero_to_screening(screening, displacement, force, campaign,
                                                  allows_reversed_load=test.kind.allows_reversed_load,
                                                  stressed=stressed)
    if labels is not None:
        inside = keep & ~np.isin(labels, ("approach",) if remembering else NOT_LOADING)
        keep = inside if inside.any() else keep
    check_displacement_range(displacement[keep], height, test, path)
    samples, later = np.flatnonzero(keep), 0
    driven = force if motions is None and is_force_controlled(screening, test, time) else displacement
    if remembering:
        if time is None:
            raise InputError(f"{path.name} has no time, and the force of this material depends on time; state a time "
                             "column, or speed_mm_s" if material.is_time_dependent else
                             f"{path.name} has no time, which is required to distinguish loading from unloading; state "
                             "a time column, or speed_mm_s", field="recordings")
        if not np.ptp(time) > 0:
            raise InputError(f"{path.name}: the time must increase for a material with memory; all samples have the "
                             "same time", field="recordings")
    elif time is None and stressed:
        # A table of stress and stretch has no order in time; neighbours in the sorted table give the noise. A table of
        # several motions keeps its order, in which series follow each other.
        if motions is None:
            samples = samples[np.argsort(displacement[samples], kind="stable")]
    else:
        samples = select_sample_indices_for_elastic_law(samples, driven, screening, path,
                                                        both_sides=test.kind.has_gripped_ends)
        # Samples after a failure are cut and do not count as hold or unloading.
        failure = whole.segmentation.failure
        end = failure.index + 1 if failure is not None and test.failure == "cut" else displacement.size
        later = max(end - 1 - int(samples[-1]), 0) if time is not None else 0
    loading = samples
    inside = np.ones(samples.size, bool)
    if test.max_strain is not None:
        reached = np.abs(displacement) if test.kind.has_gripped_ends else displacement
        inside = reached[samples] <= test.max_strain * height * (1 + 1e-9)
        # With memory, samples after the first one beyond the window depend on a history outside of the window.
        beyond = np.flatnonzero(~inside)
        samples = samples[: beyond[0]] if remembering and beyond.size else samples[inside]
    if samples.size < MIN_POINTS:
        raise InputError(f"{path.name} must have at least {MIN_POINTS} points of loading in the window; got "
                         f"{samples.size}. Sort the file by time, or increase max_strain", field="recordings")
    if is_load_against_motion(displacement[samples], force[samples], None if motions is None else motions[samples],
                              test):
        raise InputError(f"{path.name} has a force or stress of the wrong sign; {test.kind.name} requires values above "
                         "zero under load. Change the sign of the column with sign = -1", field="recordings")
    time = None if time is None else time[samples]
    if remembering and time is not None:
        if "speed" in test.reading and bool(np.any(np.diff(time) <= 0)):
            raise InputError(f"{path.name} has holds or reversals, for which speed_mm_s gives no time; state a time "
                             "column", field="speed_mm_s")
        if campaign.fit.method != "analytical":
            # Distinct times, if the clock is coarser than the sampling interval.
            time = spread_time_stamps(time, time.size)
        tolerance = compute_corner_tolerance_of_force(force[samples]) if driven is force else None
        labels = append_numbers_to_repeated_runs(label_samples_ramp_hold_unload(time, driven[samples], tolerance)
                                                 if labels is None else labels[samples])
    used = np.isin(np.arange(displacement.size), samples)
    curve = MeasuredCurve(name, test, time, displacement[samples], force[samples], labels if remembering else None,
                          path, str(recording.metadata.get("sha256", "")), stressed, later,
                          whole=replace(whole, used=used),
                          notes=get_notes_with_fit_before_contact_warning(whole, int(samples.min()), stressed=stressed)
                          | make_kind_and_tool_mismatch_notes(recording, test)
                          | make_screening_notes_by_subject(screening, recording, remembering=remembering),
                          screening=screening, motions=None if motions is None else motions[samples])
    if campaign.fit.method == "analytical":
        loaded = replace(curve, displacement=displacement[loading], force=force[loading])
        curve = add_noise_and_requested_interpolation(loaded, campaign, curve)
    for array in (curve.displacement, curve.force):
        array.flags.writeable = False
    return curve


def _make_curve_of_moduli(recording: Recording, name: str, path: Path, test: Test, campaign: Campaign) -> MeasuredCurve:
    """Return one modulus of a table as a curve; see `calibration.forward.modulus.ModulusTest` for its coordinates."""
    material = campaign.fit.placeholder_material_with_effects
    require_closed_form_support_if_used(test, material, True, True, path)
    if material.viscoelastic is None:
        raise InputError(f"{path.name} contains a loss modulus, which requires a material that relaxes; name "
                         "viscoelastic.terms[0].g and viscoelastic.terms[0].tau_s in fit.start",
                         file=campaign.path, field="fit.start")
    left_out = test.leave_out.get(name.removeprefix(f"{test.name}/"), test.leave_out.get("", ()))
    frequency, logarithm = get_frequency_and_log_modulus(recording, test.modulus, left_out, path)
    return MeasuredCurve(name, test, None, frequency, logarithm, None, path, str(recording.metadata.get("sha256", "")),
                         stressed=True)


def add_noise_and_requested_interpolation(loading: MeasuredCurve, campaign: Campaign,
                                          window: MeasuredCurve | None = None) -> MeasuredCurve:
    """Return a copy of `window` whose field `noise` is the stated or estimated noise of the sensor.

    The forces are unchanged, except for interpolation if the campaign states `strain_points`.

    Args:
        loading: all samples of the loading, from which the noise is estimated.
        campaign: campaign with the stated noise.
        window: the fitted samples; None: all samples of the loading.
    """
    stated, window = _find_stated_force_noise_or_none(loading, campaign), loading if window is None else window
    if stated is None:
        spread = estimate_white_noise(loading.force, loading.displacement)
        rounding = find_quantisation_step(loading.force) / np.sqrt(12.0)
        noise = SensorNoise(spread, source="estimated") if spread >= rounding else \
            SensorNoise(rounding, source="resolution")
    else:
        noise = SensorNoise(stated)
    points = campaign.fit.strain_points
    if points is None:
        return replace(window, noise=noise)
    if window.motions is not None:
        raise InputError(f"strain_points must be left out, because several motions determine the force of "
                         f"{window.file.name}; got {points}", file=campaign.path, field="fit.strain_points")
    grid, interpolation = _make_even_grid_and_interpolation_matrix(loading.displacement, loading, campaign, points)
    return replace(window, noise=noise, time=None, displacement=grid, force=interpolation @ loading.force,
                   interpolation=interpolation)


def _make_even_grid_and_interpolation_matrix(displacement: np.ndarray, curve: MeasuredCurve, campaign: Campaign,
                                             points: int) -> tuple[np.ndarray, csr_array]:
    """Return evenly spaced displacements up to the end of the window, and the matrix that interpolates onto them."""
    from scipy.sparse import csr_array

    test = curve.test
    height = test.reference_height
    limit = np.inf if test.max_strain is None else test.max_strain * height
    distinct, samples = np.unique(displacement, return_index=True)
    start = max(distinct[0], -limit if test.kind.has_gripped_ends else 0.0)
    grid = np.linspace(start, min(distinct[-1], limit), points)
    inside = int(np.sum((distinct >= grid[0]) & (distinct <= grid[-1] * (1 + 1e-9))))
    if points > inside:
        raise InputError(f"strain_points must be at most {inside}, the number of different strains of "
                         f"{curve.file.name} in the window; got {points}", file=campaign.path,
                         field="fit.strain_points")
    right = np.clip(np.searchsorted(distinct, grid), 1, distinct.size - 1)
    fraction = (grid - distinct[right - 1]) / (distinct[right] - distinct[right - 1])
    weights = np.concatenate([1.0 - fraction, fraction])
    indices = np.tile(np.arange(points), 2), np.concatenate([samples[right - 1], samples[right]])
    return grid, csr_array((weights, indices), shape=(points, displacement.size))


def _require_similar_speeds_and_depths(curves: list[MeasuredCurve], test: Test, campaign: Campaign) -> None:
    """Raise an `InputError` if recordings of one test differ by more than 20 % in speed or largest displacement."""
    first = curves[0]
    for other in curves[1:]:
        depths = [curve.displacement.max() for curve in (first, other)]
        speeds = [speed for curve in (first, other) if (speed := curve.mean_loading_speed) is not None]
        for what, unit, pair in (("to", "mm", depths), ("at", "mm/s", speeds)):
            torn = what == "to" and any("failure" in curve.notes for curve in (first, other))
            if torn or len(pair) < 2 or max(pair) <= (1 + REPLICATE_TOLERANCE) * min(pair):
                continue
            raise InputError(f"{first.file.name} moves {what} {pair[0] * 1e3:.4g} {unit} and {other.file.name} {what} "
                             f"{pair[1] * 1e3:.4g} {unit}, so they are not replicates; move one of them to a separate "
                             "[[test]]", file=campaign.path, field=f"{test.place}.recordings")


def _find_stated_force_noise_or_none(curve: MeasuredCurve, campaign: Campaign) -> float | None:
    """Return the stated noise as a force, N, from the value in the recorded unit if stated; None: to be estimated."""
    if curve.test.modulus:
        return campaign.noise.modulus
    force, stress = campaign.noise.force, campaign.noise.nominal_stress
    if not curve.stressed:
        return force
    if stress is not None:
        return stress * curve.test.reference_area
    return None if curve.test.states_stress else force


def compute_input_and_version_digest(campaign: Campaign, recordings: Sequence[MeasuredCurve],
                                     changed: Mapping[str, object] | None = None) -> str:
    """Return the SHA-256 digest, in hexadecimal, of all inputs of a campaign and of the program version.

    Args:
        campaign: campaign.
        recordings: all recordings of the campaign.
        changed: name -> value of settings that differ from the defaults; None: none.
    """
    content = [campaign.sha256, *(f"{curve.name} {curve.sha256}" for curve in recordings)]
    for test in campaign.tests:
        if test.experiment is not None:
            outline = test.experiment.tool.profile.vertices.tolist()
            content.append(hashlib.sha256(repr((test.rig, outline)).encode()).hexdigest())
    content += [digest for specimen in campaign.specimens.values() if (digest := specimen.digest_of_files)]
    content += [f"{name} = {value!r}" for name, value in (changed or {}).items()]
    return hashlib.sha256("\n".join([*content, tissue_sim.__version__]).encode()).hexdigest()
