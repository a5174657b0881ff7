"""Interpretation of a file: guesses with their reasons, and hints of the user that override them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.recording.formats.assumption import Assumption
from tissue_sim.recording.formats.columns import Curves, Sheets
from tissue_sim.recording.formats.kind_words import NamedTest
from tissue_sim.recording.recording import CHANNELS, Recording
from tissue_sim.settings import make_shallow_read_only_copy
from tissue_sim.units import UNITS, find_quantity_of_unit_or_none

__getattr__ = make_getattr_for_old_names(__name__, {"Stated": "InterpretationOverrides",
                                                    "ColumnHints": "InterpretationOverrides"})


@dataclass(frozen=True)
class KindGuess:
    """The kind of test of a table, and the evidence.

    Attributes:
        kind: name in `KINDS`; None: unknown.
        reason: evidence in one sentence.
        against: evidence against the kind.
        alternatives: names of kinds that other words in the file name.
        is_stated: whether the user states the kind.
        refused: test without a registered kind that the file names; no kind may be assumed then.
        is_weak: whether the name of the file is the only evidence.
    """

    kind: str | None
    reason: str
    against: tuple[str, ...] = ()
    alternatives: tuple[str, ...] = ()
    is_stated: bool = False
    refused: NamedTest | None = None
    is_weak: bool = False


@dataclass(frozen=True)
class ColumnGuess:
    """One column and its interpretation.

    Attributes:
        channel: channel of the recording.
        header: header of the column; empty without a header.
        place: position of the column, from 1.
        unit: unit of the numbers; None: unknown.
        sign, scale, offset, measure: as in ``columns`` of a campaign; None: not stated in the campaign.
        by_name: whether the header is unique in its table.
        reason: evidence in one sentence.
        role: quantity that the header names, such as ``strain``, which is read as a stretch.
        rank: rank of `tissue_sim.recording.formats.vocabulary.find_role_and_rank_or_none`; the column with the lowest
            rank is read.
        other_unit: unit in the row of units that contradicts the unit in the header; None: no contradiction.
        strain_unit: unit of a strain that the gauge length converts to a displacement; None: no such column.
    """

    channel: str
    header: str
    place: int
    unit: str | None
    role: str
    sign: int = 1
    scale: float | None = None
    offset: float | str | None = None
    by_name: bool = True
    reason: str = ""
    measure: str | None = None
    rank: int = 0
    other_unit: str | None = None
    strain_unit: str | None = None

    def to_campaign_entry(self) -> dict[str, Any]:
        """Return the mapping that describes this column in the key ``columns`` of a campaign file."""
        entry: dict[str, Any] = {"name": self.header} if self.by_name else {"column": self.place}
        stated = {"unit": self.unit, "sign": self.sign if self.sign != 1 else None, "scale": self.scale,
                  "offset": self.offset, "measure": self.measure}
        return entry | {key: value for key, value in stated.items() if value is not None}

    @property
    def missing_information_text_or_none(self) -> str | None:
        """Information about this column that only the user knows, such as its unit, in words; None: complete."""
        name = repr(self.header) if self.header else str(self.place)
        if self.unit is None and self.scale is None and CHANNELS[self.channel] != "ratio":
            return f"the unit of column {name} ({self.channel})"
        if self.unit is not None and self.unit not in UNITS:
            return f"the unit of column {name} ({self.channel}), as {self.unit!r} is no known one"
        if find_quantity_of_unit_or_none(self.unit) == "signal" and self.scale is None:
            return f"the scale of column {name} ({self.channel}), SI units in 1 {self.unit}"
        return None


@dataclass(frozen=True, eq=False)
class TableGroup:
    """Tables of one file that are read with the same options, their recordings and the assumptions about them.

    Attributes:
        name: name that distinguishes the tables from others of the file; empty without others.
        columns: columns that are read. others: headers of the other columns.
        options: options of `tissue_sim.read_recordings`, including ``columns``.
        recordings: recordings in SI; if a unit or scale is missing, in the numbers of the file.
        kind: kind of test.
        line: line of the header, or of the first numbers.
        sheets: names of the sheets that are read.
        stated: key -> value of the statements in the file.
        remarks: sentences on omitted parts.
        specimen: key of ``[[specimen]]`` -> value in the sidecar of the recording.
        assumptions: assumptions about these tables: columns, units, kind of test, sizes.
        unused: headers (positions, without a header) of the columns that are not read.
        speed: constant speed that gives the displacement from the time, m/s, and its source; None: not needed.
    """

    name: str
    columns: tuple[ColumnGuess, ...]
    others: tuple[str, ...]
    options: Mapping[str, Any]
    recordings: tuple[Recording, ...]
    kind: KindGuess
    line: int
    sheets: tuple[str, ...] = ()
    stated: Mapping[str, str] = field(default_factory=lambda: make_shallow_read_only_copy({}))
    remarks: tuple[str, ...] = ()
    specimen: Mapping[str, float | str] = field(default_factory=lambda: make_shallow_read_only_copy({}))
    assumptions: tuple[Assumption, ...] = ()
    unused: tuple[str, ...] = ()
    speed: tuple[float, str] | None = None

    @property
    def channels_without_unit(self) -> frozenset[str]:
        """Channels whose unit or scale is unknown, so that they have the numbers of the file."""
        return frozenset(column.channel for column in self.columns if column.missing_information_text_or_none)

    @property
    def missing_information_texts(self) -> tuple[str, ...]:
        """Information about the columns that only the user knows, in words; empty: complete."""
        return tuple(column.missing_information_text_or_none for column in self.columns
                     if column.missing_information_text_or_none)


@dataclass(frozen=True, eq=False)
class FileInterpretation:
    """Interpretation of a file of measurements: machine, format, table groups, warnings and assumptions.

    Attributes:
        file: path.
        format: name of the machine, ``native``, ``afm``, or ``table`` for an unknown machine.
        kind_of_file: ``text``, ``workbook``, ``container`` or ``afm``.
        delimiter, decimal_mark, encoding: properties of a text; else None.
        readings: groups of tables that are read with the same options, at least one group.
        warnings: sentences for the user.
        assumptions: assumptions about the complete file: format, separators.
    """

    file: Path
    format: str
    kind_of_file: str
    delimiter: str | None
    decimal_mark: str | None
    encoding: str | None
    readings: tuple[TableGroup, ...]
    warnings: tuple[str, ...] = ()
    assumptions: tuple[Assumption, ...] = ()


@dataclass(frozen=True)
class InterpretationOverrides:
    """Hints of the user about the columns of a file, which override the detected ones.

    Attributes:
        columns: channel (or ``strain``) -> header, or position as a number from 1 or a letter.
        units: channel -> unit.
        scales: channel -> SI units in one unit of the file.
        signs: channel -> 1 or -1.
        kind: kind of test.
        format: format of a machine.
        sheet: name or number of the sheet of a spreadsheet, or a list of them.
        delimiter: character between the cells of a text.
        skip_lines: number of lines at the top that are ignored.
        direct: whether stress and strain are read from a file that also has force and displacement.
        measures: channel (or ``strain``) -> measure of strain or stress, ``engineering`` or a name in
            `tissue_sim.recording.measures.MEASURES`.
        any_test: whether tables of tests without a registered kind are read, too, for their numbers alone.
        height: height of the specimen, m: the gauge length that converts a strain to a displacement; None: not stated.
        speed: constant speed of the test, m/s, for a file without a clock or without a motion; None: not stated.
        decimal: decimal mark of the numbers, ``"."`` or ``","``; None: found.
        curve: number, or numbers, from 1, of the recordings of each file that are read; None: all.
        one_material: whether titled blocks of one file are replicates of one material whatever their names.
    """

    columns: Mapping[str, str | int] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    scales: Mapping[str, float] = field(default_factory=dict)
    signs: Mapping[str, int] = field(default_factory=dict)
    kind: str | None = None
    format: str | None = None
    sheet: Sheets | None = None
    delimiter: str | None = None
    skip_lines: int = 0
    direct: bool = False
    measures: Mapping[str, str] = field(default_factory=dict)
    speed: float | None = None
    height: float | None = None
    any_test: bool = False
    decimal: str | None = None
    curve: Curves | None = None
    one_material: bool = False
