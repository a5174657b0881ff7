"""Entry point of the command line program `tissue-sim`.

Results go to stdout. An error is one sentence on stderr. `ExitCode` lists the exit codes.
"""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from collections.abc import Iterable, Sequence

from scenes.commands import COMMANDS, Command, ExitCode
from scenes.commands.shared.parsing import InputErrorArgumentParser
from tissue_sim import __version__
from tissue_sim.errors import (
    ConvergenceError,
    InputError,
    MissingBackendError,
    WorkerError,
    join_location_and_problem,
    make_hint_with_similar_or_known_words,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code, a value of `ExitCode`.

    Args:
        argv: arguments after ``tissue-sim``; None: ``sys.argv[1:]``.
    """
    _set_utf8_output()
    words = list(sys.argv[1:] if argv is None else argv)
    arguments = None
    try:
        arguments = _parse_command_line_or_none(words)
        code = ExitCode.DONE if arguments is None else arguments.command.run_and_print_result(arguments)
        sys.stdout.flush()  # raises BrokenPipeError inside this block instead of at exit
        return code
    except InputError as error:
        return _print_error_and_return_code(str(error), ExitCode.BAD_INPUT)
    except (ConvergenceError, MissingBackendError, WorkerError) as error:
        return _print_error_and_return_code(str(error), ExitCode.GOAL_MISSED)
    except BrokenPipeError:
        # A program such as head closed the pipe early, which is no error. The buffered rest goes to the null device,
        # so that the interpreter does not fail when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.DONE
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        return _print_error_and_return_code(text, ExitCode.BAD_INPUT)
    except KeyboardInterrupt:
        hint = getattr(arguments, "resume_hint", "nothing was written")
        return _print_error_and_return_code(f"stopped by Ctrl-C; {hint}", ExitCode.INTERRUPTED)


def _parse_command_line_or_none(words: list[str]) -> Namespace | None:
    """Parse the arguments; return None after argparse printed the help or the version.

    Raises:
        InputError: unknown command, action or option, or a bad value.
    """
    _require_known_command_and_action(words)
    # A command is parsed without the import of other commands, and the help of the program shows summaries only.
    parser = make_command_line_parser(words[:1] if words and words[0] in COMMANDS else None,
                                      with_arguments=not all(word.startswith("-") for word in words))
    if not words:
        parser.print_help()
        return None
    try:
        arguments, rest = parser.parse_known_args(words)
    except SystemExit:  # argparse exits after --help and --version; its errors are raised as InputError
        return None
    if rest:
        options = list(arguments.parser.list_option_names())
        hint = make_hint_with_similar_or_known_words(rest[0].split("=")[0], options) if rest[0].startswith("-") else ""
        command = arguments.parser.prog.removeprefix("tissue-sim ")
        raise InputError(f"{command}: unexpected argument {rest[0]!r}{hint}")
    return arguments


def make_command_line_parser(names: Iterable[str] | None = None, *,
                             with_arguments: bool = True) -> InputErrorArgumentParser:
    """Return the parser of commands; it imports no numerical package, so that ``--help`` answers at once.

    Args:
        names: names of the commands; None: all.
        with_arguments: whether the parser accepts arguments of the commands, besides its own options.
    """
    parser = InputErrorArgumentParser(prog="tissue-sim",
                                      description="Calibrate soft-tissue finite-element models from measured force "
                                      "curves, and simulate tests with them, also in real time.",
                                      epilog="first steps:\n  tissue-sim doctor\n  tissue-sim demo\n\n"
                                      "tissue-sim COMMAND --help explains a command")
    parser.add_argument("--version", action="version", version=f"tissue-sim {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name in COMMANDS if names is None else names:
        try:
            command = _import_command(name)
        except InputError as error:
            if names is not None:
                raise
            print(f"tissue-sim: {error}", file=sys.stderr)  # the help lists the other commands
            continue
        command.add_parser(commands, with_arguments=with_arguments)
    return parser


def _import_command(name: str) -> Command:
    """Return the command of a name; raise an `InputError` for an unknown command, or one that cannot be imported."""
    try:
        return COMMANDS.find(name)
    except ImportError as error:
        raise InputError(f"the command {name!r} cannot be imported ({error}). Reinstall or remove the package that "
                         "adds it", field="tissue_sim.commands") from None


def _require_known_command_and_action(words: list[str]) -> None:
    """Raise an error for an unknown command or action; the message names the nearest one, unlike that of argparse.

    Raises:
        InputError: unknown command.
    """
    if not words or words[0].startswith("-"):
        return
    command = _import_command(words[0])
    actions = [action.name for action in command.actions]
    if actions and len(words) > 1 and not words[1].startswith("-") and words[1] not in actions:
        raise InputError(f"unknown command {' '.join(words[:2])!r}"
                         f"{make_hint_with_similar_or_known_words(words[1], actions)}")


def _set_utf8_output() -> None:
    """Set the encoding of stdout and stderr to UTF-8.

    On Windows the encoding of a redirected stream lacks characters such as the plus-minus sign. File names may contain
    bytes without a character; these are printed as escapes.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")


def _print_error_and_return_code(text: str, code: int) -> int:
    """Print an error on stderr and return `code`, the exit code of the process."""
    print(f"tissue-sim: {join_location_and_problem(text)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
