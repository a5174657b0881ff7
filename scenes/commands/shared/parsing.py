"""What the commands share in reading their arguments: one-sentence errors, numbers, files to write."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.experiment.interfaces import INTERFACES


class Parser(argparse.ArgumentParser):
    """argparse with one-sentence errors, no abbreviations, and a help that keeps the lines of its example."""

    def __init__(self, **options):
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(**options, allow_abbrev=False)
        # The innermost parser sets its defaults last, so `arguments.parser` is that of the command in use.
        self.set_defaults(parser=self)

    def error(self, message: str):
        raise InputError(f"{message}; see '{self.prog} --help'")

    def option_names(self) -> Iterable[str]:
        return (option for action in self._actions for option in action.option_strings)


def later_answer(what: str) -> str:
    """The one sentence for everything that is planned."""
    return f"{what} is not available in this version; 'tissue-sim --help' lists what is"


def add_json(parser: Parser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else")


def add_overwrite(parser: Parser) -> None:
    parser.add_argument("--overwrite", action="store_true", help="replace output that is already there")


def positive(text: str) -> float:
    """A finite number above zero."""
    value = _number(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def not_negative(text: str) -> float:
    """A finite number of zero or more."""
    value = _number(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of zero or more")
    return value


def between(lowest: float, highest: float):
    """A number above `lowest` and below `highest`."""
    def inside(text: str) -> float:
        value = _number(text)
        if not lowest < value < highest:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number between {lowest:.3g} and {highest:.3g}")
        return value
    return inside


def interface(text: str) -> str | float:
    """How a face holds the tissue: a word of `INTERFACES`, or Coulomb's coefficient of friction."""
    if text in INTERFACES:
        return text
    value = _number(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(INTERFACES)} and not a friction coefficient "
                                         "such as 0.7")
    return value


def _number(text: str) -> float:
    """A finite number, or NaN."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def at_least(lowest: int, highest: int | None = None):
    """A whole number not below `lowest`, nor above `highest` where that is given."""
    def whole(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = lowest - 1
        if value < lowest:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {lowest}")
        if highest is not None and value > highest:
            raise argparse.ArgumentTypeError(f"{text!r} is too many, give at most {highest}")
        return value
    return whole


def new_file(path: Path | None, option: str, *, overwrite: bool, suffixes: tuple[str, ...] = ()) -> None:
    """Refuse, before anything is computed, an output file that cannot or must not be written.

    Raises:
        InputError: a directory, a suffix that is not in `suffixes`, or an existing file without ``--overwrite``.
    """
    if path is None:
        return
    if path.is_dir():
        raise InputError("is a directory; give the name of a file", file=path, field=option)
    if suffixes and not path.name.lower().endswith(suffixes):
        raise InputError(f"expected a name that ends in {' or '.join(suffixes)}", file=path, field=option)
    if path.exists() and not overwrite:
        raise InputError("exists already; give another name, or --overwrite to replace it", file=path, field=option)
