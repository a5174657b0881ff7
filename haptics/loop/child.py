"""What runs in the process of a loop: build, warm up, tick, report; and end when the parent does."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from haptics.devices.motion_source import MotionSource
from haptics.loop.loop import Loop, LoopReport, LoopSettings
from haptics.loop.ring import RingWriter
from haptics.loop.shared_slots import remove
from haptics.loop.snapshot_board import SnapshotBoard
from haptics.loop.surface_board import SurfaceBoard
from haptics.safety.rendering import ForceRendering
from tissue_sim.child_process import follow_parent
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError
from tissue_sim.tool_force import Tissue

#: Errors that are a sentence for the user, and no fault of the program.
_EXPECTED = (InputError, ConvergenceError, MissingBackendError)
#: How long the loop has to end by itself when its parent is gone, s.
_GRACE = 0.5


class LoopFiles(NamedTuple):
    """Where other processes read along."""

    ring: Path
    surface: Path
    snapshots: Path


def run_child(connection: Connection, build_tissue: Callable[[], Tissue], source: MotionSource,
              rendering: ForceRendering, settings: LoopSettings, files: LoopFiles) -> None:
    """Run a loop for the parent at the other end of the connection.

    The parent is told, as pairs: ``doing`` a sentence; ``pattern`` of the snapshots, where there are any; ``ready``;
    ``changed`` with what a change of the material changes in the pattern; ``answer`` to each command, empty where it is
    done and else the reason why not; at the end ``report``, or ``error`` with a sentence and whether bad input is the
    cause.
    """
    def remove_files() -> None:
        for path in files:
            remove(path)

    follow_parent(_GRACE, remove_files)  # while the tissue is built, nobody listens to the connection
    try:
        report = _loop(connection, build_tissue, source, rendering, settings, files)
    except Exception as error:
        expected = isinstance(error, _EXPECTED)
        sentence = " ".join(str(error).split())
        if not expected:
            traceback.print_exc()
            sentence = f"{type(error).__name__}: {sentence}"
        _say(connection, "error", (sentence, isinstance(error, InputError)))
        sys.exit(1)
    _say(connection, "report", report)


def _loop(connection: Connection, build_tissue: Callable[[], Tissue], source: MotionSource, rendering: ForceRendering,
          settings: LoopSettings, files: LoopFiles) -> LoopReport:
    with ExitStack() as stack:
        ring = stack.enter_context(RingWriter(files.ring, settings.capacity))
        _say(connection, "doing", "building the tissue")
        tissue = build_tissue()
        if hasattr(tissue, "warm_up"):
            _say(connection, "doing", "loading the solver (a machine's first run compiles it, about 20 s)")
            tissue.warm_up()
        board = snapshots = None
        if settings.surface_rate and hasattr(tissue, "surface"):
            board = stack.enter_context(SurfaceBoard(files.surface, len(tissue.surface().outline)))
        if settings.snapshot_rate and hasattr(tissue, "snapshot"):
            pattern = tissue.snapshot()
            snapshots = stack.enter_context(SnapshotBoard(files.snapshots, pattern))
            _say(connection, "pattern", pattern)
        _say(connection, "ready")
        return Loop(tissue, source, rendering, settings, ring, board=board, snapshots=snapshots,
                    listen=lambda loop: _listen(loop, connection, tissue if snapshots else None)).run()


def _listen(loop: Loop, connection: Connection, shown: Tissue | None) -> None:
    """Do what the parent has asked for.

    Args:
        shown: the tissue, where snapshots of it are published.
    """
    try:
        while connection.poll():
            command, values = connection.recv()
            try:
                getattr(loop, command)(**values)
                if command == "set_parameters" and shown is not None:
                    fields = shown.snapshot().fields
                    # Not the whole pattern: its arrays would take a good part of a tick.
                    connection.send(("changed", {name: getattr(fields, name) for name in fields.OF_THE_MATERIAL}))
                connection.send(("answer", ""))
            except InputError as error:
                connection.send(("answer", str(error)))
    except (EOFError, OSError):
        loop.stop("parent")


def _say(connection: Connection, kind: str, content: Any = None) -> None:
    with suppress(OSError):  # the parent is gone
        connection.send((kind, content))
