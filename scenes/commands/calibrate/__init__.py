"""`tissue-sim calibrate CAMPAIGN.toml ...`: fit material laws to recordings; write material files and a report."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.campaigns import add_worker_figure_overwrite_json_flags, progress_and_resume_hint_context
from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.parsing import InputErrorArgumentParser

SUMMARY = "fit strain-energy laws to the recordings of one or more campaigns"
EXAMPLE = "tissue-sim calibrate campaign.toml -o results --workers 4"


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim calibrate`."""
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml",
                        help="campaign files; tissue-sim import writes them from recordings")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder for material files, tables and the report; a folder of the same calibration is "
                        "resumed")
    add_worker_figure_overwrite_json_flags(parser, "the starts, profiles, laws and left-out tests of inverse fits")
    parser.set_defaults(run=run)


def run(arguments) -> int:
    """Calibrate and print the results; `ExitCode.GOAL_MISSED` if a campaign has no usable fit."""
    from calibration import Workers, calibrate

    with progress_and_resume_hint_context(arguments, "fit.json") as progress:
        results = calibrate(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                            progress=progress.show_task, listen=progress.add_fit_iteration,
                            figures_format=arguments.figures_format,
                            workers=Workers(arguments.workers, arguments.dask))
    if arguments.json:
        from calibration import to_json_dictionary

        print_json(to_json_dictionary(results))
    else:
        from scenes.commands.calibrate.results import print_calibration_results

        print_calibration_results(results, arguments.output, make_results_console())
    has_material = all(result.best.status == "converged" for result in results)
    return ExitCode.DONE if has_material else ExitCode.GOAL_MISSED
