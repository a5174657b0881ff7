"""Numbered slots in a file that processes share: one writes, any number reads, nobody waits.

A slot is taken for what it is only where its number and its checksum are right. So a reader needs nothing of the order
in which another core's writes become visible to it, and a writer that dies in the middle of a slot deceives nobody.

Layout, little-endian: a head of 64 bytes (`HEAD`), then the slots, each of 16 bytes (`_SLOT`) and its content, padded
to a multiple of 8 bytes. The slot of number n, counted from 1, is slot (n - 1) modulo their count.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import secrets
import struct
import tempfile
import zlib
from pathlib import Path

from tissue_sim.errors import InputError

VERSION = 1
#: Kind of the file, version of the layout, bytes of a slot with its head, slots, process that writes.
HEAD = struct.Struct("<8sIIQQ")
HEAD_SIZE = 64
#: Number of the newest slot, and whether its writer has ended.
_WRITTEN, _ENDED = HEAD.size, HEAD.size + 8
#: Number of a slot, bytes of its content, CRC-32 of the content that starts from the number.
_SLOT = struct.Struct("<QII")
_ATTEMPTS = 1000


def runtime_folder() -> Path:
    """This user's folder for files that live as long as a process; in memory where the platform has such a place.

    Raises:
        InputError: somebody else owns the folder, or it cannot be made.
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
        raise InputError(f"cannot be made ({error.strerror}); set XDG_RUNTIME_DIR to a folder of yours",
                         file=folder) from error
    if hasattr(os, "getuid") and (folder.is_symlink() or folder.stat().st_uid != os.getuid()):
        raise InputError("belongs to somebody else; set XDG_RUNTIME_DIR to a folder of yours", file=folder)
    return folder


def unused_path(ending: str) -> Path:
    """A name in `runtime_folder` that no file has."""
    return runtime_folder() / f"{os.getpid()}-{secrets.token_hex(4)}.{ending}"


