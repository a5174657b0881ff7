"""Recordings of homogeneous tests as curves of nominal stress, ready to fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from calibration.analytical.forward import Homogeneous, Weighing, forward_model
from calibration.campaign.campaign import Campaign, Test
from calibration.statistics.statistics import estimate_noise, resolution
from tissue_sim.errors import InputError
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.recording import MIN_POINTS, Recording

#: Largest difference of a specimen's size between a recording's own word and the campaign's, as a share.
SIZE_TOLERANCE = 0.02
#: Segments other than a first loading, to which an elastic law is fitted.
NOT_LOADING = ("approach", "hold", "unload", "reload", "retract")


@dataclass(frozen=True, eq=False)
class Replicate:
    """The loading curve of one recording.

    Attributes:
        name: of the recording, unique among the replicates of a campaign.
        test: the test that it belongs to.
        abscissa: what `model` takes: stretch (with self-weight 1 - displacement/height) or shear strain, shape (n,).
        stress: nominal stress, Pa, negative in compression, shape (n,).
        noise: standard deviation of the stress of a sample, Pa. noise_source: ``"stated"``, ``"estimated"`` or, where
            the sensor's step makes it, ``"resolution"``.
        mechanical: whether it was recorded as displacement and force, so that an offset and a zero make sense.
        file, sha256: where it came from.
        interpolation: what takes the samples of the file to these points, shape (n, samples); None: they are samples.
    """

    name: str
    test: Test
    abscissa: np.ndarray
    stress: np.ndarray
    noise: float
    noise_source: str
    mechanical: bool
    file: Path
    sha256: str
    interpolation: csr_array | None = None

    @property
    def rest(self) -> float:
        """Abscissa of the undeformed specimen."""
        return self.test.kind.require_closed_form().rest

    @property
    def model(self) -> Homogeneous | Weighing:
        """What its abscissa and a law make of the stress."""
        return forward_model(self.test)

    @property
    def strain(self) -> np.ndarray:
        """Nominal strain (shear strain for shear), positive under load, shape (n,)."""
        return self.test.kind.strain(self.abscissa)

    @property
    def offset_slope(self) -> float:
        """d(abscissa)/d(contact offset), 1/m: a later contact means a smaller true displacement."""
        return -self.force_sign / self.test.specimen.height

    @property
    def zero_slope(self) -> float:
        """d(nominal stress)/d(zero of the force), 1/m2."""
        return self.force_sign / self.area

    @property
    def force_sign(self) -> float:
        """Sign of the nominal stress under a positive force."""
        return self.test.kind.sign

    @property
    def area(self) -> float | None:
        """Undeformed cross-section, m2; None without a specimen."""
        return None if self.test.specimen is None else self.test.specimen.area

    @property
    def force(self) -> np.ndarray:
        """Force, N, positive under load; only with a specimen."""
        return self.force_sign * self.area * self.stress


def read_replicates(campaign: Campaign) -> tuple[Replicate, ...]:
    """Read and check all recordings of a campaign, held-out tests included.

    Raises:
        InputError: an unreadable recording, columns that do not fit the kind, a recording deeper than its specimen or
            of a specimen of another size, stress of the wrong sign, too few points.
    """
    replicates: list[Replicate] = []
    for test in campaign.tests:
        for path in test.recordings:
            try:
                recordings = read_recordings(path, kind=test.kind.name, **test.reading)
                found = [_read(recording, name, path, test, campaign)
                         for recording, name in zip(recordings, names_of(recordings, path, test), strict=True)]
            except InputError as error:
                field = test.place if error.file is None else None
                raise error.located(file=campaign.path, field=field) from None
            for replicate in found:
                if any(other.name == replicate.name for other in replicates):
                    raise InputError(f"two recordings are called {replicate.name!r}; give their tests different names",
                                     file=campaign.path, field=f"{test.place}.recordings")
                replicates.append(replicate)
    if campaign.fit.offset == "fit" and not any(r.mechanical for r in replicates if not r.test.hold_out):
        raise InputError('offset = "fit" needs tests recorded as displacement and force; use "none"',
                         file=campaign.path, field="fit.offset")
    return tuple(replicates)


def names_of(recordings: Sequence[Recording], path: Path, test: Test) -> list[str]:
    """Names of the recordings of one file: the file's, or their own where it holds several."""
    return [f"{test.name}/{path.stem if len(recordings) == 1 else recording.name}" for recording in recordings]


