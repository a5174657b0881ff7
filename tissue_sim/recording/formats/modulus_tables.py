"""Tables of storage and loss modulus over frequency (rheometer, DMA): their columns and their kind of test.

Moduli over amplitude, temperature or time at one frequency, several sweeps in one table, and logarithms are refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS, MODULUS_PAIRS
from tissue_sim.recording.formats.assumption import Assumption
from tissue_sim.recording.formats.blocks import find_positions_of_cells_with_name
from tissue_sim.recording.formats.guesses import ColumnGuess, InterpretationOverrides, KindGuess, TableGroup
from tissue_sim.recording.formats.kind_guess import (
    make_hints_from_text_above_and_sheet_name,
    make_kind_assumption,
)
from tissue_sim.recording.formats.kind_words import KindHint, find_named_tests
from tissue_sim.recording.formats.pairing import find_column_position_or_none
from tissue_sim.recording.formats.sources import FileContent, NumberTable
from tissue_sim.recording.formats.table_reader import FileReaderForChosenColumns
from tissue_sim.recording.recording import MIN_POINTS
from tissue_sim.settings import make_shallow_read_only_copy
from tissue_sim.units import find_quantity_of_unit_or_none

#: Channel -> pattern of its headers, lower case, without unit. The letter G or E is the modulus of shear or tension.
_CHANNELS = {
    "storage modulus": re.compile(r"\bstorage modul(us|i)\b|\belastic shear modul(us|i)\b|\bspeichermodul\w*|"
                                  r"\bmodule (de |d )?(conservation|stockage)\b|^[ge] ?['′’´`](?!['′’´`\"])(?!\w)|"
                                  r"^[ge][ _]prime\b|^[ge]p(?!\w)"),
    "loss modulus": re.compile(r"\bloss modul(us|i)\b|\bviscous modul(us|i)\b|\bverlustmodul\w*|"
                               r"\bmodule (de |d )?perte\b|^[ge] ?['′’´`]{2}(?!\w)|^[ge] ?[\"″”](?!\w)|"
                               r"^[ge][ _]double prime\b|^[ge]pp(?!\w)"),
    "complex modulus": re.compile(r"\bcomplex (shear )?modul(us|i)\b|\bdynamic modul(us|i)\b|\bmodule complexe\b|"
                                  r"\bkomplexe\w* (modul|schubmodul)\b|^\|?[ge]\*\|?(?!\w)"),
    "loss factor": re.compile(r"\btan ?\(?(delta|δ)\)?|\bloss factor\b|\bverlustfaktor\w*|\bdamping factor\b"),
    "frequency": re.compile(r"\b(angular )?frequenc(y|ies)\b|\b(kreis)?frequenz\b|\bfréquence\b|\bomega\b|^ω|"
                            r"^f(req)?(?!\w)"),
}
#: Headers of other quantities from which moduli follow, or over which moduli are measured.
_OTHER_MODULI = re.compile(r"\bcomplex viscosity\b|\bkomplexe\w* viskosität\b")
_AMPLITUDES = re.compile(r"\bamplitude\w*|\boscillation (strain|stress)\b|\bscher(dehnungs)?amplitude\w*|"
                         r"\bstrain amp\w*")
#: Letter of a modulus in a header, such as G of G', |G*| or "Storage modulus G'".
_LETTER = re.compile(r"(?<!\w)([ge]) ?(?:['′’´`\"″”*]|p\b|pp\b|prime\b|double prime\b)")
#: Words of an angular frequency.
_ANGULAR = re.compile(r"\bangular\b|\bkreis\w*|\bomega\b|^ω")
#: Unit of an angular frequency, and of a frequency, whose header states 1/s.
_PER_SECOND = {"1/s": ("rad/s", "Hz"), "s-1": ("rad/s", "Hz"), "s^-1": ("rad/s", "Hz")}
#: Words of a logarithm at the start of a header.
_LOGARITHM = re.compile(r"^(?:log(?:10|_10|e)?|lg|ln)(?![a-z0-9])[ (\[]*(?:of )?")
#: Words of a temperature.
_TEMPERATURE = re.compile(r"\btemp(erature?|eratur)?\b|^t ?[(\[]? ?(°|deg|[ck][)\]])")


@dataclass(frozen=True)
class SweepLevels:
    """Limits that separate the sweeps of one table by the values of a column, such as its temperatures.

    Attributes:
        temperature: smallest difference of two temperatures, in the unit of the column. Controlled temperatures vary
            by some tenths of a degree.
        relative: smallest difference of two other values, relative to the largest value.
        gap: smallest difference of two values of different sweeps, relative to the range of the column.
        spread: largest range of the values in one sweep, relative to the smallest difference between sweeps.
        frequencies: smallest number of frequencies of a sweep.
    """

    temperature: float = 1.5
    relative: float = 0.02
    gap: float = 0.1
    spread: float = 0.2
    frequencies: int = 3


_LEVELS = SweepLevels()
#: Words of a shear test, if the headers do not name the modulus by a letter.
_SHEAR = re.compile(r"\b(shear|rheo\w*|scher\w*|schub\w*|cisaillement|cone|kegel)\b")


def _normalize(header: str) -> str:
    """Return a header in lower case with single blanks."""
    return " ".join(header.casefold().replace("_", " ").split())


def is_frequency_or_amplitude_sweep(headers: Sequence[str]) -> bool:
    """Return whether the headers of a table are those of moduli over frequency or amplitude.

    Such a table has two dynamic moduli, or one modulus and the quantity over which the modulus is measured.
    """
    names = [_LOGARITHM.sub("", _normalize(header)) for header in headers]
    moduli = sum(bool(_OTHER_MODULI.search(name)) or any(
        pattern.search(name) for channel, pattern in _CHANNELS.items() if channel != "frequency") for name in names)
    swept = sum(bool(_CHANNELS["frequency"].search(name) or _AMPLITUDES.search(name)) for name in names)
    amplitudes = sum("amplitude" in name or "oscillation" in name for name in names)
    return moduli >= 2 or (moduli >= 1 and swept >= 1) or swept > amplitudes > 0


def explain_refused_sweep(headers: Sequence[str]) -> str:
    """Return the reason why a table of moduli is not imported, in one sentence."""
    named = ", ".join(repr(header) for header in headers if header)
    return (f"moduli must be over at least {MIN_POINTS} frequencies; got the columns {named}. Give two moduli over "
            "frequency, or displacement and force, or strain and stress, against time")


def split_off_modulus_tables(source: FileContent, found: Sequence[NumberTable], hints: InterpretationOverrides,
                             titles: Sequence[KindHint]) -> tuple[list[NumberTable], list[TableGroup], tuple[str, ...]]:
    """Split the tables of a file into recordings of a motion and tables of moduli over frequency.

    Args:
        source: content of the file.
        found: tables of numbers.
        hints: hints of the user.
        titles: texts with words for a test outside of the tables.

    Returns:
        Tables without moduli, readings of the tables of moduli, and a sentence about omitted tables.

    Raises:
        InputError: no table can be read.
    """
    kept, groups, refused = [], [], []
    for numbers in found:
        headers = [numbers.get_column_header(position) for position in numbers.columns]
        is_named = "frequency" in hints.columns
        if not is_named and (hints.columns or not is_frequency_or_amplitude_sweep(headers)):
            kept.append(numbers)
        elif isinstance(group := _read_modulus_table_or_refusal(
                source, numbers, [each for each in found if each.table is numbers.table], hints, titles), str):
            refused.append((numbers, group))
        else:
            groups.append(replace(group, name=numbers.table.name if len(found) > 1 else ""))
    if not kept and not groups:
        raise InputError(refused[0][1], file=source.file, line=refused[0][0].rows[0].line)
    return kept, groups, tuple(f"a table is omitted: {reason}" for _, reason in refused[:1])


def _read_modulus_table_or_refusal(source: FileContent, numbers: NumberTable, blocks: Sequence[NumberTable],
                                   hints: InterpretationOverrides, titles: Sequence[KindHint]) -> TableGroup | str:
    """Return the reading of a table with two moduli over frequency; for another table the reason of its refusal.

    Args:
        source: content of the file.
        numbers: table of numbers.
        blocks: all tables of numbers of the same sheet or text.
        hints: hints of the user.
        titles: texts with words for a test outside of the tables.
    """
    headers = [numbers.get_column_header(position) for position in numbers.columns]
    columns = _find_named_columns(numbers, hints) if "frequency" in hints.columns else _find_columns(numbers)
    channels = {column.channel for column in columns}
    pair = next((pair for pair in MODULUS_PAIRS if {"frequency", *pair} <= channels), None)
    if pair is None or "frequency" in hints.columns:
        read = [column.header for column in columns] if "frequency" in hints.columns else headers
        if logarithms := [header for header in read if _LOGARITHM.search(_normalize(header))]:
            return ("columns of frequency and moduli must have values; got logarithms in "
                    f"{', '.join(map(repr, logarithms))}. Write the values, such as 10^x of a decimal logarithm x")
    if pair is None:
        return explain_refused_sweep(headers)
    columns = [column for column in columns if column.channel in ("frequency", *pair)]
    columns = [replace(column, unit=hints.units.get(column.channel, column.unit)) for column in columns]
    options: dict[str, Any] = {}
    if numbers.table.name and len(source.tables) > 1:
        options["sheet"] = numbers.table.name
    if source.kind == "text" and numbers.table.delimiter in ("|", " "):
        options["delimiter"] = numbers.table.delimiter
    if hints.decimal is not None:
        options["decimal"] = hints.decimal
    header, first = numbers.header, numbers.rows[0]
    # Rows with fewer cells than the header are read by the positions of their columns.
    by_name = header is not None and len(first.cells) >= len(header.cells) and all(
        len(find_positions_of_cells_with_name(header.cells, column.header)) == 1 for column in columns)
    if not by_name:
        columns = [replace(column, by_name=False) for column in columns]
        if first.line > 1:
            options["skip_lines"] = first.line - 1
    recordings = FileReaderForChosenColumns(source.file, options).read_recordings(columns)
    # A repeated header begins another recording, which is that of another block.
    same = [each for each in blocks if each.header is not None and header is not None
            and each.header.cells == header.cells]
    if len(recordings) == len(same) > 1:
        number = next(number for number, each in enumerate(same) if each is numbers)
        recordings, options["curve"] = (recordings[number],), number + 1
    if any(np.unique(each.channel("frequency")).size < MIN_POINTS for each in recordings):
        return explain_refused_sweep(headers)
    if (lowest := min(float(each.channel("frequency").min()) for each in recordings)) <= 0.0:
        return (f"frequency must be positive; got {lowest:g}. Leave out rows without a frequency; write a logarithm as "
                "values")
    if several := _explain_several_sweeps_or_empty(numbers, {column.place - 1: column for column in columns}):
        return several
    kind = _guess_kind(numbers, columns, hints, titles)
    kept = {**options, "columns": {column.channel: column.to_campaign_entry() for column in columns}}
    assumptions = (make_kind_assumption(kind), *(Assumption(
        f"unit of {column.channel}", column.unit, (column.reason,), (), (), f"--unit {column.channel}=...")
        for column in columns if column.channel == "frequency" and column.unit is not None))
    used = {column.place for column in columns}
    unused = tuple(numbers.get_column_header(place) or str(place + 1) for place in numbers.columns
                   if place + 1 not in used)
    return TableGroup("", tuple(columns), unused, make_shallow_read_only_copy(kept), recordings, kind,
                      (header or first).line,
                      (numbers.table.name,) if numbers.table.name else (), assumptions=assumptions, unused=unused)


def _explain_several_sweeps_or_empty(numbers: NumberTable, used: Mapping[int, ColumnGuess]) -> str:
    """Return the reason why a table contains several sweeps of the frequency; empty for one sweep.

    The rows of a sweep have one value of another column, such as temperature, strain amplitude or specimen, and the
    ranges of the frequency overlap.

    Args:
        numbers: table of moduli.
        used: position -> column that is read.
    """
    place = next(place for place, column in used.items() if column.channel == "frequency")
    frequency = _parse_column(numbers, place)
    for other in range(numbers.column_count):
        values = np.array([]) if other in used else _parse_column(numbers, other)
        header = numbers.get_column_header(other)
        if not values.size or np.isnan(values).all():
            continue
        levels = _find_levels(values, is_temperature=bool(_TEMPERATURE.search(_normalize(header))))
        ranges = sorted((frequency[rows].min(), frequency[rows].max()) for rows in levels
                        if np.unique(frequency[rows]).size >= _LEVELS.frequencies)
        if 1 < len(ranges) == len(levels) and any(after[0] <= before[1] for before, after in pairwise(ranges)):
            return (f"a table must have one sweep of the frequency; column {header or other + 1!r} has {len(levels)} "
                    "values over the same frequencies. Write the rows of each value to a separate file; import the "
                    "files of one state of the material together")
    return ""


def _parse_column(numbers: NumberTable, place: int) -> np.ndarray:
    """Return the numbers of a column, NaN without a number; texts get the number of their first row, shape (n,)."""
    cells = [row.cells[place].strip() if place < len(row.cells) else "" for row in numbers.rows]
    values = []
    for cell in cells:
        try:
            values.append(float(cell.replace(",", ".")))
        except ValueError:
            values.append(np.nan)
    if cells and np.isnan(values).all() and any(cells):
        return np.array([cells.index(cell) + 1.0 for cell in cells])
    return np.array(values)


def _find_levels(values: np.ndarray, *, is_temperature: bool) -> list[np.ndarray]:
    """Return the rows of each level of a column; one level if the values do not form separate groups.

    Args:
        values: values of the rows, shape (n,); NaN: no value.
        is_temperature: whether the column is a temperature.
    """
    order = np.argsort(values, kind="stable")[:int(np.isfinite(values).sum())]
    ordered = values[order]
    steps = np.diff(ordered)
    smallest = _LEVELS.temperature if is_temperature else _LEVELS.relative * float(np.abs(ordered).max())
    cuts = np.flatnonzero(steps > max(_LEVELS.gap * float(np.ptp(ordered)), smallest)) + 1
    levels = np.split(order, cuts)
    largest_spread = max(float(np.ptp(values[rows])) for rows in levels)
    is_separate = cuts.size and largest_spread <= _LEVELS.spread * float(steps[cuts - 1].min())
    return levels if is_separate else [order]


def _find_columns(numbers: NumberTable) -> list[ColumnGuess]:
    """Return the first column of each channel; of several frequencies the first with a known unit."""
    found: dict[str, ColumnGuess] = {}
    for place in numbers.columns:
        header = numbers.get_column_header(place)
        name = _normalize(numbers.get_header_without_unit(place)) or _normalize(header)
        channel = next((channel for channel, pattern in _CHANNELS.items() if pattern.search(name)), None)
        if channel is None or (channel == "frequency" and _AMPLITUDES.search(name)) \
                or _LOGARITHM.search(_normalize(header)):
            continue
        unit, reason = numbers.get_unit_in_header_or_unit_row(place), f"column {header!r}"
        if channel == "frequency":
            unit, reason = _interpret_unit_of_frequency(unit, name, reason)
        elif channel == "loss factor" and find_quantity_of_unit_or_none(unit) != "ratio":
            # The brackets of tan(delta) are no unit.
            unit = "-"
        known = found.get(channel)
        if known is None or (find_quantity_of_unit_or_none(known.unit) is None
                             and find_quantity_of_unit_or_none(unit) is not None):
            found[channel] = ColumnGuess(channel, header, place + 1, unit, channel, reason=reason)
    return list(found.values())


def _find_named_columns(numbers: NumberTable, hints: InterpretationOverrides) -> list[ColumnGuess]:
    """Return the columns that the user names.

    Raises:
        InputError: the table has no such column.
    """
    found = []
    for channel, name in hints.columns.items():
        place = find_column_position_or_none(numbers, name)
        if place is None:
            raise InputError(f"has no column {channel} = {name}", field="--column")
        found.append(ColumnGuess(channel, numbers.get_column_header(place), place + 1,
                                 "-" if channel == "loss factor" else numbers.get_unit_in_header_or_unit_row(place),
                                 channel, reason="stated"))
    return found


def _interpret_unit_of_frequency(unit: str | None, name: str, reason: str) -> tuple[str | None, str]:
    """Return the unit of a frequency, and the reason: 1/s and no unit mean rad/s in an angular frequency."""
    angular = _ANGULAR.search(name)
    if unit in _PER_SECOND:
        return _PER_SECOND[unit][0 if angular else 1], f"{reason}, in {unit}"
    if unit is None and angular:
        return "rad/s", f"{reason}, the unit of an angular frequency"
    return unit, reason


def _guess_kind(numbers: NumberTable, columns: Sequence[ColumnGuess], hints: InterpretationOverrides,
                titles: Sequence[KindHint]) -> KindGuess:
    """Return the kind of test of a table of moduli: stated, by its letter G or E, or by words for a shear test."""
    if hints.kind is not None:
        return KindGuess(hints.kind, "stated", is_stated=True)
    texts = [*make_hints_from_text_above_and_sheet_name(numbers), *titles]
    headers = [_normalize(numbers.get_column_header(place)) for place in numbers.columns]
    letters = {match[1] for column in columns if column.channel != "frequency"
               and (match := _LETTER.search(_normalize(column.header)))}
    words = _normalize(" ".join([*(text.text for text in texts), *headers]))
    shear = letters == {"g"} or (not letters and _SHEAR.search(words))
    named = [each for each in find_named_tests(texts) if each.kind is not None
             and KINDS[each.kind].closed_form is not None]
    fitting = [each for each in named
               if not letters or (KINDS[each.kind or ""].require_closed_form().rest == 0.0) == bool(shear)]
    if fitting:
        return KindGuess(fitting[0].kind, f"{fitting[0].word!r} {fitting[0].where}")
    if shear:
        return KindGuess("simple_shear", "G is the modulus of a shear test" if letters else "words of a shear test")
    if letters == {"e"}:
        return KindGuess("uniaxial_tension", "E is the modulus of tension and compression, which are equal without "
                         "pre-strain")
    return KindGuess(None, "the file does not state whether the moduli are those of shear or of tension")


def has_moduli(reading: TableGroup) -> bool:
    """Return whether a reading is a table of moduli, which has no motion."""
    return "frequency" in reading.recordings[0]
