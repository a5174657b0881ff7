"""Recordings as curves of force against displacement, ready to fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibration.campaign.campaign import DEFAULT_OFFSET_BOUND, DEFAULT_OFFSET_PRIOR, Campaign, Test
from calibration.campaign.loading import check_motion, elastic_samples, require_loading
from calibration.campaign.schema import PRISM
from calibration.campaign.screened import check_left_out, cleaned, notes_of, with_control, with_preload
from calibration.campaign.segmented import SegmentedRecording, from_elsewhere, segment_recording, with_air_noted
from calibration.statistics.sensor_noise import SensorNoise, estimate_shared_noise, spread_time_stamps
from calibration.statistics.statistics import estimate_noise, resolution
from tissue_sim.errors import InputError
from tissue_sim.material.material import Material
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.recording import MIN_POINTS, Recording
from tissue_sim.recording.screening import Screening
from tissue_sim.recording.segmentation import label_motion, number_runs
from tissue_sim.specimen.specimen import with_article

if TYPE_CHECKING:
    from scipy.sparse import csr_array

#: Largest difference of a specimen's size between a recording's own word and the campaign's, as a share.
SIZE_TOLERANCE = 0.02
#: Segments other than a first loading, to which an elastic law is fitted.
NOT_LOADING = ("approach", "preconditioning", "hold", "unload", "reload", "retract")
#: Contact offsets that nobody states scatter by no more than this share of the way of a test, and of the strain of one
#: that was recorded as strain.
CONTACT_SHARE, STRAIN_SHARE = 0.02, 0.005
#: Loading has ended where this share of the largest displacement is reached.
LOADED = 0.98
#: Replicates of one test may differ by this share in their speed and in their largest displacement.
REPLICATE_TOLERANCE = 0.2


@dataclass(frozen=True, eq=False)
class MeasuredCurve:
    """One recording, as far as it is compared with a model.

    A test without a specimen was recorded as stretch (or shear strain) and nominal stress. It is taken as done on a
    cube of 1 m, whose displacement is the strain and whose force in N is the stress in Pa.

    Attributes:
        name: of the recording, unique in the campaign. test: it belongs to.
        time: s, shape (n,), or None. displacement: m, positive under load, shape (n,). force: N, positive under load.
        segment: labels, shape (n,), or None where everything is one loading.
        file, sha256: where it came from.
        stressed: whether it was recorded as strain and stress.
        later: samples after the loading (holds, returns) that are left out, because the model does not remember.
        noise: of the sensor; None only while its test is read.
        interpolation: what takes the samples of the file to these points, shape (n, samples); None: they are samples.
        whole: all of the recording, with its segments; None of one that is made up.
        notes: subject -> what a user has to know of it.
        screening: findings about the signals: samples left out, saturation, preload, control.
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

    @property
    def clock(self) -> np.ndarray:
        """The time of a recording that has one, s, shape (n,)."""
        if self.time is None:
            raise InputError(f"{self.name} has no time; give a time column, or speed_mm_s", field="recordings")
        return self.time

    @property
    def speed(self) -> float | None:
        """Of the loading, m/s; None without time."""
        if self.time is None:
            return None
        # A hold trembles and creeps: its largest displacement may be anywhere in it.
        last = int(np.argmax(self.displacement >= LOADED * self.displacement.max()))
        way, duration = self.displacement[last] - self.displacement[0], self.time[last] - self.time[0]
        return float(way / duration) if duration > 0 else None


def remembers(test: Test, material: Material) -> bool:
    """Whether force depends on the way of the tool and not on its place alone, so that unloading is fitted too."""
    return material.remembers or (test.experiment is not None and test.experiment.is_path_dependent)


