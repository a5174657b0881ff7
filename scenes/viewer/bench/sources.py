"""Where a page that watches a bench has its numbers from; none of them moves anything."""

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
from tissue_sim.decode import read_json
from tissue_sim.errors import InputError

#: Points that are drawn of a recording, and seconds that are kept of a sensor.
POINTS, SECONDS = 600, 20.0


@dataclass(frozen=True)
class BenchView:
    """What a page shows of a bench.

    Attributes:
        title: what is going on, in a line. message: why it is not; empty: it is.
        force: N. depth: mm, or the stage's position; None: not known.
        share: of the run, 0 to 1; None: not known.
        time, displacement, forces: of the recording under way, or of the last seconds: s, mm (NaN where the place is
            not known), N, each of shape (n,).
    """

    title: str
    message: str = ""
    force: float | None = None
    depth: float | None = None
    share: float | None = None
    time: np.ndarray = field(default_factory=lambda: np.empty(0))
    displacement: np.ndarray = field(default_factory=lambda: np.empty(0))
    forces: np.ndarray = field(default_factory=lambda: np.empty(0))


class BenchSource(ABC):
    """Looks at a bench."""

    @abstractmethod
    def look(self) -> BenchView:
        """What is there now; does not wait for more."""

    def close(self) -> None:
        """Nothing where there is nothing to close."""
        return


class RunSource(BenchSource):
    """A run of ``tissue-sim record``, by its folder; the recorder is another program and does not know.

    Args:
        folder: of the run; it may come later.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._partial: Path | None = None
        self._rows: list[tuple[float, float, float]] = []
        self._read = 0

    def look(self) -> BenchView:
        state, live = self._json(RUN_FILE), self._json(LIVE_FILE)
        if state is None:
            return BenchView(f"no run in {self._folder} yet", "start it with: tissue-sim record PROTOCOL.toml -o "
                                                              f"{self._folder}")
        time, displacement, force = self._recording()
        done, said = len(state.get("done", [])), {"running": "the recorder does not answer; it may have been killed",
                                                  "complete": "", "new": ""}
        if live is None:
            stops = state.get("stops") or [{}]
            words = stops[-1].get("message", "") if state["state"] == "stopped" else said.get(state["state"], "")
            return BenchView(f"{state['state']}: {done} recordings", words, time=time, displacement=displacement,
                             forces=force)
        replicate = f" {live['replicate']}" if live.get("replicate") else ""
        return BenchView(f"{live['test']}{replicate}: {live['phase']}; {done} recordings done", "",
                         live.get("force_N"), live.get("depth_mm", live.get("position_mm")), live.get("share"), time,
                         displacement, force)

    def _json(self, name: str) -> dict | None:
        with contextlib.suppress(OSError, ValueError):
            content = read_json(self._folder / name, "a file of the run")
            return content if isinstance(content, dict) else None
        return None

    def _recording(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The rows that are there of the recording under way, thinned; of the last one when none is."""
        partial = max(self._folder.glob(f"*{PARTIAL_SUFFIX}"), key=_changed, default=None)
        if partial is not None and partial != self._partial:
            self._partial, self._rows, self._read = partial, [], 0
        if self._partial is not None and self._partial.exists():
            with self._partial.open("rb") as file:
                file.seek(self._read)
                whole, newline, _ = file.read().rpartition(b"\n")
            self._read += len(whole) + len(newline)
            for line in whole.decode("utf-8", "replace").splitlines():
                cells = line.split(",")
                with contextlib.suppress(ValueError, IndexError):  # the header is no row
                    self._rows.append((float(cells[0]), float(cells[1]), float(cells[2])))
        rows = np.array(self._rows[:: max(1, len(self._rows) // POINTS)]).reshape(-1, 3)
        return rows[:, 0], rows[:, 1], rows[:, 2]


class DevicesSource(BenchSource):
    """A sensor, and a stage that is only asked where it is.

    Args:
        sensor: of whose channels `axis` is shown. stage: None: there is none.
        axis: of the sensor; one of one channel shows that.

    Raises:
        DeviceError: one does not start.
        InputError: the sensor has no such channel.
    """

    def __init__(self, sensor: ForceSensor, stage: Stage | None = None, axis: str = "Fz"):
        if axis not in sensor.channels and len(sensor.channels) > 1:
            raise InputError(f"the sensor has no channel {axis!r}; it has {', '.join(sensor.channels)}", field="axis")
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

    def look(self) -> BenchView:
        message, place = "", np.nan
        try:
            samples = self._sensor.read()
            if self._stage is not None:
                place = 1e3 * self._stage.position().position
        except DeviceError as error:
            return self._view(str(error))
        self._rows.extend((sample.received, place, sample.values[self._axis]) for sample in samples)
        while self._rows and self._rows[-1][0] - self._rows[0][0] > SECONDS:
            self._rows.popleft()
        if any(sample.status & SampleStatus.SATURATED for sample in samples):
            message = "the sensor is at the end of its range"
        elif any(sample.status & SampleStatus.FAULT for sample in samples):
            message = "the sensor reports a fault"
        return self._view(message)

    def _view(self, message: str) -> BenchView:
        rows = np.array(list(self._rows)[:: max(1, len(self._rows) // POINTS)]).reshape(-1, 3)
        last = self._rows[-1] if self._rows else None
        return BenchView("sensor" if self._stage is None else "sensor and stage", message or (
            "" if last else "no sample has come yet"), None if last is None else last[2],
            None if last is None or np.isnan(last[1]) else last[1], None,
            rows[:, 0] - (last[0] if last else 0.0), rows[:, 1], rows[:, 2])

    def close(self) -> None:
        if self._stage is not None:
            self._stage.stop()
        self._sensor.stop()


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # it was renamed meanwhile
        return 0.0
