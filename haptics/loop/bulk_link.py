"""Links between the contact solver and the slower solver of the bulk: in one process with a fixed delay, or in two."""

from __future__ import annotations

import math
import os
import pickle
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from haptics.loop.multirate_settings import BULK_PROCESS
from haptics.loop.shared_slots import SLOTS, SlotReader, SlotWriter, find_unused_path, remove_file
from haptics.loop.slow_bulk import (
    KIND_CORRECTION,
    KIND_MODEL,
    KIND_STATE,
    BulkReadyMessage,
    make_linearisation,
    make_untouched_state,
)
from haptics.loop.snapshot_board import SnapshotReader
from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import (
    BulkLinearisation,
    CondensedBulk,
    ContactState,
    ContactSurface,
    compute_packed_state_size,
)
from tissue_sim.fem.condensed.predictive_linearisation import PREDICTION, PredictiveLinearisation
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.packing import pack_task
from tissue_sim.snapshot import Snapshot


class BulkLink(Protocol):
    """Source of linearised models of the bulk. Call `close` at the end."""

    @property
    def contact_surface(self) -> ContactSurface:
        """Contact nodes and tool of the bulk; available after `start`."""

    @property
    def is_alive(self) -> bool:
        """Whether the bulk, or its process, still runs and can send models."""

    def start(self) -> CondensedBulk:
        """Start the bulk, wait until it is ready, and return its model of the undeformed tissue.

        Raises:
            InputError: the solver does not support the model.
            RuntimeError: the process of the bulk ended.
        """

    def send_state(self, state: ContactState) -> None:
        """Send the state of the contact, at which the bulk is linearised next, without waiting for the model."""

    def receive_model(self, now: float) -> CondensedBulk | None:
        """Return a model that has arrived since the last call, or None; does not wait. `now` is the loop's time, s."""

    def send_state_and_wait_for_model(self, state: ContactState) -> CondensedBulk | None:
        """Send a state and block until the next model arrives, which may belong to an earlier state.

        Returns:
            The model; None if none arrives within `BulkCommunicationSettings.longest_exchange` or the bulk has ended.
        """

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk; models of the new material have this `number` in their field `material`."""

    def snapshot(self) -> Snapshot | None:
        """Return a snapshot of the deformed tissue at a recent model; None for a link without snapshots."""

    def close(self) -> None:
        """End the bulk and free its resources."""


class DelayedBulk:
    """Bulk in this process whose models arrive after a fixed simulated delay, so that forces are reproducible.

    Args:
        linearisation: linearisation of the bulk.
        delay: time from the state of a model to the tick that receives the model, s.
        tangent: time from the state of a tangent to the first model with this tangent, s; None: each model has a new
            tangent.

    Attributes:
        linearising: CPU time spent on models, s.
    """

    is_alive = True

    def __init__(self, linearisation: BulkLinearisation, delay: float, tangent: float | None = None):
        self._bulk, self.contact_surface, self._delay, self._epoch = linearisation, linearisation.surface, delay, 0
        self._predictive, self._now = PredictiveLinearisation(linearisation), 0.0
        self._tangent = tangent
        if tangent is not None:
            linearisation.executor = self._compute_tangent_and_get_finish_check
        self.linearising = 0.0
        self._coming: tuple[float, CondensedBulk | None] | None = None

    def _compute_tangent_and_get_finish_check(self, compute: Callable[[], None]) -> Callable[[], bool]:
        """Compute a tangent now, and return a function that returns True once the tangent's delay is over.

        After a reset the tangent belongs to a discarded specimen and is reported as finished at once.
        """
        assert self._tangent is not None
        compute()
        due, epoch = self._now + self._tangent, self._epoch
        return lambda: self._epoch != epoch or self._now >= due - 1e-9

    def start(self) -> CondensedBulk:
        """Compute and return the model of the undeformed tissue.

        Raises:
            RuntimeError: the undeformed tissue has no linearisation.
        """
        model = self._predictive.linearise_at_predicted_pose_or_none(make_untouched_state(self.contact_surface), 0.0,
                                                                     0.0)
        if model is None:
            raise RuntimeError("the bulk must have a linearisation of the undeformed tissue; the solver returned none")
        return model

    def send_state(self, state: ContactState) -> None:
        """Linearise the bulk at a state, unless a model is in transit; the model arrives after the delay."""
        if state.epoch != self._epoch:
            # A model in transit belongs to the specimen before the reset.
            self._epoch, self._coming = state.epoch, None
        if self._coming is None:
            began, self._now = time.process_time(), state.time
            serves = 2.0 * (self._delay if self._tangent is None else self._tangent)
            model = self._predictive.linearise_at_predicted_pose_or_none(state, PREDICTION.lead_factor * self._delay,
                                                                         serves)
            self._coming = state.time + self._delay, model
            self.linearising += time.process_time() - began

    def receive_model(self, now: float) -> CondensedBulk | None:
        """Return the model in transit if it has arrived at the time `now`, s, otherwise None."""
        if self._coming is None or now < self._coming[0] - 1e-9:
            return None
        model, self._coming = self._coming[1], None
        return model

    def send_state_and_wait_for_model(self, state: ContactState) -> CondensedBulk | None:
        """Return a model at once: of an earlier state whose model was not yet received, otherwise of this state."""
        self.send_state(state)
        return self.receive_model(math.inf)

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk; later models have this `number` in their field `material`."""
        self._predictive.set_material(material, number)

    def snapshot(self) -> Snapshot | None:
        """Return None: this link has no snapshots."""
        return None

    def close(self) -> None:
        """Do nothing: the bulk is part of this process."""
        return


class BulkProcess:
    """Bulk in a separate process that linearises continuously.

    Args:
        model: experiment and material.
        solver: name of the solver.
        resolution: resolution of the mesh.
        mesh: mesh of the solver's type; None: generated with `resolution`.
    """

    def __init__(self, model: Model, *, solver: str = "solid", resolution: str = "realtime", mesh: Any = None):
        self._task = pack_task(make_linearisation, (model, solver, resolution, mesh))
        self._paths = tuple(find_unused_path(ending) for ending in ("states", "models", "corrections", "surface"))
        self._process: subprocess.Popen[bytes] | None = None
        self._surface: ContactSurface | None = None

    def start(self) -> CondensedBulk:
        """Start the process and return its model of the undeformed tissue; raises the errors of `BulkLink.start`."""
        one = {"MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._process = process = subprocess.Popen(
            [sys.executable, "-c", "from haptics.loop.slow_bulk import main; main()"], stdin=subprocess.PIPE,
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
            if models.written == self._received:
                return None
            self._reading, self._piece = models.written, 0
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
        if corrections.written == self._corrected:
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
        for path in self._paths:
            remove_file(path)
        self._process = None

    def _write_to_process_stdin(self, content: bytes) -> None:
        """Write bytes to the standard input of the process at once; raises an OSError if the process has ended."""
        assert self._process is not None and self._process.stdin is not None
        self._process.stdin.write(content)
        self._process.stdin.flush()
