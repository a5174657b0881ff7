"""Output streams of the commands: results and JSON on stdout, progress on stderr."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.commands.shared.text_table import TABLES

if TYPE_CHECKING:
    from rich.console import Console


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
