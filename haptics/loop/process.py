"""Run the loop in a separate process, because a Taichi kernel holds the lock of its Python interpreter.

The child process creates the tissue, warms it up, runs the loop, reports, and ends with the parent process.
"""

from __future__ import annotations

import multiprocessing
import pickle
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from haptics.devices.contracts import DeviceError, HapticDevice
from haptics.loop.loop import COMMANDS, Loop, LoopReport, LoopSettings, get_mesh_resolution_and_force_error
from haptics.loop.ring import RingReader, RingWriter
from haptics.loop.shared_slots import SnapshotReader, SnapshotWriter, find_unused_path, remove_files_ignoring_errors
from haptics.safety.rendering import ForceRendering
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError, make_hint_with_similar_or_known_words
from tissue_sim.public_names import OldName, with_old_names
from tissue_sim.registry import list_registered_groups_names_objects, register_objects_of_other_process
from tissue_sim.signals import (
    child_processes_ignore_ctrl_c,
    ignore_ctrl_c_and_exit_with_parent,
    limit_threads_of_child_processes,
)
from tissue_sim.snapshot import DisplayableTissue, Snapshot
from tissue_sim.tool_force import Tissue

#: Errors with a message for the user; other errors are faults of the program.
_EXPECTED = (InputError, ConvergenceError, MissingBackendError, DeviceError)


@dataclass(frozen=True)
class LoopProcessTimeouts:
    """Waiting times of the process of a loop and of its parent, s.

    Attributes:
        patience: time that the loop has to answer a command, or to end. A longer time tolerates a slower computer, and
            reports a blocked loop later.
        grace: time that the loop has to end after its parent has ended.
    """

    patience: float = 5.0
    grace: float = 0.5


#: Times of every process of a loop.
PROCESS_TIMES = LoopProcessTimeouts()


class SharedLoopFiles(NamedTuple):
    """Shared files from which other processes read.

    Attributes:
        ring: ring of ticks.
        snapshots: board of snapshots.
    """

    ring: Path
    snapshots: Path


class LoopComponents(NamedTuple):
    """Components of a loop that are sent to its process.

    Attributes:
        make_tissue: creates the tissue in the process of the loop.
        device: haptic device or motion.
        rendering: conversion of poses and forces.
        settings: settings of the loop.
    """

    make_tissue: Callable[[], Tissue]
    device: HapticDevice
    rendering: ForceRendering
    settings: LoopSettings


def run_loop_in_this_process(connection: Connection, parts: LoopComponents, files: SharedLoopFiles,
                             things: list[tuple[str, str, Any]]) -> None:
    """Run a loop in this process and communicate with the parent process.

    Messages to the parent are pairs (kind, content): ``doing`` with a sentence; ``pattern`` of the snapshots, if there
    are any; ``ready``; ``changed`` with the new material data of the pattern; ``answer`` to each command, empty on
    success or with the reason of the refusal; at the end ``report``, or ``error`` with a sentence and whether invalid
    input is the cause.

    Args:
        connection: connection to the parent.
        parts: components of the loop.
        files: shared files to write.
        things: plug-ins registered in the parent, to be registered here too.
    """
    # The creation of the tissue does not read the connection, so it cannot notice the end of the parent.
    ignore_ctrl_c_and_exit_with_parent(PROCESS_TIMES.grace, partial(remove_files_ignoring_errors, *files))
    try:
        register_objects_of_other_process(things)
        report = _run_new_loop_and_get_report(connection, parts, files)
    except Exception as error:
        expected = isinstance(error, _EXPECTED)
        sentence = " ".join(str(error).split())
        if not expected:
            traceback.print_exc()
            sentence = f"{type(error).__name__}: {sentence}"
        _send_message(connection, "error", (sentence, isinstance(error, InputError)))
        sys.exit(1)
    _send_message(connection, "report", report)


