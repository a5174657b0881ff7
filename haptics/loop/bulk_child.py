"""Process of a bulk: linearise the bulk at the state of the contact, publish the model, repeat; end with the parent.

Tangents are condensed in a separate thread; the library releases the lock of the Python interpreter meanwhile.
"""

from __future__ import annotations

import os
import pickle
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from haptics.loop.shared_slots import SLOTS, SlotReader, SlotWriter, remove_files_ignoring_errors
from haptics.loop.snapshot_board import SnapshotWriter
from tissue_sim.bounded import run_packed_task
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError
from tissue_sim.fem.condensed.model import (
    LINEARISATIONS,
    BulkLineariser,
    CondensedBulk,
    ContactState,
    ContactSurface,
    max_packed_linearisation_size,
)
from tissue_sim.fem.condensed.predictive_linearisation import PREDICTION, PredictiveLineariser
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.realtime.multirate import make_untouched_state
from tissue_sim.snapshot import Snapshot, snapshot


@dataclass(frozen=True)
class BulkCommunicationSettings:
    """Communication with the process of a bulk.

    Attributes:
        piece: bytes of a model that are read in one tick. A larger piece delivers the model earlier and takes more of
            the tick.
        end_timeout: time that the process has to end before it is killed, s.
        longest_exchange: longest wall time that `BulkLink.send_state_and_wait_for_model` blocks, s.
        polling_interval: polling interval of `BulkLink.send_state_and_wait_for_model`, s. A longer interval uses less
            CPU time and delays the model.
        resend_interval: time after which `BulkLink.send_state_and_wait_for_model` sends the state again, s, so that a
            bulk without a linearisation tries again.
        idle_sleep: sleep of the process when no new state is available, s. A longer sleep uses less CPU time and
            delays the model.
        surface_interval: time between two publications of the surface, s. A longer interval uses less CPU time.
        niceness: increment of the niceness of the process, so that the loop has priority on computers with few cores.
    """

    piece: int = 1 << 16
    end_timeout: float = 5.0
    longest_exchange: float = 60.0
    polling_interval: float = 0.2e-3
    resend_interval: float = 0.05
    idle_sleep: float = 0.5e-3
    surface_interval: float = 0.05
    niceness: int = 5


#: Settings of every process of a bulk.
BULK_PROCESS = BulkCommunicationSettings()
#: Kind of the shared file of contact states.
KIND_STATE = b"tsSTATE\0"
#: Kind of the shared file of models with tangent.
KIND_MODEL = b"tsBULK\0\0"
#: Kind of the shared file of models without tangent (corrections).
KIND_CORRECTION = b"tsCORR\0\0"


class BulkReadyMessage(NamedTuple):
    """Message to the parent when the bulk is ready.

    Attributes:
        surface: contact nodes and tool of the bulk.
        model: model of the undeformed tissue.
        pattern: pattern of the snapshots; None without snapshots.
    """

    surface: ContactSurface
    model: CondensedBulk
    pattern: Snapshot | None


def make_bulk_lineariser(model: Model, solver: str, resolution: str, mesh: Any) -> BulkLineariser:
    """Create the object that linearises the bulk of a model with a solver; does not linearise yet.

    Raises:
        InputError: the solver has no linearisation, or it does not support the model.
    """
    if solver not in LINEARISATIONS:
        raise InputError(f"solver must be {' or '.join(LINEARISATIONS)} for a linearised bulk; got {solver!r}",
                         field="solver")
    return LINEARISATIONS.find(solver, "solver")(model, resolution=resolution, mesh=mesh)


def start_in_thread_and_get_finish_check(compute: Callable[[], None]) -> Callable[[], bool]:
    """Run `compute` in a new thread; return a function that returns True once the computation has finished."""
    thread = threading.Thread(target=compute, daemon=True)
    thread.start()
    return lambda: not thread.is_alive()


