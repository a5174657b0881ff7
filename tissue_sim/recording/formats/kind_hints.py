"""Collect texts that may name a test: headers, titles, names of sheets, columns of labels, and the name of the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.kind_words import KindHint, find_named_tests
from tissue_sim.recording.formats.sources import FileContent, NumberTable


@dataclass(frozen=True)
class KindHintSettings:
    """Limits of the search for names of tests.

    Attributes:
        title_rows: number of rows above a table that are searched.
        sheet_rows: number of rows of a sheet without numbers that are searched.
        most_labels: largest number of different labels of a column that names tests.
    """

    title_rows: int = 40
    sheet_rows: int = 60
    most_labels: int = 20


#: Settings that the functions of this module use.
_SETTINGS = KindHintSettings()


def make_hints_from_text_above_and_sheet_name(numbers: NumberTable) -> list[KindHint]:
    """Return two texts that may name the test: the text above a table, and the name of its sheet."""
    above = "\n".join(" ".join(row.cells) for row in numbers.above[-_SETTINGS.title_rows:])
    return [KindHint(above, "above the numbers"), KindHint(numbers.table.name, "in the name of the sheet")]


def make_hints_from_file_top_and_text_sheets(source: FileContent, found: Sequence[NumberTable]) -> list[KindHint]:
    """Return texts that may name the test: the top of a file without sheets, and each sheet without numbers."""
    first = found[0]
    top = "\n".join(" ".join(row.cells) for row in first.above[:_SETTINGS.title_rows])
    hints = [KindHint(top, "at the top of the file")] if not first.table.name else []
    with_numbers = {id(numbers.table) for numbers in found}
    return hints + [KindHint("\n".join(" ".join(row.cells) for row in table.rows[:_SETTINGS.sheet_rows]),
                             f"in sheet {table.name!r}")
                    for table in source.tables if id(table) not in with_numbers]


def make_header_hint_without_unregistered_tests(own: Sequence[str], others: Sequence[str]) -> KindHint:
    """Return one hint: headers of the columns that are read, and other headers that name no test without a kind.

    A header of a column that is not read is omitted if it names a test without a kind, such as a bending strain.
    """
    where = "in the headers"
    harmless = [name for name in others
                if all(each.unknown is None for each in find_named_tests([KindHint(name, where)]))]
    return KindHint(" ".join((*own, *harmless)), where)


def collect_label_hints(numbers: NumberTable) -> list[KindHint]:
    """Return the texts in the label columns of a table as hints for the kind of test.

    Raises:
        InputError: the rows are of different tests, one of which has no registered kind.
    """
    hints = []
    width = max(len(row.cells) for row in numbers.rows)
    for place in (place for place in range(width) if place not in numbers.columns):
        labels = list(dict.fromkeys(row.cells[place] for row in numbers.rows if place < len(row.cells)
                                    and row.cells[place]))
        if not 1 <= len(labels) <= _SETTINGS.most_labels:
            continue
        where = f"in column {numbers.get_column_header(place) or place + 1!r}"
        named = [find_named_tests([KindHint(label, where)]) for label in labels]
        unknown = {each.unknown.name for tests in named for each in tests if each.unknown is not None}
        if unknown and len({tuple((each.kind, each.unknown) for each in tests) for tests in named}) > 1:
            raise InputError(f"the rows are of different tests ({', '.join(labels)} {where}); write each test to a "
                             "separate file", line=numbers.rows[0].line)
        hints.append(KindHint("\n".join(labels), where))
    return hints