def _run_new_loop_and_get_report(connection: Connection, parts: LoopComponents, files: SharedLoopFiles) -> LoopReport:
    """Create the tissue, start the device, and run the loop; notify the parent, and return the report."""
    settings = parts.settings
    with ExitStack() as stack:
        ring = stack.enter_context(RingWriter(files.ring, settings.capacity))
        _send_message(connection, "doing", "making the tissue")
        tissue = parts.make_tissue()
        if hasattr(tissue, "warm_up"):
            _send_message(connection, "doing",
                          "loading the solver (the first run on a computer compiles it, about 10 s)")
            tissue.warm_up()
        snapshots = shown = None
        if settings.snapshot_rate and isinstance(tissue, DisplayableTissue):
            pattern = tissue.snapshot()
            if pattern.arrays():
                shown, snapshots = tissue, stack.enter_context(SnapshotWriter(files.snapshots, pattern))
                _send_message(connection, "pattern", pattern)
        loop = Loop(tissue, parts.device, parts.rendering, settings, ring, snapshots=snapshots,
                    listen=lambda loop: _execute_received_commands(loop, connection, shown))
        # Started last: a user must not hold a device during compilation.
        parts.device.start()
        _send_message(connection, "ready", get_mesh_resolution_and_force_error(tissue))
        return loop.run()


def _execute_received_commands(loop: Loop, connection: Connection, shown: DisplayableTissue | None) -> None:
    """Execute and answer the commands that the parent has sent so far; stop the loop if the parent has ended.

    Args:
        loop: the loop.
        connection: connection to the parent.
        shown: the tissue if snapshots are published, otherwise None.
    """
    try:
        while connection.poll():
            command, values = connection.recv()
            try:
                COMMANDS[command](loop, **values)
                if command == "set_parameters" and shown is not None:
                    # Only the material: sending all arrays of the pattern would take a large part of a tick.
                    connection.send(("changed", shown.snapshot().material_data()))
                connection.send(("answer", ""))
            except (InputError, DeviceError) as error:
                connection.send(("answer", str(error)))
    except (EOFError, OSError):
        loop.stop("parent")


def _send_message(connection: Connection, kind: str, content: Any = None) -> None:
    """Send a pair (kind, content) to the parent; has no effect if the parent has ended."""
    with suppress(OSError):  # the parent has ended
        connection.send((kind, content))


#: Time that the loop has to answer a command, or to end, s.
PATIENCE = PROCESS_TIMES.patience


class LoopError(RuntimeError):
    """The process of the loop ended unexpectedly or does not answer."""


