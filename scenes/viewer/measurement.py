"""Measurement of a scene: replicates of one test, their mean and spread, the residual of the model, and uploaded files.

Uploaded recordings are files of tissue_sim, or files of test machines whose columns are recognised.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from scenes.viewer.shell import LARGEST_UPLOAD
from scenes.viewer.trace import interpolate_branch_force
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import STUDY_SPEED, Protocol
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.files import read_bytes
from tissue_sim.recording.file import read_recording, write_recording
from tissue_sim.recording.formats.guesses import ColumnGuess, TableGroup
from tissue_sim.recording.recording import MIN_POINTS, Recording, get_recorded_tool_if_different_or_empty
from tissue_sim.recording.segmentation import find_loading_and_unloading_indices


@dataclass(frozen=True)
class ResamplingPointCounts:
    """Numbers of points to which measured curves are resampled.

    Attributes:
        grid_points: Number of depths of the grid on which replicates are averaged.
        motion_samples: Number of samples of a measured motion that is simulated for comparison; the fast solver needs
            about 25 ms for 50.
        time_weight: Weight of time relative to path length in the distribution of these samples, 1. A larger weight
            places more samples in holds.
    """

    grid_points: int = 201
    motion_samples: int = 50
    time_weight: float = 0.25


#: Resolution of every comparison.
RESAMPLING = ResamplingPointCounts()


@dataclass(frozen=True, eq=False)
class BranchReplicateStatistics:
    """Statistics of one branch, loading or unloading, over the replicates on a grid of depths.

    All arrays have shape (n,) and are NaN at depths that a replicate does not reach.

    Attributes:
        mean: Mean force, N.
        low: Smallest force, N.
        high: Largest force, N.
        standard_deviation: Sample standard deviation of the force, N; None for one replicate.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    standard_deviation: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Measurement:
    """Replicates of one test, with their first loading and first unloading on a common grid of depths.

    Attributes:
        recordings: The replicates, with displacement and force.
        depth: Grid of depths, m, ascending from the smallest displacement (at least 0) to the largest one, shape (n,).
        load: Statistics of the first loading.
        unload: Statistics of the first unloading after it; None if no replicate has one.
        branches: Sample numbers of loading and unloading of each replicate, from `find_loading_and_unloading_indices`.
    """

    recordings: tuple[Recording, ...]
    depth: np.ndarray
    load: BranchReplicateStatistics
    unload: BranchReplicateStatistics | None
    branches: tuple[tuple[np.ndarray, np.ndarray], ...]

    @property
    def stated_test_kind(self) -> str | None:
        """Kind of test that the recordings state; None if they state none."""
        return next((str(each.metadata["kind"]) for each in self.recordings if "kind" in each.metadata), None)

    def describe_deviating_tool_or_empty(self, tool: Tool) -> str:
        """Describe the tool of the recordings if its shape, or its radius by more than 1 %, differs from a tool.

        Returns:
            The description; empty if the tools agree or the recordings state none.
        """
        return next(filter(
            None, (get_recorded_tool_if_different_or_empty(each, tool.shape, tool.radius) for each in self.recordings)),
                    "")

    @property
    def replicate_force_rms_scatter(self) -> float | None:
        """Root mean square over depths and branches of the standard deviation of replicates, N; None for one."""
        spreads = [each.standard_deviation for each in (self.load, self.unload)
                   if each is not None and each.standard_deviation is not None]
        known = np.concatenate([each[np.isfinite(each)] for each in spreads]) if spreads else np.empty(0)
        return float(np.sqrt(np.mean(known**2))) if known.size else None


@dataclass(frozen=True, eq=False)
class ForceResidualCurves:
    """Difference between model and measurement over depth, with its root mean square.

    Attributes:
        depth: Grid of the measurement, m, shape (n,).
        load: Model minus mean measured force in loading, N, shape (n,), NaN where one of the two is missing.
        unload: The same in unloading.
        rmse: Root mean square of model minus measured force over the samples of both branches of all replicates, N;
            samples at depths that the model does not reach, holds and reversals are excluded.
        samples: Number of samples in `rmse`.
    """

    depth: np.ndarray
    load: np.ndarray
    unload: np.ndarray
    rmse: float
    samples: int


