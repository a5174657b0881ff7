"""Tables of reports on the console."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from calibration.report.content import Table, get_terminal_text
from scenes.commands.shared.text_table import make_table_with_headings

if TYPE_CHECKING:
    from rich.table import Table as PrintedTable


def make_printed_table(table: Table, *, text: int = 1) -> PrintedTable:
    """Return a table of a report as a table of the library rich; the best row is bold.

    Args:
        table: table; columns without a heading for the terminal are omitted.
        text: number of left-aligned columns at the left; columns of text are left-aligned too.
    """
    return make_printed_table_of_groups([("", table)], text=text)


def make_printed_table_of_groups(groups: Sequence[tuple[str, Table]], *, text: int = 1) -> PrintedTable:
    """Return tables with equal columns as one printed table.

    Args:
        groups: name and table of each group, at least one. A group with a name begins with a row that contains the
            name, and its other rows are indented.
        text: see `make_printed_table`.
    """
    from rich.text import Text

    shown = [(name, table.select_terminal_columns()) for name, table in groups]
    columns = shown[0][1].columns
    printed = make_table_with_headings(*(str(column.terminal) for column in columns), text=text)
    for column, style in zip(columns, printed.columns, strict=True):
        if column.text:
            style.justify, style.no_wrap = "left", False
    for name, table in shown:
        if name:
            printed.add_row(name)
        for i, row in enumerate(table.rows):
            first, *others = map(get_terminal_text, row)
            printed.add_row(Text(f"{'  ' if name else ''}{first}"), *map(Text, others),
                            style="bold" if i == table.best_row else None)
    return printed
