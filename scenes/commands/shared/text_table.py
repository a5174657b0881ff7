"""Tables and sentences of results on the screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def text_table(*headings: str, text: int = 1) -> Table:
    """A rich table without lines; the first `text` columns hold words and stand left, the others numbers."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for i, heading in enumerate(headings):
        table.add_column(heading, no_wrap=True, justify="left" if i < text else "right")
    return table


def print_sentence(console: Console, sentence: str) -> None:
    """Print it, wrapped between words on a terminal only; brackets in it are no markup."""
    console.print(sentence, markup=False, emoji=False, soft_wrap=not console.is_terminal)
