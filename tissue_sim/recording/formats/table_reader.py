"""Recordings of chosen columns of the tables of a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.constant_speed import with_constant_speed
from tissue_sim.recording.formats.columns import MarkedRecording, read_marked_blocks
from tissue_sim.recording.formats.guesses import ColumnGuess
from tissue_sim.recording.recording import Recording
from tissue_sim.units import UNITS

#: Largest value of any channel, in SI or in the unit of the file; a larger value is a damaged cell.
_LARGEST_VALUE = 1e20


@dataclass(frozen=True)
class TableReader:
    """Reads the tables of one file with any choice of columns.

    Attributes:
        path: the file. options: of `read_recordings` without ``columns``.
        speed: constant speed that replaces a column of the motion, m/s; None: there is a motion.
    """

    path: Path
    options: Mapping[str, Any]
    speed: float | None = None

    def read(self, columns: Sequence[ColumnGuess]) -> tuple[MarkedRecording, ...]:
        """Read the recordings with the marks of their numbers.

        Raises:
            InputError: a cell without a number, or with a number that no machine measures.
        """
        entries = {}
        for column in columns:
            entries[column.channel] = column.entry()
            if column.missing:
                # Without a unit the numbers of the file still show the shape of the test.
                entries[column.channel]["scale"] = column.scale or 1.0
                if column.unit not in UNITS:
                    entries[column.channel].pop("unit", None)
        marked = tuple(self._with_motion(each) for each in read_marked_blocks(self.path, entries, **self.options))
        for each in marked:
            for channel, values in each.recording.channels.items():
                largest = values[np.argmax(np.abs(values))]
                if abs(largest) > _LARGEST_VALUE:
                    raise InputError(f"{channel} reaches {largest:g}, which no machine measures: a cell is damaged",
                                     file=self.path)
        return marked

    def _with_motion(self, marked: MarkedRecording) -> MarkedRecording:
        if self.speed is None:
            return marked
        return replace(marked, recording=with_constant_speed(marked.recording, self.speed, self.path))

    def recordings(self, columns: Sequence[ColumnGuess]) -> tuple[Recording, ...]:
        """The recordings; see `read`."""
        return tuple(each.recording for each in self.read(columns))

    def readable(self, columns: tuple[ColumnGuess, ...]
                 ) -> tuple[tuple[ColumnGuess, ...], tuple[MarkedRecording, ...], tuple[str, ...]]:
        """Columns that can be read, their recordings, and remarks: without a clock that runs backwards, and with a
        stretch that falls below zero read as a strain."""
        remarks: tuple[str, ...] = ()
        try:
            marked = self.read(columns)
        except InputError as error:
            if not error.problem.startswith("time runs backwards"):
                raise
            columns = tuple(column for column in columns if column.channel != "time")
            marked = self.read(columns)
            remarks = (f"the clock is left out: line {error.line}: {error.problem.split(' in column')[0]}",)
        if any(column.role == "stretch" for column in columns) and min(
                each.recording.channel("stretch").min() for each in marked) <= 0:
            columns = tuple(replace(column, role="strain", offset=1.0, reason=f"{column.reason}; not above zero, as a "
                                    "stretch is; a strain, which 1 makes a stretch")
                            if column.role == "stretch" else column for column in columns)
            marked = self.read(columns)
        return columns, marked, remarks

    def turned(self, recordings: tuple[Recording, ...], before: Sequence[ColumnGuess],
               after: Sequence[ColumnGuess]) -> tuple[Recording, ...]:
        """The recordings after some columns have changed their sign."""
        other = [column for was, column in zip(before, after, strict=True) if column.entry() != was.entry()]
        if any(column.offset is not None for column in other) or (other and any(column.measure for column in after)):
            return self.recordings(after)
        # 0.0 - x has no negative zero.
        return tuple(each.with_channels(**{column.channel: 0.0 - each.channel(column.channel) for column in other})
                     if other else each for each in recordings)
