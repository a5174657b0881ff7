"""`tissue-sim design CAMPAIGN.toml`: predict the accuracy of planned experiments."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scenes.commands.shared.campaigns import add_workers_and_dask_flags
from scenes.commands.shared.console import make_progress_console, make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.log_lines import TaskLogLines
from scenes.commands.shared.parsing import InputErrorArgumentParser, add_json_flag, make_integer_parser

SUMMARY = "predict, before an experiment, the errors of the material parameters and which effects are detectable"
EXAMPLE = "tissue-sim design plan.toml --replicates 3 --workers 2"


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


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim design`."""
    parser.add_argument("campaign", type=Path, metavar="CAMPAIGN.toml",
                        help='campaign file with method = "inverse_fem", the expected parameters as start, and force_N '
                        'under [noise]; each test has recordings or a motion such as protocol = "ramp 10mm; '
                        'hold 60s; unload"')
    parser.add_argument("--replicates", type=make_integer_parser(1), default=FLAGS.replicates, metavar="N",
                        help=f"number of recordings of each planned test (default: {FLAGS.replicates})")
    parser.add_argument("--samples", type=make_integer_parser(FLAGS.min_samples), default=FLAGS.samples, metavar="N",
                        help=f"number of samples of a recording, evenly spaced in time (default: {FLAGS.samples})")
    parser.add_argument("--law", help="material law, one of the laws of the campaign (default: its first law)")
    add_workers_and_dask_flags(parser, "the evaluation of the effects")
    add_json_flag(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    """Predict and print the accuracy of the planned experiments."""
    from calibration import Workers, evaluate_planned_experiments
    from scenes.commands.shared.progress import CampaignProgressDisplay

    with CampaignProgressDisplay(make_progress_console(quiet=arguments.json),
                                 lines=TaskLogLines(quiet=arguments.json)) as progress:
        design = evaluate_planned_experiments(arguments.campaign, law=arguments.law, replicates=arguments.replicates,
                                              samples=arguments.samples, progress=progress.show_task,
                                              workers=Workers(arguments.workers, arguments.dask))
    if arguments.json:
        from msgspec import to_builtins

        print_json(to_builtins(design))
    else:
        from scenes.commands.design.results import print_design_tables

        print_design_tables(design, make_results_console())
    return ExitCode.DONE
