"""What runs in the process of a bulk: linearise where the contact is, publish, again; and end when the parent does.

Tangents are condensed in a thread beside, which holds no lock of Python's while the library works."""

from __future__ import annotations

import os
import pickle
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from haptics.loop.shared_slots import SlotReader, SlotWriter, remove
from haptics.loop.snapshot_board import SnapshotBoard
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError
from tissue_sim.fem.condensed.model import (
    LINEARISATIONS,
    BulkLinearisation,
    CondensedContact,
    ContactState,
    ContactSurface,
    max_packed_size,
)
from tissue_sim.fem.condensed.predictive_linearisation import LEAD_FACTOR, PredictiveLinearisation
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.packing import run_packed
from tissue_sim.snapshot import Snapshot, snapshot

KIND_STATE, KIND_MODEL, KIND_CORRECTION = b"tsSTATE\0", b"tsBULK\0\0", b"tsCORR\0\0"
_SLOTS = 4
#: How long to sleep where there is nothing new, and between two publications of the surface, s.
_NAP, _SHOW_EVERY = 0.5e-3, 0.05
#: By how much the priority of the process is lower than the loop's.
_NICE = 5


class Started(NamedTuple):
    """What the parent is told when the bulk has been made: its surface, its first model, a pattern of its snapshots."""

    surface: ContactSurface
    model: CondensedContact
    pattern: Snapshot | None


def make_linearisation(model: Model, solver: str, resolution: str, mesh: Any) -> BulkLinearisation:
    """The linearisation of a model's bulk.

    Raises:
        InputError: a solver that has none, or a model that it cannot take.
    """
    if solver not in LINEARISATIONS:
        raise InputError(f"the solver {solver!r} has no bulk to linearise; use {' or '.join(LINEARISATIONS)}",
                         field="solver")
    return LINEARISATIONS.find(solver, "solver")(model, resolution=resolution, mesh=mesh)


def in_a_thread(compute: Callable[[], None]) -> Callable[[], bool]:
    """A `tissue_sim.fem.condensed.model.Executor`."""
    thread = threading.Thread(target=compute, daemon=True)
    thread.start()
    return lambda: not thread.is_alive()


def first_state(surface: ContactSurface) -> ContactState:
    """Of a tool that has touched nothing."""
    nothing, count = np.zeros((len(surface.places), 3)), len(surface.places)
    return ContactState(0, 0, 0.0, surface.start, 0.0, surface.start, nothing, nothing, np.zeros((3, count)), False)


def serve(task: bytes, orders: BinaryIO, answers: BinaryIO) -> None:
    """Make the bulk, tell the parent, and linearise until the orders end.

    Args:
        task: that makes the linearisation.
        orders: first the paths of states, models, corrections and surface; then changes of material, each a pair of
            its number and the material.
        answers: gets a `Started`, or the error that prevented it.
    """
    paths = states_path, models_path, corrections_path, surface_path = pickle.load(orders)
    try:
        bulk = run_packed(task)
        predictive = PredictiveLinearisation(bulk)
        first = predictive.linearise(first_state(bulk.surface), 0.0, 0.0)
        bulk.executor = in_a_thread
        if first is None:
            raise InputError("the untouched tissue has no linearisation", field="specimen")
    except (InputError, ConvergenceError, MissingBackendError) as error:
        pickle.dump(error, answers)
        answers.flush()
        return
    pattern = _snapshot(bulk, first)
    whole, part = (8 * max_packed_size(bulk.surface, is_whole) for is_whole in (True, False))
    with (SlotWriter(models_path, KIND_MODEL, _SLOTS, whole) as models,
          SlotWriter(corrections_path, KIND_CORRECTION, _SLOTS, part) as corrections,
          SnapshotBoard(surface_path, pattern) as board):
        pickle.dump(Started(bulk.surface, first, pattern), answers)
        answers.flush()
        orders.readline()  # the parent has opened its files
        materials: deque[tuple[int, Material]] = deque()
        threading.Thread(target=_listen, args=(orders, materials, paths), daemon=True).start()
        with SlotReader(states_path, KIND_STATE) as states:
            _linearise(bulk, predictive, states, (models, corrections), board, materials)


def _linearise(bulk: BulkLinearisation, predictive: PredictiveLinearisation, states: SlotReader,
               writers: tuple[SlotWriter, SlotWriter], board: SnapshotBoard,
               materials: deque[tuple[int, Material]]) -> None:
    models, corrections = writers
    seen, lead, shown, changed, serves = 0, 0.0, 0.0, time.monotonic(), 0.0
    while True:
        while materials:
            number, material = materials.popleft()
            try:
                predictive.set_material(material, number)
            except InputError as refused:
                # No model carries this number, so the parent answers LATE until the next change.
                print(f"the bulk keeps its material: {refused}", file=sys.stderr, flush=True)
        newest = states.newest() if states.written != seen else None
        if newest is None:
            time.sleep(_NAP)
            continue
        began = time.monotonic()
        seen, content = newest
        model = predictive.linearise(ContactState.unpack(np.frombuffer(content)), lead, serves)
        if model is None:
            time.sleep(_NAP)  # the loop has not taken the last one yet
            continue
        (models if model.has_own_tangent else corrections).write(model.pack().tobytes())
        now = time.monotonic()
        lead = LEAD_FACTOR * (now - began)
        if model.has_own_tangent:
            # A tangent serves until the next one is there, which is begun when it comes.
            changed, serves = now, 2.0 * (now - changed)
        if now - shown > _SHOW_EVERY:
            board.publish(model.time, _snapshot(bulk, model))
            shown = now


def _snapshot(bulk: BulkLinearisation, model: CondensedContact) -> Snapshot:
    return replace(snapshot(bulk.solver), pose=model.pose, datum=bulk.surface.datum)


def _listen(orders: BinaryIO, materials: deque[tuple[int, Material]], files: tuple[Path, ...]) -> None:
    """Take materials until the parent is gone, then end."""
    try:
        while True:
            materials.append(pickle.load(orders))
    except (EOFError, OSError):
        for path in files:
            remove(path)
        os._exit(0)


def main() -> None:
    """Run the task that stands in the standard input."""
    orders = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what is printed must not stand between the answers
    if hasattr(os, "nice"):
        os.nice(_NICE)  # the loop comes first where there are few cores
    size, = struct.unpack("<Q", orders.read(8))
    serve(orders.read(size), orders, answers)


if __name__ == "__main__":
    main()
