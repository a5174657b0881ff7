"""Publish the newest snapshot of the whole tissue in a shared file, for viewers in other processes."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptics.loop.shared_slots import SLOTS, SlotReader, SlotWriter
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot

#: Kind of the shared file.
_SNAPSHOT_KIND = b"tsSNAP\0\0"
#: Header of a snapshot: time, datum, position and orientation of the tool.
_SNAPSHOT_HEAD = struct.Struct("<2d3d4d")


@dataclass(frozen=True, eq=False)
class PublishedSnapshot:
    """A published snapshot.

    Attributes:
        number: number of the publication, from 1.
        time: time since the start of the loop, s.
        snapshot: the snapshot.
    """

    number: int
    time: float
    snapshot: Snapshot


class SnapshotWriter(SlotWriter):
    """Write snapshots to a shared file, without mesh and material, which are the same in all snapshots.

    Args:
        path: file to create.
        pattern: a snapshot of the same tissue.

    Raises:
        InputError: the file exists already or cannot be created.
    """

    def __init__(self, path: str | Path, pattern: Snapshot):
        size = _SNAPSHOT_HEAD.size + 8 * sum(array.size for array in pattern.arrays())
        super().__init__(path, _SNAPSHOT_KIND, SLOTS.count, size)

    def publish(self, time: float, snapshot: Snapshot) -> int:
        """Publish a snapshot and return its number.

        Args:
            time: time since the start of the loop, s.
            snapshot: the snapshot.

        Raises:
            InputError: the snapshot is larger than the pattern.
        """
        arrays = snapshot.arrays()
        return self.write(_SNAPSHOT_HEAD.pack(time, snapshot.datum, *snapshot.pose.position, *snapshot.pose.orientation)
                          + b"".join(np.ascontiguousarray(array, "<f8").tobytes() for array in arrays))


class SnapshotReader(SlotReader):
    """Read the snapshots of a running loop in any process.

    Args:
        path: file of the snapshots, see `LoopProcess.snapshot_path`.
        pattern: mesh and material of the snapshots, see `LoopProcess.pattern`.

    Attributes:
        pattern: mesh and material of the snapshots; replace the pattern when the material changes.
        ended: whether the loop has ended normally; False if it was killed.

    Raises:
        InputError: the file does not exist or is not a file of snapshots of this version.
    """

    def __init__(self, path: str | Path, pattern: Snapshot):
        super().__init__(path, _SNAPSHOT_KIND)
        self.pattern = pattern

    def latest(self, after: int = 0) -> PublishedSnapshot | None:
        """Return the newest snapshot; None if its number is not above `after`.

        Raises:
            InputError: the pattern belongs to another tissue.
        """
        newest = self.read_newest_number_and_content() if self.written_count > after else None
        if newest is None:
            return None
        number, content = newest
        arrays, numbers = self.pattern.arrays(), np.frombuffer(content, "<f8", offset=_SNAPSHOT_HEAD.size)
        ends = np.cumsum([array.size for array in arrays])
        if numbers.size != ends[-1]:
            raise InputError(f"the pattern must have {numbers.size} numbers as the file; got {ends[-1]}. Use the "
                             "pattern of the loop that writes the file", file=self.path)
        parts = [part.reshape(array.shape) for part, array in zip(np.split(numbers, ends[:-1]), arrays, strict=True)]
        time, datum, *pose = _SNAPSHOT_HEAD.unpack_from(content)
        (x, y, z), (a, b, c, d) = pose[:3], pose[3:]
        return PublishedSnapshot(number, time,
                                 self.pattern.with_pose_and_arrays(Pose((x, y, z), (a, b, c, d)), datum, parts))
