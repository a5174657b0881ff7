"""Lock-free communication through numbered slots in a shared file with one writer and any number of readers.

A reader accepts a slot only if its number and its checksum are correct. The protocol therefore does not depend on the
order in which writes become visible on another core, and a writer that ends within a slot leaves no invalid data.

Layout, little-endian: a header of 64 bytes (`HEAD`), then the slots. Each slot has a header of 16 bytes (`_SLOT`) and
its content, padded to a multiple of 8 bytes. Number n, counted from 1, is stored in slot (n - 1) modulo the slot count.

`SnapshotWriter` publishes the newest snapshot of the whole tissue in such a file, for viewers in other processes.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import secrets
import struct
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.public_names import with_old_names
from tissue_sim.snapshot import Snapshot


@dataclass(frozen=True)
class SlotSettings:
    """Layout of files of slots, and patience of their readers.

    Attributes:
        version: version of the layout. Each change of the layout requires a new version.
        head_size: bytes reserved for the header.
        count: default number of slots. With 4 slots a reader can copy a slot during three further publications; more
            slots give slow readers more time and use more memory.
        attempts: attempts to read the newest slot, which the writer may overwrite meanwhile.
    """

    version: int = 1
    head_size: int = 64
    count: int = 4
    attempts: int = 1000


#: Settings of all files of slots.
SLOTS = SlotSettings()
#: Header: kind of the file, version, bytes of a slot including its header, number of slots, id of the writing process.
HEAD = struct.Struct("<8sIIQQ")
#: Offset of the number of the newest slot, bytes.
_WRITTEN = HEAD.size
#: Offset of the flag that the writer has ended, bytes.
_ENDED = HEAD.size + 8
#: Header of a slot: number, bytes of the content, CRC-32 of the content with the number as start value.
_SLOT = struct.Struct("<QII")


def get_or_create_runtime_folder() -> Path:
    """Create, if necessary, and return this user's folder for temporary shared files, in memory if possible.

    Raises:
        InputError: the folder cannot be created or belongs to another user.
    """
    given = os.environ.get("XDG_RUNTIME_DIR")
    shared = Path("/dev/shm")
    if given:
        folder = Path(given) / "tissue_sim"
    else:
        user = f"-{os.getuid()}" if hasattr(os, "getuid") else ""
        folder = (shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())) / f"tissue_sim{user}"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be created ({error.strerror}); set XDG_RUNTIME_DIR to a folder that you own",
                         file=folder) from error
    if hasattr(os, "getuid") and (folder.is_symlink() or folder.stat().st_uid != os.getuid()):
        raise InputError("belongs to another user; set XDG_RUNTIME_DIR to a folder that you own", file=folder)
    return folder


def find_unused_path(ending: str) -> Path:
    """Return the path of a new file with the extension `ending` in the runtime folder; creates no file."""
    return get_or_create_runtime_folder() / f"{os.getpid()}-{secrets.token_hex(4)}.{ending}"


@with_old_names(written="written_count")
class SlotWriter:
    """Writer of slots; creates the file and removes it when closed.

    Args:
        path: path of the file, which must not exist.
        kind: 8 bytes that identify the content of the slots.
        count: number of slots, at least 2.
        size: maximum size of the content of a slot, bytes.

    Raises:
        InputError: the file exists already or cannot be created, or the disk is full.
    """

    def __init__(self, path: str | Path, kind: bytes, count: int, size: int):
        if count < 2:
            raise InputError(f"count must be at least 2, so that one slot is complete while another is written; got "
                             f"{count}", field="count")
        self.path, self.count, self.size, self.written_count = Path(path), count, size, 0
        self._stride = _SLOT.size + -(-size // 8) * 8
        total = SLOTS.head_size + count * self._stride
        empty = HEAD.pack(kind, SLOTS.version, self._stride, count, os.getpid()).ljust(total, b"\0")
        try:
            _create_file_atomically(self.path, empty)
            with self.path.open("r+b") as stream:
                self._map = mmap.mmap(stream.fileno(), total)
        except FileExistsError:
            raise InputError("exists already; remove the file or choose another name", file=self.path) from None
        except OSError as error:
            raise InputError(f"cannot be shared ({error.strerror or error}); choose another folder",
                             file=path) from error
        self._numbers = memoryview(self._map)[_WRITTEN:_ENDED + 8].cast("Q")

    def write(self, content: bytes | bytearray | memoryview) -> int:
        """Write the content to the next slot and return the number of the slot.

        Raises:
            InputError: the content is larger than a slot.
        """
        length = len(content)
        if length > self.size:
            raise InputError(f"content must have at most {self.size} bytes; got {length}", file=self.path)
        number = self.written_count + 1
        offset = SLOTS.head_size + (number - 1) % self.count * self._stride
        _SLOT.pack_into(self._map, offset, number, length, _compute_checksum(content, number))
        offset += _SLOT.size
        self._map[offset:offset + length] = content
        self._numbers[0] = self.written_count = number
        return number

    def close(self) -> None:
        """Mark the file as ended and remove it; readers that have opened the file can still read it."""
        if self._map.closed:
            return
        self._numbers[1] = 1
        self._numbers.release()
        self._map.close()
        remove_files_ignoring_errors(self.path)

    def __enter__(self):
        return self

    def __exit__(self, *failure) -> None:
        self.close()


@with_old_names(written="written_count")
class SlotReader:
    """Reader of slots in any process.

    Args:
        path: file of a writer.
        kind: required kind of content.

    Raises:
        InputError: the file does not exist or has another kind or version.
    """

    def __init__(self, path: str | Path, kind: bytes):
        self.path = Path(path)
        try:
            with self.path.open("rb") as stream:
                self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:  # ValueError: an empty file
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"cannot be read ({reason}); use the file that a running loop prints",
                             file=path) from error
        found = HEAD.unpack_from(self._map) if len(self._map) >= SLOTS.head_size else (b"", 0, 0, 0, 0)
        _, version, self._stride, self.count, self.writer = found
        whole = len(self._map) == SLOTS.head_size + self._stride * self.count
        if found[0] != kind or version != SLOTS.version or not whole:
            self._map.close()
            raise InputError(f"is not a file of kind {kind.rstrip(bytes(1)).decode()!r}, version {SLOTS.version}; use "
                             "the file that a running loop of the same version prints", file=path)
        self._numbers = memoryview(self._map)[_WRITTEN:_ENDED + 8].cast("Q")

    @property
    def written_count(self) -> int:
        """Number of the newest written content, counted from 1; 0 before the first."""
        return self._numbers[0]

    @property
    def ended(self) -> bool:
        """Whether the writer has closed the file; False if it was killed."""
        return self._numbers[1] != 0

    def read(self, number: int) -> bytes | None:
        """Return the content with this number; None if it is overwritten, incomplete or not yet written."""
        offset = SLOTS.head_size + (number - 1) % self.count * self._stride
        copy = self._map[offset:offset + self._stride]
        found, length, checksum = _SLOT.unpack_from(copy)
        content = copy[_SLOT.size:_SLOT.size + length]
        return content if found == number and checksum == _compute_checksum(content, number) else None

    @property
    def max_content_size(self) -> int:
        """Maximum size of the content of a slot, bytes."""
        return self._stride - _SLOT.size

    def read_content_length_and_checksum(self, number: int) -> tuple[int, int]:
        """Return (length in bytes, CRC-32) of the content with this number; (0, -1) if it is overwritten."""
        offset = SLOTS.head_size + (number - 1) % self.count * self._stride
        found, length, checksum = _SLOT.unpack_from(self._map, offset)
        return (length, checksum) if found == number and length <= self.max_content_size else (0, -1)

    def read_unchecked_content_bytes(self, number: int, start: int, end: int) -> bytes:
        """Return the bytes from `start` to `end` (exclusive) of the content with a number, without a check.

        The caller checks all parts together with the CRC-32 from `read_content_length_and_checksum`, whose start value
        is the number.
        """
        offset = SLOTS.head_size + (number - 1) % self.count * self._stride + _SLOT.size
        return self._map[offset + start:offset + end]

    def read_newest_number_and_content(self) -> tuple[int, bytes] | None:
        """Return (number, content) of the newest complete slot; None before the first.

        Raises:
            InputError: no complete slot was found.
        """
        for _ in range(SLOTS.attempts):
            number = self.written_count
            if number == 0:
                return None
            content = self.read(number)
            if content is not None:
                return number, content
        raise InputError("must hold a complete record; found none in repeated reads. Start the loop that writes the "
                         "file again", file=self.path)

    def read_contents_and_lost_count_after(self, number: int) -> tuple[list[bytes], int, int]:
        """Read the contents with a larger number than this one, oldest first.

        Args:
            number: number of the slot that was read last; 0: begin with the oldest slot in the file.

        Returns:
            The contents in order, the argument for the next call, and the number of slots that were overwritten before
            they were read (not counted for a reader that begins with 0).
        """
        newest = self.written_count
        oldest = max(newest - self.count, 0) + 1
        first = max(number + 1, oldest)
        lost = first - number - 1 if number > 0 else 0
        contents = []
        for slot in range(first, newest + 1):
            content = self.read(slot)
            if content is not None:
                contents.append(content)
            elif self.written_count - slot >= self.count - 1:
                lost += 1  # the slot is being overwritten, or was overwritten
            else:
                newest = slot - 1  # the content is not completely visible on this core yet: read it in the next call
                break
        return contents, max(number, newest), lost

    def close(self) -> None:
        """Close the file; the writer removes it."""
        self._numbers.release()
        self._map.close()

    def __enter__(self):
        return self

    def __exit__(self, *failure) -> None:
        self.close()


def remove_files_ignoring_errors(*paths: Path) -> None:
    """Remove the files of writers that have ended, if the files exist."""
    # Windows refuses to remove an open file; the small file then stays in the folder for temporary files.
    for path in paths:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def _compute_checksum(content, number: int) -> int:
    """Return the CRC-32 of the content, with the number of the slot as start value."""
    return zlib.crc32(content, number & 0xFFFFFFFF)


def _create_file_atomically(path: Path, content: bytes) -> None:
    """Create a file with access for this user only, which appears with its complete content.

    The content fills the file, so that a full disk causes an error here and not in a tick.

    Raises:
        OSError: the file exists already, or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "xb", opener=_open_with_owner_only_mode) as stream:
            stream.write(content)
        # Neither call replaces an existing file.
        if os.name == "nt":
            temporary.rename(path)
        else:
            path.hardlink_to(temporary)
    finally:
        remove_files_ignoring_errors(temporary)


def _open_with_owner_only_mode(path: str, flags: int) -> int:
    """Open a file, for `open(opener=...)`; a file that is created is accessible by its owner only."""
    return os.open(path, flags, 0o600)


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
