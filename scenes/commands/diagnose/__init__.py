"""`tissue-sim diagnose CAMPAIGN.toml ...`: find physical effects in the measurements that the model lacks."""

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

SUMMARY = "find where simulation and measurement disagree, and name the physical effect that the model lacks"
EXAMPLE = "tissue-sim diagnose campaign.toml -o diagnosis --workers 2"


def add_arguments(parser: Parser) -> None:
    """Declare the arguments of `tissue-sim diagnose`."""
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml",
                        help='campaign files with method = "inverse_fem"')
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder for the diagnosis and the report; a folder of the same diagnosis is resumed")
    parser.add_argument("--law", help="material law of the model, one of the laws of the campaign (default: its first "
                                      "law)")
    add_workers(parser, "the starts, the effects and their fits")
    add_figures_format(parser)
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="no campaign was finished. Run the same command to start again")


def run(arguments) -> int:
    """Diagnose the campaigns and print the verdicts; `ExitCode.DONE` for every verdict, "unknown" included."""
    from calibration import Workers, diagnose
    from scenes.commands.shared.progress import CampaignProgress

    stamp = read_folder_stamp(arguments.output)
    try:
        with CampaignProgress(progress_console(quiet=arguments.json), len(arguments.campaigns),
                              LogLines(quiet=arguments.json)) as progress:
            results = diagnose(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                               progress=progress.show_task, announce=progress.print_above,
                               figures_format=arguments.figures_format, law=arguments.law,
                               workers=Workers(arguments.workers, arguments.dask))
    except KeyboardInterrupt:
        if not arguments.overwrite or read_folder_stamp(arguments.output) != stamp:
            arguments.resume_hint = describe_resumption(arguments, "diagnosis.json")
        raise
    if arguments.json:
        from calibration import diagnosis_to_json

        print_json(diagnosis_to_json(results))
    else:
        from scenes.commands.diagnose.results import print_diagnoses

        print_diagnoses(results, results_console())
    return ExitCode.DONE
