"""Progress without a terminal: at most one line per minute on stderr, for a log file."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from scenes.commands.shared.console import make_progress_console

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
