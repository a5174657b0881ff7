"""Bulk of a multirate simulation in another process, which linearises it continuously."""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import time
import zlib
from contextlib import suppress
from typing import Any

import numpy as np

from haptics.loop.bulk_child import (
    BULK_PROCESS,
    KIND_CORRECTION,
    KIND_MODEL,
    KIND_STATE,
    BulkReadyMessage,
    make_bulk_lineariser,
)
from haptics.loop.shared_slots import SLOTS, SlotReader, SlotWriter, find_unused_path, remove_files_ignoring_errors
from haptics.loop.snapshot_board import SnapshotReader
from tissue_sim.bounded import pack_task
from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import CondensedBulk, ContactState, ContactSurface, compute_packed_state_size
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.snapshot import Snapshot


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
            [sys.executable, "-c", "from haptics.loop.bulk_child import main; main()"], stdin=subprocess.PIPE,
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
