"""What runs in the process of a loop: make the tissue, warm it up, tick, report; and end when the parent does."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from haptics.devices.contracts import DeviceError, HapticDevice
from haptics.loop.commands import COMMANDS
from haptics.loop.loop import Loop, LoopReport, LoopSettings, mesh_of
from haptics.loop.ring import RingWriter
from haptics.loop.shared_slots import remove
from haptics.loop.snapshot_board import SnapshotBoard
from haptics.safety.rendering import ForceRendering
from tissue_sim.child_process import follow_parent
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError
from tissue_sim.registry import register_all
from tissue_sim.snapshot import ShownTissue
from tissue_sim.tool_force import Tissue

#: Errors that are a sentence for the user, and no fault of the program.
_EXPECTED = (InputError, ConvergenceError, MissingBackendError, DeviceError)
#: How long the loop has to end by itself when its parent is gone, s.
_GRACE = 0.5


class LoopFiles(NamedTuple):
    """Where other processes read along."""

    ring: Path
    snapshots: Path


class LoopParts(NamedTuple):
    """What a loop is made of; its tissue is made where it runs."""

    make_tissue: Callable[[], Tissue]
    device: HapticDevice
    rendering: ForceRendering
    settings: LoopSettings


def run_child(connection: Connection, parts: LoopParts, files: LoopFiles, things: list[tuple[str, str, Any]]) -> None:
    """Run a loop for the parent at the other end of the connection.

    Args:
        connection: to the parent.
        parts: of the loop.
        files: to write.
        things: that were registered in the parent, for those who take their names here.

    The parent is told, as pairs: ``doing`` a sentence; ``pattern`` of the snapshots, where there are any; ``ready``;
    ``changed`` with what a change of the material changes in the pattern; ``answer`` to each command, empty where it is
    done and else the reason why not; at the end ``report``, or ``error`` with a sentence and whether bad input is the
    cause.
    """
    def remove_files() -> None:
        for path in files:
            remove(path)

    follow_parent(_GRACE, remove_files)  # while the tissue is made, nobody listens to the connection
    try:
        register_all(things)
        report = _loop(connection, parts, files)
    except Exception as error:
        expected = isinstance(error, _EXPECTED)
        sentence = " ".join(str(error).split())
        if not expected:
            traceback.print_exc()
            sentence = f"{type(error).__name__}: {sentence}"
        _say(connection, "error", (sentence, isinstance(error, InputError)))
        sys.exit(1)
    _say(connection, "report", report)


def _loop(connection: Connection, parts: LoopParts, files: LoopFiles) -> LoopReport:
    settings = parts.settings
    with ExitStack() as stack:
        ring = stack.enter_context(RingWriter(files.ring, settings.capacity))
        _say(connection, "doing", "making the tissue")
        tissue = parts.make_tissue()
        if hasattr(tissue, "warm_up"):
            _say(connection, "doing", "loading the solver (a machine's first run compiles it, some 10 s)")
            tissue.warm_up()
        snapshots = shown = None
        if settings.snapshot_rate and isinstance(tissue, ShownTissue):
            pattern = tissue.snapshot()
            if pattern.arrays():
                shown, snapshots = tissue, stack.enter_context(SnapshotBoard(files.snapshots, pattern))
                _say(connection, "pattern", pattern)
        loop = Loop(tissue, parts.device, parts.rendering, settings, ring, snapshots=snapshots,
                    listen=lambda loop: _listen(loop, connection, shown))
        # Last, so that nobody holds a device that waits for a compiler.
        parts.device.start()
        _say(connection, "ready", mesh_of(tissue))
        return loop.run()


def _listen(loop: Loop, connection: Connection, shown: ShownTissue | None) -> None:
    """Do what the parent has asked for.

    Args:
        shown: the tissue, where snapshots of it are published.
    """
    try:
        while connection.poll():
            command, values = connection.recv()
            try:
                COMMANDS[command](loop, **values)
                if command == "set_parameters" and shown is not None:
                    # Not the whole pattern: its arrays would take a good part of a tick.
                    connection.send(("changed", shown.snapshot().of_the_material()))
                connection.send(("answer", ""))
            except (InputError, DeviceError) as error:
                connection.send(("answer", str(error)))
    except (EOFError, OSError):
        loop.stop("parent")


def _say(connection: Connection, kind: str, content: Any = None) -> None:
    with suppress(OSError):  # the parent is gone
        connection.send((kind, content))
