"""What an import understood, on the screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.markup import escape

from calibration.importing.assumption_table import HEADINGS, assumption_rows, unused_columns
from scenes.commands.shared.text_table import print_sentence, text_table
from tissue_sim.units import shown

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.importing.imported import Imported, Part
    from calibration.importing.motion import Motion

_MARKS = {"\t": "tab", " ": "blanks", ",": "comma", ";": "semicolon", "|": "bar", None: ""}
#: Recordings in a table; all are in the JSON.
_MOST_ROWS = 40


def print_imported(imported: Imported, console: Console) -> None:
    """A row for each recording, the assumptions, then what is missing and what was written."""
    files = text_table("file", "what", "test", "points", "Hz", "reaches", "contact", "cycles", "segments", text=3)
    for column in (0, 1, 2, 6, 8):
        files.columns[column].no_wrap, files.columns[column].overflow = False, "fold"
    files.columns[8].justify = "left"
    rows = [(test.name, part, number, motion) for test in imported.tests for part in test.parts
            for number, motion in enumerate(part.motions, start=1)]
    for name, part, number, motion in rows[:_MOST_ROWS]:
        several = f" {number}" if len(part.motions) > 1 else ""
        files.add_row(part.file.name + several, _what(part), name, str(len(part.reading.recordings[number - 1])),
                      "-" if motion.rate is None else f"{motion.rate:.3g}", _reach(part, motion), _contact(motion),
                      str(motion.cycles), ", ".join(_runs(motion)))
    console.print(files)
    if len(rows) > _MOST_ROWS:
        print_sentence(console, f"and {len(rows) - _MOST_ROWS} more recordings")
    console.print()
    _print_assumptions(imported, console)
    for test in imported.tests:
        print_sentence(console, f"{test.name}: {test.kind or 'kind not known'}; {test.reason}")
    for each in unused_columns(imported.tests):
        print_sentence(console, f"columns not used: {each}")
    for warning in imported.warnings:
        print_sentence(console, f"note: {warning}")
    if imported.output is not None:
        console.print(f"wrote {imported.output} and {imported.picture}", markup=False, emoji=False, soft_wrap=True)
    for question in imported.questions:
        print_sentence(console, f"question: {question}")
    if imported.missing:
        fill = "" if imported.output is None else f": give the flags, or fill in the lines in {imported.output}"
        print_sentence(console, f"missing, and only you know it: {'; '.join(imported.missing)}{fill}")
    elif imported.problem:
        print_sentence(console, f"the campaign does not run as it stands: {imported.problem}")
    elif imported.output is not None and not imported.questions:
        print_sentence(console, f"next: tissue-sim calibrate {imported.output} -o results")


def _print_assumptions(imported: Imported, console: Console) -> None:
    """One row for each assumption; columns that are empty in all rows are left out."""
    rows = [row.cells for row in assumption_rows(imported.tests)]
    if not rows:
        return
    used = [i for i in range(len(HEADINGS)) if any(cells[i] for cells in rows)]
    table = text_table(*(HEADINGS[i] for i in used), text=len(used))
    for column in table.columns:
        column.no_wrap, column.overflow = False, "fold"
    for cells in rows:
        table.add_row(*(escape(cells[i]) for i in used))
    console.print(table)
    console.print()


def _what(part: Part) -> str:
    """``bluehill, comma``."""
    understood = part.understanding
    mark = _MARKS.get(understood.delimiter, str(understood.delimiter))
    comma = "decimal comma" if understood.decimal_mark == "," else ""
    encoding = understood.encoding if understood.encoding not in (None, "utf-8") else ""
    thousands = "thousands separated" if any(each.subject == "thousands separator"
                                             for each in understood.assumptions) else ""
    return ", ".join(filter(None, (understood.format, mark, comma, thousands, encoding)))


def _reach(part: Part, motion: Motion) -> str:
    """The far end of the way, in the unit of people."""
    if any(column.missing for column in part.reading.columns if column.channel == motion.channel):
        return f"{max(motion.reach, key=abs):.4g} ?"
    unit, factor = shown("m") if motion.channel == "displacement" else ("", 1.0)
    return f"{max(motion.reach, key=abs) * factor:.4g} {unit}".strip()


def _contact(motion: Motion) -> str:
    """Where it touched, in the file's own displacement, and the 95 % interval."""
    contact = motion.contact
    if contact is None or contact.status == "none":
        return "-"
    if not motion.air:
        return "?" if motion.air is None else "no air"
    factor, unit = (1e3, " mm") if motion.channel == "displacement" else (1.0, "")
    low, high = (factor * end for end in contact.interval)
    return f"{factor * contact.displacement:.3g} ({low:.3g} to {high:.3g}){unit}"


def _runs(motion: Motion) -> list[str]:
    """Names of the segments, ``8 x`` where one comes as often."""
    names = [segment.name for segment in motion.segments]
    if len(names) <= 4:
        return names
    return [f"{names.count(name)} {name}" for name in dict.fromkeys(names)]
