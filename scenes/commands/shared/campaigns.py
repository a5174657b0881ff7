"""Flags of the commands that work on campaigns, and the state that an interrupted command leaves in its folder."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from scenes.commands.shared.parsing import Parser, make_integer_type


def add_workers(parser: Parser, tasks: str) -> None:
    """Add ``--workers`` and ``--dask``.

    Args:
        parser: parser of the command.
        tasks: tasks that the processes share, in words for the help.
    """
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--workers", type=make_integer_type(1), default=1, metavar="N",
                       help=f"number of processes that share {tasks} (default: 1)")
    group.add_argument("--dask", metavar="ADDRESS",
                       help="share the tasks on a running dask cluster: tcp://HOST:PORT, or its scheduler file")


def add_figures_format(parser: Parser) -> None:
    """Add ``--figures-format``."""
    parser.add_argument("--figures-format", choices=("svg", "pdf", "png"),
                        help="also write each figure of the report as a file of this format")


def read_folder_stamp(output: Path) -> tuple[int, int] | None:
    """Identify the calibration or diagnosis to which a result folder belongs.

    Returns:
        Modification time, ns, and inode of ``work.json`` in the folder; None without this file. Two equal results mean
        that no other calibration or diagnosis has taken the folder over.
    """
    try:
        file = (output / "work.json").stat()
    except OSError:
        return None
    return file.st_mtime_ns, file.st_ino


def describe_resumption(arguments: Namespace, last_file: str) -> str:
    """Describe the results that an interrupted command has kept, and how to resume it.

    Args:
        arguments: parsed arguments with ``campaigns``, ``output``, ``overwrite`` and the default ``resume_hint``.
        last_file: name of the file that a finished campaign has in its folder.
    """
    folders = [arguments.output]
    if len(arguments.campaigns) > 1:
        folders = [arguments.output / path.stem for path in arguments.campaigns]
    finished = [folder for folder in folders if (folder / last_file).is_file()]
    kept = ["finished campaigns are kept"] if finished else []
    for folder in folders:
        count = 0 if folder in finished else len(list(folder.glob("solves/*.msgpack")))
        if count:
            kept.append(f"{count} simulation{'s' if count > 1 else ''} {'are' if count > 1 else 'is'} kept in "
                        f"{folder / 'solves'}")
    if not kept:
        return arguments.resume_hint
    without = " without --overwrite" if arguments.overwrite else ""
    return f"{', '.join(kept)}. Run the same command{without} to resume"
