"""Recordings as curves of force against displacement, ready for an inverse fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.analytical.replicates import NOT_LOADING, check_size, names_of
from calibration.campaign.campaign import Campaign, Test
from calibration.statistics.sensor_noise import SensorNoise, estimate_shared_noise, spread_stamps
from tissue_sim.errors import InputError
from tissue_sim.material.material import Material
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.recording import MIN_POINTS, Recording
from tissue_sim.recording.segmentation import label_motion, number_runs

#: Replicates of one test may differ by this share in their speed and in their largest displacement.
REPLICATE_TOLERANCE = 0.2


@dataclass(frozen=True, eq=False)
class MeasuredCurve:
    """One recording, as far as it is compared with a simulation.

    A test without a specimen was recorded as stretch (or shear strain) and nominal stress. It is taken as done on a
    cube of 1 m, whose displacement is the strain and whose force in N is the stress in Pa.

    Attributes:
        name: of the recording, unique in the campaign. test: it belongs to.
        time: s, shape (n,), or None. displacement: m, positive under load, shape (n,). force: N, positive under load.
        segment: labels, shape (n,), or None where everything is one loading.
        file, sha256: where it came from.
        stressed: whether it was recorded as strain and stress.
        later: samples after the loading (holds, returns) that are left out, because the model does not remember.
        noise: of the sensor; None before anybody has estimated it.
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
    noise: SensorNoise | None = None

    @property
    def speed(self) -> float | None:
        """Of the loading, m/s; None without time."""
        if self.time is None:
            return None
        last = int(np.argmax(self.displacement))
        way, duration = self.displacement[last] - self.displacement[0], self.time[last] - self.time[0]
        return float(way / duration) if duration > 0 else None


def remembers(test: Test, material: Material) -> bool:
    """Whether force depends on the way of the tool and not on its place alone, so that unloading is fitted too."""
    return material.remembers or (test.experiment is not None and test.experiment.slides)


def read_measured(campaign: Campaign) -> dict[str, tuple[MeasuredCurve, ...]]:
    """Read and check all recordings of a campaign, held-out tests included: test -> its recordings.

    Raises:
        InputError: an unreadable recording, columns that do not fit the kind, a recording deeper than its specimen or
            of a specimen of another size, force of the wrong sign, too few points, replicates that differ in speed or
            depth, a material that ages and a recording without time.
    """
    found: dict[str, tuple[MeasuredCurve, ...]] = {}
    names: set[str] = set()
    for test in campaign.tests:
        curves: list[MeasuredCurve] = []
        for path in test.recordings:
            try:
                recordings = read_recordings(path, kind=test.kind.name, **test.reading)
                curves += [_curve(recording, name, path, test, campaign)
                           for recording, name in zip(recordings, names_of(recordings, path, test), strict=True)]
            except InputError as error:
                field = test.place if error.file is None else None
                raise error.located(file=campaign.path, field=field) from None
        for curve in curves:
            if curve.name in names:
                raise InputError(f"two recordings are called {curve.name!r}; give their tests different names",
                                 file=campaign.path, field=f"{test.place}.recordings")
            names.add(curve.name)
        _check_replicates(curves, test, campaign)
        noise = _noise(curves, test, campaign)
        found[test.name] = tuple(replace(curve, noise=noise) for curve in curves)
    return found


