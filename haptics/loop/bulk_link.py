"""Between the fast solver of a contact and the slow one of the bulk: in one process with a known delay, or in two."""

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

from haptics.loop.shared_slots import SlotReader, SlotWriter, remove, unused_path
from haptics.loop.slow_bulk import KIND_CORRECTION, KIND_MODEL, KIND_STATE, Started, first_state, make_linearisation
from haptics.loop.snapshot_board import SnapshotReader
from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import (
    BulkLinearisation,
    CondensedContact,
    ContactState,
    ContactSurface,
    packed_state_size,
)
from tissue_sim.fem.condensed.predictive_linearisation import LEAD_FACTOR, PredictiveLinearisation
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.packing import pack
from tissue_sim.snapshot import Snapshot

#: Bytes of a model that are read in one tick: a whole one would take a good part of it.
_PIECE = 1 << 16
#: How long the process of the bulk may take to end, s.
_PATIENCE = 5.0
#: Longest time that `BulkLink.exchange` blocks, s of wall time.
LONGEST_EXCHANGE = 60.0
#: Time between two looks for a model in `BulkLink.exchange`, s.
_POLL = 0.2e-3
#: Time after which `BulkLink.exchange` sends the state again, s: a bulk that found no linearisation tries again then.
_SEND_AGAIN = 0.05


