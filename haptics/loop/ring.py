"""The last seconds of the loop, tick by tick, for viewers and recorders in other processes."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptics.loop.shared_slots import SlotReader, SlotWriter

#: One tick. SI units; times in s since the loop began; a depth that is not known is NaN.
TICK = np.dtype([
    ("tick", "<u8"),            # number of the deadline, from 1; what is not there was missed
    ("time", "<f8"),            # when it began
    ("device_depth", "<f8"),    # of the device or the source of motion; NaN: no pose
    ("tool_depth", "<f8"),      # of the simulated tool
    ("force", "<f8"),           # rendered: what the device shall give
    ("tissue_force", "<f8"),    # of the tissue on the tool
    ("stiffness", "<f8"),       # dF/dd of the tissue, N/m
    ("residual", "<f8"),
    ("compute_time", "<f8"),    # from the beginning of the tick to its force
    ("lateness", "<f8"),        # behind the first deadline that no tick has kept
    ("age", "<f8"),             # of the last equilibrium
    ("late", "<u8"),            # ticks so far that began late
    ("missed", "<u8"),          # deadlines so far that passed without a tick
    ("status", "<i4"),          # tissue_sim.tool_force.ForceStatus
    ("iterations", "<i4"),
    ("flags", "<u4"),           # of haptics.safety.rendering.RenderFlag, and PAUSED
    ("inertial", "<u4"),        # 1: with the mass of the tissue
])
#: The bit of `flags` that a loop which is paused adds to those of `haptics.safety.rendering.RenderFlag`.
PAUSED = 1 << 16
#: 16 s at 1 kHz.
CAPACITY = 16384
_KIND = b"tsTICKS\0"
_CODES = {"<u8": "Q", "<f8": "d", "<i4": "i", "<u4": "I"}
_RECORD = struct.Struct("<" + "".join(_CODES[TICK[name].str] for name in TICK.names))
assert _RECORD.size == TICK.itemsize


@dataclass(frozen=True, eq=False)
class Ticks:
    """Ticks that a reader has not seen before.

    Attributes:
        records: shape (n,), dtype `TICK`, in the order in which they were written.
        number: to give to `RingReader.since` the next time.
        lost: how many were overwritten before this reader came to them.
    """

    records: np.ndarray
    number: int
    lost: int


class RingWriter(SlotWriter):
    """The ring of a loop.

    Args:
        path: file to make; `haptics.loop.shared_slots.unused_path` finds a place in memory.
        capacity: ticks that it keeps.

    Raises:
        InputError: the file is there already or cannot be made.
    """

    def __init__(self, path: str | Path, capacity: int = CAPACITY):
        super().__init__(path, _KIND, capacity, TICK.itemsize)
        self._record = bytearray(TICK.itemsize)

    def append(self, *values: float) -> int:
        """Add a tick, all fields of `TICK` in their order; returns how many were added so far."""
        _RECORD.pack_into(self._record, 0, *values)
        return self.write(self._record)


class RingReader(SlotReader):
    """Reads the ring of a running loop, from any process, without the loop knowing.

    Args:
        path: as `LoopProcess.ring_path` or ``tissue-sim loop`` name it.

    Attributes:
        count: ticks that the ring keeps; written: ticks so far; ended: whether the loop has, one that was killed has
            not said so; writer: number of the process that writes.

    Raises:
        InputError: no such file, or not a ring of this version.
    """

    def __init__(self, path: str | Path):
        super().__init__(path, _KIND)

    def latest(self) -> np.void | None:
        """The newest tick, a record of dtype `TICK`; None before the first."""
        found = super().latest()
        return None if found is None else np.frombuffer(found[1], TICK)[0]

    def since(self, number: int = 0) -> Ticks:
        """Ticks that were written after a number; with 0 all that the ring still has."""
        contents, newest, lost = super().since(number)
        return Ticks(np.frombuffer(b"".join(contents), TICK), newest, lost)
