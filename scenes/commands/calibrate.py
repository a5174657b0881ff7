"""`tissue-sim calibrate CAMPAIGN.toml ...`: fit material laws to recordings; write material files and a report."""

from __future__ import annotations

from argparse import Namespace
from typing import TYPE_CHECKING

from scenes.commands.shared.campaigns import (
    make_campaign_command,
    make_workers_from_flags,
    progress_and_resume_hint_context,
)
from scenes.commands.shared.command import CommandResult, ExitCode

if TYPE_CHECKING:
    from rich.console import Console


def _run(arguments: Namespace) -> CommandResult:
    """Calibrate the campaigns; `ExitCode.GOAL_MISSED` if a campaign has no usable fit."""
    from calibration import calibrate, to_json_dictionary

    with progress_and_resume_hint_context(arguments, "fit.json") as progress:
        results = calibrate(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                            progress=progress.show_task, listen=progress.add_fit_iteration,
                            figures_format=arguments.figures_format, workers=make_workers_from_flags(arguments))

    def print_text(console: Console) -> None:
        """Print tables and remarks of each campaign, and the written files."""
        from scenes.commands.shared.campaign_results import print_calibration_results

        print_calibration_results(results, arguments.output, console)

    has_material = all(result.best.status == "converged" for result in results)
    return CommandResult(lambda: to_json_dictionary(results), print_text,
                         ExitCode.DONE if has_material else ExitCode.GOAL_MISSED)


COMMAND = make_campaign_command(
    "calibrate", "fit strain-energy laws to the recordings of one or more campaigns",
    "tissue-sim calibrate campaign.toml -o results --workers 4", _run,
    files="campaign files; tissue-sim import writes them from recordings",
    output="folder for material files, tables and the report; a folder of the same calibration is resumed",
    tasks="the starts, profiles, laws and left-out tests of inverse fits")
