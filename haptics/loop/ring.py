"""Ring of the last ticks of a loop in a shared file, for viewers and recorders in other processes."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptics.loop.shared_slots import SlotReader, SlotWriter
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Screw
from tissue_sim.public_names import with_old_names
from tissue_sim.tool_force import ToolForce

#: Fields of a tick in SI units; times are in s since the start of the loop; an unknown pose is NaN. Depths, forces and
#: the stiffness are the components along z of the poses, wrenches and the stiffness matrix below.
_FIELDS = [
    ("tick", "<u8"),            # number of the deadline, from 1; numbers that are not in the ring were missed
    ("time", "<f8"),            # start of the tick
    ("device_depth", "<f8"),    # depth of the device or the motion; NaN: no pose
    ("tool_depth", "<f8"),      # depth of the simulated tool
    ("force", "<f8"),           # rendered force on the device
    ("tissue_force", "<f8"),    # force of the tissue on the tool
    ("stiffness", "<f8"),       # dF/dd of the tissue without its mass, N/m
    ("residual", "<f8"),
    ("compute_time", "<f8"),    # from the start of the tick to its force
    ("lateness", "<f8"),        # time since the first deadline without a tick
    ("age", "<f8"),             # age of the last equilibrium
    ("late", "<u8"),            # number of ticks so far that began late
    ("missed", "<u8"),          # number of deadlines so far without a tick
    ("status", "<i4"),          # tissue_sim.tool_force.ForceStatus
    ("iterations", "<i4"),
    ("flags", "<u4"),           # haptics.safety.rendering.RenderFlag and PAUSED
    ("inertial", "<u4"),        # 1: the mass of the tissue is included
    ("device_pose", "<f8", 7),  # x, y, z, then the quaternion w, x, y, z
    ("tool_pose", "<f8", 7),
    ("wrench", "<f8", 6),       # rendered force and torque about the deepest point of the tool
    ("tissue_wrench", "<f8", 6),
    ("stiffness_matrix", "<f8", (6, 6)),
    ("step_stiffness", "<f8"),  # dF/dd within the step, N/m, including the mass of the tissue if inertial
]
#: Fields that older versions do not write; see `tissue_sim.tool_force.ToolForce`.
_AGES = [
    ("stiffness_age", "<f8"),   # age of the stiffness; NaN: not recorded
    ("force_error", "<f8"),     # estimated error of the tissue force; NaN: unknown
    ("error_age", "<f8"),       # age of this estimate; NaN: not recorded
    ("least_tool_mass", "<f8"),  # smallest tool mass of a stable explicit coupling, kg; NaN: not recorded
    ("on_axis", "<u8"),         # 0: the tool is off the axis of an axisymmetric scene or moves across it
]
#: Record of a tick.
TICK = np.dtype(_FIELDS + _AGES)
#: Record of a tick of older versions.
_OLD_TICK = np.dtype(_FIELDS)
#: Bit of `flags` that marks a paused loop, in addition to `haptics.safety.rendering.RenderFlag`.
PAUSED = 1 << 16
#: Default number of ticks in the ring: 16 s at 1 kHz.
CAPACITY = 16384
#: Kind of the shared file.
_KIND = b"tsTICKS\0"
#: Binary layout of `TICK`.
_RECORD = struct.Struct("<Q10d2Q2i2I63d4dQ")
assert _RECORD.size == TICK.itemsize
#: Position and orientation of an unknown pose.
_UNKNOWN = (math.nan,) * 7


@dataclass(frozen=True, eq=False)
class TickBatch:
    """Ticks that one call of `RingReader.read_ticks_after` has read, with the argument of the next call.

    Attributes:
        records: ticks in the order of writing, dtype `TICK`, shape (n,).
        number: argument for the next call of `RingReader.read_ticks_after`.
        lost: number of ticks that were overwritten before they were read.
    """

    records: np.ndarray
    number: int
    lost: int


class RingWriter(SlotWriter):
    """Write the ticks of a loop to a ring in a shared file.

    Args:
        path: file to create; `haptics.loop.shared_slots.find_unused_path` returns a path in memory.
        capacity: number of ticks in the ring.

    Raises:
        InputError: the file exists already or cannot be created.
    """

    def __init__(self, path: str | Path, capacity: int = CAPACITY):
        super().__init__(path, _KIND, capacity, TICK.itemsize)
        self._record = bytearray(TICK.itemsize)

    def append_tick(self, tick: int, time: float, device: Pose | None, tool: Pose, wrench: Screw, answer: ToolForce,
                    compute_time: float, lateness: float, late: int, missed: int, flags: int) -> int:
        """Write a tick to the next slot, over the oldest one, and return the number of ticks written so far.

        Args:
            tick: number of the deadline, from 1.
            time: start of the tick, s.
            device: pose of the device; None if unknown.
            tool: pose of the simulated tool.
            wrench: rendered wrench on the device.
            answer: force of the tissue.
            compute_time: time from the start of the tick to its force, s.
            lateness: lateness of the tick, s.
            late: number of late ticks so far.
            missed: number of deadlines without a tick so far.
            flags: flags of the tick.
        """
        position = tool.position
        device_pose = _UNKNOWN if device is None else device.position + device.orientation
        tissue, (a, b, c, d, e, f) = answer.wrench, answer.stiffness_matrix
        _RECORD.pack_into(self._record, 0, tick, time, -device_pose[2], -position[2], wrench[2], tissue[2], c[2],
                          answer.residual, compute_time, lateness, answer.age, late, missed, answer.status,
                          answer.iterations, flags, answer.inertial, *device_pose, *position, *tool.orientation,
                          *wrench, *tissue, *a, *b, *c, *d, *e, *f, answer.step_stiffness, answer.stiffness_age,
                          math.nan if answer.force_error is None else answer.force_error, answer.error_age,
                          answer.least_tool_mass, answer.is_on_axis)
        return self.write(self._record)


@with_old_names(since="read_ticks_after")
class RingReader(SlotReader):
    """Read the ring of a running loop from any process without affecting the loop.

    Args:
        path: file of the ring, see `LoopProcess.ring_path` and ``tissue-sim loop``.

    Attributes:
        count: number of ticks in the ring.
        written_count: number of ticks written so far.
        ended: whether the loop has ended normally; False if it was killed.
        writer: id of the process of the loop.

    Raises:
        InputError: the file does not exist or is not a ring of this version.
    """

    def __init__(self, path: str | Path):
        super().__init__(path, _KIND)

    def latest(self) -> np.void | None:
        """Return the newest tick, a record of dtype `TICK`; None before the first tick."""
        newest = self.read_newest_number_and_content()
        return None if newest is None else _convert_slot_contents_to_ticks(newest[1])[0]

    def read_ticks_after(self, number: int = 0) -> TickBatch:
        """Return the ticks after the first `number` ticks of the loop; 0: all ticks that the ring still holds."""
        contents, newest, lost = self.read_contents_and_lost_count_after(number)
        return TickBatch(_convert_slot_contents_to_ticks(*contents), newest, lost)


def _convert_slot_contents_to_ticks(*contents: bytes) -> np.ndarray:
    """Convert contents of slots, one tick each, to an array of dtype `TICK`, also from versions with fewer fields.

    Raises:
        InputError: the slots have another size.
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
