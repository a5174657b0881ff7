"""Uploaded recordings, and the calibration of the scene's material with them: its process and its commands."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from calibration.tasks.process_pool import ProcessPool
from scenes.viewer.calibration_task import (
    PROGRESS_FILE,
    RECORDINGS,
    CalibrationRequest,
    CalibrationResult,
    FitProgress,
    calibrate_uploaded_files,
    read_fit_progress_or_none,
)
from scenes.viewer.material_files import require_unused_material_path
from scenes.viewer.measurement import Measurement, UploadedRecordingOrSidecar, build_measurement_from_replicates
from scenes.viewer.scene import Scene
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError, WorkerError, shorten_text_in_middle
from tissue_sim.files import write_bytes
from tissue_sim.material.material import Material
from tissue_sim.recording.recording import Recording

_logger = logging.getLogger(__name__)

#: Source of a material that was calibrated on the page and is not saved yet.
CALIBRATED = "calibrated here"


@dataclass(frozen=True)
class RecordingCountAndReplicateLimits:
    """Limits of the recordings of a calibration.

    Attributes:
        max_recordings: Largest number of recordings.
        replicate_tolerance: Largest relative difference of depth and of speed between replicates, 1, as in the package
            `calibration`. A larger value groups tests of different speeds.
    """

    max_recordings: int = 50
    replicate_tolerance: float = 0.2


#: Limits of every calibration.
LIMITS = RecordingCountAndReplicateLimits()


@dataclass(frozen=True, eq=False)
class UploadedRecording:
    """Uploaded recording with its sidecar; SI units.

    Attributes:
        file: The uploaded file.
        measured: The recording as a measurement of one replicate.
        sidecar: The uploaded sidecar; None if there is none.
    """

    file: UploadedRecordingOrSidecar
    measured: Measurement
    sidecar: UploadedRecordingOrSidecar | None = None

    @property
    def recording(self) -> Recording:
        """The recording, with the metadata of its sidecar."""
        return self.measured.recordings[0]

    @property
    def max_displacement(self) -> float:
        """Largest displacement of the recording, m."""
        return float(self.recording.displacement.max())

    @property
    def recording_duration_or_none(self) -> float | None:
        """Duration of the recording, s; None if it has no time."""
        return float(self.recording.time[-1] - self.recording.time[0]) if "time" in self.recording else None

    @property
    def first_loading_mean_speed_or_none(self) -> float | None:
        """Mean speed of the first loading, m/s; None if the recording has no time."""
        loading, _ = self.measured.branches[0]
        if "time" not in self.recording:
            return None
        duration = float(self.recording.time[loading[-1]] - self.recording.time[loading[0]])
        travel = float(self.recording.displacement[loading[-1]] - self.recording.displacement[loading[0]])
        return travel / duration if duration > 0 else None

    @property
    def stated_tool_text(self) -> str:
        """Tool that the sidecar states, such as "flat, radius 8 mm"; empty if it states none."""
        stated = self.recording.metadata.get("tool")
        if not isinstance(stated, Mapping) or "shape" not in stated:
            return ""
        radius = stated.get("radius_mm")
        return f"{stated['shape']}{f', radius {radius:g} mm' if isinstance(radius, (int, float)) else ''}"

    def list_scene_mismatches(self, scene: Scene) -> tuple[str, ...]:
        """Return sentences about differences between the recording and a scene: kind of test, tool, depth."""
        sentences = []
        kind, tool = self.measured.stated_test_kind, self.measured.describe_deviating_tool_or_empty(
            scene.experiment.tool)
        if kind is not None and kind != scene.kind.name:
            sentences.append(f"The recording is a {kind}; the scene is a {scene.kind.name}.")
        if tool:
            sentences.append(f"The recording was measured with a {tool}; the scene has another tool.")
        if self.max_displacement >= scene.experiment.specimen.height:
            sentences.append(f"The recording has a depth of {self.max_displacement * 1e3:.4g} mm; the height of the "
                             f"specimen is {scene.experiment.specimen.height * 1e3:.4g} mm.")
        return tuple(sentences)


@dataclass(frozen=True, eq=False)
class CalibrationState:
    """State of the calibration for a page; each change creates a new object.

    Attributes:
        recordings: Uploaded recordings in order of upload.
        status: Progress of the running fit; None if no fit runs.
        result: Result of the last successful fit; None before.
        problem: Why the last fit gave no usable result; empty otherwise.
    """

    recordings: tuple[UploadedRecording, ...] = ()
    status: FitProgress | None = None
    result: CalibrationResult | None = None
    problem: str = ""


class SessionCalibrations:
    """Holds uploaded recordings and runs one fit at a time in another process; call `close` at the end.

    Attributes:
        state: State for the page.
        scene: Scene for which the newest fit was started; None before the first fit.
    """

    def __init__(self) -> None:
        self._pool = ProcessPool(1)
        #: Sidecars that were uploaded before their recordings, by the stem of the recording.
        self._waiting: dict[str, UploadedRecordingOrSidecar] = {}
        self._computed: Future | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        self.state = CalibrationState()
        self.scene: Scene | None = None

    def add_uploads_atomically(self, uploads: Sequence[UploadedRecordingOrSidecar]) -> None:
        """Add the recordings or the sidecar of an uploaded file; add all of them or, on an error, none.

        Raises:
            InputError: A fit runs, a recording of this name exists, a sidecar belongs to another file, or there are
                too many recordings.
        """
        self._raise_if_fit_runs()
        before, waiting = self.state, dict(self._waiting)
        try:
            for upload in uploads:
                self._add_upload(upload)
        except InputError:
            self.state, self._waiting = before, waiting
            raise

    def _add_upload(self, upload: UploadedRecordingOrSidecar) -> None:
        """Add one recording, or the sidecar of one; a sidecar is kept until its recording is uploaded."""
        present = self.state.recordings
        if upload.measured is None:
            number = next((i for i, each in enumerate(present) if each.file.file_stem == upload.file_stem), None)
            if number is None:
                self._waiting[upload.file_stem] = upload
                return
            changed = (*present[:number], _combine_with_sidecar(present[number].file, upload), *present[number + 1:])
            self.state = replace(self.state, recordings=changed)
            return
        if any(each.file.file_stem.lower() == upload.file_stem.lower() for each in present):
            raise InputError("A recording of this name was uploaded before. Rename one of the files, or remove all "
                             "recordings.", file=upload.name)
        if len(present) >= LIMITS.max_recordings:
            raise InputError("The recording was not added: a calibration takes at most "
                             f"{LIMITS.max_recordings} recordings.",
                             file=upload.name)
        new = _combine_with_sidecar(upload, self._waiting.get(upload.file_stem))
        self._waiting.pop(upload.file_stem, None)
        self.state = replace(self.state, recordings=(*present, new))

    def remove_recordings_but_keep_result(self) -> None:
        """Remove all recordings; keep the last result.

        Raises:
            InputError: A fit runs.
        """
        self._raise_if_fit_runs()
        self._waiting.clear()
        self.state = replace(self.state, recordings=())

    @property
    def combined_measurement_or_raise(self) -> Measurement:
        """Measurement of all recordings.

        Raises:
            InputError: There is no recording, or the recordings are of different kinds of tests.
        """
        if not self.state.recordings:
            raise InputError("There is no recording. Upload a recording first.")
        return build_measurement_from_replicates([each.recording for each in self.state.recordings])

    def start_fit(self, scene: Scene) -> None:
        """Start a fit of the scene's material to the recordings, with its parameters as start values.

        Raises:
            InputError: A fit runs, there is no recording, the recordings are of different kinds of tests, or the
                process does not start.
        """
        self._raise_if_fit_runs()
        _ = self.combined_measurement_or_raise  # raises if the recordings are of different kinds
        request = CalibrationRequest(scene.kind.name, scene.experiment, scene.rig, scene.material,
                                     group_replicate_file_names(self.state.recordings),
                                     {each.file.name: each.file.origin for each in self.state.recordings
                                      if each.file.origin is not None})
        folder = tempfile.TemporaryDirectory(prefix="tissue_sim_")
        try:
            for each in self.state.recordings:
                write_bytes(Path(folder.name) / RECORDINGS / each.file.name, each.file.content)
                if each.sidecar is not None:
                    write_bytes(Path(folder.name) / RECORDINGS / f"{each.file.file_stem}.json", each.sidecar.content)
            self._computed = self._pool.submit(calibrate_uploaded_files, (folder.name, request))
        except WorkerError as error:
            folder.cleanup()
            raise InputError(str(error)) from None
        except BaseException:
            folder.cleanup()
            raise
        self._folder, self.scene = folder, scene
        self.state = replace(self.state, status=FitProgress("starting"), problem="")

    def cancel_fit(self) -> None:
        """Stop the running fit; material and last result are unchanged.

        Raises:
            InputError: No fit runs.
        """
        if self._computed is None:
            raise InputError("No calibration is running.")
        self._pool.abandon_tasks()
        self._delete_fit_folder_and_set_outcome(problem="The calibration was cancelled. The material is unchanged.")

    def poll_fit_for_new_result(self) -> CalibrationResult | None:
        """Update the state from the process of the fit.

        Returns:
            The result, once, when the fit has ended successfully; otherwise None.
        """
        if self._computed is None or self._folder is None:
            return None
        if not self._computed.done():
            status = read_fit_progress_or_none(Path(self._folder.name) / PROGRESS_FILE)
            if status is not None and status != self.state.status:
                self.state = replace(self.state, status=status)
            return None
        try:
            result = self._computed.result()
        except (ConvergenceError, InputError, MissingBackendError) as error:
            self._delete_fit_folder_and_set_outcome(problem=f"{error} The material is unchanged.")
        except self._pool.death:
            self._delete_fit_folder_and_set_outcome(
                problem="The calibration process has died. The material is unchanged. Press "
                "Calibrate to try again.")
        except Exception as error:  # a programming error in the fit must not stop the running simulation
            _logger.exception("the calibration failed with an internal error")
            self._delete_fit_folder_and_set_outcome(
                problem=f"The calibration failed with an internal error ({type(error).__name__}: "
                f"{shorten_text_in_middle(str(error), 200)}). The material is unchanged.")
        else:
            self._delete_fit_folder_and_set_outcome(result=result)
            return result
        return None

    def set_problem_message(self, problem: str) -> None:
        """Set the message of the state that explains why the last result is not in use."""
        self.state = replace(self.state, problem=problem)

    def close(self) -> None:
        """Stop the process and delete its folder."""
        self._pool.abandon_tasks()
        self._delete_fit_folder_and_set_outcome()

    def _raise_if_fit_runs(self) -> None:
        """Raise InputError if a fit runs."""
        if self._computed is not None:
            raise InputError("A calibration is running. Wait for its end, or cancel it.")

    def _delete_fit_folder_and_set_outcome(self, result: CalibrationResult | None = None, problem: str = "") -> None:
        """Delete the folder of the fit, and store its result or problem."""
        self._computed = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None
        self.state = replace(self.state, status=None, result=self.state.result if result is None else result,
                             problem=problem)


def group_replicate_file_names(recordings: Sequence[UploadedRecording]) -> tuple[tuple[str, ...], ...]:
    """Group recordings into tests; a recording joins the first test whose first recording has its depth and speed.

    Returns:
        File names of the replicates of each test.
    """
    groups: list[list[UploadedRecording]] = []
    for each in recordings:
        group = next((group for group in groups if _have_similar_depth_and_speed(group[0], each)), None)
        if group is None:
            groups.append([each])
        else:
            group.append(each)
    return tuple(tuple(each.file.name for each in group) for group in groups)


def _have_similar_depth_and_speed(first: UploadedRecording, second: UploadedRecording) -> bool:
    """Return whether depths and speeds differ by at most the replicate tolerance; an unknown speed agrees."""
    pairs = [(first.max_displacement, second.max_displacement),
             (first.first_loading_mean_speed_or_none, second.first_loading_mean_speed_or_none)]
    return all(a is None or b is None or max(a, b) <= (1.0 + LIMITS.replicate_tolerance) * min(a, b) for a, b in pairs)


def _combine_with_sidecar(file: UploadedRecordingOrSidecar,
                          sidecar: UploadedRecordingOrSidecar | None) -> UploadedRecording:
    """Combine a recording with the metadata of its sidecar.

    Raises:
        InputError: The SHA-256 in the sidecar differs from that of the recording.
    """
    assert file.measured is not None
    recording = file.measured.recordings[0]
    if sidecar is None or sidecar.sidecar is None:
        return UploadedRecording(file, file.measured)
    own = recording.metadata.get("sha256")
    if sidecar.sidecar.get("sha256", own) != own:
        raise InputError(f"must be the SHA-256 of {file.name}. The recording was changed after the sidecar was "
                         "written; upload the original files.", file=sidecar.name, field="sha256")
    metadata = {key: value for key, value in sidecar.sidecar.items() if key not in ("source", "sha256")}
    return UploadedRecording(file, build_measurement_from_replicates([recording.with_metadata(**metadata)]), sidecar)


class SessionWithCalibration(Protocol):
    """Part of a session that the calibration commands use.

    Attributes:
        scene: The displayed scene.
        calibration: Recordings and fit of the session.
    """

    scene: Scene
    calibration: SessionCalibrations

    def replace_material_restart_if_needed(self, material: Material, source: str) -> None:
        """Replace the material of the scene; raise InputError if the simulation refuses the material."""


def use_finished_calibration_in_scene(session: SessionWithCalibration) -> None:
    """Use a finished calibration in the scene: its material, and its recordings as the measurement.

    The scene is unchanged, and the calibration state gets a message, if the fit is unusable, if the scene has changed
    to another test since the start of the fit, or if the simulation refuses the material. Without a new result the
    function does nothing.
    """
    run = session.calibration
    result = run.poll_fit_for_new_result()
    if result is None or run.scene is None:
        return
    if result.unusable:
        run.set_problem_message("The fit is unusable for the reason given below. The material of the scene is "
                                "unchanged.")
        return
    before = session.scene
    if before.kind is not run.scene.kind or before.experiment != run.scene.experiment:
        run.set_problem_message("The scene changed during the calibration, so the calibrated material is not in use. "
                                "Save the material, or return to the previous scene and calibrate again.")
        return
    session.scene = replace(before,
                            measurements={**before.measurements, before.kind.name: run.combined_measurement_or_raise})
    try:
        session.replace_material_restart_if_needed(result.material, CALIBRATED)
    except InputError as error:
        session.scene = before
        run.set_problem_message(f"{error} The material is unchanged.")


def _write_calibrated_material_to_new_file(session: SessionWithCalibration, folder: Path, name: str) -> None:
    """Write the material file of the newest result into a new file of a folder.

    Raises:
        InputError: There is no result, the name is empty, or the file exists already.
    """
    result = session.calibration.state.result
    if result is None:
        raise InputError("There is no calibrated material yet. Press Calibrate first.")
    path = require_unused_material_path(folder, name)
    write_bytes(path, result.file)
    if session.scene.source == CALIBRATED and session.scene.material == result.material:
        session.scene = replace(session.scene, source=path.name)


def _add_recordings(session: SessionWithCalibration, uploads: Sequence[UploadedRecordingOrSidecar]) -> None:
    """Add all uploaded files to the calibration, or none of them if one is refused with an InputError."""
    session.calibration.add_uploads_atomically(uploads)


def _remove_recordings(session: SessionWithCalibration) -> None:
    """Remove all uploaded recordings; keep the last result."""
    session.calibration.remove_recordings_but_keep_result()


def _begin_fit(session: SessionWithCalibration) -> None:
    """Start a fit of the material of the displayed scene to the uploaded recordings."""
    session.calibration.start_fit(session.scene)


def _cancel_running_fit_or_raise(session: SessionWithCalibration) -> None:
    """Stop the running fit; raise InputError if no fit runs."""
    session.calibration.cancel_fit()


#: Calibration commands by name; the reply of a command contains the message of its InputError.
CALIBRATION_COMMANDS: dict[str, Callable[..., None]] = {
    "add_recordings": _add_recordings,
    "remove_recordings": _remove_recordings,
    "calibrate": _begin_fit,
    "cancel_calibration": _cancel_running_fit_or_raise,
    "save_calibration": _write_calibrated_material_to_new_file,
}
