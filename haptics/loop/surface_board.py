"""The deformed surface, for viewers in other processes: the newest one, and whether there is a newer."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptics.loop.shared_slots import SlotReader, SlotWriter
from tissue_sim.errors import InputError

_KIND = b"tsSURF\0\0"
#: A reader has three more publications of time to copy one.
_SLOTS = 4
_TIME = struct.Struct("<d")


@dataclass(frozen=True, eq=False)
class PublishedSurface:
    """A surface as the loop has published it.

    Attributes:
        number: of the publication, from 1.
        time: s since the loop began.
        outline: (r, z) from the axis along the deformed top and down the side, m, shape (n, 2).
    """

    number: int
    time: float
    outline: np.ndarray


class SurfaceBoard(SlotWriter):
    """Where the loop publishes the surface.

    Args:
        path: file to make.
        points: most points of an outline.

    Raises:
        InputError: the file is there already or cannot be made.
    """

    def __init__(self, path: str | Path, points: int):
        super().__init__(path, _KIND, _SLOTS, _TIME.size + 16 * points)

    def publish(self, time: float, outline: np.ndarray) -> int:
        """Make an outline, m, shape (n, 2), the newest one; returns its number.

        Raises:
            InputError: another shape, or more points than there is room for.
        """
        outline = np.ascontiguousarray(outline, "<f8")
        if outline.ndim != 2 or outline.shape[1] != 2:
            raise InputError(f"an outline of shape {outline.shape}; expected (n, 2)", field="outline")
        return self.write(_TIME.pack(time) + outline.tobytes())


class SurfaceReader(SlotReader):
    """Reads the board of a running loop, from any process.

    Args:
        path: as `LoopProcess.surface_path` names it.

    Attributes:
        ended: whether the loop has; one that was killed has not said so.

    Raises:
        InputError: no such file, or not a board of this version.
    """

    def __init__(self, path: str | Path):
        super().__init__(path, _KIND)

    def latest(self, after: int = 0) -> PublishedSurface | None:
        """The newest surface; None where there is none with a number above `after`."""
        if self.written <= after:
            return None
        number, content = super().latest()
        return PublishedSurface(number, *_TIME.unpack_from(content),
                                np.frombuffer(content, "<f8", offset=_TIME.size).reshape(-1, 2))
