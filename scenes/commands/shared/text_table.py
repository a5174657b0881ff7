"""Tables and sentences on the console."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


@dataclass(frozen=True)
class PrintedTableLimits:
    """Sizes of printed tables. The JSON objects and reports contain all rows.

    Attributes:
        pipe_width: width of tables that go to a file or a pipe, characters.
        max_effects: largest number of effects in the table of a diagnosis.
        max_recordings: largest number of recordings in the table of an import.
        max_curve_rows: largest number of rows of a printed curve; longer curves are thinned.
    """

    pipe_width: int = 132
    max_effects: int = 8
    max_recordings: int = 40
    max_curve_rows: int = 60


#: Sizes of all printed tables.
TABLES = PrintedTableLimits()


def make_table_with_headings(*headings: str, text: int = 1) -> Table:
    """Return an empty table of the library rich, without lines.

    Args:
        headings: heading of each column.
        text: number of text columns at the left, which are left-aligned; the other columns hold right-aligned numbers.
    """
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for i, heading in enumerate(headings):
        table.add_column(heading, no_wrap=True, justify="left" if i < text else "right")
    return table


def print_sentence(console: Console, sentence: str) -> None:
    """Print a sentence literally (brackets are no markup); on a terminal it is wrapped between words."""
    console.print(sentence, markup=False, emoji=False, soft_wrap=not console.is_terminal)
