"""Multirate simulation whose bulk is linearised in another process, and the choice of a tissue for a loop at 1 kHz.

The process linearises the bulk at the state of the contact, publishes the model, repeats, and ends with its parent.
Tangents are condensed in a separate thread; the library releases the lock of the Python interpreter meanwhile.
"""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from haptics.loop.shared_slots import (
    SLOTS,
    SlotReader,
    SlotWriter,
    SnapshotReader,
    SnapshotWriter,
    find_unused_path,
    remove_files_ignoring_errors,
)
from tissue_sim.bounded import pack_task, run_packed_task
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError
from tissue_sim.fem.condensed.model import (
    LINEARISATIONS,
    BulkLineariser,
    CondensedBulk,
    ContactState,
    ContactSurface,
    compute_packed_state_size,
    max_packed_linearisation_size,
)
from tissue_sim.fem.condensed.predictive_linearisation import PREDICTION, PredictiveLineariser
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.realtime import multirate
from tissue_sim.realtime.multirate import BulkLink, make_untouched_state
from tissue_sim.realtime.simulator import Simulator
from tissue_sim.realtime.tissue import MotionLimits
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


class BulkProcess:
    """Bulk in a separate process that linearises continuously.

    Args:
        model: experiment and material.
        solver: name of the solver.
        resolution: resolution of the mesh.
        mesh: mesh of the solver's type; None: generated with `resolution`.
    """

    def __init__(self, model: Model, *, solver: str = "solid", resolution: str = "realtime", mesh: Any = None):
        self._task = pack_task(make_bulk_lineariser, (model, solver, resolution, mesh))
        self._paths = tuple(find_unused_path(ending) for ending in ("states", "models", "corrections", "surface"))
        self._process: subprocess.Popen[bytes] | None = None
        self._surface: ContactSurface | None = None

    def start(self) -> CondensedBulk:
        """Start the process and return its model of the undeformed tissue; raises the errors of `BulkLink.start`."""
        one = {"MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._process = process = subprocess.Popen(
            [sys.executable, "-c", "from haptics.loop.multirate import main; main()"], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, env={**one, **os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))})
        assert process.stdin is not None and process.stdout is not None
        self._write_to_process_stdin(struct.pack("<Q", len(self._task)) + self._task)
        self._write_to_process_stdin(pickle.dumps(self._paths))
        try:
            started: BulkReadyMessage | InputError = pickle.load(process.stdout)
        except EOFError:
            raise RuntimeError("the process of the bulk ended during its start; see its printed errors") from None
        if isinstance(started, Exception):
            raise started
        self._surface = started.surface
        size = 8 * compute_packed_state_size(self.contact_surface)
        self._states = SlotWriter(self._paths[0], KIND_STATE, SLOTS.count, size)
        self._models = SlotReader(self._paths[1], KIND_MODEL)
        self._corrections, self._corrected = SlotReader(self._paths[2], KIND_CORRECTION), 0
        self._board = None if started.pattern is None else SnapshotReader(self._paths[3], started.pattern)
        self._shown = started.pattern
        #: Numbers of the last model received and of the model being read, bytes read of it, and their checksum.
        self._received, self._reading, self._piece, self._check = 0, 0, 0, 0
        self._model = started.model
        #: Buffer into which the next model is read, and buffer of the last model.
        self._buffers = bytearray(self._models.max_content_size), bytearray(self._models.max_content_size)
        self._write_to_process_stdin(b"go\n")
        return started.model

    @property
    def contact_surface(self) -> ContactSurface:
        """Contact nodes and tool of the bulk; available after `start`."""
        assert self._surface is not None
        return self._surface

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    def send_state(self, state: ContactState) -> None:
        """Write a state to the shared file of states, without waiting."""
        self._states.write(state.pack_to_array().tobytes())

    def receive_model(self, now: float) -> CondensedBulk | None:
        """Read one piece of a model; return the model if it is complete, otherwise a new correction or None."""
        found = self._receive_model_piece() or self._receive_model_with_last_tangent()
        if found is not None:
            self._model = found
        return found

    def send_state_and_wait_for_model(self, state: ContactState) -> CondensedBulk | None:
        """Send a state and wait for the next model; None if none arrives.

        The longest waiting time is `BulkCommunicationSettings.longest_exchange`.
        """
        now = time.monotonic()
        deadline, sends = now + BULK_PROCESS.longest_exchange, now
        while now < deadline and self.is_alive:
            if now >= sends:
                self.send_state(state)
                sends = now + BULK_PROCESS.resend_interval
            if (model := self.receive_model(state.time)) is not None:
                return model
            time.sleep(BULK_PROCESS.polling_interval)
            now = time.monotonic()
        return None

    def _receive_model_piece(self) -> CondensedBulk | None:
        """Read the next piece of a model with tangent; return the model when it is complete, otherwise None.

        The arrays of the model are valid until the next complete model.
        """
        models = self._models
        if self._reading == 0:
            if models.written_count == self._received:
                return None
            self._reading, self._piece = models.written_count, 0
            self._check = self._reading & 0xFFFFFFFF
        length, checksum = models.read_content_length_and_checksum(self._reading)
        end = min(self._piece + BULK_PROCESS.piece, length)
        piece = models.read_unchecked_content_bytes(self._reading, self._piece, end)
        self._buffers[0][self._piece:end] = piece
        self._check, self._piece = zlib.crc32(piece, self._check), end
        if end < length:
            return None
        number, self._reading = self._reading, 0
        if self._check != checksum or models.read_content_length_and_checksum(number) != (length, checksum):
            return None  # the slot was overwritten during reading: start again
        self._received, self._buffers = number, self._buffers[::-1]
        return CondensedBulk.unpack_from_array(np.frombuffer(self._buffers[1], count=length // 8))

    def _receive_model_with_last_tangent(self) -> CondensedBulk | None:
        """Return a new model without own tangent (a correction), which reuses the last complete tangent, or None."""
        corrections = self._corrections
        if corrections.written_count == self._corrected:
            return None
        newest = corrections.read_newest_number_and_content()
        if newest is None:
            return None
        self._corrected, content = newest
        return CondensedBulk.unpack_from_array(np.frombuffer(content), self._model)

    def set_material(self, material: Material, number: int) -> None:
        """Send a material and its number to the process."""
        self._write_to_process_stdin(pickle.dumps((number, material)))

    def snapshot(self) -> Snapshot | None:
        """Return the newest published snapshot, at first of the undeformed tissue; None if the bulk publishes none."""
        if self._board is not None:
            newest = self._board.latest()
            self._shown = self._shown if newest is None else newest.snapshot
        return self._shown

    def close(self) -> None:
        """End the process, if necessary by killing it, and remove the shared files."""
        process = self._process
        if process is None:
            return
        if self._surface is not None:
            self._states.close()
            self._models.close()
            self._corrections.close()
            if self._board is not None:
                self._board.close()
        if process.stdin is not None:
            with suppress(OSError):  # the process was killed before it read all of its input
                process.stdin.close()  # the process ends at the end of its input
        try:
            process.wait(BULK_PROCESS.end_timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
        remove_files_ignoring_errors(*self._paths)
        self._process = None

    def _write_to_process_stdin(self, content: bytes) -> None:
        """Write bytes to the standard input of the process at once; raises an OSError if the process has ended."""
        assert self._process is not None and self._process.stdin is not None
        self._process.stdin.write(content)
        self._process.stdin.flush()


__getattr__ = make_getattr_for_old_names(__name__, {
    "ERROR_FLOOR": "tissue_sim.tool_force:ERROR_FLOOR", "ERROR_SHARE": "tissue_sim.tool_force:ERROR_SHARE",
    "OLDEST": "tissue_sim.realtime.multirate:OLDEST"})


class MultiRateTissue(multirate.MultiRateTissue):
    """`tissue_sim.realtime.multirate.MultiRateTissue` with a process for the bulk, which `warm_up` starts.

    Args:
        model: experiment and material.
        solver: solver of the bulk; see `tissue_sim.fem.condensed.model.LINEARISATIONS`.
        resolution: resolution of the mesh of the bulk.
        mesh: mesh of the bulk; None: generated with `resolution`.
        link: link to a bulk; None: to a new process.
        oldest: largest age of the model of a CONVERGED force, s.
        waits: whether a step blocks until the bulk has sent a model for the pose of the step.
        limits: limits of poses and time steps; see `MotionLimits`.

    Raises:
        InputError: a `Simulator` refuses the model; `warm_up` also raises the errors of the linearisation.
    """

    def __init__(self, model: Model, *, solver: str = "solid", resolution: str = "realtime", mesh: Any = None,
                 link: BulkLink | None = None, oldest: float = multirate.MULTIRATE.oldest, waits: bool = False,
                 limits: MotionLimits | None = None):
        self.require_valid_arguments(model, oldest)  # before the task of the process is packed
        super().__init__(model, link or BulkProcess(model, solver=solver, resolution=resolution, mesh=mesh),
                         resolution=resolution if mesh is None else "own mesh", oldest=oldest, waits=waits,
                         limits=limits)


#: Default wall-time budget of a step in a tick of 1 ms, s; the rest of the tick is left for the ring and the snapshots.
STEP_BUDGET = 0.8e-3


def make_real_time_tissue_factory(model: Model, *, solver: str, resolution: str, budget: float | None,
                                  inertia: str = "auto", looks_ahead: bool = False,
                                  simulator: type[Simulator] = Simulator, mesh: Any = None) -> partial[Any]:
    """Return a function without arguments that makes a tissue for steps at 1 kHz; it can be sent to another process.

    The tissue is a `MultiRateTissue` if the bulk of the solver can be linearised, otherwise a `Simulator`.

    Args:
        model: experiment and material.
        solver: name of the solver.
        resolution: resolution of the mesh.
        budget: computing time per step, s; see `Simulator`.
        inertia: ``auto``, ``on`` or ``off``; see `Simulator`.
        looks_ahead: see `Simulator`.
        simulator: class used instead of `Simulator`.
        mesh: mesh; None: generated with `resolution`.

    Raises:
        InputError: ``inertia = 'on'`` for a solver without inertia.
    """
    if solver not in LINEARISATIONS:
        given = {} if mesh is None else {"mesh": mesh}
        return partial(simulator, model, resolution=resolution, inertia=inertia, looks_ahead=looks_ahead, budget=budget,
                       solver=solver, **given)
    if inertia == "on":
        raise InputError(f"inertia must be 'auto' or 'off' for a multirate solid, which has no mass ({solver!r}); got "
                         "'on'", field="inertia")
    return partial(MultiRateTissue, model, solver=solver, resolution=resolution, mesh=mesh)