def _read(recording: Recording, name: str, path: Path, test: Test, campaign: Campaign) -> Replicate:
    check_size(recording, test, campaign, path)
    recording = _loading(recording)
    mechanical, abscissa, stress = _curve(recording, test, path)
    _check_range(abscissa, recording, test, path)
    if mechanical or "time" in recording:
        loaded = slice(0, int(np.argmax(test.kind.strain(abscissa))) + 1)
    else:
        # A table of stress and stretch has no order in time; sorted, its neighbours tell the noise.
        loaded = np.argsort(test.kind.strain(abscissa), kind="stable")
    abscissa, stress = abscissa[loaded], stress[loaded]
    inside = np.ones(abscissa.size, bool)
    if test.max_strain is not None:
        strain = test.kind.strain(abscissa)
        inside = (np.abs(strain) if test.kind.both_ways else strain) <= test.max_strain * (1 + 1e-9)
    if (mechanical or "time" in recording) and loaded.stop < MIN_POINTS:
        raise InputError(f"{path.name} has its largest strain in sample {loaded.stop}, and what follows counts as "
                         f"unloading; sort the file by time, so that at least {MIN_POINTS} samples load the specimen",
                         field="recordings")
    if inside.sum() < MIN_POINTS:
        raise InputError(f"{path.name} has {inside.sum()} points of loading in the window; at least {MIN_POINTS} are "
                         "needed, so widen max_strain", field="recordings")
    _check_sign(abscissa, stress, test, path)
    noise, source = _noise(abscissa, stress, mechanical, test, campaign)
    interpolation = None
    if campaign.fit.strain_points is not None:
        abscissa, interpolation = _evenly_spaced(abscissa, test, campaign, path)
        stress = interpolation @ stress
    else:
        abscissa, stress = abscissa[inside], stress[inside]
    for array in (abscissa, stress):
        array.flags.writeable = False
    return Replicate(name, test, abscissa, stress, noise, source, mechanical, path,
                     str(recording.metadata.get("sha256", "")), interpolation)


def check_size(recording: Recording, test: Test, campaign: Campaign, path: Path) -> None:
    """Refuse a recording that says itself that its specimen has another size."""
    said = recording.metadata.get("specimen")
    if test.specimen is None or not isinstance(said, Mapping):
        return
    place = f"specimen[{list(campaign.specimens).index(test.specimen.name)}]"
    for key, size in (("radius_mm", test.specimen.radius * 1e3), ("height_mm", test.specimen.height * 1e3)):
        own = said.get(key)
        if isinstance(own, int | float) and abs(own - size) > SIZE_TOLERANCE * size:
            raise InputError(f"{size:g} mm, but {path.name} says of itself that it is {own:g} mm; mend the one that is "
                             "wrong", file=campaign.path, field=f"{place}.{key}")


def _loading(recording: Recording) -> Recording:
    if "segment" not in recording.labels:
        return recording
    keep = ~np.isin(np.char.lower(recording.labels["segment"].astype(str)), NOT_LOADING)
    return recording.select(keep) if keep.any() else recording


def loading_path(replicates: Sequence[Replicate], points: int) -> np.ndarray:
    """Evenly spaced stretches or shear strains from rest to the farthest of one test's data, shape (points,).

    Shear may go both ways: there the path leads from one end to the other.
    """
    first = replicates[0]
    reached = np.concatenate([r.abscissa for r in replicates])
    start = min(reached.min(), first.rest) if first.test.kind.both_ways else first.rest
    return np.linspace(start, reached[np.argmax(first.test.kind.strain(reached))], points)


