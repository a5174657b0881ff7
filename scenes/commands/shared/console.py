"""Where the commands print: results on stdout, progress on stderr, JSON alone."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

#: Columns of a table that goes to a file or a pipe, where there is no terminal to ask.
PIPE_WIDTH = 132


def print_json(content: dict[str, Any]) -> None:
    """One JSON object on stdout; refuses NaN and infinity, which JSON does not have."""
    print(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False, default=_plain))


def _plain(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no place in JSON")


def results_console(*, quiet: bool = False) -> Console:
    """Console of the results: stdout, or nowhere when `quiet` (``--json``)."""
    from rich.console import Console

    class ResultsConsole(Console):
        """rich ends the process with code 1 when the reader of a pipe has left; `scenes.cli` knows better."""

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    width = None if sys.stdout.isatty() else PIPE_WIDTH
    return ResultsConsole(quiet=quiet, width=width, highlight=False, soft_wrap=False)


def progress_console(*, quiet: bool = False) -> Console:
    """Console of progress: stderr, silent when `quiet` or where stderr is no terminal."""
    from rich.console import Console

    return Console(stderr=True, quiet=quiet or not sys.stderr.isatty(), highlight=False)
