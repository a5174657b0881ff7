"""`tissue-sim design CAMPAIGN.toml`: predict the accuracy of planned experiments."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.campaigns import (
    add_optional_figure_files_flag,
    add_workers_and_dask_flags,
    make_workers_from_flags,
    progress_and_resume_hint_context,
)
from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.console import print_sentence
from scenes.commands.shared.parsing import InputErrorArgumentParser, add_overwrite_flag, make_integer_parser
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class ReplicateAndSampleDefaults:
    """Defaults and limits of the flags, as of `calibration.evaluate_planned_experiments`.

    Attributes:
        replicates: recordings of each planned test.
        samples: samples of a recording.
        min_samples: least number of samples of a recording.
    """

    replicates: int = 3
    samples: int = 500
    min_samples: int = 20


#: Defaults of the command.
FLAGS = ReplicateAndSampleDefaults()


def _add_campaign_output_replicate_and_law_flags(parser: InputErrorArgumentParser) -> None:
    """Add the campaign, the output folder, and the flags of the planned recordings and the law."""
    parser.add_argument("campaigns", type=Path, nargs=1, metavar="CAMPAIGN.toml",
                        help='campaign file with method = "inverse_fem", the expected parameters as start, and force_N '
                        'under [noise]; each test has recordings or a motion such as protocol = "ramp 10mm; '
                        'hold 60s; unload"')
    parser.add_argument("-o", dest="output", type=Path, metavar="OUT",
                        help="folder for the result and the report; a folder of the same design is resumed (default: "
                        "nothing is written)")
    parser.add_argument("--replicates", type=make_integer_parser(1), default=FLAGS.replicates, metavar="N",
                        help=f"number of recordings of each planned test (default: {FLAGS.replicates})")
    parser.add_argument("--samples", type=make_integer_parser(FLAGS.min_samples), default=FLAGS.samples, metavar="N",
                        help=f"number of samples of a recording, evenly spaced in time (default: {FLAGS.samples})")
    parser.add_argument("--law", help="material law, one of the laws of the campaign (default: its first law)")


def _run(arguments: Namespace) -> CommandResult:
    """Predict the accuracy of the planned experiments."""
    from calibration import evaluate_planned_experiments

    if arguments.output is None and (arguments.figures_format or arguments.overwrite):
        raise InputError("--figures-format and --overwrite need an output folder; add -o OUT", field="-o")
    with progress_and_resume_hint_context(arguments, "design.json") as progress:
        design = evaluate_planned_experiments(
            arguments.campaigns[0], law=arguments.law, replicates=arguments.replicates, samples=arguments.samples,
            output=arguments.output, overwrite=arguments.overwrite, figures_format=arguments.figures_format,
            progress=progress.show_task, workers=make_workers_from_flags(arguments))

    def make_json() -> dict:
        """Return the fields of the prediction as a JSON object."""
        from msgspec import to_builtins

        return to_builtins(design)

    def print_text(console: Console) -> None:
        """Print planned tests, expected errors and detectable effects: the tables of the report."""
        from calibration.report.content import Paragraph, Table, get_terminal_text
        from calibration.report.outputs import list_sections_in_page_order
        from calibration.report.section import DesignReport
        from scenes.commands.shared.campaign_results import make_printed_table

        report = DesignReport(design)
        blocks = [block for section in list_sections_in_page_order() if report.kind in section.reports
                  for block in section.iterate_blocks(report)]
        summary = next(block for block in blocks if isinstance(block, Paragraph))
        print_sentence(console, f"{design.campaign}: {get_terminal_text(summary.text)}")
        for table in blocks:
            if isinstance(table, Table):
                console.print()
                console.print(make_printed_table(table))
        if arguments.output is not None:
            console.print()
            console.print(f"report: {arguments.output / 'report.html'}", markup=False, emoji=False, soft_wrap=True)

    return CommandResult(make_json, print_text)


COMMAND = Command(
    "design", "predict, before an experiment, the errors of the material parameters and which effects are detectable",
    "tissue-sim design plan.toml -o design --replicates 3 --workers 2", _run,
    needs=(_add_campaign_output_replicate_and_law_flags,
           partial(add_workers_and_dask_flags, tasks="the evaluation of the effects"),
           add_optional_figure_files_flag, add_overwrite_flag),
    resume_hint="no result was written. Run the same command to start again")
