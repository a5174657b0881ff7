"""Read the recordings of chosen columns of a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.columns import RecordingWithDecimalMark, read_recordings_and_decimal_marks
from tissue_sim.recording.formats.guesses import ColumnGuess
from tissue_sim.recording.recording import Recording, add_time_or_motion_from_speed
from tissue_sim.units import UNITS

#: Largest valid value of any channel, SI units or the unit of the file. A larger value is a damaged cell.
_LARGEST_VALUE = 1e20


@dataclass(frozen=True)
class FileReaderForChosenColumns:
    """Reader of the tables of one file for any choice of columns.

    Attributes:
        path: the file.
        options: options of `tissue_sim.read_recordings` without ``columns``.
        speed: constant speed, m/s, that replaces a column of the motion; None: the file has a motion.
    """

    path: Path
    options: Mapping[str, Any]
    speed: float | None = None

    def read_recordings_and_decimal_marks(self, columns: Sequence[ColumnGuess]) -> tuple[RecordingWithDecimalMark, ...]:
        """Read the recordings with the marks of their numbers.

        Raises:
            InputError: a cell without a number, or with a number that no machine measures.
        """
        entries = {}
        for column in columns:
            entries[column.channel] = column.to_campaign_entry()
            if column.missing_information_text_or_none:
                # The kind of test is found from numbers without a unit, too.
                entries[column.channel]["scale"] = column.scale or 1.0
                if column.unit not in UNITS:
                    entries[column.channel].pop("unit", None)
        marked = tuple(self._add_displacement_from_speed_if_stated(each)
                       for each in read_recordings_and_decimal_marks(self.path, entries, **self.options))
        for each in marked:
            for channel, values in each.recording.channels.items():
                largest = values[np.argmax(np.abs(values))]
                if abs(largest) > _LARGEST_VALUE:
                    raise InputError(f"{channel} reaches {largest:g}, which no machine measures: a cell is damaged",
                                     file=self.path)
        return marked

    def _add_displacement_from_speed_if_stated(self, marked: RecordingWithDecimalMark) -> RecordingWithDecimalMark:
        """Return the recording with a displacement of speed times time; unchanged if `speed` is None."""
        if self.speed is None:
            return marked
        return replace(marked, recording=add_time_or_motion_from_speed(marked.recording, self.speed, self.path))

    def read_recordings(self, columns: Sequence[ColumnGuess]) -> tuple[Recording, ...]:
        """Read the recordings of the columns, without the marks; see `read_recordings_and_decimal_marks`."""
        return tuple(each.recording for each in self.read_recordings_and_decimal_marks(columns))

    def read_repairing_time_and_stretch(self, columns: tuple[ColumnGuess, ...]
                                        ) -> tuple[tuple[ColumnGuess, ...], tuple[RecordingWithDecimalMark, ...],
                                                   tuple[str, ...]]:
        """Read the recordings after the correction of two faults of a file.

        A time that decreases is omitted, and a stretch that is not positive is read as a strain.

        Returns:
            Corrected columns, recordings, and remarks on the corrections.
        """
        remarks: tuple[str, ...] = ()
        try:
            marked = self.read_recordings_and_decimal_marks(columns)
        except InputError as error:
            if not error.problem.startswith("time runs backwards"):
                raise
            columns = tuple(column for column in columns if column.channel != "time")
            marked = self.read_recordings_and_decimal_marks(columns)
            remarks = (f"the time is omitted: line {error.line}: {error.problem.split(' in column')[0]}",)
        if any(column.role == "stretch" for column in columns) and min(
                each.recording.channel("stretch").min() for each in marked) <= 0:
            columns = tuple(replace(column, role="strain", offset=1.0, reason=f"{column.reason}; not positive, unlike "
                                    "a stretch; a strain, which 1 makes a stretch")
                            if column.role == "stretch" else column for column in columns)
            marked = self.read_recordings_and_decimal_marks(columns)
        return columns, marked, remarks

    def negate_or_reread_changed_channels(self, recordings: tuple[Recording, ...], before: Sequence[ColumnGuess],
                                          after: Sequence[ColumnGuess]) -> tuple[Recording, ...]:
        """Return the recordings after a change of the signs of some columns.

        Args:
            recordings: recordings of the columns `before`.
            before: columns before the change.
            after: columns after the change.
        """
        other = [column for was, column in zip(before, after, strict=True)
                 if column.to_campaign_entry() != was.to_campaign_entry()]
        if any(column.offset is not None for column in other) or (other and any(column.measure for column in after)):
            return self.read_recordings(after)
        # 0.0 - x has no negative zero.
        return tuple(each.with_channels(**{column.channel: 0.0 - each.channel(column.channel) for column in other})
                     if other else each for each in recordings)
