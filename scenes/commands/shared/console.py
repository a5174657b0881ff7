"""Output of the commands: results and JSON on stdout, progress on stderr, tables and sentences.

Without a terminal, progress is at most one line per minute, for a log file.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

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


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON object on stdout.

    Raises:
        ValueError: NaN or infinity, which JSON does not represent.
        TypeError: a value of a type without a JSON form. Paths are printed as strings.
    """
    print(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False, default=_convert_path_for_json))


def _convert_path_for_json(value: Any) -> str:
    """Convert a path to a string for JSON; raise TypeError for a value of any other type."""
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"value must be a JSON type or a path; got {value!r}. Convert it before printing.")


def make_results_console(*, quiet: bool = False) -> Console:
    """Return a console that prints results on stdout, or prints nothing if `quiet` (``--json``)."""
    from rich.console import Console

    class ConsoleRaisingBrokenPipe(Console):
        """Console that passes a closed pipe on to `scenes.cli`; rich itself would end the process with code 1."""

        def on_broken_pipe(self) -> None:
            """Raise BrokenPipeError, which `scenes.cli` handles."""
            raise BrokenPipeError

    width = None if sys.stdout.isatty() else TABLES.pipe_width
    return ConsoleRaisingBrokenPipe(quiet=quiet, width=width, highlight=False, soft_wrap=False)


def make_progress_console(*, quiet: bool = False) -> Console:
    """Return a console that shows progress on stderr, or nothing if `quiet` or if stderr is not a terminal."""
    from rich.console import Console

    return Console(stderr=True, quiet=quiet or not sys.stderr.isatty(), highlight=False)


#: Least time before the first line and between two lines, s. A shorter command prints none.
MIN_INTERVAL = 60.0


class TaskDisplay(Protocol):
    """Display of the current task of a command."""

    def update(self, sentence: str) -> None:
        """Replace the displayed sentence."""


class TaskLogLines:
    """`TaskDisplay` that prints at most one line per `MIN_INTERVAL` on stderr.

    Args:
        quiet: print nothing (``--json``).
    """

    def __init__(self, *, quiet: bool = False):
        self._quiet = quiet
        self._start = self._last = time.monotonic()

    def update(self, sentence: str) -> None:
        """Print the elapsed time and the sentence, unless a line was printed within the last `MIN_INTERVAL`."""
        now = time.monotonic()
        if self._quiet or now - self._last < MIN_INTERVAL:
            return
        self._last = now
        print(f"{format_minutes_and_seconds(round(now - self._start))} {sentence}", file=sys.stderr, flush=True)


@contextmanager
def display_task(sentence: str, *, quiet: bool) -> Iterator[TaskDisplay]:
    """Show the current task on the progress console or, without a terminal, as log lines.

    Args:
        sentence: first task.
        quiet: show nothing (``--json``).

    Yields:
        Display whose `update` replaces the sentence.
    """
    console = make_progress_console(quiet=quiet)
    if console.quiet:
        yield TaskLogLines(quiet=quiet)
        return
    with console.status(sentence) as status:
        yield status


def format_minutes_and_seconds(seconds: int) -> str:
    """Format a duration, s, as minutes and seconds, such as ``1:05``."""
    return f"{seconds // 60}:{seconds % 60:02d}"