def read_measured(campaign: Campaign) -> dict[str, tuple[MeasuredCurve, ...]]:
    """Read and check all recordings of a campaign, held-out tests included: test -> its recordings.

    Raises:
        InputError: an unreadable recording, columns that do not fit the kind, a recording deeper than its specimen or
            of a specimen of another size, force of the wrong sign, too few points, a material that ages and a recording
            without time; of an inverse fit also replicates that differ in speed or depth.
    """
    analytical = campaign.fit.method == "analytical"
    found: dict[str, tuple[MeasuredCurve, ...]] = {}
    names: set[str] = set()
    for test in campaign.tests:
        curves: list[MeasuredCurve] = []
        for path in test.recordings:
            try:
                recordings = read_recordings(path, kind=test.kind.name, **test.reading)
                curves += [_curve(*cleaned(recording, name, test), name, path, test, campaign)
                           for recording, name in zip(recordings, names_of(recordings, path, test), strict=True)]
            except InputError as error:
                field = test.place if error.file is None else None
                raise error.located(file=campaign.path, field=field) from None
        check_left_out(test, [curve.name for curve in curves], campaign)
        for curve in curves:
            if curve.name in names:
                raise InputError(f"two recordings are called {curve.name!r}; give their tests different names",
                                 file=campaign.path, field=f"{test.place}.recordings")
            names.add(curve.name)
        if not analytical:
            _check_replicates(curves, test, campaign)
            noise = estimate_shared_noise([(curve.force, curve.time, curve.segment) for curve in curves],
                                          deviation=_stated_noise(curves[0], campaign),
                                          correlation_time=campaign.noise.correlation_time)
            curves = [replace(curve, noise=noise) for curve in curves]
        found[test.name] = tuple(curves)
    fitted = [curve for test in campaign.tests if not test.hold_out for curve in found[test.name]]
    if analytical and campaign.fit.offset == "fit" and all(curve.stressed for curve in fitted):
        raise InputError('offset = "fit" needs tests recorded as displacement and force; use "none"',
                         file=campaign.path, field="fit.offset")
    return found


def usual_contact(curves: Sequence[MeasuredCurve]) -> float:
    """Standard deviation of a contact offset that is assumed where nobody states one, m: the usual one, or a share of
    the way of the shortest test. Of tests recorded as strain a share of that."""
    return min(STRAIN_SHARE * way if stressed else min(CONTACT_SHARE * way, DEFAULT_OFFSET_PRIOR)
               for way, stressed in ((float(np.abs(curve.displacement).max()), curve.stressed) for curve in curves))


def scale_offsets(campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]]) -> Campaign:
    """The campaign with prior and bounds of contact offsets that nobody stated in the size of its tests."""
    curves = [curve for test in campaign.tests if not test.hold_out for curve in measured[test.name]]
    contact = usual_contact(curves)
    # Where the displacement was zeroed at a preload, contact was so far before it.
    preloads = [abs(curve.screening.preload.shift) for curve in curves if curve.screening.preload is not None]
    contact = max([contact, *preloads])
    fit = campaign.fit
    if "offset_prior" in fit.offset_usual:
        fit = replace(fit, offset_prior=contact)
    if "offset_bound" in fit.offset_usual:
        fit = replace(fit, offset_bound=contact * DEFAULT_OFFSET_BOUND / DEFAULT_OFFSET_PRIOR)
    return replace(campaign, fit=fit)


def names_of(recordings: Sequence[Recording], path: Path, test: Test) -> list[str]:
    """Names of the recordings of one file: the file's, or their own where it holds several."""
    return [f"{test.name}/{path.stem if len(recordings) == 1 else recording.name}" for recording in recordings]


