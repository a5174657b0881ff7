"""`tissue-sim diagnose CAMPAIGN.toml ...`: find physical effects in the measurements that the model lacks."""

from __future__ import annotations

from argparse import Namespace
from typing import TYPE_CHECKING

from scenes.commands.shared.campaigns import (
    make_campaign_command,
    make_workers_from_flags,
    progress_and_resume_hint_context,
)
from scenes.commands.shared.command import CommandResult
from scenes.commands.shared.parsing import InputErrorArgumentParser

if TYPE_CHECKING:
    from rich.console import Console


def _add_law_flag(parser: InputErrorArgumentParser) -> None:
    """Add ``--law``, the material law of the model."""
    parser.add_argument("--law", help="material law of the model, one of the laws of the campaign (default: its first "
                        "law)")


def _run(arguments: Namespace) -> CommandResult:
    """Diagnose the campaigns; `ExitCode.DONE` for every verdict, "unknown" included."""
    from calibration import diagnose, diagnosis_to_json

    with progress_and_resume_hint_context(arguments, "diagnosis.json") as progress:
        results = diagnose(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                           progress=progress.show_task, announce=progress.print_above_display,
                           figures_format=arguments.figures_format, law=arguments.law,
                           workers=make_workers_from_flags(arguments))

    def print_text(console: Console) -> None:
        """Print the verdicts with their evidence."""
        from scenes.commands.shared.campaign_results import print_diagnoses

        print_diagnoses(results, console)

    return CommandResult(lambda: diagnosis_to_json(results), print_text)


COMMAND = make_campaign_command(
    "diagnose", "find where simulation and measurement disagree, and name the physical effect that the model lacks",
    "tissue-sim diagnose campaign.toml -o diagnosis --workers 2", _run,
    files='campaign files with method = "inverse_fem"',
    output="folder for the diagnosis and the report; a folder of the same diagnosis is resumed",
    tasks="the starts, the effects and their fits", own_needs=(_add_law_flag,))
