"""The folder of a run: what was planned, what was recorded, who stopped it; readable at every moment."""

from __future__ import annotations

import json
import os
import queue
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tissue_sim import Recording, write_recording
from tissue_sim.atomic_write import write_bytes, write_text
from tissue_sim.decode import read_json
from tissue_sim.errors import InputError
from tissue_sim.files import read_bytes

RUN_FILE, LOCK_FILE, PARTIAL = "run.json", "run.lock", ".partial.csv"
#: Folder, in that of the run, of copies of files that the tests depend on.
FILES = "files"
#: Rows are on the disk after so long at the latest, s.
KEPT_EVERY = 0.5


class RunFolder:
    """Where a run writes. What was recorded stays whatever happens to the program.

    Args:
        folder: of the run.
        digest: of the protocol: a folder belongs to one.

    Raises:
        InputError: the folder belongs to another protocol, or holds something else, or another program writes to it.
    """

    def __init__(self, folder: Path, digest: str):
        self.folder, self._digest = folder, digest
        self._lock: int | None = None
        self._copies: dict[Path, str] = {}
        self.state: dict[str, Any] = {"schema": "tissue_sim.run/1", "protocol_sha256": digest, "state": "new",
                                      "done": [], "history": [], "stops": []}
        self._take_state()

    def _take_state(self) -> None:
        if self.folder.exists() and any(each.name != LOCK_FILE for each in self.folder.iterdir()):
            self.state = self._read_state()
            if self.state["state"] == "running" and self._lock is not None:
                # Nobody else has the lock: who ran has died.
                self.note_stop("died", "the program ended without a word: killed, or a power cut", "", "", 0)

    def _read_state(self) -> dict[str, Any]:
        file = self.folder / RUN_FILE
        if not file.exists():
            raise InputError("holds other files and no run; choose an empty folder", file=self.folder)
        try:
            state = read_json(file, "the file of a run")
        except (OSError, ValueError):
            state = None
        if not isinstance(state, dict) or "protocol_sha256" not in state:
            raise InputError("is no file of a run; choose an empty folder", file=file)
        if state["protocol_sha256"] != self._digest:
            raise InputError("belongs to a run with another protocol; choose another folder, so that no folder holds "
                             "halves of two runs", file=self.folder)
        return state

    @property
    def is_begun(self) -> bool:
        """Whether something was recorded, or tried, here."""
        return self.state["state"] != "new"

    def __enter__(self) -> RunFolder:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(self.folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o644)
        if not _lock_file(self._lock):
            os.close(self._lock)
            self._lock = None
            raise InputError("another program records into this folder; wait for it, or choose another folder",
                             file=self.folder)
        self._take_state()
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def note(self, **entries: Any) -> None:
        """Put entries into ``run.json``."""
        self.state |= entries
        write_text(self.folder / RUN_FILE, json.dumps(self.state, indent=2, ensure_ascii=False) + "\n")

    def note_stop(self, cause: str, message: str, test: str, phase: str, replicate: int) -> None:
        """Why and where a run was ended."""
        self.note(state="stopped", stops=[*self.state["stops"], {
            "cause": cause, "message": message, "test": test, "phase": phase, "replicate": replicate, "at": _now()}])

    def note_loading(self, test: str, words: str, depth: float, entry: int | None = None) -> int:
        """That a specimen is loaded, to a depth, m; again, with the number that this returned, when it was."""
        history = list(self.state["history"])
        row = {"test": test, "what": words, "depth_mm": depth * 1e3, "at": _now()}
        if entry is None:
            history.append({**row, "planned": True})
        else:
            history[entry] = row
        self.note(history=history)
        return len(history) - 1 if entry is None else entry

    def of_test(self, test: str) -> tuple[int, list[dict[str, Any]]]:
        """How often the specimen of a test was loaded, and what stopped its runs."""
        return (sum(entry["test"] == test for entry in self.state["history"]),
                [stop for stop in self.state["stops"] if stop["test"] in (test, "")])

    def missing(self, name: str, replicates: int) -> list[int]:
        """Numbers of the recordings of a test that are not there yet."""
        return [number for number in range(1, replicates + 1) if f"{name}_{number}.csv" not in self.state["done"]]

    def copy_of(self, path: Path) -> str:
        """Name, from the folder of the run, of a copy of a file that its tests depend on; it is copied once a program.

        Raises:
            InputError: the file cannot be read, or the copy not be written.
        """
        path = path.resolve()
        if path not in self._copies:
            self.note()  # a folder with other files and no run would be refused
            taken, number, name = set(self._copies.values()), 1, f"{FILES}/{path.name}"
            while name in taken:
                number += 1
                name = f"{FILES}/{path.stem}_{number}{path.suffix}"
            write_bytes(self.folder / name, read_bytes(path, "a file that the tests depend on"))
            self._copies[path] = name
        return self._copies[path]

    def partial(self, name: str, header: Sequence[str]) -> PartialRecording:
        """A file that is written as samples come."""
        return PartialRecording(self.folder / f"{name}{PARTIAL}", header)

    def keep(self, name: str, recording: Recording) -> Path:
        """A whole recording, in the place of the partial one."""
        path = self.folder / f"{name}.csv"
        write_recording(recording, path)
        (self.folder / f"{name}{PARTIAL}").unlink(missing_ok=True)
        self.note(done=[*self.state["done"], path.name])
        return path


class PartialRecording:
    """A recording under way: each row is written whole, and on the disk within half a second.

    A thread writes: a disk that is busy must not keep anybody from looking at a motor.

    Args:
        path: of it; an older one of this name is kept beside it, with a number.
        header: of the columns.
    """

    def __init__(self, path: Path, header: Sequence[str]):
        number = 1
        while path.exists():
            older = path.with_name(path.name.replace(PARTIAL, f".stopped_{number}.csv"))
            number += 1
            if not older.exists():
                path.rename(older)
        self.path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._waiting: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._waiting.put(",".join(header) + "\n")
        #: What the disk said when it refused.
        self.failure: str | None = None
        self._thread = threading.Thread(target=self._write, name="partial recording", daemon=True)
        self._thread.start()

    def add(self, rows: Sequence[Sequence[Any]]) -> None:
        """Rows, as many cells each as the header."""
        if rows:
            self._waiting.put("".join(",".join(cell if isinstance(cell, str) else f"{cell:.9g}" for cell in row) + "\n"
                                      for row in rows))

    def _write(self) -> None:
        ending = False
        try:
            while not ending:
                parts = [self._waiting.get()]
                until = time.monotonic() + 0.5 * KEPT_EVERY
                # Together, so that the disk is not asked more often than the half second needs.
                while parts[-1] is not None and (left := until - time.monotonic()) > 0:
                    try:
                        parts.append(self._waiting.get(timeout=left))
                    except queue.Empty:
                        break
                ending = parts[-1] is None
                data = "".join(part for part in parts if part is not None).encode("utf-8")
                while data:
                    data = data[os.write(self._file, data):]
                os.fsync(self._file)
        except OSError as error:
            self.failure = f"{self.path} cannot be written ({error.strerror or error}); free the disk"

    def close(self) -> None:
        """All that was added is on the disk then."""
        self._waiting.put(None)
        self._thread.join()
        os.close(self._file)


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


def _lock_file(descriptor: int) -> bool:
    """Whether the lock was free; the system frees it when the program ends, however it ends."""
    try:
        import fcntl
    except ImportError:  # Windows: opening it for writing is all that can be asked
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
