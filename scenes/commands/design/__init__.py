"""`tissue-sim design CAMPAIGN.toml`: predict the accuracy of planned experiments."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.campaigns import (
    add_workers_and_dask_flags,
    make_campaign_progress_display,
    make_workers_from_flags,
)
from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.parsing import InputErrorArgumentParser, make_integer_parser

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


def _add_campaign_replicate_and_law_flags(parser: InputErrorArgumentParser) -> None:
    """Add the campaign and the flags of the planned recordings and the law."""
    parser.add_argument("campaign", type=Path, metavar="CAMPAIGN.toml",
                        help='campaign file with method = "inverse_fem", the expected parameters as start, and force_N '
                        'under [noise]; each test has recordings or a motion such as protocol = "ramp 10mm; '
                        'hold 60s; unload"')
    parser.add_argument("--replicates", type=make_integer_parser(1), default=FLAGS.replicates, metavar="N",
                        help=f"number of recordings of each planned test (default: {FLAGS.replicates})")
    parser.add_argument("--samples", type=make_integer_parser(FLAGS.min_samples), default=FLAGS.samples, metavar="N",
                        help=f"number of samples of a recording, evenly spaced in time (default: {FLAGS.samples})")
    parser.add_argument("--law", help="material law, one of the laws of the campaign (default: its first law)")


def _run(arguments: Namespace) -> CommandResult:
    """Predict the accuracy of the planned experiments."""
    from calibration import evaluate_planned_experiments

    with make_campaign_progress_display(quiet=arguments.json) as progress:
        design = evaluate_planned_experiments(arguments.campaign, law=arguments.law, replicates=arguments.replicates,
                                              samples=arguments.samples, progress=progress.show_task,
                                              workers=make_workers_from_flags(arguments))

    def make_json() -> dict:
        """Return the fields of the prediction as a JSON object."""
        from msgspec import to_builtins

        return to_builtins(design)

    def print_text(console: Console) -> None:
        """Print planned tests, expected errors and detectable effects as tables."""
        from scenes.commands.design.results import print_design_tables

        print_design_tables(design, console)

    return CommandResult(make_json, print_text)


COMMAND = Command(
    "design", "predict, before an experiment, the errors of the material parameters and which effects are detectable",
    "tissue-sim design plan.toml --replicates 3 --workers 2", _run,
    needs=(_add_campaign_replicate_and_law_flags,
           partial(add_workers_and_dask_flags, tasks="the evaluation of the effects")))
