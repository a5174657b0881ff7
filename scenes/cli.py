"""The `tissue-sim` command.

Exit codes: 0 done, 1 ran but did not reach its goal, 2 bad input, 130 stopped with Ctrl-C. An error is one sentence
on stderr; stdout carries results only.
"""

from __future__ import annotations

import os
import sys
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
from scenes.commands.shared.parsing import Parser, later_answer
from tissue_sim import __version__
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError, nearest, sentence

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
DONE, GOAL_MISSED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Args:
        argv: words after ``tissue-sim``; those of the process by default.
    """
    _speak_utf8()
    words = list(sys.argv[1:] if argv is None else argv)
    arguments = None
    try:
        arguments = _parse(words)
        code = DONE if arguments is None else arguments.run(arguments)
        sys.stdout.flush()  # here, where a reader that has left is noticed, and not at exit
        return code
    except InputError as error:
        return _fail(str(error), BAD_INPUT)
    except (ConvergenceError, MissingBackendError, WorkerError) as error:
        return _fail(str(error), GOAL_MISSED)
    except BrokenPipeError:
        # The reader of a pipe (head, less) has left: not an error. What is still buffered goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error), BAD_INPUT)
    except KeyboardInterrupt:
        return _fail(f"stopped by Ctrl-C; {getattr(arguments, 'resume_hint', 'nothing was written')}", INTERRUPTED)


def _parse(words: list[str]):
    """Parsed arguments, or None where argparse has printed the help or the version."""
    _refuse_unknown_names(words)
    parser = make_parser()
    if not words:
        parser.print_help()
        return None
    try:
        arguments, rest = parser.parse_known_args(words)
    except SystemExit:  # --help and --version; errors are raised as InputError
        return None
    if rest:
        options = list(arguments.parser.option_names())
        hint = nearest(rest[0].split("=")[0], options) if rest[0].startswith("-") else ""
        raise InputError(f"{arguments.parser.prog.removeprefix('tissue-sim ')}: unexpected {rest[0]!r}{hint}")
    return arguments


def make_parser() -> Parser:
    """The parser of all commands. Imports nothing heavy: help must answer at once."""
    parser = Parser(prog="tissue-sim",
                    description="Soft-tissue finite elements, calibrated from measured force curves.",
                    epilog="start with:  tissue-sim demo")
    parser.add_argument("--version", action="version", version=f"tissue-sim {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        command.add_arguments(commands.add_parser(name, help=command.SUMMARY, description=command.SUMMARY,
                                                  epilog=f"example:\n  {command.EXAMPLE}"))
    return parser


def _refuse_unknown_names(words: list[str]) -> None:
    """Answer a mistyped command, or one of a later version, better than argparse does."""
    if not words or words[0].startswith("-"):
        return
    name = words[0]
    if name not in COMMANDS:
        raise InputError(f"unknown command {name!r}{nearest(name, COMMANDS)}")
    actions = getattr(COMMANDS[name], "ACTIONS", ())
    if actions and len(words) > 1 and not words[1].startswith("-"):
        if words[1] in COMMANDS[name].LATER:
            raise InputError(later_answer(f"command {f'{name} {words[1]}'!r}"))
        if words[1] not in actions:
            raise InputError(f"unknown command {f'{name} {words[1]}'!r}{nearest(words[1], actions)}")


def _speak_utf8() -> None:
    # A redirected stream on Windows has the code page's encoding, which has no lambda or plus-minus sign.
    # And names of files may hold bytes that no encoding has.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")


def _fail(text: str, code: int) -> int:
    print(f"tissue-sim: {sentence(text)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