def build_measurement_from_replicates(recordings: Sequence[Recording]) -> Measurement:
    """Build a measurement from replicates of one test.

    Raises:
        InputError: There is no recording, displacement or force is missing, a recording has too few samples, or the
            recordings are of different kinds of tests.
    """
    recordings = tuple(recordings)
    if not recordings:
        raise InputError("must contain at least one recording; got none. Name a recording file.", field="measurement")
    kinds: dict[Any, Any] = {}
    for recording in recordings:
        file = recording.metadata.get("source")
        for channel in ("displacement", "force"):
            if channel not in recording:
                raise InputError(f"must be a channel of the recording; got {', '.join(recording.channels)}",
                                 file=file, field=channel)
        if len(recording) < MIN_POINTS:
            raise InputError(f"must have at least {MIN_POINTS} samples; got {len(recording)}", file=file)
        if not recording.displacement.max() > max(0.0, recording.displacement[0]):
            raise InputError("must increase above its first value. Displacements are positive into the tissue; check "
                             "the sign.", file=file, field="displacement")
        kinds.setdefault(recording.metadata.get("kind"), file)
    named = [kind for kind in kinds if kind is not None]
    if len(named) > 1:
        raise InputError(f"must be the same in all recordings; got {named[0]} and {named[1]}. Give replicates of one "
                         "test.", file=kinds[named[1]], field="kind")
    grid = np.linspace(max(0.0, min(each.displacement.min() for each in recordings)),
                       max(each.displacement.max() for each in recordings), RESAMPLING.grid_points)
    branches = tuple(find_loading_and_unloading_indices(each) for each in recordings)
    unloadings = [unloading for _, unloading in branches if unloading.size]
    unload = None
    if unloadings:
        unloaded = [each for each, (_, unloading) in zip(recordings, branches, strict=True) if unloading.size]
        unload = _compute_replicate_statistics(unloaded, unloadings, -1, grid)
    load = _compute_replicate_statistics(recordings, [loading for loading, _ in branches], 1, grid)
    return Measurement(recordings, grid, load, unload, branches)


def _compute_replicate_statistics(recordings: Sequence[Recording], branches: Sequence[np.ndarray], direction: int,
                                  grid: np.ndarray) -> BranchReplicateStatistics:
    """Return the statistics of one branch per recording; `direction` is 1 for loading and -1 for unloading."""
    forces = np.array([interpolate_branch_force(each.displacement[branch], each.force[branch], direction, grid)
                       for each, branch in zip(recordings, branches, strict=True)])
    spread = forces.std(axis=0, ddof=1) if len(forces) > 1 else None
    return BranchReplicateStatistics(forces.mean(axis=0), forces.min(axis=0), forces.max(axis=0), spread)


