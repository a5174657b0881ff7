"""`tissue-sim doctor`: check whether this computer meets the requirements of the program."""

from __future__ import annotations

from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.parsing import InputErrorArgumentParser, add_json_flag, parse_positive_number

SUMMARY = "check this computer: Python, Taichi, packages, real-time behaviour, caches and ports"
EXAMPLE = "tissue-sim doctor"
#: Status of a check -> colour on a terminal.
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim doctor`."""
    parser.add_argument("--clock-seconds", type=parse_positive_number, metavar="N", default=2.0,
                        help="duration of the clock measurement (default: 2)")
    add_json_flag(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
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
    if arguments.json:
        print_json({"ok": not failed, "checks": [check.make_json_object() for check in checks]})
    elif failed:
        console.print(f"\nfailed checks: {', '.join(failed)}", markup=False)
    return ExitCode.GOAL_MISSED if failed else ExitCode.DONE
