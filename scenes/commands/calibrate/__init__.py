"""`tissue-sim calibrate CAMPAIGN.toml ...`: recordings in, material files and a report out."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.campaigns import add_figures_format, add_workers, claim_on, resume_hint
from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.log_lines import LogLines
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite

SUMMARY = "fit strain-energy laws to the recordings of one or more campaigns"
EXAMPLE = "tissue-sim calibrate campaign.toml -o results --workers 4"


def add_arguments(parser: Parser) -> None:
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml", help="campaign files")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder of material files, tables and the report; one that holds the same calibration is "
                             "resumed")
    add_workers(parser, "starts, profiles, laws and left-out tests of inverse fits")
    add_figures_format(parser)
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="no campaign was finished: run the same command to start again")


def run(arguments) -> int:
    from calibration import Workers, calibrate
    from scenes.commands.shared.progress import CampaignProgress

    before = claim_on(arguments.output)
    try:
        with CampaignProgress(progress_console(quiet=arguments.json), len(arguments.campaigns),
                              LogLines(quiet=arguments.json)) as progress:
            results = calibrate(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                                progress=progress.say, listen=progress.listen,
                                figures_format=arguments.figures_format,
                                workers=Workers(arguments.workers, arguments.dask))
    except KeyboardInterrupt:
        # With --overwrite, results of another calibration may still be there, untouched.
        if not arguments.overwrite or claim_on(arguments.output) != before:
            arguments.resume_hint = resume_hint(arguments, "fit.json")
        raise
    if arguments.json:
        from calibration import to_json

        print_json(to_json(results))
    else:
        from scenes.commands.calibrate.results import print_results

        print_results(results, arguments.output, results_console())
    # The goal is a material that a simulator can use: a usable fit at the top of each ranking.
    return 0 if all(result.best.status == "converged" for result in results) else 1
