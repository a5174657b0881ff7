"""`tissue-sim calibrate CAMPAIGN.toml ...`: recordings in, material files and a report out."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite, at_least

SUMMARY = "fit strain-energy laws to the recordings of one or more campaigns"
EXAMPLE = "tissue-sim calibrate campaign.toml -o results --workers 4"


def add_arguments(parser: Parser) -> None:
    parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml", help="campaign files")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="folder of material files, tables and the report; one that holds the same calibration is "
                             "resumed")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=at_least(1), default=1, metavar="N",
                       help="processes that share starts, profiles, laws and left-out tests of inverse fits (default: "
                            "this one)")
    where.add_argument("--dask", metavar="ADDRESS",
                       help="the same on a running dask cluster: tcp://HOST:PORT, or the file of its scheduler")
    parser.add_argument("--figures-format", choices=("svg", "pdf", "png"),
                        help="write each picture of the report also as a file beside it")
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="no campaign was finished: run the same command to start again")


def run(arguments) -> int:
    from calibration import Workers, calibrate
    from scenes.commands.calibrate.progress import CalibrationProgress

    before = _claim_on(arguments.output)
    try:
        with CalibrationProgress(progress_console(quiet=arguments.json), len(arguments.campaigns)) as progress:
            results = calibrate(arguments.campaigns, arguments.output, overwrite=arguments.overwrite,
                                progress=progress.say, listen=progress.listen,
                                figures_format=arguments.figures_format,
                                workers=Workers(arguments.workers, arguments.dask))
    except KeyboardInterrupt:
        # With --overwrite, results of another calibration may still be there, untouched.
        if not arguments.overwrite or _claim_on(arguments.output) != before:
            arguments.resume_hint = _resume_hint(arguments)
        raise
    if arguments.json:
        from calibration import to_json

        print_json(to_json(results))
    else:
        from scenes.commands.calibrate.results import print_results

        print_results(results, arguments.output, results_console())
    # The goal is a material that a simulator can use: a usable fit at the top of each ranking.
    return 0 if all(result.best.status == "converged" for result in results) else 1


def _claim_on(output: Path) -> tuple[int, int] | None:
    """Which file says what calibration a folder holds."""
    try:
        file = (output / "work.json").stat()
    except OSError:
        return None
    return file.st_mtime_ns, file.st_ino


def _resume_hint(arguments) -> str:
    """What an interrupted call leaves, and how to go on with it."""
    folders = [arguments.output]
    if len(arguments.campaigns) > 1:
        folders = [arguments.output / path.stem for path in arguments.campaigns]
    finished = [folder for folder in folders if (folder / "fit.json").is_file()]
    kept = ["campaigns that were finished are kept"] if finished else []
    for folder in folders:
        count = 0 if folder in finished else len(list(folder.glob("solves/*.msgpack")))
        if count:
            kept.append(f"{count} simulation{'s' if count > 1 else ''} {'are' if count > 1 else 'is'} kept in "
                        f"{folder / 'solves'}")
    if not kept:
        return arguments.resume_hint
    without = " without --overwrite" if arguments.overwrite else ""
    return f"{', '.join(kept)}: run the same command{without} to go on"
