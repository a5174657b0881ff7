"""`tissue-sim diagnose CAMPAIGN.toml ...`: where simulation and measurement part, and which effect is missing."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.campaigns import add_figures_format, add_workers, claim_on, resume_hint
from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.log_lines import LogLines
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite

SUMMARY = "find where simulation and measurement disagree, and name the effect that is missing"
EXAMPLE = "tissue-sim diagnose campaign.toml -o diagnosis --workers 2"


def add_arguments(parser: Parser) -> None:
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml",
                        help='campaign files with method = "inverse_fem"')
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder of the answer and the report; one that holds the same diagnosis is resumed")
    parser.add_argument("--law", help="law of the plain model, one of the campaign's (default: its first)")
    add_workers(parser, "starts, effects and the fits with them")
    add_figures_format(parser)
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="no campaign was finished: run the same command to start again")


def run(arguments) -> int:
    from calibration import Workers, diagnose
    from scenes.commands.shared.progress import CampaignProgress

    before = claim_on(arguments.output)
    try:
        with CampaignProgress(progress_console(quiet=arguments.json), len(arguments.campaigns),
                              LogLines(quiet=arguments.json)) as progress:
            results = diagnose(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                               progress=progress.say, announce=progress.announce,
                               figures_format=arguments.figures_format, law=arguments.law,
                               workers=Workers(arguments.workers, arguments.dask))
    except KeyboardInterrupt:
        if not arguments.overwrite or claim_on(arguments.output) != before:
            arguments.resume_hint = resume_hint(arguments, "diagnosis.json")
        raise
    if arguments.json:
        from calibration import diagnosis_to_json

        print_json(diagnosis_to_json(results))
    else:
        from scenes.commands.diagnose.results import print_diagnoses

        print_diagnoses(results, results_console())
    # Every honest verdict is what was asked for, "unknown" too.
    return 0
