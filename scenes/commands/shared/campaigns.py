"""Flags of the commands that work on campaigns, and the state that an interrupted command leaves in its folder."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.command import Command, CommandResult, Need
from scenes.commands.shared.console import TaskLogLines, make_progress_console
from scenes.commands.shared.parsing import InputErrorArgumentParser, add_overwrite_flag, make_integer_parser

if TYPE_CHECKING:
    from calibration import Workers
    from scenes.commands.shared.progress import CampaignProgressDisplay


def make_campaign_command(name: str, summary: str, example: str, run: Callable[[Namespace], CommandResult], *,
                          files: str, output: str, tasks: str, own_needs: tuple[Need, ...] = ()) -> Command:
    """Return a command that writes the results of campaigns to a folder; worker processes share its tasks.

    Its needs are campaigns, output folder, `own_needs`, workers, figure files and ``--overwrite``.

    Args:
        name: name of the command.
        summary: sentence for the help.
        example: command line for the help.
        run: function that runs the command.
        files: description of the campaign files for the help.
        output: description of the output folder for the help.
        tasks: tasks that the workers share, in words for the help.
        own_needs: functions that add the flags of this command alone.
    """
    def add_campaigns_and_output_flag(parser: InputErrorArgumentParser) -> None:
        """Add the campaign files and the folder of their results."""
        parser.add_argument("campaigns", type=Path, nargs="+", metavar="CAMPAIGN.toml", help=files)
        parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help=output)

    return Command(name, summary, example, run,
                   needs=(add_campaigns_and_output_flag, *own_needs, partial(add_workers_and_dask_flags, tasks=tasks),
                          add_optional_figure_files_flag, add_overwrite_flag),
                   resume_hint="no campaign was finished. Run the same command to start again")


@contextmanager
def progress_and_resume_hint_context(arguments: Namespace, last_file: str) -> Iterator[CampaignProgressDisplay]:
    """Show the progress of campaigns, and on Ctrl-C set ``arguments.resume_hint`` to the results that are kept.

    Args:
        arguments: parsed arguments with ``campaigns``, ``output``, ``overwrite``, ``json`` and ``resume_hint``.
        last_file: name of the file that a finished campaign has in its folder.
    """
    stamp = get_work_file_time_and_inode_or_none(arguments.output)
    try:
        with make_campaign_progress_display(len(arguments.campaigns), quiet=arguments.json) as progress:
            yield progress
    except KeyboardInterrupt:
        # Until the run writes its stamp, --overwrite leaves the results of another run in the folder.
        if arguments.output is not None and (
                not arguments.overwrite or get_work_file_time_and_inode_or_none(arguments.output) != stamp):
            arguments.resume_hint = describe_kept_results_and_resuming(arguments, last_file)
        raise


def make_campaign_progress_display(campaigns: int = 1, *, quiet: bool) -> CampaignProgressDisplay:
    """Return a display of the progress of campaigns on stderr: live on a terminal, otherwise as log lines.

    Args:
        campaigns: number of campaigns.
        quiet: show nothing (``--json``).
    """
    from scenes.commands.shared.progress import CampaignProgressDisplay

    return CampaignProgressDisplay(make_progress_console(quiet=quiet), campaigns, TaskLogLines(quiet=quiet))


def add_workers_and_dask_flags(parser: InputErrorArgumentParser, tasks: str) -> None:
    """Add ``--workers`` (number of processes, default 1) and ``--dask`` (cluster), which exclude each other.

    Args:
        parser: parser of the command.
        tasks: tasks that the processes share, in words for the help.
    """
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--workers", type=make_integer_parser(1), default=1, metavar="N",
                       help=f"number of processes that share {tasks} (default: 1)")
    group.add_argument("--dask", metavar="ADDRESS",
                       help="share the tasks on a running dask cluster: tcp://HOST:PORT, or its scheduler file")


def make_workers_from_flags(arguments: Namespace) -> Workers:
    """Return the workers of ``--workers`` and ``--dask``."""
    from calibration import Workers

    return Workers(arguments.workers, arguments.dask)


def add_optional_figure_files_flag(parser: InputErrorArgumentParser) -> None:
    """Add ``--figures-format``; without this flag the figures are drawn in the report only."""
    parser.add_argument("--figures-format", choices=("svg", "pdf", "png"),
                        help="also write each figure of the report as a file of this format")


def get_work_file_time_and_inode_or_none(output: Path | None) -> tuple[int, int] | None:
    """Identify the calibration, diagnosis or design to which a result folder belongs.

    Returns:
        Modification time, ns, and inode of ``work.json`` in the folder; None without this file or without a folder. Two
        equal results mean that no other calibration, diagnosis or design has taken the folder over.
    """
    if output is None:
        return None
    try:
        file = (output / "work.json").stat()
    except OSError:
        return None
    return file.st_mtime_ns, file.st_ino


def describe_kept_results_and_resuming(arguments: Namespace, last_file: str) -> str:
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
