"""Argument parser of the commands: errors as one sentence, number types, and checks of output files."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.experiment.contact_law import INTERFACES


class InputErrorArgumentParser(argparse.ArgumentParser):
    """Argument parser that raises `InputError`, accepts no abbreviations and keeps the line breaks of its epilog."""

    def __init__(self, **options):
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(**options, allow_abbrev=False)
        # The innermost parser sets its defaults last, so that `arguments.parser` is the parser of the command.
        self.set_defaults(parser=self)

    def error(self, message: str):
        """Raise the message of argparse as an `InputError`."""
        raise InputError(f"{message}; see '{self.prog} --help'")

    def list_option_names(self) -> Iterable[str]:
        """Return the names of all options, such as ``--json``."""
        return (option for action in self._actions for option in action.option_strings)


def add_json_flag(parser: InputErrorArgumentParser) -> None:
    """Add ``--json``, with which a command prints one JSON object on stdout and nothing else."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else")


def add_overwrite_flag(parser: InputErrorArgumentParser) -> None:
    """Add ``--overwrite``, without which a command refuses to replace existing output."""
    parser.add_argument("--overwrite", action="store_true", help="replace existing output")


def parse_positive_number(text: str) -> float:
    """Convert an argument to a finite number above zero."""
    value = _parse_number_or_nan(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"must be a positive number; got {text!r}")
    return value


def parse_non_negative_number(text: str) -> float:
    """Convert an argument to a finite number of zero or more."""
    value = _parse_number_or_nan(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"must be zero or a positive number; got {text!r}")
    return value


def make_open_interval_number_parser(lowest: float, highest: float):
    """Return a function for argparse's ``type`` that converts text to a number above `lowest` and below `highest`."""
    def parse_number_in_open_interval(text: str) -> float:
        """Convert text to a number above `lowest` and below `highest`."""
        value = _parse_number_or_nan(text)
        if not lowest < value < highest:
            raise argparse.ArgumentTypeError(f"must be between {lowest:.3g} and {highest:.3g}; got {text!r}")
        return value
    return parse_number_in_open_interval


def parse_contact_interface_or_friction(text: str) -> str | float:
    """Convert an argument to an interface of a face: a word of `INTERFACES` or a Coulomb friction coefficient."""
    if text in INTERFACES:
        return text
    value = _parse_number_or_nan(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"must be {', '.join(INTERFACES)} or a friction coefficient such as 0.7; got "
                                         f"{text!r}")
    return value


def _parse_number_or_nan(text: str) -> float:
    """Convert text to a finite number, or to NaN where that fails."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def make_integer_parser(lowest: int, highest: int | None = None):
    """Return a function for argparse's ``type`` that converts text to an integer from `lowest` to `highest`.

    `highest` None: no upper limit.
    """
    def parse_whole_number(text: str) -> int:
        """Convert text to an integer from `lowest` to `highest`, both included."""
        try:
            value = int(text)
        except ValueError:
            value = lowest - 1
        if value < lowest:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {lowest}; got {text!r}")
        if highest is not None and value > highest:
            raise argparse.ArgumentTypeError(f"must be at most {highest}; got {text!r}")
        return value
    return parse_whole_number


def check_output_file(path: Path | None, option: str, *, overwrite: bool, suffixes: tuple[str, ...] = ()) -> None:
    """Raise an error if an output file cannot be written as asked; commands call it before the computation.

    Args:
        path: output file; None is accepted.
        option: command line option that names the file, for the error message.
        overwrite: whether an existing file may be replaced.
        suffixes: allowed ends of the file name, in lower case; empty allows every name.

    Raises:
        InputError: the path is a directory, has another suffix, or exists and `overwrite` is False.
    """
    if path is None:
        return
    if path.is_dir():
        raise InputError("must be a file; got a directory", file=path, field=option)
    if suffixes and not path.name.lower().endswith(suffixes):
        raise InputError(f"the file name must end in {' or '.join(suffixes)}", file=path, field=option)
    if path.exists() and not overwrite:
        raise InputError("exists already. Choose another name, or replace it with --overwrite", file=path, field=option)
