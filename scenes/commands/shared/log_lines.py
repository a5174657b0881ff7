"""Progress where there is no terminal to draw it on: a line on stderr now and then, for who reads a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console

#: From the beginning to the first line, and from each to the next, s: what takes less says nothing.
EVERY = 60.0


class Status(Protocol):
    """Shows what is done."""

    def update(self, sentence: str) -> None:
        """This, from now on."""


class LogLines:
    """A `Status` of a line a minute.

    Args:
        quiet: no line at all (``--json``).
    """

    def __init__(self, *, quiet: bool = False):
        self._quiet = quiet
        self._began = self._last = time.monotonic()

    def update(self, sentence: str) -> None:
        """Print it with the time that has passed, if the last line is old enough."""
        now = time.monotonic()
        if self._quiet or now - self._last < EVERY:
            return
        self._last = now
        print(f"{clock(round(now - self._began))} {sentence}", file=sys.stderr, flush=True)


@contextmanager
def status_of(console: Console, sentence: str, *, quiet: bool) -> Iterator[Status]:
    """What is done, on the console of the progress, or as lines where that has no terminal.

    Args:
        console: see `progress_console`. quiet: neither.
    """
    if console.quiet:
        yield LogLines(quiet=quiet)
        return
    with console.status(sentence) as status:
        yield status


def clock(seconds: int) -> str:
    """``1:05``."""
    return f"{seconds // 60}:{seconds % 60:02d}"
