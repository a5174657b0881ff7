"""Keep the files of a run: its state, its recordings and their partial files, complete at every moment."""

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
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError
from tissue_sim.files import read_bytes, write_bytes, write_text

#: Name of the file with the state of a run.
RUN_FILE = "run.json"
#: Name of the file whose lock prevents a second program from recording into the folder.
LOCK_FILE = "run.lock"
#: End of the name of an unfinished recording.
PARTIAL_SUFFIX = ".partial.csv"
#: Folder, inside the folder of a run, with copies of the input files of the tests.
COPIES_FOLDER = "files"
#: Longest time until a row is on the disk, s.
SYNC_INTERVAL = 0.5


class RunFolder:
    """Folder of one run: state, history of loadings and stops, and recordings. The files survive a crash.

    Use the object in a ``with`` block to record: the block holds the lock of the folder.

    Args:
        folder: path of the folder; it is created when the ``with`` block begins.
        digest: SHA-256 of the protocol; a folder belongs to one protocol.

    Attributes:
        folder: path of the folder.
        state: content of ``run.json``.

    Raises:
        InputError: the folder belongs to another protocol or contains other files, or another program records into it.
    """

    def __init__(self, folder: Path, digest: str):
        self.folder, self._digest = folder, digest
        self._lock: int | None = None
        self._copies: dict[Path, str] = {}
        self.state: dict[str, Any] = {"schema": "tissue_sim.run/1", "protocol_sha256": digest, "state": "new",
                                      "done": [], "history": [], "stops": [], "left_out": {}}
        self._load_state_and_record_crash()

    def _load_state_and_record_crash(self) -> None:
        """Set `state` from ``run.json`` if the folder has files; add the stop "died" if a previous program crashed."""
        if self.folder.exists() and any(each.name != LOCK_FILE for each in self.folder.iterdir()):
            self.state = self._read_state()
            if self.state["state"] == "running" and self._lock is not None:
                # This program holds the lock: the program that wrote "running" has ended.
                self.record_stop("died", "the program ended without a message: it was killed, or the power failed", "",
                                 "", 0)

    def _read_state(self) -> dict[str, Any]:
        """Return the content of ``run.json``.

        Raises:
            InputError: the file is missing, unreadable, or of another protocol.
        """
        file = self.folder / RUN_FILE
        if not file.exists():
            raise InputError("the folder must be empty or contain a run; it contains other files. Choose an empty "
                             "folder", file=self.folder)
        try:
            state = read_json_value(file, "the file of a run")
        except (OSError, ValueError):
            state = None
        if not isinstance(state, dict) or "protocol_sha256" not in state:
            raise InputError("the file is not the state of a run; choose an empty folder", file=file)
        if state["protocol_sha256"] != self._digest:
            raise InputError("the folder belongs to a run with another protocol; choose another folder, because a "
                             "folder holds one run", file=self.folder)
        return state

    @property
    def has_started_run(self) -> bool:
        """Whether a run was started in this folder: its state is not "new"."""
        return self.state["state"] != "new"

    def __enter__(self) -> RunFolder:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(self.folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o644)
        if not _try_lock(self._lock):
            os.close(self._lock)
            self._lock = None
            raise InputError("another program records into this folder; wait for its end, or choose another folder",
                             file=self.folder)
        self._load_state_and_record_crash()
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def update_state(self, **entries: Any) -> None:
        """Replace the given entries of the state of the run, and write the state to ``run.json``."""
        self.state |= entries
        write_text(self.folder / RUN_FILE, json.dumps(self.state, indent=2, ensure_ascii=False) + "\n")

    def record_stop(self, cause: str, message: str, test: str, phase: str, replicate: int) -> None:
        """Set the state to "stopped", and append the stop to the list of stops.

        Args:
            cause: cause of the stop, see `haptics.safety.motion_guard.StopReason`.
            message: sentence with the remedy.
            test: name of the test.
            phase: activity that was stopped.
            replicate: number of the replicate; 0 outside of a replicate.
        """
        self.update_state(state="stopped", stops=[*self.state["stops"], {
            "cause": cause, "message": message, "test": test, "phase": phase, "replicate": replicate,
            "at": _format_local_time()}])

    def add_or_update_loading_entry(self, test: str, description: str, depth: float, entry: int | None = None) -> int:
        """Append a loading of the specimen to the history, or replace an entry, and write ``run.json``.

        Args:
            test: name of the test.
            description: text of the entry.
            depth: planned depth of a new entry, or the reached depth of an existing entry, m.
            entry: number of the entry to replace after the motion; None: append an entry that is marked as planned.

        Returns:
            Number of the entry.
        """
        history = list(self.state["history"])
        row = {"test": test, "what": description, "depth_mm": depth * 1e3, "at": _format_local_time()}
        if entry is None:
            history.append({**row, "planned": True})
        else:
            history[entry] = row
        self.update_state(history=history)
        return len(history) - 1 if entry is None else entry

    def count_loadings_of_test(self, test: str) -> int:
        """Return the number of entries of a test in the history of loadings, planned entries included."""
        return sum(entry["test"] == test for entry in self.state["history"])

    def list_stops_for_test(self, test: str) -> list[dict[str, Any]]:
        """Return the recorded stops of a test, and the stops that belong to no test, oldest first."""
        return [stop for stop in self.state["stops"] if stop["test"] in (test, "")]

    def list_missing_replicate_numbers(self, name: str, replicates: int) -> list[int]:
        """Return the numbers, from 1, of the replicates of a test that have no recording yet.

        Args:
            name: name of the test.
            replicates: planned number of recordings.
        """
        return [number for number in range(1, replicates + 1) if f"{name}_{number}.csv" not in self.state["done"]]

    def copy_input_file_once(self, path: Path) -> str:
        """Copy an input file of the tests into the folder; a later call with the same path makes no second copy.

        Args:
            path: file to copy.

        Returns:
            Path of the copy, relative to the folder of the run.

        Raises:
            InputError: the file cannot be read, or the copy cannot be written.
        """
        path = path.resolve()
        if path not in self._copies:
            self.update_state()  # A folder with copies and without run.json would be refused later.
            used, number, name = set(self._copies.values()), 1, f"{COPIES_FOLDER}/{path.name}"
            while name in used:
                number += 1
                name = f"{COPIES_FOLDER}/{path.stem}_{number}{path.suffix}"
            write_bytes(self.folder / name, read_bytes(path, "a file that the tests depend on"))
            self._copies[path] = name
        return self._copies[path]

    def create_partial_recording(self, name: str, header: Sequence[str]) -> PartialRecordingWriter:
        """Create the file of an unfinished recording, and return the `PartialRecordingWriter` that writes its rows.

        Args:
            name: name of the recording, without ending.
            header: titles of the columns.
        """
        return PartialRecordingWriter(self.folder / f"{name}{PARTIAL_SUFFIX}", header)

    def save_recording(self, name: str, recording: Recording) -> Path:
        """Write a complete recording, delete its partial file, and add the recording to the state.

        Args:
            name: name of the recording, without ending.
            recording: samples and metadata.

        Returns:
            Path of the recording.
        """
        path = self.folder / f"{name}.csv"
        write_recording(recording, path)
        (self.folder / f"{name}{PARTIAL_SUFFIX}").unlink(missing_ok=True)
        left_out = {name: recording.metadata["left_out"]} if "left_out" in recording.metadata else {}
        self.update_state(done=[*self.state["done"], path.name],
                          left_out={**self.state.get("left_out", {}), **left_out})
        return path