def run_bulk_in_this_process(task: bytes, orders: BinaryIO, answers: BinaryIO) -> None:
    """Create the bulk, notify the parent, and linearise until the input ends.

    Args:
        task: packed call that creates the linearisation.
        orders: input: first the paths of states, models, corrections and surface, then changes of the material, each a
            pair (number, material).
        answers: output: a `BulkReadyMessage`, or the error that prevented the start.
    """
    paths = states_path, models_path, corrections_path, surface_path = pickle.load(orders)
    try:
        bulk = run_packed_task(task)
        predictive = PredictiveLineariser(bulk)
        first = predictive.linearise_at_predicted_pose_or_none(make_untouched_state(bulk.surface), 0.0, 0.0)
        bulk.executor = start_in_thread_and_get_finish_check
        if first is None:
            raise InputError("the bulk must have a linearisation of the undeformed tissue; the solver returned none",
                             field="specimen")
    except (InputError, ConvergenceError, MissingBackendError) as error:
        pickle.dump(error, answers)
        answers.flush()
        return
    pattern = _make_bulk_snapshot(bulk, first)
    whole, part = (8 * max_packed_linearisation_size(bulk.surface, is_whole) for is_whole in (True, False))
    with (SlotWriter(models_path, KIND_MODEL, SLOTS.count, whole) as models,
          SlotWriter(corrections_path, KIND_CORRECTION, SLOTS.count, part) as corrections,
          SnapshotWriter(surface_path, pattern) as board):
        pickle.dump(BulkReadyMessage(bulk.surface, first, pattern), answers)
        answers.flush()
        orders.readline()  # wait until the parent has opened the files
        materials: deque[tuple[int, Material]] = deque()
        threading.Thread(target=_receive_materials_then_exit_process, args=(orders, materials, paths),
                         daemon=True).start()
        with SlotReader(states_path, KIND_STATE) as states:
            _run_linearisation_loop(bulk, predictive, states, (models, corrections), board, materials)


def _run_linearisation_loop(bulk: BulkLineariser, predictive: PredictiveLineariser, states: SlotReader,
                            writers: tuple[SlotWriter, SlotWriter], board: SnapshotWriter,
                            materials: deque[tuple[int, Material]]) -> None:
    """Linearise the bulk at each new state; publish models and snapshots, apply new materials; never returns."""
    models, corrections = writers
    seen, lead, shown, changed, serves = 0, 0.0, 0.0, time.monotonic(), 0.0
    while True:
        while materials:
            number, material = materials.popleft()
            try:
                predictive.set_material(material, number)
            except InputError as refused:
                # No model will have this number, so the status in the parent is LATE until the next change.
                print(f"the bulk keeps its material: {refused}", file=sys.stderr, flush=True)
        newest = states.read_newest_number_and_content() if states.written_count != seen else None
        if newest is None:
            time.sleep(BULK_PROCESS.idle_sleep)
            continue
        began = time.monotonic()
        seen, content = newest
        model = predictive.linearise_at_predicted_pose_or_none(ContactState.unpack_from_array(np.frombuffer(content)),
                                                               lead, serves)
        if model is None:
            time.sleep(BULK_PROCESS.idle_sleep)  # no linearisation at this state: wait for the next state
            continue
        (models if model.has_own_tangent else corrections).write(model.pack_to_array().tobytes())
        now = time.monotonic()
        lead = PREDICTION.lead_factor * (now - began)
        if model.has_own_tangent:
            # A tangent is used until the next one is finished, whose computation begins when this one is published.
            changed, serves = now, 2.0 * (now - changed)
        if now - shown > BULK_PROCESS.surface_interval:
            board.publish(model.time, _make_bulk_snapshot(bulk, model))
            shown = now


def _make_bulk_snapshot(bulk: BulkLineariser, model: CondensedBulk) -> Snapshot:
    """Return a snapshot of the solver's deformed tissue with the pose of the model; does not publish it."""
    return replace(snapshot(bulk.solver), pose=model.pose, datum=bulk.surface.datum)


def _receive_materials_then_exit_process(orders: BinaryIO, materials: deque[tuple[int, Material]],
                                         files: tuple[Path, ...]) -> None:
    """Queue received materials until the input ends, then remove `files` and end this process; a thread's body."""
    try:
        while True:
            materials.append(pickle.load(orders))
    except (EOFError, OSError):
        remove_files_ignoring_errors(*files)
        os._exit(0)


def main() -> None:
    """Entry point of the process of a bulk: read the task from the standard input and run it."""
    orders = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # printed text must not mix with the binary output
    if hasattr(os, "nice"):
        os.nice(BULK_PROCESS.niceness)  # the loop has priority on computers with few cores
    size, = struct.unpack("<Q", orders.read(8))
    run_bulk_in_this_process(orders.read(size), orders, answers)


if __name__ == "__main__":
    main()
