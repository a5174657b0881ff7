"""Child process of a loop: create the tissue, warm it up, run the loop, report, and end with the parent process."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from haptics.devices.contracts import DeviceError, HapticDevice
from haptics.loop.loop import COMMANDS, Loop, LoopReport, LoopSettings, get_mesh_resolution_and_force_error
from haptics.loop.ring import RingWriter
from haptics.loop.shared_slots import remove_files_ignoring_errors
from haptics.loop.snapshot_board import SnapshotWriter
from haptics.safety.rendering import ForceRendering
from tissue_sim.child_process import ignore_ctrl_c_and_exit_with_parent
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError
from tissue_sim.registry import register_objects_of_other_process
from tissue_sim.snapshot import DisplayableTissue
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