def check_size(recording: Recording, test: Test, campaign: Campaign, path: Path) -> None:
    """Refuse one that says another shape or size of its specimen; cylinders once said no shape, prisms never know."""
    if test.specimen is None or not isinstance(said := recording.metadata.get("specimen"), Mapping):
        return
    place = f"specimen[{list(campaign.specimens).index(test.specimen.name)}]"
    shape, told = test.specimen.shape, said.get("shape", "cylinder" if "radius_mm" in said else None)
    any_shape = test.kind.gripped or campaign.fit.method == "analytical" or test.specimen.name in campaign.prisms
    if not any_shape and isinstance(told, str) and told not in (shape, PRISM):
        raise InputError(f"{with_article(shape)}, but {path.name} says of itself that it is {with_article(told)}; mend "
                         "the one that is wrong", file=campaign.path, field=f"{place}.shape")
    for key, size in test.specimen.sizes.items():
        stated = said.get(key)
        if isinstance(stated, int | float) and abs(stated - size) > SIZE_TOLERANCE * size:
            raise InputError(f"{size:g} mm, but {path.name} says of itself that it is {stated:g} mm; mend the one that "
                             "is wrong", file=campaign.path, field=f"{place}.{key}")


def _curve(recording: Recording, screening: Screening, name: str, path: Path, test: Test,
           campaign: Campaign) -> MeasuredCurve:
    material, closed = campaign.fit.material, campaign.fit.method == "analytical" or test.experiment is None
    check_size(recording, test, campaign, path)
    displacement, force, stressed = _mechanical(recording, test, path)
    _check_parts(test, material, stressed or closed, path)
    time = np.array(recording.time) if "time" in recording else None
    if time is None and test.rig.needs_time:
        raise InputError(f"{path.name} has no time, and the rig of its test needs it (latency, damping or drift); give "
                         "a time column, or speed_mm_s", field="recordings")
    remembering = remembers(test, material) or (campaign.fit.whole and time is not None)
    height = 1.0 if test.specimen is None else test.specimen.height
    screening = with_control(screening, displacement, force, time, test)
    if remembering:
        require_loading(displacement, force, screening, path)
    labels = np.char.lower(recording.labels["segment"].astype(str)) if "segment" in recording.labels else None
    whole = segment_recording(test, displacement, force, time, labels, stressed=stressed, remembering=remembering,
                              path=path)
    displacement, force, keep = whole.displacement, whole.force, whole.used
    if not whole.segmentation.has_air:
        screening = with_preload(screening, displacement, force, campaign,
                                 can_pull=test.kind.can_pull, stressed=stressed)
    if labels is not None:
        inside = keep & ~np.isin(labels, ("approach",) if remembering else NOT_LOADING)
        keep = inside if inside.any() else keep
    check_motion(displacement[keep], height, test, path)
    places, later = np.flatnonzero(keep), 0
    if remembering:
        if time is None:
            raise InputError(f"{path.name} has no time, and the force of this material depends on it; give a time "
                             "column, or speed_mm_s" if material.ages else
                             f"{path.name} has no time, which tells loading from unloading; give a time column, or "
                             "speed_mm_s", field="recordings")
        if not np.ptp(time) > 0:
            raise InputError(f"{path.name} has a time that does not advance; relaxation needs samples at different "
                             "times", field="recordings")
    elif time is None and stressed:
        # A table of stress and stretch has no order in time; sorted, its neighbours tell the noise.
        places = places[np.argsort(displacement[places], kind="stable")]
    else:
        places = elastic_samples(places, displacement, screening, path, both_sides=test.kind.gripped)
        # What comes after a failure is cut with it, and is no hold or return.
        failure = whole.segmentation.failure
        end = failure.index + 1 if failure is not None and test.failure == "cut" else displacement.size
        later = max(end - 1 - int(places[-1]), 0) if time is not None else 0
    loading = places
    inside = np.ones(places.size, bool)
    if test.max_strain is not None:
        reached = np.abs(displacement) if test.kind.gripped else displacement
        inside = reached[places] <= test.max_strain * height * (1 + 1e-9)
        # A window of the loading; what comes after the first sample beyond it had a history outside it.
        beyond = np.flatnonzero(~inside)
        places = places[: beyond[0]] if remembering and beyond.size else places[inside]
    if places.size < MIN_POINTS:
        raise InputError(f"{path.name} has {places.size} points of loading in the window; at least {MIN_POINTS} are "
                         "needed, so sort the file by time or widen max_strain", field="recordings")
    if np.sum(force[places] * displacement[places]) <= 0:
        raise InputError(f"{path.name} has a force or stress against the load; {test.kind.name} expects force above "
                         "zero, so turn the column with sign = -1", field="recordings")
    time = None if time is None else time[places]
    if remembering and time is not None:
        if "speed" in test.reading and bool(np.any(np.diff(time) <= 0)):
            raise InputError(f"{path.name} stands still or turns, and speed_mm_s cannot tell the time there; give a "
                             "time column", field="speed_mm_s")
        if campaign.fit.method != "analytical":
            # A clock that is coarser than the sampling.
            time = spread_time_stamps(time, time.size)
        labels = number_runs(label_motion(time, displacement[places]) if labels is None else labels[places])
    used = np.isin(np.arange(displacement.size), places)
    curve = MeasuredCurve(name, test, time, displacement[places], force[places], labels if remembering else None, path,
                          str(recording.metadata.get("sha256", "")), stressed, later,
                          whole=replace(whole, used=used),
                          notes=with_air_noted(whole, int(places.min()), stressed=stressed)
                          | from_elsewhere(recording, test) | notes_of(screening, recording, remembering=remembering),
                          screening=screening)
    if campaign.fit.method == "analytical":
        curve = with_noise(replace(curve, displacement=displacement[loading], force=force[loading]), campaign,
                           curve)
    for array in (curve.displacement, curve.force):
        array.flags.writeable = False
    return curve