def _curve(recording: Recording, name: str, path: Path, test: Test, campaign: Campaign) -> MeasuredCurve:
    material = campaign.fit.material
    check_size(recording, test, campaign, path)
    displacement, force, stressed = _mechanical(recording, test, path)
    _check_parts(test, material, stressed, path)
    time = np.array(recording.time) if "time" in recording else None
    if time is None and test.rig.needs_time:
        raise InputError(f"{path.name} has no time, and the rig of its test needs it (latency, damping or drift); give "
                         "a time column, or speed_mm_s", field="recordings")
    labels = np.char.lower(recording.labels["segment"].astype(str)) if "segment" in recording.labels else None
    keep = np.ones(displacement.size, bool)
    if labels is not None:
        away = ("approach",) if remembers(test, material) else NOT_LOADING
        keep = ~np.isin(labels, away)
        keep = keep if keep.any() else np.ones(displacement.size, bool)
    if not keep.any() or np.ptp(displacement[keep]) == 0:
        raise InputError(f"{path.name} does not move: its displacement has the same value in all "
                         f"{int(keep.sum())} samples; check which column it is read from", field="recordings")
    height = 1.0 if test.specimen is None else test.specimen.height
    if not test.kind.gripped and displacement[keep].max() >= height:
        raise InputError(f"{path.name} goes to {displacement[keep].max() * 1e3:g} mm, deeper than the specimen "
                         f"{test.specimen.name!r} is high ({height * 1e3:g} mm)", field="recordings")
    if displacement[keep].max() <= 0:
        raise InputError(f"{path.name} holds no loading: its largest displacement is "
                         f"{displacement[keep].max() * 1e3:g} mm; turn the column with sign = -1", field="recordings")
    places, later = np.flatnonzero(keep), 0
    if not remembers(test, material):
        if time is None and "displacement" not in recording:
            # A table of stress and stretch has no order in time.
            places = places[np.argsort(displacement[places], kind="stable")]
        places = places[: int(np.argmax(displacement[places])) + 1]
        later = displacement.size - 1 - int(places[-1]) if time is not None else 0
        labels = None
    elif time is None:
        raise InputError(f"{path.name} has no time, and the force of this material depends on it; give a time column, "
                         "or speed_mm_s" if material.ages else
                         f"{path.name} has no time, which tells loading from unloading; give a time column, or "
                         "speed_mm_s", field="recordings")
    if test.max_strain is not None:
        reached = np.abs(displacement) if test.kind.both_ways else displacement
        inside = reached[places] <= test.max_strain * height * (1 + 1e-9)
        # A window of the loading; what comes after the first sample beyond it had a history outside it.
        beyond = np.flatnonzero(~inside)
        places = places[: beyond[0]] if remembers(test, material) and beyond.size else places[inside]
    if places.size < MIN_POINTS:
        raise InputError(f"{path.name} has {places.size} points of loading in the window; at least {MIN_POINTS} are "
                         "needed, so sort the file by time or widen max_strain", field="recordings")
    displacement, force = displacement[places], force[places]
    if np.sum(force * displacement) <= 0:
        raise InputError(f"{path.name} has a force against the load; {test.kind.name} expects force above zero, so "
                         "turn the column with sign = -1", field="recordings")
    time = None if time is None else time[places]
    if remembers(test, material):
        if "speed" in test.reading and (np.diff(time) <= 0).any():
            raise InputError(f"{path.name} stands still or turns, and speed_mm_s cannot tell the time there; give a "
                             "time column", field="speed_mm_s")
        # A clock that is coarser than the sampling.
        time = spread_stamps(time, time.size)
        labels = number_runs(label_motion(time, displacement) if labels is None else labels[places])
    return MeasuredCurve(name, test, time, displacement, force, labels, path,
                         str(recording.metadata.get("sha256", "")), stressed, later)


def _check_parts(test: Test, material: Material, stressed: bool, path: Path) -> None:
    """Refuse what the closed form of a homogeneous test leaves out."""
    if test.experiment is not None and not stressed:
        return
    if material.layers:
        raise InputError(f"a layered specimen does not deform homogeneously, and {path.name} has a closed form only; "
                         "give displacement and force of a compression or a needle", field="kind")
    if test.specimen is None and material.poroelasticity is not None:
        raise InputError("a material that drains needs the size of the specimen; add a [[specimen]]", field="specimen")
    if not test.rig.ideal:
        raise InputError(f"{path.name} holds stress, which no load frame reads; leave the rig out", field="rig")


def _mechanical(recording: Recording, test: Test, path: Path) -> tuple[np.ndarray, np.ndarray, bool]:
    """Displacement, m, and force, N, positive under load, and whether they were recorded as strain and stress."""
    mechanical, *direct = test.kind.channels
    if all(name in recording for name in mechanical):
        if test.specimen is None:
            raise InputError(f"{path.name} holds displacement and force, which need a [[specimen]]", field="specimen")
        return np.array(recording.displacement), np.array(recording.force), False
    for motion, load in direct:
        if motion in recording and load in recording:
            height, area = (1.0, 1.0) if test.specimen is None else (test.specimen.height, test.specimen.area)
            return (height * test.kind.strain(recording.channel(motion)),
                    test.kind.sign * area * recording.channel(load), True)
    wanted = " or ".join(" and ".join(pair) for pair in test.kind.channels)
    raise InputError(f"{path.name} has {', '.join(recording.channels)}; {test.kind.name} needs {wanted}",
                     field="recordings")


def _check_replicates(curves: list[MeasuredCurve], test: Test, campaign: Campaign) -> None:
    """Refuse recordings of one test that are not replicates of each other."""
    first = curves[0]
    for other in curves[1:]:
        depths = [curve.displacement.max() for curve in (first, other)]
        speeds = [curve.speed for curve in (first, other)]
        for what, unit, pair in (("to", "mm", depths), ("at", "mm/s", speeds)):
            if None in pair or max(pair) <= (1 + REPLICATE_TOLERANCE) * min(pair):
                continue
            raise InputError(f"{first.file.name} goes {what} {pair[0] * 1e3:.4g} {unit} and {other.file.name} {what} "
                             f"{pair[1] * 1e3:.4g} {unit}, so they are not replicates; give one of them a [[test]] of "
                             "its own", file=campaign.path, field=f"{test.place}.recordings")


def _noise(curves: list[MeasuredCurve], test: Test, campaign: Campaign) -> SensorNoise:
    """One noise for the recordings of a test: what is stated in the unit that they were recorded in counts first."""
    force, stress = campaign.noise.force, campaign.noise.nominal_stress
    area = 1.0 if test.specimen is None else test.specimen.area
    if curves[0].stressed:
        stated = stress * area if stress is not None else None if test.specimen is None else force
    else:
        stated = force
    return estimate_shared_noise([(curve.force, curve.time, curve.segment) for curve in curves], deviation=stated,
                                 correlation_time=campaign.noise.correlation_time)