def interpolate_loading_and_unloading(recording: Recording, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate loading and unloading of a recording to a grid of depths.

    The interpolant is a monotone cubic (Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300), because a
    simulation for comparison has few samples.

    Args:
        recording: The recording.
        grid: Depths, m, shape (n,).

    Returns:
        Force in loading and in unloading, N, each of shape (n,), NaN at depths that the branch does not reach.
    """
    load, unload = find_loading_and_unloading_indices(recording)
    return (_interpolate_branch_by_monotone_cubic(recording, load, 1, grid),
            _interpolate_branch_by_monotone_cubic(recording, unload, -1, grid))


def _interpolate_branch_by_monotone_cubic(recording: Recording, branch: np.ndarray, direction: int,
                                          depth: np.ndarray) -> np.ndarray:
    """Interpolate the force of one branch to depths by a monotone cubic, N; NaN at depths outside of the branch."""
    from scipy.interpolate import PchipInterpolator

    branch = branch[::direction]
    if branch.size < 2:
        return np.full(depth.shape, np.nan)
    x = recording.displacement[branch]
    # A sample at the end of the branch may lie outside by the rounding of its file.
    tolerance = 1e-9 * (x[-1] - x[0])
    inside = (depth >= x[0] - tolerance) & (depth <= x[-1] + tolerance)
    return np.where(inside, PchipInterpolator(x, recording.force[branch])(np.clip(depth, x[0], x[-1])), np.nan)


def compute_force_residual(model: Recording, measured: Measurement) -> ForceResidualCurves:
    """Compute model minus measurement.

    Args:
        model: Simulation of `make_first_cycle_motion_protocol(measured)`, or of another motion that reaches the same
            depths.
        measured: The measurement.

    Raises:
        InputError: The model reaches no sample of the measurement.
    """
    load, unload = interpolate_loading_and_unloading(model, measured.depth)
    model_branches = dict(zip((1, -1), find_loading_and_unloading_indices(model), strict=True))
    differences = []
    for recording, branches in zip(measured.recordings, measured.branches, strict=True):
        for direction, branch in zip((1, -1), branches, strict=True):
            force = _interpolate_branch_by_monotone_cubic(model, model_branches[direction], direction,
                                                          recording.displacement[branch])
            differences.append(force - recording.force[branch])
    errors = np.concatenate(differences)
    errors = errors[np.isfinite(errors)]
    if not errors.size:
        raise InputError("must reach the measured depths. Simulate the measured motion.", field="model")
    out = np.full(measured.depth.size, np.nan) if measured.unload is None else unload - measured.unload.mean
    return ForceResidualCurves(measured.depth, load - measured.load.mean, out, float(np.sqrt(np.mean(errors**2))),
                               errors.size)


def make_first_cycle_motion_protocol(measured: Measurement, *, samples: int = RESAMPLING.motion_samples,
                                     speed: float | None = None) -> Protocol:
    """Return a protocol of the measured motion with few samples, to simulate it for comparison.

    The motion is that of the typical replicate from its first sample to the end of its first unloading. The samples are
    distributed evenly over path length and time; the first and last samples of loading and unloading are kept.

    Args:
        measured: The measurement.
        samples: Largest number of samples; the result has about as many.
        speed: Speed for recordings without time, m/s; None: ``speed_mm_s`` of their metadata, or else the speed of the
            reference study.

    Raises:
        InputError: The speed is not positive.
    """
    recording, (load, unload) = find_typical_replicate_and_branches(measured)
    end = int(unload[-1] if unload.size else load[-1]) + 1
    depth = recording.displacement[:end]
    time = recording.time[:end] if "time" in recording else _compute_constant_speed_times(depth, recording, speed)
    # A protocol needs increasing times: keep the first of several samples with the same time.
    later = np.concatenate([[True], np.diff(np.maximum.accumulate(time)) > 0])
    kept = np.flatnonzero(later)
    time, depth = time[kept], depth[kept]
    ends = [0, load[0], load[-1], *([unload[0], unload[-1]] if unload.size else [])]
    corners = np.unique(np.minimum(np.searchsorted(kept, ends), kept.size - 1))
    chosen = np.union1d(corners,
                        _select_samples_even_in_path_and_time(time, depth, corners, max(samples - corners.size, 2)))
    labels = {name: values[:end][kept][chosen] for name, values in recording.labels.items()
              if values.dtype.kind in {"segment": "U", "cycle": "iu"}[name]}
    return Protocol(time[chosen], depth[chosen], **labels)


def find_typical_replicate_and_branches(measured: Measurement) -> tuple[Recording, tuple[np.ndarray, np.ndarray]]:
    """Return the replicate whose loading is nearest to the mean in least squares, and its `Measurement.branches`."""
    def compute_squared_deviation(pair) -> float:
        """Return the sum of the squared differences between the loading of a replicate and the mean loading, N^2."""
        recording, (loading, _) = pair
        force = interpolate_branch_force(recording.displacement[loading], recording.force[loading], 1, measured.depth)
        return float(np.nansum((force - measured.load.mean)**2))

    return min(zip(measured.recordings, measured.branches, strict=True), key=compute_squared_deviation)


def _compute_constant_speed_times(depth: np.ndarray, recording: Recording, speed: float | None) -> np.ndarray:
    """Return the times of a motion at constant speed, s, shape (n,)."""
    if speed is None:
        stated = recording.metadata.get("speed_mm_s")
        speed = stated * 1e-3 if isinstance(stated, int | float) and not isinstance(stated, bool) else STUDY_SPEED
    if not 0 < speed < np.inf:
        raise InputError(f"must be positive and finite; got {speed:g} m/s",
                         file=recording.metadata.get("source"), field="speed")
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(depth)))]) / speed


def _select_samples_even_in_path_and_time(time: np.ndarray, depth: np.ndarray, corners: np.ndarray,
                                          count: int) -> np.ndarray:
    """Return the numbers of about `count` samples that are evenly distributed over path length and time.

    The path length between two corners ignores reversals, which are noise.
    """
    path = np.zeros(depth.size)
    for begin, end in pairwise(corners.tolist()):
        travel = np.maximum.accumulate(np.sign(depth[end] - depth[begin]) * (depth[begin:end + 1] - depth[begin]))
        path[begin:end + 1] = path[begin] + np.maximum(travel, 0.0)
    measure = path / max(path[-1], 1e-12) + RESAMPLING.time_weight * (time - time[0]) / max(time[-1] - time[0], 1e-12)
    return np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], count)).clip(0, depth.size - 1))


def compute_force_residual_if_possible(model: Recording | None,
                                       measured: Measurement | None) -> ForceResidualCurves | None:
    """Return `compute_force_residual`; None if one of the two is missing or the model reaches no measured depth."""
    if model is None or measured is None:
        return None
    try:
        return compute_force_residual(model, measured)
    except InputError:
        return None


#: First line of a recording file of tissue_sim.
_OWN = re.compile(rb"^[^\n]*\b(displacement|force) \[")


@dataclass(frozen=True, eq=False)
class UploadedRecordingOrSidecar:
    """Uploaded recording, or uploaded sidecar of a recording.

    Attributes:
        name: File name without unsafe characters.
        content: Content of the file in the format of tissue_sim.
        measured: The recording; None for a sidecar.
        sidecar: Metadata of the sidecar; None for a recording.
        understood: Sentences about the interpretation of a test-machine file.
        origin: Name and SHA-256 of the test-machine file from which the recording was converted; otherwise None.
    """

    name: str
    content: bytes
    measured: Measurement | None = None
    sidecar: Mapping[str, Any] | None = None
    understood: tuple[str, ...] = ()
    origin: Mapping[str, str] | None = None

    @property
    def file_stem(self) -> str:
        """File name without suffix, which a recording and its sidecar share."""
        return Path(self.name).stem


def read_uploaded_recordings_or_sidecar(name: str, content: bytes) -> tuple[UploadedRecordingOrSidecar, ...]:
    """Read an uploaded file; any thread may call this function.

    Args:
        name: Name of the file on the user's computer: ``NAME.csv``, its sidecar ``NAME.json``, or a file of a test
            machine, which may contain several recordings.
        content: Content of the file.

    Returns:
        The recordings of the file, or its sidecar.

    Raises:
        InputError: The file is too large, cannot be read, or contains no force over a displacement.
    """
    name = re.sub(r"[^\w .()+-]", "_", PureWindowsPath(name).name).strip(" .")[-100:] or "unnamed"
    if len(content) > LARGEST_UPLOAD:
        raise InputError(f"must be at most {LARGEST_UPLOAD / 1e6:g} MB; got {len(content) / 1e6:.1f} MB. Upload a "
                         "shorter recording.", file=name)
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            match path.suffix.lower():
                case ".json":
                    return (_make_sidecar_upload(path, content),)
                case ".csv" if _OWN.match(content[:1000]):
                    recording = read_recording(path).with_metadata(source=name)
                    return (UploadedRecordingOrSidecar(name, content, build_measurement_from_replicates([recording])),)
                case _:
                    return _convert_machine_file_to_uploads(path,
                                                            {"file": name,
                                                             "sha256": hashlib.sha256(content).hexdigest()})
        except InputError as error:
            raise InputError(error.problem, file=name, line=error.line, field=error.field) from None


def _make_sidecar_upload(path: Path, content: bytes) -> UploadedRecordingOrSidecar:
    """Return the upload of a sidecar; raise an `InputError` unless the file contains a JSON object."""
    metadata = read_json_value(path, "the sidecar of a recording (JSON)")
    if not isinstance(metadata, dict):
        raise InputError("must be a JSON object {...} with the metadata of a recording. Upload the file that was "
                         "written next to the recording.")
    return UploadedRecordingOrSidecar(path.name, content, sidecar=metadata)


def _convert_machine_file_to_uploads(path: Path, origin: Mapping[str, str]) -> tuple[UploadedRecordingOrSidecar, ...]:
    """Convert the recordings of a test-machine file to the format of tissue_sim; number them if there are several."""
    # Imported here so that the page starts without the file parsers.
    from tissue_sim.recording.formats.understanding import interpret_file

    found = run_in_sandbox(interpret_file, path, file=path)
    recordings = [(reading, recording) for reading in found.readings
                  for recording in _require_channels_and_get_recordings(reading)]
    uploads = []
    for number, (reading, recording) in enumerate(recordings, start=1):
        stem = path.stem if len(recordings) == 1 else f"{path.stem}_{number}"
        own = path.with_name(f"{stem}.csv") if path.suffix != ".csv" else path.with_name(f"{stem}.own.csv")
        kept = Recording({name: recording.channel(name) for name in ("time", "displacement", "force")
                          if name in recording}, {}, {"name": stem})
        write_recording(kept, own)
        uploads.append(UploadedRecordingOrSidecar(f"{stem}.csv", read_bytes(own, "a recording"),
                                                  build_measurement_from_replicates(
                                                      [kept.with_metadata(source=path.name)]),
                                                  understood=(_describe_column_channels(reading, found.format),
                                                              *reading.remarks, *found.warnings),
                                                  origin=origin))
    return tuple(uploads)


def _require_channels_and_get_recordings(reading: TableGroup) -> tuple[Recording, ...]:
    """Return all recordings of a reading that has displacement, force and their units.

    Raises:
        InputError: Displacement, force or a unit is missing.
    """
    channels = {column.channel for column in reading.columns}
    if not {"displacement", "force"} <= channels:
        raise InputError(f"must contain displacement and force; got {' and '.join(sorted(channels - {'time'}))}. Use "
                         "tissue-sim calibrate for other quantities.")
    if reading.missing_information_texts:
        raise InputError(
            f"does not state {', '.join(reading.missing_information_texts)}. Write the unit into the header, as "
            "in 'Load (N)', or use tissue-sim import.")
    return reading.recordings


def _describe_column_channels(reading: TableGroup, machine: str) -> str:
    """Return a sentence that states which column was read as which channel."""
    columns = ", ".join(f"{column.channel} from {_describe_column_header_unit_and_sign(column)}"
                        for column in reading.columns)
    return f"{columns}{'' if machine == 'table' else f' (a file of {machine})'}"


def _describe_column_header_unit_and_sign(column: ColumnGuess) -> str:
    """Return header (or number), unit and a changed sign of a column as text."""
    sign = ", its sign changed" if column.sign < 0 else ""
    return f"{repr(column.header) if column.header else f'column {column.place}'} in {column.unit}{sign}"
