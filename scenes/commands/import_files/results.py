"""Printed results of `tissue-sim import`: recordings, assumptions, warnings and missing information."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.markup import escape

from calibration.importing.assumption_table import HEADINGS, describe_unused_columns_of_each_file, make_assumption_rows
from scenes.commands.shared.text_table import TABLES, make_table_with_headings, print_sentence
from tissue_sim.units import get_display_unit_and_factor

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.importing.imported import ImportResult, ReplicateFile
    from calibration.importing.motion import RecordedMotion

#: Delimiter -> its name.
_DELIMITER_NAMES = {"\t": "tab", " ": "spaces", ",": "comma", ";": "semicolon", "|": "bar", None: ""}


def print_import_result(imported: ImportResult, console: Console) -> None:
    """Print the recordings, the assumptions, warnings, written files and missing information of an import."""
    files = make_table_with_headings("file", "format", "test", "samples", "Hz", "reaches", "contact", "cycles",
                                     "segments", text=3)
    for column in (0, 1, 2, 6, 8):
        files.columns[column].no_wrap, files.columns[column].overflow = False, "fold"
    files.columns[8].justify = "left"
    rows = [(test.name, part, number, motion) for test in imported.tests for part in test.parts
            for number, motion in enumerate(part.motions, start=1)]
    for name, part, number, motion in rows[:TABLES.max_recordings]:
        several = f" {number}" if len(part.motions) > 1 else ""
        files.add_row(part.file.name + several, _describe_file_format(part), name,
                      str(len(part.reading.recordings[number - 1])),
                      "-" if motion.rate is None else f"{motion.rate:.3g}", _format_largest_channel_value(part, motion),
                      _format_contact_displacement_interval(motion), str(motion.loading_cycle_count),
                      ", ".join(_list_segment_names_or_counts(motion)))
    console.print(files)
    if len(rows) > TABLES.max_recordings:
        print_sentence(console, f"and {len(rows) - TABLES.max_recordings} more recordings")
    console.print()
    _print_assumption_table(imported, console)
    for test in imported.tests:
        print_sentence(console, f"{test.name}: {test.kind or 'kind unknown'}; {test.reason}")
    for each in describe_unused_columns_of_each_file(imported.tests):
        print_sentence(console, f"columns not used: {each}")
    for warning in imported.warnings:
        print_sentence(console, f"note: {warning}")
    if imported.output is not None:
        console.print(f"wrote {imported.output} and {imported.picture}", markup=False, emoji=False, soft_wrap=True)
    for question in imported.questions:
        print_sentence(console, f"question: {question}")
    if imported.missing:
        remedy = "" if imported.output is None else f". Add the flags, or fill in the lines in {imported.output}"
        print_sentence(console, f"missing information: {'; '.join(imported.missing)}{remedy}")
    elif imported.problem:
        print_sentence(console, f"the campaign cannot be calibrated yet: {imported.problem}")
    elif imported.output is not None and not imported.questions:
        print_sentence(console, f"next: tissue-sim calibrate {imported.output} -o results")


def _print_assumption_table(imported: ImportResult, console: Console) -> None:
    """Print the table of the assumptions, without columns that are empty in all rows."""
    rows = [row.cell_texts for row in make_assumption_rows(imported.tests)]
    if not rows:
        return
    used = [i for i in range(len(HEADINGS)) if any(cell_texts[i] for cell_texts in rows)]
    table = make_table_with_headings(*(HEADINGS[i] for i in used), text=len(used))
    for column in table.columns:
        column.no_wrap, column.overflow = False, "fold"
    for cell_texts in rows:
        table.add_row(*(escape(cell_texts[i]) for i in used))
    console.print(table)
    console.print()


def _describe_file_format(part: ReplicateFile) -> str:
    """Return format, delimiter, number style and encoding of a file, such as ``bluehill, comma``."""
    understood = part.understanding
    mark = _DELIMITER_NAMES.get(understood.delimiter, str(understood.delimiter))
    comma = "decimal comma" if understood.decimal_mark == "," else ""
    encoding = understood.encoding if understood.encoding not in (None, "utf-8") else ""
    thousands = "thousands separator" if any(each.subject == "thousands separator"
                                             for each in understood.assumptions) else ""
    return ", ".join(filter(None, (understood.format, mark, comma, thousands, encoding)))


def _format_largest_channel_value(part: ReplicateFile, motion: RecordedMotion) -> str:
    """Return the largest displacement, stretch or shear strain of a motion in its display unit.

    A question mark follows a value whose unit is unknown.
    """
    if any(column.missing_information_text_or_none for column in part.reading.columns
           if column.channel == motion.channel):
        return f"{max(motion.reach, key=abs):.4g} ?"
    unit, factor = get_display_unit_and_factor("m") if motion.channel == "displacement" else ("", 1.0)
    return f"{max(motion.reach, key=abs) * factor:.4g} {unit}".strip()


def _format_contact_displacement_interval(motion: RecordedMotion) -> str:
    """Return the displacement of the first contact, as in the file, with its 95 % interval."""
    contact = motion.contact
    if contact is None or contact.status == "none":
        return "-"
    if not motion.starts_in_air_or_none_if_unclear:
        return "?" if motion.starts_in_air_or_none_if_unclear is None else "no air"
    factor, unit = (1e3, " mm") if motion.channel == "displacement" else (1.0, "")
    low, high = (factor * end for end in contact.interval)
    return f"{factor * contact.displacement:.3g} ({low:.3g} to {high:.3g}){unit}"


def _list_segment_names_or_counts(motion: RecordedMotion) -> list[str]:
    """Return the names of the segments; of more than four segments the number of each, such as ``8 ramp``."""
    names = [segment.name for segment in motion.segments]
    if len(names) <= 4:
        return names
    return [f"{names.count(name)} {name}" for name in dict.fromkeys(names)]
