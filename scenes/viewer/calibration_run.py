"""Recordings that were uploaded, and the calibration of a scene's material with them; no browser in it."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path

from calibration.tasks.errors import WorkerError
from calibration.tasks.process_pool import ProcessPool
from scenes.viewer.calibration_task import PROGRESS_FILE, RECORDINGS, Calibrated, Wanted, calibrate_files
from scenes.viewer.measurement import Measurement, measurement
from scenes.viewer.recording_upload import Upload
from scenes.viewer.scene import Scene
from tissue_sim.atomic_write import write_bytes
from tissue_sim.decode import read_json
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError, shortened
from tissue_sim.recording.recording import Recording

_logger = logging.getLogger(__name__)
#: How many recordings a calibration takes.
MOST_RECORDINGS = 50
#: Recordings whose depth and speed differ by no more than this share are replicates, as the calibration has it.
_ALIKE = 0.2


@dataclass(frozen=True, eq=False)
class Uploaded:
    """A recording with its sidecar, and what was understood of it; SI.

    Attributes:
        file, sidecar: as they came; the sidecar is None where none came.
        measured: the recording.
    """

    file: Upload
    measured: Measurement
    sidecar: Upload | None = None

    @property
    def recording(self) -> Recording:
        """The recording itself."""
        return self.measured.recordings[0]

    @property
    def depth(self) -> float:
        """Largest, m."""
        return float(self.recording.displacement.max())

    @property
    def duration(self) -> float | None:
        """s; None without a time."""
        return float(self.recording.time[-1] - self.recording.time[0]) if "time" in self.recording else None

    @property
    def speed(self) -> float | None:
        """Mean way over time of the first loading, m/s; None without a time."""
        way, _ = self.measured.ways[0]
        if "time" not in self.recording:
            return None
        taken = float(self.recording.time[way[-1]] - self.recording.time[way[0]])
        gone = float(self.recording.displacement[way[-1]] - self.recording.displacement[way[0]])
        return gone / taken if taken > 0 else None

    @property
    def tool(self) -> str:
        """As its sidecar says it; empty where it does not."""
        said = self.recording.metadata.get("tool")
        if not isinstance(said, Mapping) or "shape" not in said:
            return ""
        radius = said.get("radius_mm")
        return f"{said['shape']}{f', radius {radius:g} mm' if isinstance(radius, (int, float)) else ''}"

    def warnings(self, scene: Scene) -> tuple[str, ...]:
        """Why it may not belong to a scene, sentences."""
        said = []
        kind, tool = self.measured.kind, self.measured.other_tool(scene.experiment.tool)
        if kind is not None and kind != scene.kind.name:
            said.append(f"is a {kind}, and the scene is a {scene.kind.name}")
        if tool:
            said.append(f"was measured with a {tool}, and the scene has another tool")
        if self.depth >= scene.experiment.specimen.height:
            said.append(f"goes to {self.depth * 1e3:.4g} mm, and the specimen is "
                        f"{scene.experiment.specimen.height * 1e3:.4g} mm high")
        return tuple(said)


@dataclass(frozen=True)
class Told:
    """How far a fit is: what it does, simulations so far, root mean square misfit (N), parameters (SI) and the SI unit
    of each."""

    sentence: str
    solves: int = 0
    rmse: float | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class CalibrationState:
    """What a page shows; a new object where something in it is new.

    Attributes:
        recordings: that were uploaded, in order.
        told: how far the fit is; None where none runs.
        result: of the last fit. problem: why the last one has none; empty where it has.
    """

    recordings: tuple[Uploaded, ...] = ()
    told: Told | None = None
    result: Calibrated | None = None
    problem: str = ""


class CalibrationRun:
    """Holds the recordings, runs one fit at a time in another process, and knows what came out. Close it.

    Attributes:
        state: for the page.
        scene: that the newest fit was asked for; None before.
    """

    def __init__(self) -> None:
        self._pool = ProcessPool(1)
        #: Sidecars by the stem of recordings that are still to come.
        self._waiting: dict[str, Upload] = {}
        self._computed: Future | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        self.state = CalibrationState()
        self.scene: Scene | None = None

    def add(self, uploads: Sequence[Upload]) -> None:
        """Take what was in a file.

        Raises:
            InputError: a fit runs, a name that is there already, a sidecar of another file, or too many; nothing is
                changed.
        """
        self._require_rest()
        before, waiting = self.state, dict(self._waiting)
        try:
            for upload in uploads:
                self._add(upload)
        except InputError:
            self.state, self._waiting = before, waiting
            raise

    def _add(self, upload: Upload) -> None:
        there = self.state.recordings
        if upload.measured is None:
            number = next((i for i, each in enumerate(there) if each.file.stem == upload.stem), None)
            if number is None:
                self._waiting[upload.stem] = upload
                return
            joined = (*there[:number], _joined(there[number].file, upload), *there[number + 1:])
            self.state = replace(self.state, recordings=joined)
            return
        if any(each.file.stem.lower() == upload.stem.lower() for each in there):
            raise InputError("is here already; rename one of the two, or remove all", file=upload.name)
        if len(there) >= MOST_RECORDINGS:
            raise InputError(f"is one too many; a calibration takes {MOST_RECORDINGS} recordings", file=upload.name)
        new = _joined(upload, self._waiting.get(upload.stem))
        self._waiting.pop(upload.stem, None)
        self.state = replace(self.state, recordings=(*there, new))

    def remove_all(self) -> None:
        """Forget all recordings; what was found stays.

        Raises:
            InputError: a fit runs.
        """
        self._require_rest()
        self._waiting.clear()
        self.state = replace(self.state, recordings=())

    @property
    def measured(self) -> Measurement:
        """All recordings.

        Raises:
            InputError: there is none, or they are of different tests.
        """
        if not self.state.recordings:
            raise InputError("there is no recording; upload one first")
        return measurement([each.recording for each in self.state.recordings])

    def begin(self, scene: Scene) -> None:
        """Fit the material of a scene to the recordings, from its parameters on.

        Raises:
            InputError: a fit runs, there is no recording, they are of different tests, or no process starts.
        """
        self._require_rest()
        _ = self.measured  # refuses what cannot be shown together
        wanted = Wanted(scene.kind.name, scene.experiment, scene.rig, scene.material,
                        replicates(self.state.recordings),
                        {each.file.name: each.file.origin for each in self.state.recordings
                         if each.file.origin is not None})
        folder = tempfile.TemporaryDirectory(prefix="tissue_sim_")
        try:
            for each in self.state.recordings:
                write_bytes(Path(folder.name) / RECORDINGS / each.file.name, each.file.content)
                if each.sidecar is not None:
                    write_bytes(Path(folder.name) / RECORDINGS / f"{each.file.stem}.json", each.sidecar.content)
            self._computed = self._pool.submit(calibrate_files, (folder.name, wanted))
        except WorkerError as error:
            folder.cleanup()
            raise InputError(str(error)) from None
        except BaseException:
            folder.cleanup()
            raise
        self._folder, self.scene = folder, scene
        self.state = replace(self.state, told=Told("starting"), problem="")

    def cancel(self) -> None:
        """End the fit, whatever it does; all stays as it was.

        Raises:
            InputError: none runs.
        """
        if self._computed is None:
            raise InputError("no calibration runs")
        self._pool.stop()
        self._end(problem="The calibration was cancelled; the material stays as it was.")

    def poll(self) -> Calibrated | None:
        """What came out, once; None while nothing has. Reads how far the fit is."""
        if self._computed is None or self._folder is None:
            return None
        if not self._computed.done():
            told = _read_told(Path(self._folder.name) / PROGRESS_FILE)
            if told is not None and told != self.state.told:
                self.state = replace(self.state, told=told)
            return None
        try:
            result = self._computed.result()
        except (ConvergenceError, InputError, MissingBackendError) as error:
            self._end(problem=f"{error} The material stays as it was.")
        except self._pool.death:
            self._end(problem="The process that calibrates has died; the material stays as it was. Try again.")
        except Exception as error:  # a fault of ours must not end the simulation beside it
            _logger.exception("the calibration has failed")
            self._end(problem=f"The calibration has failed, which should not happen ({type(error).__name__}: "
                              f"{shortened(str(error), 200)}); the material stays as it was.")
        else:
            self._end(result=result)
            return result
        return None

    def complain(self, problem: str) -> None:
        """Say beside a result why it is not shown."""
        self.state = replace(self.state, problem=problem)

    def close(self) -> None:
        """End the process and remove its folder."""
        self._pool.stop()
        self._end()

    def _require_rest(self) -> None:
        if self._computed is not None:
            raise InputError("a calibration runs; wait for it, or cancel it")

    def _end(self, result: Calibrated | None = None, problem: str = "") -> None:
        self._computed = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None
        self.state = replace(self.state, told=None, result=self.state.result if result is None else result,
                             problem=problem)


def replicates(recordings: Sequence[Uploaded]) -> tuple[tuple[str, ...], ...]:
    """Names of the files of each test: recordings that go as deep and as fast as its first one are replicates."""
    groups: list[list[Uploaded]] = []
    for each in recordings:
        group = next((group for group in groups if _alike(group[0], each)), None)
        if group is None:
            groups.append([each])
        else:
            group.append(each)
    return tuple(tuple(each.file.name for each in group) for group in groups)


def _alike(first: Uploaded, second: Uploaded) -> bool:
    pairs = [(first.depth, second.depth), (first.speed, second.speed)]
    return all(a is None or b is None or max(a, b) <= (1.0 + _ALIKE) * min(a, b) for a, b in pairs)


def _joined(file: Upload, sidecar: Upload | None) -> Uploaded:
    """A recording with the metadata of its sidecar.

    Raises:
        InputError: the sidecar of a file with other bytes.
    """
    assert file.measured is not None
    recording = file.measured.recordings[0]
    if sidecar is None or sidecar.sidecar is None:
        return Uploaded(file, file.measured)
    own = recording.metadata.get("sha256")
    if sidecar.sidecar.get("sha256", own) != own:
        raise InputError(f"{file.name} was changed after it was recorded, expected the SHA-256 given here",
                         file=sidecar.name, field="sha256")
    said = {key: value for key, value in sidecar.sidecar.items() if key not in ("source", "sha256")}
    return Uploaded(file, measurement([recording.with_metadata(**said)]), sidecar)


def _read_told(path: Path) -> Told | None:
    """What the process has written; None where it has not yet."""
    try:
        return Told(**read_json(path, "the progress of a calibration"))
    except (InputError, TypeError):
        return None
