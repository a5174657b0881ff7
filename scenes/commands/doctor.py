"""`tissue-sim doctor`: check whether this computer meets the requirements of the program."""

from __future__ import annotations

from argparse import Namespace
from typing import TYPE_CHECKING

from scenes.commands.shared.command import Command, CommandResult, ExitCode
from scenes.commands.shared.console import make_results_console
from scenes.commands.shared.parsing import InputErrorArgumentParser, parse_positive_number

if TYPE_CHECKING:
    from rich.console import Console

#: Status of a check -> colour on a terminal.
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def _add_clock_flag(parser: InputErrorArgumentParser) -> None:
    """Add the flag of the clock measurement."""
    parser.add_argument("--clock-seconds", type=parse_positive_number, metavar="N", default=2.0,
                        help="duration of the clock measurement (default: 2)")


def _run(arguments: Namespace) -> CommandResult:
    """Print each check with its remedy; `ExitCode.GOAL_MISSED` if a check failed."""
    from scenes.doctor import run_checks

    checks = []
    console = make_results_console(quiet=arguments.json)
    for check in run_checks(clock_seconds=arguments.clock_seconds):
        checks.append(check)
        console.print(f"[{_COLOURS[check.status]}]{check.status:<4}[/]", end="  ")
        console.print(f"{check.name}: {check.finding}", markup=False, soft_wrap=True)
        if check.remedy:
            console.print(f"      {check.remedy}", markup=False, soft_wrap=True)
    failed = [check.name for check in checks if check.status == "fail"]

    def print_failed_checks(console: Console) -> None:
        """Print the names of the failed checks, if any."""
        if failed:
            console.print(f"\nfailed checks: {', '.join(failed)}", markup=False)

    return CommandResult(lambda: {"ok": not failed, "checks": [check.make_json_object() for check in checks]},
                         print_failed_checks, ExitCode.GOAL_MISSED if failed else ExitCode.DONE)


COMMAND = Command("doctor", "check this computer: Python, Taichi, packages, real-time behaviour, caches and ports",
                  "tissue-sim doctor", _run, needs=(_add_clock_flag,))