class BulkLink(Protocol):
    """Where models of the bulk come from. Close it."""

    @property
    def surface(self) -> ContactSurface:
        """What may be touched, and by what; once it is started."""

    @property
    def alive(self) -> bool:
        """Whether models can still come."""

    def start(self) -> CondensedContact:
        """Make the bulk; its model at the first touch.

        Raises:
            InputError, RuntimeError: it cannot be made, and why.
        """

    def send(self, state: ContactState) -> None:
        """Tell where the contact is; never waits."""

    def receive(self, now: float) -> CondensedContact | None:
        """A model that has come since the last call, at a time, s; never waits."""

    def exchange(self, state: ContactState) -> CondensedContact | None:
        """Send a state and block until the next model has come, which can still be that of an earlier state.

        Returns:
            None if no model has come within `LONGEST_EXCHANGE`, or none can come any more.
        """

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk; models of the new material carry the number."""

    def snapshot(self) -> Snapshot | None:
        """The tissue at the last model; None of a link that shows none."""

    def close(self) -> None:
        """End it."""


class DelayedBulk:
    """A bulk in this process, whose models come a fixed time after they were asked for: the same motion gives the same
    forces.

    Args:
        linearisation: of the bulk.
        delay: from the state that a model is made of to the tick that takes it, s.
        tangent: from the state that a tangent is of to the first model with it, s; None: each model has its own.

    Attributes:
        linearising: CPU time that went into models, s.
    """

    alive = True

    def __init__(self, linearisation: BulkLinearisation, delay: float, tangent: float | None = None):
        self._bulk, self.surface, self._delay, self._epoch = linearisation, linearisation.surface, delay, 0
        self._predictive, self._now = PredictiveLinearisation(linearisation), 0.0
        self._tangent = tangent
        if tangent is not None:
            linearisation.executor = self._later
        self.linearising = 0.0
        self._coming: tuple[float, CondensedContact | None] | None = None

    def _later(self, compute: Callable[[], None]) -> Callable[[], bool]:
        """Computed now, and there when its time has come; nobody waits for one of a specimen that is no more."""
        assert self._tangent is not None
        compute()
        due, epoch = self._now + self._tangent, self._epoch
        return lambda: self._epoch != epoch or self._now >= due - 1e-9

    def start(self) -> CondensedContact:
        model = self._predictive.linearise(first_state(self.surface), 0.0, 0.0)
        if model is None:
            raise RuntimeError("the untouched tissue has no linearisation")
        return model

    def send(self, state: ContactState) -> None:
        if state.epoch != self._epoch:
            # What is on its way is of a specimen that is no more.
            self._epoch, self._coming = state.epoch, None
        if self._coming is None:
            began, self._now = time.process_time(), state.time
            serves = 2.0 * (self._delay if self._tangent is None else self._tangent)
            model = self._predictive.linearise(state, LEAD_FACTOR * self._delay, serves)
            self._coming = state.time + self._delay, model
            self.linearising += time.process_time() - began

    def receive(self, now: float) -> CondensedContact | None:
        if self._coming is None or now < self._coming[0] - 1e-9:
            return None
        model, self._coming = self._coming[1], None
        return model

    def exchange(self, state: ContactState) -> CondensedContact | None:
        """The model of a state, or of one that was sent before and has not been received, without its delay."""
        self.send(state)
        return self.receive(math.inf)

    def set_material(self, material: Material, number: int) -> None:
        self._predictive.set_material(material, number)

    def snapshot(self) -> Snapshot | None:
        return None

    def close(self) -> None:
        return


class BulkProcess:
    """A bulk in a process of its own, which linearises as fast as it can.

    Args:
        model: experiment and material.
        solver, resolution: whose bulk.
        mesh: of the solver's own kind, instead.
    """

    def __init__(self, model: Model, *, solver: str = "solid", resolution: str = "realtime", mesh: Any = None):
        self._task = pack(make_linearisation, (model, solver, resolution, mesh))
        self._paths = tuple(unused_path(ending) for ending in ("states", "models", "corrections", "surface"))
        self._process: subprocess.Popen[bytes] | None = None
        self._surface: ContactSurface | None = None

    def start(self) -> CondensedContact:
        one = {"MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._process = process = subprocess.Popen(
            [sys.executable, "-c", "from haptics.loop.slow_bulk import main; main()"], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, env={**one, **os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))})
        assert process.stdin is not None and process.stdout is not None
        self._say(struct.pack("<Q", len(self._task)) + self._task)
        self._say(pickle.dumps(self._paths))
        try:
            started: Started | InputError = pickle.load(process.stdout)
        except EOFError:
            raise RuntimeError("the process of the bulk ended before it began; see what it printed") from None
        if isinstance(started, Exception):
            raise started
        self._surface = started.surface
        size = 8 * packed_state_size(self.surface)
        self._states = SlotWriter(self._paths[0], KIND_STATE, 4, size)
        self._models = SlotReader(self._paths[1], KIND_MODEL)
        self._corrections, self._corrected = SlotReader(self._paths[2], KIND_CORRECTION), 0
        self._board = None if started.pattern is None else SnapshotReader(self._paths[3], started.pattern)
        self._shown = started.pattern
        self._taken, self._reading, self._piece, self._check = 0, 0, 0, 0
        self._model = started.model
        #: Where the next model is read to, and where the last one is.
        self._buffers = bytearray(self._models.size), bytearray(self._models.size)
        self._say(b"go\n")
        return started.model

    @property
    def surface(self) -> ContactSurface:
        assert self._surface is not None
        return self._surface

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    def send(self, state: ContactState) -> None:
        self._states.write(state.pack().tobytes())

    def receive(self, now: float) -> CondensedContact | None:
        found = self._received_whole() or self._received_correction()
        if found is not None:
            self._model = found
        return found

    def exchange(self, state: ContactState) -> CondensedContact | None:
        now = time.monotonic()
        deadline, sends = now + LONGEST_EXCHANGE, now
        while now < deadline and self.alive:
            if now >= sends:
                self.send(state)
                sends = now + _SEND_AGAIN
            if (model := self.receive(state.time)) is not None:
                return model
            time.sleep(_POLL)
            now = time.monotonic()
        return None

    def _received_whole(self) -> CondensedContact | None:
        """A model with a tangent of its own, read a piece at a time; its arrays are there until the next one is."""
        models = self._models
        if self._reading == 0:
            if models.written == self._taken:
                return None
            self._reading, self._piece = models.written, 0
            self._check = self._reading & 0xFFFFFFFF
        length, checksum = models.head(self._reading)
        end = min(self._piece + _PIECE, length)
        piece = models.part(self._reading, self._piece, end)
        self._buffers[0][self._piece:end] = piece
        self._check, self._piece = zlib.crc32(piece, self._check), end
        if end < length:
            return None
        number, self._reading = self._reading, 0
        if self._check != checksum or models.head(number) != (length, checksum):
            return None  # it was written while it was read: once more
        self._taken, self._buffers = number, self._buffers[::-1]
        return CondensedContact.unpack(np.frombuffer(self._buffers[1], count=length // 8))

    def _received_correction(self) -> CondensedContact | None:
        """A later state of the bulk on the tangent of the model that is here."""
        corrections = self._corrections
        if corrections.written == self._corrected:
            return None
        newest = corrections.newest()
        if newest is None:
            return None
        self._corrected, content = newest
        return CondensedContact.unpack(np.frombuffer(content), self._model)

    def set_material(self, material: Material, number: int) -> None:
        self._say(pickle.dumps((number, material)))

    def snapshot(self) -> Snapshot | None:
        if self._board is not None:
            newest = self._board.latest()
            self._shown = self._shown if newest is None else newest.snapshot
        return self._shown

    def close(self) -> None:
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
            with suppress(OSError):  # the process was killed before it read everything
                process.stdin.close()  # the end of its input ends the process
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
        for path in self._paths:
            remove(path)
        self._process = None

    def _say(self, content: bytes) -> None:
        assert self._process is not None and self._process.stdin is not None
        self._process.stdin.write(content)
        self._process.stdin.flush()