def with_noise(loading: MeasuredCurve, campaign: Campaign, window: MeasuredCurve | None = None) -> MeasuredCurve:
    """A curve with the noise of its samples, stated or estimated, and interpolated where the campaign asks for it.

    Args:
        loading: all of its samples. campaign: what is stated. window: those that are fitted; None: all.
    """
    stated, window = _stated_noise(loading, campaign), loading if window is None else window
    if stated is None:
        spread = estimate_noise(loading.force, loading.displacement)
        rounding = resolution(loading.force) / np.sqrt(12.0)
        noise = SensorNoise(spread, source="estimated") if spread >= rounding else \
            SensorNoise(rounding, source="resolution")
    else:
        noise = SensorNoise(stated)
    points = campaign.fit.strain_points
    if points is None:
        return replace(window, noise=noise)
    grid, interpolation = _evenly_spaced(loading.displacement, loading, campaign, points)
    return replace(window, noise=noise, time=None, displacement=grid, force=interpolation @ loading.force,
                   interpolation=interpolation)


def _evenly_spaced(displacement: np.ndarray, curve: MeasuredCurve, campaign: Campaign,
                   points: int) -> tuple[np.ndarray, csr_array]:
    """Even displacements from rest to the end of the window, and the linear interpolation onto them."""
    from scipy.sparse import csr_array

    test = curve.test
    height = 1.0 if test.specimen is None else test.specimen.height
    limit = np.inf if test.max_strain is None else test.max_strain * height
    way, samples = np.unique(displacement, return_index=True)
    start = max(way[0], -limit if test.kind.gripped else 0.0)
    grid = np.linspace(start, min(way[-1], limit), points)
    inside = int(np.sum((way >= grid[0]) & (way <= grid[-1] * (1 + 1e-9))))
    if points > inside:
        raise InputError(f"{points} points, but {curve.file.name} has {inside} samples of different strain in the "
                         f"window; give at most {inside}", file=campaign.path, field="fit.strain_points")
    right = np.clip(np.searchsorted(way, grid), 1, way.size - 1)
    share = (grid - way[right - 1]) / (way[right] - way[right - 1])
    weights = np.concatenate([1.0 - share, share])
    places = np.tile(np.arange(points), 2), np.concatenate([samples[right - 1], samples[right]])
    return grid, csr_array((weights, places), shape=(points, displacement.size))


