"""`tissue-sim calibrate CAMPAIGN.toml ...`: fit material laws to recordings; write material files and a report."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.campaigns import (
    add_figures_format,
    add_workers,
    describe_resumption,
    read_folder_stamp,
)
from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.log_lines import LogLines
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite

SUMMARY = "fit strain-energy laws to the recordings of one or more campaigns"
EXAMPLE = "tissue-sim calibrate campaign.toml -o results --workers 4"


def add_arguments(parser: Parser) -> None:
    """Declare the arguments of `tissue-sim calibrate`."""
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml",
                        help="campaign files; tissue-sim import writes them from recordings")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder for material files, tables and the report; a folder of the same calibration is "
                             "resumed")
    add_workers(parser, "the starts, profiles, laws and left-out tests of inverse fits")
    add_figures_format(parser)
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="no campaign was finished. Run the same command to start again")


def run(arguments) -> int:
    """Calibrate and print the results; `ExitCode.GOAL_MISSED` if a campaign has no usable fit."""
    from calibration import Workers, calibrate
    from scenes.commands.shared.progress import CampaignProgress

    stamp = read_folder_stamp(arguments.output)
    try:
        with CampaignProgress(progress_console(quiet=arguments.json), len(arguments.campaigns),
                              LogLines(quiet=arguments.json)) as progress:
            results = calibrate(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                                progress=progress.show_task, listen=progress.add_iteration,
                                figures_format=arguments.figures_format,
                                workers=Workers(arguments.workers, arguments.dask))
    except KeyboardInterrupt:
        # Until the calibration writes its stamp, --overwrite leaves the results of another calibration in the folder.
        if not arguments.overwrite or read_folder_stamp(arguments.output) != stamp:
            arguments.resume_hint = describe_resumption(arguments, "fit.json")
        raise
    if arguments.json:
        from calibration import to_json

        print_json(to_json(results))
    else:
        from scenes.commands.calibrate.results import print_results

        print_results(results, arguments.output, results_console())
    has_material = all(result.best.status == "converged" for result in results)
    return ExitCode.DONE if has_material else ExitCode.GOAL_MISSED
