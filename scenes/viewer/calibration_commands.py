"""Calibration commands of a session, and use of the calibrated material in the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import tissue_sim as ts
from scenes.viewer.calibration_run import SessionCalibrations
from scenes.viewer.material_files import require_unused_material_path
from scenes.viewer.recording_upload import UploadedRecordingOrSidecar
from scenes.viewer.scene import Scene
from tissue_sim.atomic_write import write_bytes
from tissue_sim.errors import InputError

#: Source of a material that was calibrated on the page and is not saved yet.
CALIBRATED = "calibrated here"


class SessionWithCalibration(Protocol):
    """Part of a session that the calibration commands use.

    Attributes:
        scene: The displayed scene.
        calibration: Recordings and fit of the session.
    """

    scene: Scene
    calibration: SessionCalibrations

    def replace_material_restart_if_needed(self, material: ts.Material, source: str) -> None:
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
