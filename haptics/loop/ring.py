"""The last seconds of the loop, tick by tick, for viewers and recorders in other processes."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptics.loop.shared_slots import SlotReader, SlotWriter
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Screw
from tissue_sim.tool_force import ToolForce

#: One tick. SI units; times in s since the loop began; a pose that is not known is NaN. Depths, forces and the
#: stiffness of the first part are those along z of the poses, wrenches and the matrix of the second.
_FIELDS = [
    ("tick", "<u8"),            # number of the deadline, from 1; what is not there was missed
    ("time", "<f8"),            # when it began
    ("device_depth", "<f8"),    # of the device or the motion; NaN: no pose
    ("tool_depth", "<f8"),      # of the simulated tool
    ("force", "<f8"),           # rendered: what the device shall give
    ("tissue_force", "<f8"),    # of the tissue on the tool
    ("stiffness", "<f8"),       # dF/dd of the tissue without its mass, N/m
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
    ("device_pose", "<f8", 7),  # x, y, z, then the quaternion w, x, y, z
    ("tool_pose", "<f8", 7),
    ("wrench", "<f8", 6),       # rendered: force, then torque about the tool's deepest point
    ("tissue_wrench", "<f8", 6),
    ("stiffness_matrix", "<f8", (6, 6)),
    ("step_stiffness", "<f8"),  # dF/dd within the step, N/m: with the mass of the tissue where inertial
]
#: Added later; see `tissue_sim.tool_force.ToolForce`.
_AGES = [
    ("stiffness_age", "<f8"),   # since the stiffness was evaluated; NaN: not recorded
    ("force_error", "<f8"),     # estimated error of the tissue's force; NaN: unknown
    ("error_age", "<f8"),       # since it was estimated; NaN: not recorded
    ("least_tool_mass", "<f8"),  # of a stable explicit coupling, kg; NaN: not recorded
    ("on_axis", "<u8"),         # 0: away from or across the axis of an axisymmetric scene
]
TICK = np.dtype(_FIELDS + _AGES)
#: Ticks of loops before these fields existed.
_OLD_TICK = np.dtype(_FIELDS)
#: The bit of `flags` that a loop which is paused adds to those of `haptics.safety.rendering.RenderFlag`.
PAUSED = 1 << 16
#: 16 s at 1 kHz.
CAPACITY = 16384
_KIND = b"tsTICKS\0"
_RECORD = struct.Struct("<Q10d2Q2i2I63d4dQ")
assert _RECORD.size == TICK.itemsize
_UNKNOWN = (math.nan,) * 7


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

    def append(self, tick: int, time: float, device: Pose | None, tool: Pose, wrench: Screw, answer: ToolForce,
               compute_time: float, lateness: float, late: int, missed: int, flags: int) -> int:
        """Add a tick; returns how many were added so far.

        Args:
            device: None where no pose has come.
            tool: where the tissue was stepped to.
            wrench: rendered.
            answer: of the tissue.
            tick, time, compute_time, lateness, late, missed, flags: as in `TICK`.
        """
        place = tool.position
        seen = _UNKNOWN if device is None else device.position + device.orientation
        tissue, (a, b, c, d, e, f) = answer.wrench, answer.stiffness_matrix
        _RECORD.pack_into(self._record, 0, tick, time, -seen[2], -place[2], wrench[2], tissue[2], c[2],
                          answer.residual, compute_time, lateness, answer.age, late, missed, answer.status,
                          answer.iterations, flags, answer.inertial, *seen, *place, *tool.orientation, *wrench, *tissue,
                          *a, *b, *c, *d, *e, *f, answer.step_stiffness, answer.stiffness_age,
                          math.nan if answer.force_error is None else answer.force_error, answer.error_age,
                          answer.least_tool_mass, answer.is_on_axis)
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
        newest = self.newest()
        return None if newest is None else _ticks_of(newest[1])[0]

    def since(self, number: int = 0) -> Ticks:
        """Ticks that were written after a number; with 0 all that the ring still has."""
        contents, newest, lost = self.after(number)
        return Ticks(_ticks_of(*contents), newest, lost)


def _ticks_of(*contents: bytes) -> np.ndarray:
    """Records of dtype `TICK` from the contents of slots, also of a loop that wrote fewer fields.

    Raises:
        InputError: slots of another size.
    """
    content, sizes = b"".join(contents), set(map(len, contents))
    if sizes <= {TICK.itemsize}:
        return np.frombuffer(content, TICK)
    if sizes != {_OLD_TICK.itemsize}:
        raise InputError(f"a tick must have {TICK.itemsize} or {_OLD_TICK.itemsize} bytes; got {sorted(sizes)}.")
    old = np.frombuffer(content, _OLD_TICK)
    ticks = np.zeros(old.shape, TICK)
    for name, _ in _AGES[:-1]:
        ticks[name] = math.nan
    for name in _OLD_TICK.names or ():
        ticks[name] = old[name]
    ticks["on_axis"] = 1
    return ticks
