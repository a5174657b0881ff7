"""Entry point of the command line program `tissue-sim`.

Results go to stdout. An error is one sentence on stderr. `ExitCode` lists the exit codes.
"""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from collections.abc import Sequence

from calibration.tasks.errors import WorkerError
from scenes.commands import (
    calibrate,
    demo,
    design,
    devices,
    diagnose,
    doctor,
    emulate,
    import_files,
    loop,
    material,
    record,
    reduce,
    serve,
    simulate,
    view,
)
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.parsing import InputErrorArgumentParser, describe_not_yet_available_feature
from tissue_sim import __version__
from tissue_sim.errors import (
    ConvergenceError,
    InputError,
    MissingBackendError,
    join_location_and_problem,
    make_hint_with_similar_or_known_words,
)

#: Module of each command, in the order of the help.
COMMANDS = {
    "demo": demo,
    "doctor": doctor,
    "import": import_files,
    "material": material,
    "simulate": simulate,
    "calibrate": calibrate,
    "diagnose": diagnose,
    "design": design,
    "loop": loop,
    "serve": serve,
    "view": view,
    "reduce": reduce,
    "record": record,
    "devices": devices,
    "emulate": emulate,
}


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
        code = ExitCode.DONE if arguments is None else arguments.run(arguments)
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
    parser = make_command_line_parser()
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


def make_command_line_parser() -> InputErrorArgumentParser:
    """Return the parser of all commands.

    It imports no numerical package, so that ``--help`` answers at once.
    """
    parser = InputErrorArgumentParser(prog="tissue-sim",
                                      description="Calibrate soft-tissue finite-element models from measured force "
                                      "curves, and simulate tests with them, also in real time.",
                                      epilog="first steps:\n  tissue-sim doctor\n  tissue-sim demo\n\n"
                                      "tissue-sim COMMAND --help explains a command")
    parser.add_argument("--version", action="version", version=f"tissue-sim {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        command.add_arguments(commands.add_parser(name, help=command.SUMMARY, description=command.SUMMARY,
                                                  epilog=f"example:\n  {command.EXAMPLE}"))
    return parser


def _require_known_command_and_action(words: list[str]) -> None:
    """Raise an error for an unknown command or action; the message names the nearest one, unlike that of argparse.

    Raises:
        InputError: unknown or planned command.
    """
    if not words or words[0].startswith("-"):
        return
    name = words[0]
    if name not in COMMANDS:
        raise InputError(f"unknown command {name!r}{make_hint_with_similar_or_known_words(name, COMMANDS)}")
    actions = getattr(COMMANDS[name], "ACTIONS", ())
    if actions and len(words) > 1 and not words[1].startswith("-"):
        if words[1] in COMMANDS[name].LATER:
            raise InputError(describe_not_yet_available_feature(f"command {f'{name} {words[1]}'!r}"))
        if words[1] not in actions:
            raise InputError(
                f"unknown command {f'{name} {words[1]}'!r}{make_hint_with_similar_or_known_words(words[1], actions)}")


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