class SlotWriter:
    """The one who writes; makes the file, and removes it when closed.

    Args:
        path: of a file that is not there yet.
        kind: 8 bytes that say what the slots hold.
        count: slots, at least 2.
        size: most bytes that a slot holds.

    Raises:
        InputError: the file is there already or cannot be made, or there is no room for it.
    """

    def __init__(self, path: str | Path, kind: bytes, count: int, size: int):
        if count < 2:
            raise InputError(f"{count} slots; give at least 2, so that one is whole while another is written",
                             field="count")
        self.path, self.count, self.size, self.written = Path(path), count, size, 0
        self._stride = _SLOT.size + -(-size // 8) * 8
        total = HEAD_SIZE + count * self._stride
        empty = HEAD.pack(kind, VERSION, self._stride, count, os.getpid()).ljust(total, b"\0")
        try:
            _appear(self.path, empty)
            with self.path.open("r+b") as stream:
                self._map = mmap.mmap(stream.fileno(), total)
        except FileExistsError:
            raise InputError("exists already; remove it or give another name", file=self.path) from None
        except OSError as error:
            raise InputError(f"cannot be shared ({error.strerror or error}); choose another place",
                             file=path) from error
        self._numbers = memoryview(self._map)[_WRITTEN:_ENDED + 8].cast("Q")

    def write(self, content: bytes | bytearray | memoryview) -> int:
        """Fill the next slot with bytes and return its number.

        Raises:
            InputError: more than a slot holds.
        """
        length = len(content)
        if length > self.size:
            raise InputError(f"{length} bytes do not fit a slot of {self.size}", file=self.path)
        number = self.written + 1
        place = HEAD_SIZE + (number - 1) % self.count * self._stride
        _SLOT.pack_into(self._map, place, number, length, _checksum(content, number))
        place += _SLOT.size
        self._map[place:place + length] = content
        self._numbers[0] = self.written = number
        return number

    def close(self) -> None:
        """Tell the readers that nothing comes any more, and remove the file; who has it open can still read it."""
        if self._map.closed:
            return
        self._numbers[1] = 1
        self._numbers.release()
        self._map.close()
        remove(self.path)

    def __enter__(self):
        return self

    def __exit__(self, *failure) -> None:
        self.close()


class SlotReader:
    """One of those who read, from any process.

    Args:
        path: file of a writer.
        kind: what it must hold.

    Raises:
        InputError: no such file, or not one of this kind and version.
    """

    def __init__(self, path: str | Path, kind: bytes):
        self.path = Path(path)
        try:
            with self.path.open("rb") as stream:
                self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:  # ValueError: an empty file
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"cannot be read ({reason}); give the file that a running loop names",
                             file=path) from error
        found = HEAD.unpack_from(self._map) if len(self._map) >= HEAD_SIZE else (b"", 0, 0, 0, 0)
        _, version, self._stride, self.count, self.writer = found
        whole = len(self._map) == HEAD_SIZE + self._stride * self.count
        if found[0] != kind or version != VERSION or not whole:
            self._map.close()
            raise InputError(f"is not a file of kind {kind.rstrip(bytes(1)).decode()!r}, version {VERSION}; give the "
                             "file that a running loop of the same version names", file=path)
        self._numbers = memoryview(self._map)[_WRITTEN:_ENDED + 8].cast("Q")

    @property
    def written(self) -> int:
        """Number of the newest slot; 0 where there is none."""
        return self._numbers[0]

    @property
    def ended(self) -> bool:
        """Whether the writer has closed; one that was killed has not."""
        return self._numbers[1] != 0

    def read(self, number: int) -> bytes | None:
        """What was written under a number, whole; None where it is not there any more, or not yet."""
        place = HEAD_SIZE + (number - 1) % self.count * self._stride
        copy = self._map[place:place + self._stride]
        found, length, checksum = _SLOT.unpack_from(copy)
        content = copy[_SLOT.size:_SLOT.size + length]
        return content if found == number and checksum == _checksum(content, number) else None

    @property
    def size(self) -> int:
        """Most bytes that a slot holds."""
        return self._stride - _SLOT.size

    def head(self, number: int) -> tuple[int, int]:
        """Length, bytes, and checksum of what was written under a number, for who reads it in parts; (0, -1) where it
        is not there any more."""
        found, length, checksum = _SLOT.unpack_from(self._map, HEAD_SIZE + (number - 1) % self.count * self._stride)
        return (length, checksum) if found == number and length <= self.size else (0, -1)

    def part(self, number: int, start: int, end: int) -> bytes:
        """Some of its bytes, whole or not: what all parts together are worth, their checksum says, a CRC-32 that starts
        from the number."""
        place = HEAD_SIZE + (number - 1) % self.count * self._stride + _SLOT.size
        return self._map[place + start:place + end]

    def newest(self) -> tuple[int, bytes] | None:
        """Number and content of the newest slot; None where nothing was written yet.

        Raises:
            InputError: no slot is whole.
        """
        for _ in range(_ATTEMPTS):
            number = self.written
            if number == 0:
                return None
            content = self.read(number)
            if content is not None:
                return number, content
        raise InputError("holds no complete record", file=self.path)

    def after(self, number: int) -> tuple[list[bytes], int, int]:
        """What was written after a number.

        Args:
            number: of the slot that was read last; 0: from the oldest one that is there.

        Returns:
            The contents in order, the number to ask with the next time, and how many between were overwritten before
            they were read. What is not there for a reader who begins is not lost.
        """
        newest = self.written
        oldest = max(newest - self.count, 0) + 1
        first = max(number + 1, oldest)
        lost = first - number - 1 if number > 0 else 0
        contents = []
        for wanted in range(first, newest + 1):
            content = self.read(wanted)
            if content is not None:
                contents.append(content)
            elif self.written - wanted >= self.count - 1:
                lost += 1  # it is being overwritten, or was
            else:
                newest = wanted - 1  # not all of it has arrived at this core: the next time
                break
        return contents, max(number, newest), lost

    def close(self) -> None:
        self._numbers.release()
        self._map.close()

    def __enter__(self):
        return self

    def __exit__(self, *failure) -> None:
        self.close()


def remove(path: Path) -> None:
    """Remove the file of a writer that is gone, where it is still there."""
    # Windows refuses while somebody has it open; it is a small file in a folder for such files.
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def _checksum(content, number: int) -> int:
    return zlib.crc32(content, number & 0xFFFFFFFF)


def _appear(path: Path, content: bytes) -> None:
    """Make a file that is this user's alone and whole from its first moment.

    Raises:
        OSError: the name is taken, or there is no room; a full disk is met here, and not in a tick.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "xb", opener=_private) as stream:
            stream.write(content)
        # Neither replaces a file that is there.
        if os.name == "nt":
            temporary.rename(path)
        else:
            path.hardlink_to(temporary)
    finally:
        remove(temporary)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