def _curve(recording: Recording, test: Test, path: Path) -> tuple[bool, np.ndarray, np.ndarray]:
    """Whether it is displacement and force, and the abscissa and nominal stress that they mean."""
    mechanical, direct = test.kind.channels
    if all(name in recording for name in mechanical) and (test.specimen is not None
                                                          or not all(name in recording for name in direct)):
        if test.specimen is None:
            raise InputError(f"{path.name} holds displacement and force, which need a [[specimen]] to become stress",
                             field="specimen")
        share = recording.displacement / test.specimen.height
        if test.kind.sign < 0 and share.max() >= 1:
            raise InputError(
                f"{path.name} goes to {recording.displacement.max() * 1e3:g} mm, deeper than the specimen "
                f"{test.specimen.name!r} is high ({test.specimen.height * 1e3:g} mm)", field="recordings")
        return True, test.kind.abscissa(share), test.kind.sign * recording.force / test.specimen.area
    if all(name in recording for name in direct) and isinstance(forward_model(test), Weighing):
        raise InputError(f"{path.name} holds {' and '.join(direct)}, which differ from slice to slice under gravity = "
                         f"true; give {' and '.join(mechanical)}, or set gravity = false", field="recordings")
    if all(name in recording for name in direct):
        return False, np.array(recording.channel(direct[0])), np.array(recording.channel(direct[1]))
    raise InputError(f"{path.name} has {', '.join(recording.channels)}; {test.kind.name} needs "
                     f"{' and '.join(mechanical)}, or {' and '.join(direct)}", field="recordings")


def _check_range(abscissa: np.ndarray, recording: Recording, test: Test, path: Path) -> None:
    if np.ptp(abscissa) == 0:
        names = [name for pair in test.kind.channels for name in pair[:1] if name in recording]
        raise InputError(f"{path.name} does not move: its {names[0]} has the same value in all {abscissa.size} samples "
                         "of loading; check which column it is read from", field="recordings")
    largest = test.kind.strain(abscissa).max()
    if not test.kind.both_ways and abscissa.min() <= 0:
        raise InputError(f"{path.name} reaches stretch {abscissa.min():g}; a stretch is above zero", field="recordings")
    if largest <= 0:
        raise InputError(f"{path.name} holds no {test.kind.motion}: its largest strain is {largest:g}; "
                         "check the kind, or turn the column with sign = -1", field="recordings")


def _check_sign(abscissa: np.ndarray, stress: np.ndarray, test: Test, path: Path) -> None:
    # Stress and strain together, so that shear may go both ways and a noisy zero does not decide.
    if np.sum(test.kind.sign * stress * test.kind.strain(abscissa)) <= 0:
        expected = "force above or stress below" if test.kind.sign < 0 else "force or stress above"
        raise InputError(f"{path.name} has a stress against the load; {test.kind.name} expects {expected} zero, so "
                         "turn the column with sign = -1", field="recordings")


def _noise(abscissa: np.ndarray, stress: np.ndarray, mechanical: bool, test: Test,
           campaign: Campaign) -> tuple[float, str]:
    """Standard deviation of the nominal stress, Pa, and whether it was stated."""
    if mechanical and campaign.noise.force is not None:
        return campaign.noise.force / test.specimen.area, "stated"
    if not mechanical and campaign.noise.nominal_stress is not None:
        return campaign.noise.nominal_stress, "stated"
    if not mechanical and campaign.noise.force is not None and test.specimen is not None:
        return campaign.noise.force / test.specimen.area, "stated"
    spread, rounding = estimate_noise(stress, abscissa), resolution(stress) / np.sqrt(12.0)
    return (spread, "estimated") if spread >= rounding else (rounding, "resolution")


def _evenly_spaced(abscissa: np.ndarray, test: Test, campaign: Campaign, path: Path) -> tuple[np.ndarray, csr_array]:
    """Evenly spaced strains from rest to the end of the window, and the linear interpolation onto them."""
    points, limit = campaign.fit.strain_points, np.inf if test.max_strain is None else test.max_strain
    strain, samples = np.unique(test.kind.strain(abscissa), return_index=True)
    start = max(strain[0], -limit if test.kind.both_ways else 0.0)
    grid = np.linspace(start, min(strain[-1], limit), points)
    inside = int(np.sum((strain >= grid[0]) & (strain <= grid[-1] * (1 + 1e-9))))
    if points > inside:
        raise InputError(f"{points} points, but {path.name} has {inside} samples of different strain in the window; "
                         f"give at most {inside}", file=campaign.path, field="fit.strain_points")
    right = np.clip(np.searchsorted(strain, grid), 1, strain.size - 1)
    share = (grid - strain[right - 1]) / (strain[right] - strain[right - 1])
    weights = np.concatenate([1.0 - share, share])
    places = np.tile(np.arange(points), 2), np.concatenate([samples[right - 1], samples[right]])
    interpolation = csr_array((weights, places), shape=(points, abscissa.size))
    return test.kind.abscissa(grid), interpolation
