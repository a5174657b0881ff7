"""What runs in the process of a loop: build, warm up, tick, report; and end when the parent does."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from haptics.loop import Loop, LoopReport, LoopSettings
from haptics.motion_source import MotionSource
from haptics.rendering import ForceRendering
from haptics.ring import RingWriter
from haptics.shared_slots import remove
from haptics.surface_board import SurfaceBoard
from tissue_sim.child_process import follow_parent
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError
from tissue_sim.tool_force import Tissue

#: Errors that are a sentence for the user, and no fault of the program.
_EXPECTED = (InputError, ConvergenceError, MissingBackendError)
#: How long the loop has to end by itself when its parent is gone, s.
_GRACE = 0.5


def run_child(connection: Connection, build_tissue: Callable[[], Tissue], source: MotionSource,
              rendering: ForceRendering, settings: LoopSettings, ring_path: Path, surface_path: Path) -> None:
    """Run a loop for the parent at the other end of the connection.

    The parent is told, as pairs: ``doing`` a sentence; ``ready``; ``answer`` to each command, empty where it is done
    and else the reason why not; at the end ``report``, or ``error`` with a sentence and whether bad input is the cause.
    """
    def remove_files() -> None:
        for path in (ring_path, surface_path):
            remove(path)

    follow_parent(_GRACE, remove_files)  # while the tissue is built, nobody listens to the connection
    try:
        report = _loop(connection, build_tissue, source, rendering, settings, ring_path, surface_path)
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
          settings: LoopSettings, ring_path: Path, surface_path: Path) -> LoopReport:
    with ExitStack() as files:
        ring = files.enter_context(RingWriter(ring_path, settings.capacity))
        _say(connection, "doing", "building the tissue")
        tissue = build_tissue()
        if hasattr(tissue, "warm_up"):
            _say(connection, "doing", "loading the solver (a machine's first run compiles it, about 20 s)")
            tissue.warm_up()
        board = None
        if settings.surface_rate and hasattr(tissue, "surface"):
            board = files.enter_context(SurfaceBoard(surface_path, len(tissue.surface().outline)))
        _say(connection, "ready")
        return Loop(tissue, source, rendering, settings, ring, board=board,
                    listen=lambda loop: _listen(loop, connection)).run()


def _listen(loop: Loop, connection: Connection) -> None:
    """Do what the parent has asked for."""
    try:
        while connection.poll():
            command, values = connection.recv()
            try:
                getattr(loop, command)(**values)
                connection.send(("answer", ""))
            except InputError as error:
                connection.send(("answer", str(error)))
    except (EOFError, OSError):
        loop.stop("parent")


def _say(connection: Connection, kind: str, content: Any = None) -> None:
    with suppress(OSError):  # the parent is gone
        connection.send((kind, content))