def _check_parts(test: Test, material: Material, closed: bool, path: Path) -> None:
    """Refuse what the closed form of a homogeneous test leaves out."""
    if not closed:
        return
    if material.layers:
        raise InputError(f"a layered specimen does not deform homogeneously, and {path.name} has a closed form only; "
                         "give displacement and force of a compression or a needle", field="kind")
    if test.specimen is None and material.poroelasticity is not None:
        raise InputError("a material that drains needs the size of the specimen; add a [[specimen]]", field="specimen")
    if test.specimen is not None and test.specimen.specific_weight and material.remembers:
        raise InputError("a specimen that weighs has no closed form of a material that remembers; set gravity = false, "
                         "or fit.method = 'inverse_fem'", field="specimen")
    if not test.rig.ideal:
        raise InputError(f"{path.name} holds stress, which no load frame reads; leave the rig out", field="rig")


def _mechanical(recording: Recording, test: Test, path: Path) -> tuple[np.ndarray, np.ndarray, bool]:
    """Displacement, m, and force, N, positive under load, and whether they were recorded as strain and stress."""
    mechanical, *direct = test.kind.channels
    stated = next((pair for pair in direct if all(name in recording for name in pair)), None)
    if all(name in recording for name in mechanical) and (test.specimen is not None or stated is None):
        if test.specimen is None:
            raise InputError(f"{path.name} holds displacement and force, which need a [[specimen]] to become stress",
                             field="specimen")
        return np.array(recording.displacement), np.array(recording.force), False
    if stated is None:
        wanted = ", or ".join(" and ".join(pair) for pair in test.kind.channels)
        raise InputError(f"{path.name} has {', '.join(recording.channels)}; {test.kind.name} needs {wanted}",
                         field="recordings")
    if test.specimen is not None and test.specimen.specific_weight:
        raise InputError(f"{path.name} holds {' and '.join(stated)}, which differ from slice to slice under gravity = "
                         f"true; give {' and '.join(mechanical)}, or set gravity = false", field="recordings")
    motion, load = stated
    if test.specimen is not None and not test.specimen.is_prism:
        raise InputError(f"{path.name} holds {' and '.join(stated)}, and {test.specimen.name!r} is "
                         f"{with_article(test.specimen.shape)}, which has not one cross-section; give "
                         f"{' and '.join(mechanical)}", field="recordings")
    height, area = (1.0, 1.0) if test.specimen is None else (test.specimen.height, test.specimen.area)
    return (height * test.kind.strain(recording.channel(motion)), test.kind.sign * area * recording.channel(load),
            True)


def _check_replicates(curves: list[MeasuredCurve], test: Test, campaign: Campaign) -> None:
    """Refuse recordings of one test that are not replicates of each other."""
    first = curves[0]
    for other in curves[1:]:
        depths = [curve.displacement.max() for curve in (first, other)]
        speeds = [speed for curve in (first, other) if (speed := curve.speed) is not None]
        for what, unit, pair in (("to", "mm", depths), ("at", "mm/s", speeds)):
            torn = what == "to" and any("failure" in curve.notes for curve in (first, other))
            if torn or len(pair) < 2 or max(pair) <= (1 + REPLICATE_TOLERANCE) * min(pair):
                continue
            raise InputError(f"{first.file.name} goes {what} {pair[0] * 1e3:.4g} {unit} and {other.file.name} {what} "
                             f"{pair[1] * 1e3:.4g} {unit}, so they are not replicates; give one of them a [[test]] of "
                             "its own", file=campaign.path, field=f"{test.place}.recordings")


def _stated_noise(curve: MeasuredCurve, campaign: Campaign) -> float | None:
    """N; what is stated in the unit that the curve was recorded in counts first. None: to be estimated."""
    force, stress, specimen = campaign.noise.force, campaign.noise.nominal_stress, curve.test.specimen
    if not curve.stressed:
        return force
    if stress is not None:
        return stress * (1.0 if specimen is None else specimen.area)
    return None if specimen is None else force
