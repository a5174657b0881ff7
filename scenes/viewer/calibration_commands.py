"""What a viewer may ask a session for about calibration, and what becomes of a result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import tissue_sim as ts
from scenes.viewer.calibration_run import CalibrationRun
from scenes.viewer.material_files import new_file
from scenes.viewer.recording_upload import Upload
from scenes.viewer.scene import Scene
from tissue_sim.atomic_write import write_bytes
from tissue_sim.errors import InputError

#: Of a material that was calibrated on the page and not saved yet.
CALIBRATED = "calibrated here"


class Calibrating(Protocol):
    """A session, as far as it is needed here."""

    scene: Scene
    calibration: CalibrationRun

    def use_material(self, material: ts.Material, source: str) -> None:
        """Look at another material."""


def take_result(session: Calibrating) -> None:
    """Put what was calibrated under the needle, with the recordings as the scene's measurement, once it is there.

    Where the scene has become another test meanwhile or refuses the material, or the fit is unusable, that is said and
    nothing is changed.
    """
    run = session.calibration
    result = run.poll()
    if result is None or run.scene is None:
        return
    if result.unusable:
        run.complain("Nobody should work with what came out, as it says below, so it is not under the needle.")
        return
    before = session.scene
    if before.kind is not run.scene.kind or before.experiment != run.scene.experiment:
        run.complain("The scene has become another one while this was calibrated, so its material is not shown; save "
                     "it, or go back and calibrate again.")
        return
    session.scene = replace(before, measurements={**before.measurements, before.kind.name: run.measured})
    try:
        session.use_material(result.material, CALIBRATED)
    except InputError as error:
        session.scene = before
        run.complain(f"{error} The material stays as it was.")


def _save(session: Calibrating, folder: Path, name: str) -> None:
    """Write the material file of the newest result into a new file of a folder.

    Raises:
        InputError: there is no result, or a name that is taken, or none.
    """
    result = session.calibration.state.result
    if result is None:
        raise InputError("nothing was calibrated yet")
    path = new_file(folder, name)
    write_bytes(path, result.file)
    if session.scene.source == CALIBRATED and session.scene.material == result.material:
        session.scene = replace(session.scene, source=path.name)


def _add(session: Calibrating, uploads: Sequence[Upload]) -> None:
    session.calibration.add(uploads)


def _remove(session: Calibrating) -> None:
    session.calibration.remove_all()


def _begin(session: Calibrating) -> None:
    session.calibration.begin(session.scene)


def _cancel(session: Calibrating) -> None:
    session.calibration.cancel()


#: By name; what each raises is said to the one who asked.
CALIBRATION_COMMANDS: dict[str, Callable[..., None]] = {
    "add_recordings": _add,
    "remove_recordings": _remove,
    "calibrate": _begin,
    "cancel_calibration": _cancel,
    "save_calibration": _save,
}
