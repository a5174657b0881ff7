"""Declaration of a command of `tissue-sim`: its help, its needs, its function and its printed result."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.parsing import InputErrorArgumentParser, add_json_flag

if TYPE_CHECKING:
    from rich.console import Console

#: Function that adds the flags of one input, such as material, experiment or output folder, to the parser of a command.
Need = Callable[[InputErrorArgumentParser], None]


class ExitCode(IntEnum):
    """Exit code of a command."""

    #: The command reached its goal.
    DONE = 0
    #: The command ran but did not reach its goal: no convergence, no usable fit, a failed check.
    GOAL_MISSED = 1
    #: The input is invalid; nothing was written.
    BAD_INPUT = 2
    #: Ctrl-C stopped the command (128 + the number of SIGINT).
    INTERRUPTED = 130


@dataclass(frozen=True)
class CommandResult:
    """Result of a command, which the command line prints.

    Attributes:
        make_json: returns the JSON object that is printed with ``--json``.
        print_text: prints the result on a console without ``--json``.
        code: exit code.
    """

    make_json: Callable[[], dict[str, Any]]
    print_text: Callable[[Console], None]
    code: ExitCode = ExitCode.DONE

    def print_as_text_or_json(self, *, json: bool) -> None:
        """Print the result on stdout."""
        if json:
            print_json(self.make_json())
        else:
            self.print_text(make_results_console())


@dataclass(frozen=True)
class Command:
    """Command of `tissue-sim`, or one action of a command such as ``material show``.

    `scenes.cli` parses the arguments, adds ``--json``, prints the result, and converts errors and Ctrl-C to one
    sentence and an exit code.

    Attributes:
        name: name on the command line.
        summary: one sentence for the help.
        example: valid command line for the help.
        run: runs the command with its parsed arguments, and returns its result; a command that prints its output while
            it runs returns its exit code. numpy and packages that need it are imported inside `run`, so that ``--help``
            answers at once.
        needs: inputs of the command, as functions that add their flags, in the order of the help: those of
            `scenes.commands.shared`, and those of this command alone.
        actions: actions of the command, which replace `run`; empty for most commands.
        resume_hint: second half of the message at Ctrl-C; `run` may replace it in its arguments.
    """

    name: str
    summary: str
    example: str
    run: Callable[[Namespace], CommandResult | int] | None = None
    needs: tuple[Need, ...] = ()
    actions: tuple[Command, ...] = ()
    resume_hint: str = "nothing was written"

    def add_arguments(self, parser: InputErrorArgumentParser) -> None:
        """Add the flags of all inputs and ``--json``, or the actions, to the parser of this command."""
        if self.actions:
            group = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
            for action in self.actions:
                action.add_parser(group)
            return
        for add_flags in self.needs:
            add_flags(parser)
        if add_json_flag not in self.needs:
            add_json_flag(parser)
        parser.set_defaults(command=self, resume_hint=self.resume_hint)

    def add_parser(self, group, *, with_arguments: bool = True) -> None:
        """Add a parser of this command, with or without its arguments, to the result of ``add_subparsers``."""
        parser = group.add_parser(self.name, help=self.summary, description=self.summary,
                                  epilog=f"example:\n  {self.example}")
        if with_arguments:
            self.add_arguments(parser)

    def run_and_print_result(self, arguments: Namespace) -> int:
        """Run the command, print its result, and return its exit code."""
        assert self.run is not None, "a command with actions is not run itself"
        result = self.run(arguments)
        if not isinstance(result, CommandResult):
            return result
        result.print_as_text_or_json(json=arguments.json)
        return result.code
