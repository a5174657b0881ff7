"""The whole tissue, for viewers in other processes that draw fields: the newest state, and whether there is a newer."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptics.loop.shared_slots import SlotReader, SlotWriter
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot

_KIND = b"tsSNAP\0\0"
#: A reader has three more publications of time to copy one.
_SLOTS = 4
#: Time, datum, position and orientation of the tool.
_HEAD = struct.Struct("<2d3d4d")


@dataclass(frozen=True, eq=False)
class PublishedSnapshot:
    """A snapshot as the loop has published it.

    Attributes:
        number: of the publication, from 1.
        time: s since the loop began.
        snapshot: see there.
    """

    number: int
    time: float
    snapshot: Snapshot


class SnapshotBoard(SlotWriter):
    """Where the loop publishes snapshots; what they have in common, mesh and material, is not among it.

    Args:
        path: file to make.
        pattern: a snapshot of the same tissue.

    Raises:
        InputError: the file is there already or cannot be made.
    """

    def __init__(self, path: str | Path, pattern: Snapshot):
        super().__init__(path, _KIND, _SLOTS, _HEAD.size + 8 * sum(array.size for array in pattern.arrays()))

    def publish(self, time: float, snapshot: Snapshot) -> int:
        """Make a snapshot the newest one; returns its number.

        Raises:
            InputError: larger than the pattern.
        """
        arrays = snapshot.arrays()
        return self.write(_HEAD.pack(time, snapshot.datum, *snapshot.pose.position, *snapshot.pose.orientation)
                          + b"".join(np.ascontiguousarray(array, "<f8").tobytes() for array in arrays))


class SnapshotReader(SlotReader):
    """Reads the board of a running loop, from any process that knows the pattern.

    Args:
        path, pattern: as `LoopProcess` knows them.

    Attributes:
        pattern: mesh and material of what is read; to be replaced when the material changes.
        ended: whether the loop has; one that was killed has not said so.

    Raises:
        InputError: no such file, or not a board of this version.
    """

    def __init__(self, path: str | Path, pattern: Snapshot):
        super().__init__(path, _KIND)
        self.pattern = pattern

    def latest(self, after: int = 0) -> PublishedSnapshot | None:
        """The newest snapshot; None where there is none with a number above `after`.

        Raises:
            InputError: the board is of another tissue than the pattern.
        """
        newest = self.newest() if self.written > after else None
        if newest is None:
            return None
        number, content = newest
        arrays, numbers = self.pattern.arrays(), np.frombuffer(content, "<f8", offset=_HEAD.size)
        ends = np.cumsum([array.size for array in arrays])
        if numbers.size != ends[-1]:
            raise InputError(f"holds {numbers.size} numbers where the pattern has {ends[-1]}; give the pattern "
                             "of the loop that writes it", file=self.path)
        parts = [part.reshape(array.shape) for part, array in zip(np.split(numbers, ends[:-1]), arrays, strict=True)]
        time, datum, *pose = _HEAD.unpack_from(content)
        (x, y, z), (a, b, c, d) = pose[:3], pose[3:]
        return PublishedSnapshot(number, time, self.pattern.at(Pose((x, y, z), (a, b, c, d)), datum, parts))
