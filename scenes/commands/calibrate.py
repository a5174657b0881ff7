"""`tissue-sim calibrate CAMPAIGN.toml ...`: recordings in, material files and a report out."""

from __future__ import annotations

from pathlib import Path

from scenes.console import print_json, progress_console, results_console
from scenes.parsing import Parser, add_json, add_overwrite

SUMMARY = "fit strain-energy laws to the recordings of one or more campaigns"
EXAMPLE = "tissue-sim calibrate campaign.toml -o results"


def add_arguments(parser: Parser) -> None:
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml", help="campaign files")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder of material files, tables and the report; resumed when it holds the same work")
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="no campaign was finished: run the same command to start again")


def run(arguments) -> int:
    from calibration import calibrate, to_json

    try:
        with progress_console(quiet=arguments.json).status("calibrating") as status:
            results = calibrate(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                                progress=status.update)
    except KeyboardInterrupt:
        if _finished(arguments):
            arguments.resume_hint = "campaigns that were finished are kept: run the same command to go on"
        raise
    if arguments.json:
        print_json(to_json(results))
    else:
        from scenes.fit_table import print_results

        print_results(to_json(results), arguments.output, results_console(),
                      read_back=[result.output for result in results if result.resumed])
    # The goal is a material that a simulator can use: a usable fit at the top of each ranking.
    return 0 if all(result.best.status == "converged" for result in results) else 1


def _finished(arguments) -> bool:
    """Whether the folder holds a finished campaign of this call."""
    folders = [arguments.output]
    if len(arguments.campaigns) > 1:
        folders = [arguments.output / path.stem for path in arguments.campaigns]
    return any((folder / "fit.json").is_file() for folder in folders)
