"""Data sources of the bench page, which only read: the folder of a running recorder, or a sensor and a stage."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from haptics.devices.contracts import DeviceError, ForceSensor, SampleStatus, Stage
from haptics.recorder.live import LIVE_FILE
from haptics.recorder.run_folder import PARTIAL_SUFFIX, RUN_FILE
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class BenchCurveSettings:
    """Size of the drawn curves.

    Attributes:
        points: Approximate number of points of a curve; more points show shorter peaks and load the browser more.
        time_span: Time span of the samples of a sensor, s.
        compared_bytes: Number of bytes before the end of the last read by which a new file of the same name is
            recognised: about two rows, whose times and noisy forces differ.
    """

    points: int = 600
    time_span: float = 20.0
    compared_bytes: int = 64


#: Curves of every bench.
CURVE = BenchCurveSettings()


@dataclass(frozen=True)
class BenchState:
    """State of a test bench for display.

    Attributes:
        title: Present activity in one line.
        message: Problem and remedy; empty if there is none.
        force: Present force, N; None if not known.
        depth: Present depth, or position of the stage, mm; None if not known.
        progress: Progress of the present recording, 0 to 1; None if not known.
        time: Times of the present recording or of the last seconds, s, shape (n,).
        displacement: Displacements at these times, mm, shape (n,), NaN where not known.
        forces: Forces at these times, N, shape (n,).
    """

    title: str
    message: str = ""
    force: float | None = None
    depth: float | None = None
    progress: float | None = None
    time: np.ndarray = field(default_factory=lambda: np.empty(0))
    displacement: np.ndarray = field(default_factory=lambda: np.empty(0))
    forces: np.ndarray = field(default_factory=lambda: np.empty(0))


class BenchSource(ABC):
    """Source of the state of a test bench."""

    @abstractmethod
    def read(self) -> BenchState:
        """Return the present state at every call, without waiting for new data."""

    def close(self) -> None:
        """Release the devices; does nothing by default."""
        return


class RunFolderSource(BenchSource):
    """Source that reads the folder of a run of ``tissue-sim record``, which another process writes.

    Args:
        folder: Folder of the run; it need not exist yet.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._partial: Path | None = None
        self._last_read = b""
        self._rows: list[tuple[float, float, float]] = []
        self._read = 0

    def read(self) -> BenchState:
        """Return the state of the run, its newest recording and the live readings of the recorder."""
        state, live = self._read_json(RUN_FILE), self._read_json(LIVE_FILE)
        if state is None:
            return BenchState(f"No run in {self._folder} yet", "Start the run with: tissue-sim record PROTOCOL.toml -o "
                              f"{self._folder}")
        time, displacement, force = self._read_thinned_recording()
        done = len(state.get("done", []))
        messages = {"running": "The recorder does not respond. It may have been killed.", "complete": "", "new": ""}
        if live is None:
            stops = state.get("stops") or [{}]
            message = stops[-1].get("message", "") if state["state"] == "stopped" else messages.get(state["state"], "")
            return BenchState(f"{state['state']}: {done} recordings", message, time=time, displacement=displacement,
                              forces=force)
        replicate = f" {live['replicate']}" if live.get("replicate") else ""
        return BenchState(f"{live['test']}{replicate}: {live['phase']}; {done} recordings done", "",
                          live.get("force_N"), live.get("depth_mm", live.get("position_mm")), live.get("share"), time,
                          displacement, force)

    def _read_json(self, name: str) -> dict | None:
        """Return the content of a JSON file of the run; None if the file is missing or invalid."""
        with contextlib.suppress(OSError, ValueError):
            content = read_json_value(self._folder / name, "a file of the run")
            return content if isinstance(content, dict) else None
        return None

    def _read_thinned_recording(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the present recording so far, or else the last one, thinned to about `BenchCurveSettings.points` rows.

        Returns:
            Time, s, displacement, mm, and force, N, each of shape (n,).
        """
        partial = max(self._folder.glob(f"*{PARTIAL_SUFFIX}"), key=_modification_time_or_zero, default=None)
        if partial is not None and partial != self._partial:
            self._partial, self._rows, self._read, self._last_read = partial, [], 0, b""
        if self._partial is not None and self._partial.exists():
            with self._partial.open("rb") as file:
                # A recording that starts again has the name of the stopped one, but other rows.
                file.seek(self._read - len(self._last_read))
                if file.read(len(self._last_read)) != self._last_read:
                    self._rows, self._read, self._last_read = [], 0, b""
                file.seek(self._read)
                whole, newline, _ = file.read().rpartition(b"\n")
            self._read += len(whole) + len(newline)
            self._last_read = (whole + newline)[-CURVE.compared_bytes:] or self._last_read
            for line in whole.decode("utf-8", "replace").splitlines():
                cells = line.split(",")
                with contextlib.suppress(ValueError, IndexError):  # skips the header
                    self._rows.append((float(cells[0]), float(cells[1]), float(cells[2])))
        rows = np.array(self._rows[:: max(1, len(self._rows) // CURVE.points)]).reshape(-1, 3)
        return rows[:, 0], rows[:, 1], rows[:, 2]


class ConnectedDevicesSource(BenchSource):
    """Source that reads a force sensor and the position of a stage.

    Args:
        sensor: Force sensor.
        stage: Stage; None: no stage.
        axis: Displayed channel of the sensor; ignored for a sensor with one channel.

    Raises:
        DeviceError: A device does not start.
        InputError: The sensor does not have the channel.
    """

    def __init__(self, sensor: ForceSensor, stage: Stage | None = None, axis: str = "Fz"):
        if axis not in sensor.channels and len(sensor.channels) > 1:
            raise InputError(f"must be one of {', '.join(sensor.channels)}; got {axis!r}", field="axis")
        self._sensor, self._stage = sensor, stage
        self._rows: deque[tuple[float, float, float]] = deque()
        sensor.start()
        try:
            if stage is not None:
                stage.start()
        except DeviceError:
            sensor.stop()
            raise
        self._axis = sensor.channels.index(axis) if axis in sensor.channels else 0

    def read(self) -> BenchState:
        """Read the new samples of the sensor and the position of the stage, and return their view."""
        message, position = "", np.nan
        try:
            samples = self._sensor.read()
            if self._stage is not None:
                position = 1e3 * self._stage.position().position
        except DeviceError as error:
            return self._make_bench_state(str(error))
        self._rows.extend((sample.received, position, sample.values[self._axis]) for sample in samples)
        while self._rows and self._rows[-1][0] - self._rows[0][0] > CURVE.time_span:
            self._rows.popleft()
        if any(sample.status & SampleStatus.SATURATED for sample in samples):
            message = "The sensor is at the limit of its range. Reduce the force."
        elif any(sample.status & SampleStatus.FAULT for sample in samples):
            message = "The sensor reports a fault. Check the sensor and its cable."
        return self._make_bench_state(message)

    def _make_bench_state(self, message: str) -> BenchState:
        """Return the view of the stored samples, thinned to about `BenchCurveSettings.points`, with a message."""
        rows = np.array(list(self._rows)[:: max(1, len(self._rows) // CURVE.points)]).reshape(-1, 3)
        last = self._rows[-1] if self._rows else None
        return BenchState("sensor" if self._stage is None else "sensor and stage", message or (
            "" if last else "The sensor has not sent a sample yet."), None if last is None else last[2],
            None if last is None or np.isnan(last[1]) else last[1], None,
            rows[:, 0] - (last[0] if last else 0.0), rows[:, 1], rows[:, 2])

    def close(self) -> None:
        """Stop stage and sensor."""
        if self._stage is not None:
            self._stage.stop()
        self._sensor.stop()


def _modification_time_or_zero(path: Path) -> float:
    """Return the modification time of a file, s; 0 if the file does not exist."""
    try:
        return path.stat().st_mtime
    except OSError:  # the recorder has renamed the file
        return 0.0
