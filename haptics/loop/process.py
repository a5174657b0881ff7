"""The loop as a process of its own: a Taichi kernel holds the interpreter lock, so the loop shares one with nobody."""

from __future__ import annotations

import multiprocessing
import pickle
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from haptics.devices.contracts import HapticDevice
from haptics.loop.child import LoopFiles, LoopParts, run_child
from haptics.loop.commands import COMMANDS
from haptics.loop.loop import LoopReport, LoopSettings
from haptics.loop.ring import RingReader
from haptics.loop.shared_slots import remove, unused_path
from haptics.loop.snapshot_board import SnapshotReader
from haptics.safety.rendering import ForceRendering
from tissue_sim.child_process import start_with_one_thread, start_without_ctrl_c
from tissue_sim.errors import InputError, nearest
from tissue_sim.registry import registered
from tissue_sim.snapshot import Snapshot
from tissue_sim.tool_force import Tissue

#: How long the loop may take to answer a command, or to end, s.
PATIENCE = 5.0


class LoopError(RuntimeError):
    """The process of the loop has ended before its time, or does not answer."""


class LoopProcess:
    """A loop in a process of its own. Use it as a context: at its end the process is stopped.

    A script that starts one must do so under ``if __name__ == "__main__":``.

    Args:
        make_tissue: called in that process, such as ``functools.partial(ts.Simulator, model)``; what it returns is
            warmed up, where it can be, before the first tick.
        device: gives poses and takes forces, or a motion; it is started in that process, when the tissue is ready.
        rendering: see there.
        settings: see there.
        ring_path: file of the ring; None: an unused one in `haptics.loop.shared_slots.runtime_folder`.

    Attributes:
        ring_path, snapshot_path: files for viewers and recorders, while the process lives.
        pattern: what its snapshots have in common, of the material as it is now; None where it publishes none.
        message: what the process has last said of itself.
        resolution, force_error: of the tissue's mesh, when it is ready; see `LoopReport`.
        report: of a loop that has ended; None before, and of one that died.
        patience: how long the loop may take to answer a command, s.

    Raises:
        InputError: the file of the ring exists already.
    """

    def __init__(self, make_tissue: Callable[[], Tissue], device: HapticDevice, rendering: ForceRendering,
                 settings: LoopSettings | None = None, *, ring_path: str | Path | None = None):
        self.ring_path = unused_path("ring") if ring_path is None else Path(ring_path)
        self.snapshot_path = self.ring_path.with_name(f"{self.ring_path.name}.snapshots")
        self._files = LoopFiles(self.ring_path, self.snapshot_path)
        for path in self._files:
            if path.exists():
                raise InputError("exists already; remove it or give another name", file=path)
        self.message, self.report, self.patience = "not started", None, PATIENCE
        self._parts = LoopParts(make_tissue, device, rendering, settings or LoopSettings())
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._lock = threading.RLock()
        self._ready = False
        self._failure: Exception | None = None
        self._answers: list[str] = []
        self.pattern: Snapshot | None = None
        self.resolution, self.force_error = "", None

    def start(self) -> None:
        """Start the process and return at once.

        Raises:
            InputError: it was started before, or something in it cannot be sent to another process.
        """
        if self._process is not None:
            raise InputError("this loop was started before; make another one")
        context = multiprocessing.get_context("spawn")  # Taichi and threads do not survive a fork
        self._connection, far_end = context.Pipe()
        process = context.Process(target=run_child, args=(far_end, self._parts, self._files, registered()),
                                  name="tissue-sim loop", daemon=True)
        try:
            with start_without_ctrl_c(), start_with_one_thread():
                process.start()
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(f"cannot be sent to another process ({error}); use functions and classes of a module, not "
                             "of a function", field="LoopProcess") from error
        finally:
            far_end.close()
        self._process, self.message = process, "starting"

    def wait_until_ready(self, timeout: float | None = None, progress: Callable[[str], None] | None = None) -> None:
        """Wait for the first tick. A machine's first run compiles the solver, which takes several seconds.

        Args:
            timeout: s; None: as long as the process lives.
            progress: told what the process does.

        Raises:
            InputError: what the tissue refuses when it is made.
            LoopError: the process has ended, or the time is over.
        """
        until = None if timeout is None else time.monotonic() + timeout
        told = ""
        ready = False
        while not ready:
            ready = self.poll(0.1)
            if progress is not None and self.message != told:
                told = self.message
                progress(told)
            if not ready and until is not None and time.monotonic() > until:
                raise LoopError(f"the loop is not ready after {timeout:g} s: {self.message}")

    def poll(self, timeout: float = 0.0) -> bool:
        """Take in what the process says within `timeout`, s; whether it has come to its first tick.

        Raises:
            InputError, LoopError: it has ended without a report, and why.
        """
        self._read(timeout)
        return self._ready

    @property
    def ready(self) -> bool:
        """Whether the process is known to have come to its first tick; `poll` looks."""
        return self._ready

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.is_alive()

    @property
    def pid(self) -> int | None:
        """Number of the process; None before it is started."""
        return None if self._process is None else self._process.pid

    @property
    def exit_code(self) -> int | None:
        """0: ended well; minus the signal of one that was killed; None: it runs, or was not started."""
        return None if self._process is None else self._process.exitcode

    def ring(self) -> RingReader:
        """A reader of the ring of a loop that is ready; close it."""
        return RingReader(self.ring_path)

    def snapshots(self) -> SnapshotReader | None:
        """A reader of the snapshots of a loop that is ready; None where it publishes none. Close it."""
        return None if self.pattern is None else SnapshotReader(self.snapshot_path, self.pattern)

    def pause(self) -> None:
        """Let the motion stand still and the force fade; returns when it is so. Raises as `set_parameters`."""
        self.ask("pause")

    def resume(self) -> None:
        """Let the motion go on. Raises as `set_parameters`."""
        self.ask("resume")

    def reset(self) -> None:
        """Begin the motion again, with undeformed tissue. Raises as `set_parameters`."""
        self.ask("reset")

    def advance(self, seconds: float) -> None:
        """Let the motion of a loop that is paused go on for so long. Raises as `set_parameters`."""
        self.ask("advance", seconds=seconds)

    def follow(self, device: HapticDevice, anew: bool = False) -> None:
        """Go on with another device or motion, from its beginning on; `anew`: on undeformed tissue. Raises as
        `set_parameters`."""
        self.ask("follow", device=device, anew=anew)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Tell a `HandMotion`, or a device that one moves, where to go, m; see `HapticDevice.aim`. Raises as
        `set_parameters`."""
        self.ask("aim", depth=depth, across=across)

    def set_parameters(self, **values: float) -> None:
        """Change parameters of the tissue between two ticks.

        Raises:
            InputError: what the tissue refuses; the loop goes on as before.
            LoopError: the process has ended, or does not answer.
        """
        self.ask("set_parameters", **values)

    def ask(self, command: str, **values: Any) -> None:
        """Send one of `haptics.loop.commands.COMMANDS` with its arguments, and wait until it is done.

        Raises:
            InputError: no such command (names the nearest), or what the loop refuses; it goes on as before.
            LoopError: the process has ended, or does not answer.
        """
        if command not in COMMANDS:
            raise InputError(f"a loop has no command {command!r}{nearest(command, COMMANDS)}")
        with self._lock:
            if self._connection is None or not self._ready:
                raise LoopError(f"the loop is not ready: {self.message}")
            self._answers.clear()
            with suppress(OSError):  # reading says why
                self._connection.send((command, values))
            until = time.monotonic() + self.patience
            while not self._answers and self.report is None:
                self._read(0.1)
                if time.monotonic() > until:
                    raise LoopError(f"the loop does not answer within {self.patience:g} s")
            if self._answers and self._answers[0]:
                raise InputError(self._answers[0])

    def wait(self, timeout: float | None = None) -> LoopReport | None:
        """Wait for the end of the loop; None where it still runs after `timeout`, s.

        Raises:
            InputError, LoopError: the process has ended without a report, and why.
        """
        until = None if timeout is None else time.monotonic() + timeout
        while self.report is None:
            left = 0.5 if until is None else until - time.monotonic()
            if left <= 0 and until is not None:
                return None
            self._read(min(left, 0.5))
        self._end(PATIENCE)
        return self.report

    def stop(self) -> LoopReport | None:
        """End the process, by force where it does not end by itself. Returns its report, None where there is none."""
        connection, self.patience = self._connection, PATIENCE
        with suppress(LoopError, InputError, OSError):  # it has died: there is nothing to stop
            while connection is not None and not self._ready and connection.poll():
                self._read(0.0)
            if self._ready and self.report is None:
                self.ask("stop")
                self.wait(PATIENCE)
        self._end(0.0 if self.report is None and self._failure is None else PATIENCE)
        return self.report

    def __enter__(self) -> LoopProcess:
        self.start()
        return self

    def __exit__(self, *failure) -> None:
        self.stop()

    def _read(self, timeout: float) -> None:
        """Take in what the process says within `timeout`, s.

        Raises:
            InputError, LoopError: it has ended without a report.
        """
        process, connection = self._process, self._connection
        if process is None or connection is None:
            raise LoopError("the loop was not started")
        with self._lock:
            if self.report is not None:
                return
            if self._failure is None:
                try:
                    if connection.poll(timeout):
                        self._take(*connection.recv())
                except (EOFError, OSError):
                    process.join(PATIENCE)
                    self._failure = LoopError(self._last_words())
            if self._failure is not None:
                self._remove_files()
                raise self._failure

    def _take(self, kind: str, content: Any) -> None:
        if kind == "doing":
            self.message = content
        elif kind == "ready":
            self.message, self._ready = "running", True
            self.resolution, self.force_error = content
        elif kind == "pattern":
            self.pattern = content
        elif kind == "changed" and self.pattern is not None:
            self.pattern = self.pattern.with_material(content)
        elif kind == "answer":
            self._answers.append(content)
        elif kind == "report":
            self.message, self.report = "ended", content
        else:
            problem, of_input = content
            self.message, self._failure = problem, InputError(problem) if of_input else LoopError(problem)

    def _last_words(self) -> str:
        code = self.exit_code
        how = f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"
        if self.message == "starting":
            return (f"the process of the loop {how} before it began; a script that starts one must do so under \"if "
                    "__name__ == '__main__':\", otherwise see what it printed")
        self.message = f"the process of the loop {how}; before that: {self.message}"
        return self.message

    def _end(self, patience: float) -> None:
        """Wait for the end of the process, then enforce it."""
        process, connection = self._process, self._connection
        if process is None or connection is None:
            return
        process.join(patience)
        for enforce in (process.terminate, process.kill):
            if process.is_alive():
                enforce()
                process.join(PATIENCE)
        connection.close()
        self._remove_files()

    def _remove_files(self) -> None:
        for path in self._files:
            remove(path)
