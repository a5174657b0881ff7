"""What a file is taken for: guesses with their reasons, and what a person states over them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.formats.assumption import Assumption
from tissue_sim.recording.formats.columns import Curves, Sheets
from tissue_sim.recording.formats.kind_words import NamedTest
from tissue_sim.recording.recording import CHANNELS, Recording
from tissue_sim.units import UNITS, quantity_of


@dataclass(frozen=True)
class KindGuess:
    """The kind of test of a table, and the evidence.

    Attributes:
        kind: name in `KINDS`; None: unknown. reason: evidence in one sentence.
        against: evidence against it. alternatives: names of kinds that other words of the file name.
        is_stated: whether the user stated it.
        refused: word for a test without a kind, for which no kind may be taken.
        is_weak: whether only the name of the file says it.
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
    """One column and what it is taken for.

    Attributes:
        channel: of the recording. header: of the column, empty where it has none. place: from 1.
        unit: None: not known. sign, scale, offset, measure: as in ``columns`` of a campaign; None: not stated there.
        by_name: whether the header tells it from all others.
        reason: why, for people.
        role: what the header says: a strain is read as a stretch.
        rank: of `tissue_sim.recording.formats.vocabulary.role_of`; the lowest of a role is read.
        other_unit: unit in the row of units, where it contradicts that of the header.
        strain_unit: unit in the file of a strain that the gauge length makes a displacement; None: no such column.
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

    def entry(self) -> dict[str, Any]:
        """As it stands in ``columns`` of a campaign."""
        entry: dict[str, Any] = {"name": self.header} if self.by_name else {"column": self.place}
        stated = {"unit": self.unit, "sign": self.sign if self.sign != 1 else None, "scale": self.scale,
                  "offset": self.offset, "measure": self.measure}
        return entry | {key: value for key, value in stated.items() if value is not None}

    @property
    def missing(self) -> str | None:
        """What only a person can say of it; None: nothing."""
        name = repr(self.header) if self.header else str(self.place)
        if self.unit is None and self.scale is None and CHANNELS[self.channel] != "ratio":
            return f"the unit of column {name} ({self.channel})"
        if self.unit is not None and self.unit not in UNITS:
            return f"the unit of column {name} ({self.channel}), as {self.unit!r} is no known one"
        if quantity_of(self.unit) == "signal" and self.scale is None:
            return f"the scale of column {name} ({self.channel}), SI units in 1 {self.unit}"
        return None


@dataclass(frozen=True, eq=False)
class Reading:
    """Tables of a file that are read alike.

    Attributes:
        name: what tells it from other tables of the file; empty where it is the only one.
        columns: what is read. others: headers of what is left.
        options: of `tissue_sim.read_recordings`, ``columns`` included.
        recordings: what they give, SI; where a unit or scale is missing the numbers of the file.
        kind: of test, as far as it shows.
        line: of the header, or of the first numbers. sheets: names of those that are read.
        stated: key -> value of what stands above the numbers. remarks: sentences on what was left out.
        specimen: key of ``[[specimen]]`` -> value, as the sidecar of the recording states them.
        assumptions: about these tables: columns, units, kind of test, sizes.
        unused: headers (places, where there is none) of the columns that are not read.
        speed: constant speed that makes the displacement from the time, m/s, and its source; None: not needed.
    """

    name: str
    columns: tuple[ColumnGuess, ...]
    others: tuple[str, ...]
    options: Mapping[str, Any]
    recordings: tuple[Recording, ...]
    kind: KindGuess
    line: int
    sheets: tuple[str, ...] = ()
    stated: Mapping[str, str] = field(default_factory=lambda: read_only({}))
    remarks: tuple[str, ...] = ()
    specimen: Mapping[str, float | str] = field(default_factory=lambda: read_only({}))
    assumptions: tuple[Assumption, ...] = ()
    unused: tuple[str, ...] = ()
    speed: tuple[float, str] | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """What only a person can say of its columns."""
        return tuple(column.missing for column in self.columns if column.missing)


@dataclass(frozen=True, eq=False)
class Understanding:
    """What a file is taken for.

    Attributes:
        file: it. format: name of the machine, ``native``, ``afm``, or ``table`` for no machine that is known.
        kind_of_file: ``text``, ``workbook``, ``container`` or ``afm``.
        delimiter, decimal_mark, encoding: of a text, else None.
        readings: at least one.
        warnings: sentences.
        assumptions: about the whole file: format, separators.
    """

    file: Path
    format: str
    kind_of_file: str
    delimiter: str | None
    decimal_mark: str | None
    encoding: str | None
    readings: tuple[Reading, ...]
    warnings: tuple[str, ...] = ()
    assumptions: tuple[Assumption, ...] = ()


@dataclass(frozen=True)
class Stated:
    """What a person says of a file, over what it shows.

    Attributes:
        columns: channel (or ``strain``) -> header, or place as a number or letter.
        units, scales, signs: channel -> it.
        kind: of test. format: of a machine. sheet, delimiter, skip_lines: where the table is.
        direct: whether stress and strain are read where a file has force and displacement, too.
        measures: channel (or ``strain``) -> measure of strain or stress, ``engineering`` or a name in
            `tissue_sim.recording.measures.MEASURES`.
        any_test: whether tables of tests without a kind are read too: only their numbers are wanted.
        height: of the specimen, m: the gauge length by which a strain becomes a displacement; None: not stated.
        speed: constant speed of the test, m/s, for a file without a clock or without a motion; None: not stated.
        decimal: decimal mark of the numbers, ``"."`` or ``","``; None: found.
        curve: number from 1, or numbers, of the recordings of each file that are read; None: all.
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
