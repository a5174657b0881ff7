"""`tissue-sim design CAMPAIGN.toml`: what planned experiments could tell."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.campaigns import add_workers
from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.log_lines import LogLines
from scenes.commands.shared.parsing import Parser, add_json, at_least

SUMMARY = "tell, before an experiment, how well it would know a material and which effects it would show"
EXAMPLE = "tissue-sim design plan.toml --replicates 3 --workers 2"
#: Those of `calibration.design_experiments`.
REPLICATES, SAMPLES, FEWEST_SAMPLES = 3, 500, 20


def add_arguments(parser: Parser) -> None:
    parser.add_argument("campaign", type=Path, metavar="CAMPAIGN.toml",
                        help='campaign file with method = "inverse_fem", a start and force_N under [noise]; each test '
                             'has recordings, or a motion such as protocol = "ramp 10mm; hold 60s; unload"')
    parser.add_argument("--replicates", type=at_least(1), default=REPLICATES, metavar="N",
                        help=f"recordings of each planned test (default: {REPLICATES})")
    parser.add_argument("--samples", type=at_least(FEWEST_SAMPLES), default=SAMPLES, metavar="N",
                        help=f"of each of them, evenly in time (default: {SAMPLES})")
    parser.add_argument("--law", help="law of the expected material, one of the campaign's (default: its first)")
    add_workers(parser, "the effects")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    from calibration import Workers, design_experiments
    from scenes.commands.shared.progress import CampaignProgress

    with CampaignProgress(progress_console(quiet=arguments.json), lines=LogLines(quiet=arguments.json)) as progress:
        design = design_experiments(arguments.campaign, law=arguments.law, replicates=arguments.replicates,
                                    samples=arguments.samples, progress=progress.say,
                                    workers=Workers(arguments.workers, arguments.dask))
    if arguments.json:
        from msgspec import to_builtins

        print_json(to_builtins(design))
    else:
        from scenes.commands.design.results import print_design

        print_design(design, results_console())
    return 0
