"""What the commands that work on campaigns in a folder share: their flags, and what a stopped call leaves."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from scenes.commands.shared.parsing import Parser, at_least


def add_workers(parser: Parser, what: str) -> None:
    """``--workers`` and ``--dask``; `what` they share, in the help."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=at_least(1), default=1, metavar="N",
                       help=f"processes that share {what} (default: this one)")
    where.add_argument("--dask", metavar="ADDRESS",
                       help="the same on a running dask cluster: tcp://HOST:PORT, or the file of its scheduler")


def add_figures_format(parser: Parser) -> None:
    parser.add_argument("--figures-format", choices=("svg", "pdf", "png"),
                        help="write each picture of the report also as a file beside it")


def claim_on(output: Path) -> tuple[int, int] | None:
    """Which file says what work a folder holds."""
    try:
        file = (output / "work.json").stat()
    except OSError:
        return None
    return file.st_mtime_ns, file.st_ino


def resume_hint(arguments: Namespace, last_file: str) -> str:
    """What an interrupted call leaves, and how to go on with it; `last_file` of a campaign says that it is finished."""
    folders = [arguments.output]
    if len(arguments.campaigns) > 1:
        folders = [arguments.output / path.stem for path in arguments.campaigns]
    finished = [folder for folder in folders if (folder / last_file).is_file()]
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
