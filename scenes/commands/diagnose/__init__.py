"""`tissue-sim diagnose CAMPAIGN.toml ...`: find physical effects in the measurements that the model lacks."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.campaigns import add_worker_figure_overwrite_json_flags, progress_and_resume_hint_context
from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.parsing import InputErrorArgumentParser

SUMMARY = "find where simulation and measurement disagree, and name the physical effect that the model lacks"
EXAMPLE = "tissue-sim diagnose campaign.toml -o diagnosis --workers 2"


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim diagnose`."""
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml",
                        help='campaign files with method = "inverse_fem"')
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder for the diagnosis and the report; a folder of the same diagnosis is resumed")
    parser.add_argument("--law", help="material law of the model, one of the laws of the campaign (default: its first "
                        "law)")
    add_worker_figure_overwrite_json_flags(parser, "the starts, the effects and their fits")
    parser.set_defaults(run=run)


def run(arguments) -> int:
    """Diagnose the campaigns and print the verdicts; `ExitCode.DONE` for every verdict, "unknown" included."""
    from calibration import Workers, diagnose

    with progress_and_resume_hint_context(arguments, "diagnosis.json") as progress:
        results = diagnose(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                           progress=progress.show_task, announce=progress.print_above_display,
                           figures_format=arguments.figures_format, law=arguments.law,
                           workers=Workers(arguments.workers, arguments.dask))
    if arguments.json:
        from calibration import diagnosis_to_json

        print_json(diagnosis_to_json(results))
    else:
        from scenes.commands.diagnose.results import print_diagnoses

        print_diagnoses(results, make_results_console())
    return ExitCode.DONE