class PartialRecordingWriter:
    """File of an unfinished recording: rows are written whole, and are on the disk within `SYNC_INTERVAL`.

    A separate thread writes the file: a busy disk must not delay the supervision of the motor.

    Args:
        path: path of the file; an existing file is renamed to NAME.stopped_N.csv.
        header: titles of the columns.

    Attributes:
        path: path of the file.
        failure: message of a failed write; None: all writes succeeded.
    """

    def __init__(self, path: Path, header: Sequence[str]):
        number = 1
        while path.exists():
            older = path.with_name(path.name.replace(PARTIAL_SUFFIX, f".stopped_{number}.csv"))
            number += 1
            if not older.exists():
                path.rename(older)
        self.path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._waiting: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._waiting.put(",".join(header) + "\n")
        self.failure: str | None = None
        self._thread = threading.Thread(target=self._write_queued_rows, name="partial recording", daemon=True)
        self._thread.start()

    def queue_rows(self, rows: Sequence[Sequence[Any]]) -> None:
        """Queue rows for the writer thread, without waiting for the disk.

        Args:
            rows: one sequence of cells per row, texts or numbers, in the order of the header.
        """
        if rows:
            self._waiting.put("".join(",".join(cell if isinstance(cell, str) else f"{cell:.9g}" for cell in row) + "\n"
                                      for row in rows))

    def _write_queued_rows(self) -> None:
        """Write queued rows until `close`; runs in the writer thread, and stores a failed write in `failure`."""
        ending = False
        try:
            while not ending:
                parts = [self._waiting.get()]
                until = time.monotonic() + 0.5 * SYNC_INTERVAL
                # Collect rows, so that the disk is synchronised only as often as the interval requires.
                while parts[-1] is not None and (remaining := until - time.monotonic()) > 0:
                    try:
                        parts.append(self._waiting.get(timeout=remaining))
                    except queue.Empty:
                        break
                ending = parts[-1] is None
                data = "".join(part for part in parts if part is not None).encode("utf-8")
                while data:
                    data = data[os.write(self._file, data):]
                os.fsync(self._file)
        except OSError as error:
            self.failure = f"{self.path} cannot be written ({error.strerror or error}); free space on the disk"

    def close(self) -> None:
        """Write all queued rows to the disk, and close the file; a failed write raises no error, see `failure`."""
        self._waiting.put(None)
        self._thread.join()
        os.close(self._file)


def _format_local_time() -> str:
    """Return the local date and time with time zone (ISO 8601)."""
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


def _try_lock(descriptor: int) -> bool:
    """Lock a file without waiting; return False if another program holds the lock, and always True on Windows.

    The operating system releases the lock when the program ends, also after a crash.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no fcntl: opening the file for writing is the only check.
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