@with_old_names(poll="read_message_and_check_ready", ring="open_ring_reader", snapshots="open_snapshot_reader")
class LoopProcess:
    """Haptic loop in a separate process. As a context manager it stops the process at the end of the block.

    A script must start the process under ``if __name__ == "__main__":``.

    Args:
        make_tissue: creates the tissue in the process of the loop, such as ``functools.partial(ts.Simulator, model)``;
            the tissue is warmed up before the first tick if it has `warm_up`.
        device: haptic device or motion; started in the process of the loop when the tissue is ready.
        rendering: conversion of poses and forces; see `ForceRendering`.
        settings: settings of the loop; None: defaults.
        ring_path: file of the ring; None: an unused file in `haptics.loop.shared_slots.get_or_create_runtime_folder`.

    Attributes:
        ring_path: file of the ring of ticks, for viewers and recorders, while the process runs.
        snapshot_path: file of the snapshots, while the process runs.
        pattern: mesh and present material of the snapshots; None if no snapshots are published.
        message: last status message of the process.
        resolution: resolution of the mesh when the tissue is ready; see `LoopReport`.
        force_error: relative error of the force when the tissue is ready; see `LoopReport`.
        report: report of a loop that has ended; None before, and after an unexpected end.
        patience: time that the loop has to answer a command, s.

    Raises:
        InputError: the file of the ring exists already.
    """

    def __init__(self, make_tissue: Callable[[], Tissue], device: HapticDevice, rendering: ForceRendering,
                 settings: LoopSettings | None = None, *, ring_path: str | Path | None = None):
        self.ring_path = find_unused_path("ring") if ring_path is None else Path(ring_path)
        self.snapshot_path = self.ring_path.with_name(f"{self.ring_path.name}.snapshots")
        self._files = SharedLoopFiles(self.ring_path, self.snapshot_path)
        for path in self._files:
            if path.exists():
                raise InputError("exists already; remove the file or choose another name", file=path)
        self.message, self.report, self.patience = "not started", None, PATIENCE
        self._parts = LoopComponents(make_tissue, device, rendering, settings or LoopSettings())
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._lock = threading.RLock()
        self._ready = False
        self._failure: Exception | None = None
        self._answers: list[str] = []
        self.pattern: Snapshot | None = None
        self.resolution, self.force_error = "", None

    def start(self) -> None:
        """Start the process, and return before its first tick.

        Raises:
            InputError: the process was started before, or a component cannot be sent to another process.
        """
        if self._process is not None:
            raise InputError("this loop was started before; create another LoopProcess")
        context = multiprocessing.get_context("spawn")  # Taichi and threads do not work after a fork
        self._connection, far_end = context.Pipe()
        process = context.Process(target=run_loop_in_this_process,
                                  args=(far_end, self._parts, self._files, list_registered_groups_names_objects()),
                                  name="tissue-sim loop", daemon=True)
        try:
            with child_processes_ignore_ctrl_c(), limit_threads_of_child_processes():
                process.start()
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(f"cannot be sent to another process ({error}); use functions and classes defined at "
                             "module level", field="LoopProcess") from error
        finally:
            far_end.close()
        self._process, self.message = process, "starting"

    def wait_until_ready(self, timeout: float | None = None, progress: Callable[[str], None] | None = None) -> None:
        """Wait until the loop runs. The first run on a computer compiles the solver, which takes several seconds.

        Args:
            timeout: longest waiting time, s; None: no limit while the process runs.
            progress: called with each new status message.

        Raises:
            InputError: the tissue cannot be created from its input.
            LoopError: the process has ended, or the time is over.
        """
        until = None if timeout is None else time.monotonic() + timeout
        last_message = ""
        ready = False
        while not ready:
            ready = self.read_message_and_check_ready(0.1)
            if progress is not None and self.message != last_message:
                last_message = self.message
                progress(last_message)
            if not ready and until is not None and time.monotonic() > until:
                raise LoopError(f"the loop is not ready after {timeout:g} s: {self.message}")

    def read_message_and_check_ready(self, timeout: float = 0.0) -> bool:
        """Wait up to `timeout`, s, for one message, handle it, and return whether the loop has reached a tick.

        Raises:
            InputError: the process ended because of invalid input.
            LoopError: the process ended without a report for another reason.
        """
        self._read_one_message(timeout)
        return self._ready

    @property
    def ready(self) -> bool:
        """Whether the loop has reached its first tick, as known from the last message that was read."""
        return self._ready

    @property
    def alive(self) -> bool:
        """Whether the process of the loop runs."""
        return self._process is not None and self._process.is_alive()

    @property
    def pid(self) -> int | None:
        """Process id of the process of the loop; None before the start."""
        return None if self._process is None else self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Exit code: 0 after a normal end, minus the signal number if killed; None while running or not started."""
        return None if self._process is None else self._process.exitcode

    def open_ring_reader(self) -> RingReader:
        """Open and return a reader of the ring of ticks of a loop that is ready; the caller closes the reader."""
        return RingReader(self.ring_path)

    def open_snapshot_reader(self) -> SnapshotReader | None:
        """Open and return a reader of the snapshots, None if none are published; the caller closes the reader."""
        return None if self.pattern is None else SnapshotReader(self.snapshot_path, self.pattern)

    def pause(self) -> None:
        """Pause the motion; ticks continue and the force fades to zero. Raises the errors of `execute_command`."""
        self.execute_command("pause")

    def resume(self) -> None:
        """Continue the motion after a pause; raises the errors of `execute_command`."""
        self.execute_command("resume")

    def reset(self) -> None:
        """Restart the motion with undeformed tissue and zero force; raises the errors of `execute_command`."""
        self.execute_command("reset")

    def advance_paused_motion(self, seconds: float) -> None:
        """Continue the motion of a paused loop for this time, s; raises the errors of `execute_command`."""
        self.execute_command("advance", seconds=seconds)

    advance = OldName("advance_paused_motion")

    def switch_device(self, device: HapticDevice, restart: bool = False) -> None:
        """Replace the device or motion by another one, which starts from its beginning.

        Raises the errors of `execute_command`.

        Args:
            device: new device or motion, not started.
            restart: whether to continue with undeformed tissue and zero force.
        """
        self.execute_command("switch_device", device=device, restart=restart)

    def follow(self, device: HapticDevice, anew: bool = False) -> None:
        """Replace the device: deprecated name of `switch_device`."""
        # The second argument keeps its released keyword until the alias is removed.
        warnings.warn("LoopProcess.follow is renamed to switch_device(device, restart)", DeprecationWarning,
                      stacklevel=2)
        self.switch_device(device, restart=anew)

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Set the position, m, to which a steerable motion moves; raises the errors of `execute_command`.

        Args:
            depth: target depth, m.
            across: target position across the axis, m; None: unchanged.
        """
        self.execute_command("aim", depth=depth, across=across)

    def set_parameters(self, **values: float) -> None:
        """Change parameters of the tissue between two ticks.

        Raises:
            InputError: the tissue refuses a value; the loop continues unchanged.
            LoopError: the process has ended or does not answer.
        """
        self.execute_command("set_parameters", **values)

    def execute_command(self, command: str, **values: Any) -> None:
        """Send one of `haptics.loop.loop.COMMANDS` with its arguments, and wait until it is executed.

        Raises:
            InputError: the command is unknown, or the loop refuses it and continues unchanged.
            LoopError: the process has ended or does not answer.
        """
        if command not in COMMANDS:
            raise InputError(
                f"a loop has no command {command!r}{make_hint_with_similar_or_known_words(command, COMMANDS)}")
        with self._lock:
            if self._connection is None or not self._ready:
                raise LoopError(f"the loop is not ready: {self.message}")
            self._answers.clear()
            with suppress(OSError):  # the reason is found when reading
                self._connection.send((command, values))
            until = time.monotonic() + self.patience
            while not self._answers and self.report is None:
                self._read_one_message(0.1)
                if time.monotonic() > until:
                    raise LoopError(f"the loop must answer within {self.patience:g} s; got no answer. Send the "
                                    "command again, or stop the loop and start it again")
            if self._answers and self._answers[0]:
                raise InputError(self._answers[0])

    ask = OldName("execute_command")

    def wait(self, timeout: float | None = None) -> LoopReport | None:
        """Wait for the end of the loop.

        Args:
            timeout: longest waiting time, s; None: no limit.

        Returns:
            The report of the loop; None if the loop still runs after `timeout`.

        Raises:
            InputError: the process ended because of invalid input.
            LoopError: the process ended without a report for another reason.
        """
        until = None if timeout is None else time.monotonic() + timeout
        while self.report is None:
            remaining = 0.5 if until is None else until - time.monotonic()
            if remaining <= 0 and until is not None:
                return None
            self._read_one_message(min(remaining, 0.5))
        self._join_or_kill_and_clean_up(PATIENCE)
        return self.report

    def stop(self) -> LoopReport | None:
        """End the process, if necessary by killing it, and return its report, or None without a report."""
        connection, self.patience = self._connection, PATIENCE
        with suppress(LoopError, InputError, OSError):  # the process has already ended
            while connection is not None and not self._ready and connection.poll():
                self._read_one_message(0.0)
            if self._ready and self.report is None:
                self.execute_command("stop")
                self.wait(PATIENCE)
        self._join_or_kill_and_clean_up(0.0 if self.report is None and self._failure is None else PATIENCE)
        return self.report

    def __enter__(self) -> LoopProcess:
        self.start()
        return self

    def __exit__(self, *failure) -> None:
        self.stop()

    def _read_one_message(self, timeout: float) -> None:
        """Wait up to `timeout`, s, for one message of the process, and handle it; none after the report.

        Raises:
            InputError: the process ended because of invalid input.
            LoopError: the process ended without a report for another reason.
        """
        process, connection = self._process, self._connection
        if process is None or connection is None:
            raise LoopError("the loop was not started; call start first")
        with self._lock:
            if self.report is not None:
                return
            if self._failure is None:
                try:
                    if connection.poll(timeout):
                        self._handle_message(*connection.recv())
                except (EOFError, OSError):
                    process.join(PATIENCE)
                    self._failure = LoopError(self._describe_and_store_unexpected_end())
            if self._failure is not None:
                remove_files_ignoring_errors(*self._files)
                raise self._failure

    def _handle_message(self, kind: str, content: Any) -> None:
        """Store the content of a message of one kind: status, ready, pattern, material, answer, report or error."""
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

    def _describe_and_store_unexpected_end(self) -> str:
        """Return a sentence about the unexpected end of the process; store it as `message` unless at the start."""
        code = self.exit_code
        how = f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"
        if self.message == "starting":
            return (f"the process of the loop {how} during its start; in a script start it under \"if __name__ == "
                    "'__main__':\". Otherwise see its printed errors")
        self.message = f"the process of the loop {how}; before that: {self.message}"
        return self.message

    def _join_or_kill_and_clean_up(self, patience: float) -> None:
        """Wait `patience` s for the process, then terminate or kill it; close the connection, remove its files."""
        process, connection = self._process, self._connection
        if process is None or connection is None:
            return
        process.join(patience)
        for enforce in (process.terminate, process.kill):
            if process.is_alive():
                enforce()
                process.join(PATIENCE)
        connection.close()
        remove_files_ignoring_errors(*self._files)
