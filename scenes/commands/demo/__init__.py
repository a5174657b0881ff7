"""`tissue-sim demo`: measurement, calibration and prediction on a virtual specimen, also with a hidden effect."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path

from scenes.commands.shared.console import make_progress_console, make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.log_lines import TaskLogLines
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    make_integer_parser,
)
from scenes.commands.view import add_page_flags, make_page_options_dict

SUMMARY = "measure a virtual specimen, calibrate its material and predict tests that the calibration did not use"
EXAMPLE = "tissue-sim demo --hidden --view -o my-demo"
#: Default folder of the results.
FOLDER = Path("tissue-sim-demo")
#: Default folder of the results with ``--hidden``.
HIDDEN_FOLDER = Path("tissue-sim-demo-hidden")
#: Random seeds are smaller than this number, so that they are easy to type.
_MAX_SEED = 10_000


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim demo`."""
    parser.add_argument("--hidden", action="store_true",
                        help="hide a random effect (or none) in the specimen or the rig, diagnose the measurements, "
                        "then reveal the effect")
    parser.add_argument("-o", dest="output", type=Path, metavar="DIR",
                        help=f"folder of the results (default: {FOLDER} or {HIDDEN_FOLDER}, replaced by every run)")
    parser.add_argument("--seed", type=make_integer_parser(0), metavar="N",
                        help="seed of the measurement noise (default: 0); with --hidden also of the hidden effect "
                        "(default: random)")
    parser.add_argument("--view", action="store_true",
                        help="then show the calibrated indentation test and the measurements on a page in the browser; "
                        "with --hidden the models with and without the found effect")
    add_overwrite_flag(parser)
    add_page_flags(parser)
    add_json_flag(parser)
    parser.set_defaults(run=run, resume_hint="run the command again with --overwrite")


def run(arguments) -> int:
    """Run the demo, and with ``--view`` show its result."""
    # The demo replaces its default folder without a flag; a folder named by the user needs --overwrite.
    overwrite = arguments.overwrite or arguments.output is None
    if arguments.hidden:
        return _run_hidden_effect_demo(arguments, arguments.output or HIDDEN_FOLDER, overwrite)
    from scenes.demo.virtual_test import run_demo

    output = arguments.output or FOLDER
    answer = run_demo(output, overwrite=overwrite, console=make_results_console(quiet=arguments.json),
                      seed=arguments.seed or 0)
    if arguments.json:
        print_json(answer)
    if arguments.view:
        return _serve_result_page(arguments, output, Path(answer["material_file"]))
    return ExitCode.DONE


def _run_hidden_effect_demo(arguments, output: Path, overwrite: bool) -> int:
    """Run the demo with a hidden effect."""
    import random

    from calibration import Workers
    from scenes.demo.hidden_effect_demo import run_hidden_demo

    seed = random.SystemRandom().randrange(_MAX_SEED) if arguments.seed is None else arguments.seed
    answer = run_hidden_demo(output, seed=seed, overwrite=overwrite,
                             progress=_display_demo_progress(quiet=arguments.json),
                             console=make_results_console(quiet=arguments.json),
                             workers=Workers(min(2, os.cpu_count() or 1)))
    if arguments.json:
        print_json(answer.make_json_object())
    if arguments.view:
        from scenes.commands.demo.found_scene import make_found_effects_scene_with_plain_curve
        from scenes.viewer.run import run_viewer_page

        return run_viewer_page(make_found_effects_scene_with_plain_curve(answer.result, output / "measured"),
                               answer.result.output, make_page_options_dict(arguments), json=arguments.json)
    return ExitCode.DONE


@contextmanager
def _display_demo_progress(*, quiet: bool):
    """Show the progress inside the block; the display is removed before the results are printed.

    Yields:
        Function that shows the current task.
    """
    from scenes.commands.shared.progress import CampaignProgressDisplay

    with CampaignProgressDisplay(make_progress_console(quiet=quiet), lines=TaskLogLines(quiet=quiet)) as progress:
        yield progress.show_task


def _serve_result_page(arguments, output: Path, material_file: Path) -> int:
    """Serve the viewer's page with an indentation of the calibrated material and the measurements."""
    import tissue_sim as ts
    from scenes.demo.specimen import DEPTH, SPECIMEN
    from scenes.viewer.run import run_viewer_page
    from scenes.viewer.scene import Scene, read_measurements_by_kind
    from tissue_sim.experiment.kinds.indentation import NEEDLE

    experiment = NEEDLE.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(DEPTH))
    measured = read_measurements_by_kind(sorted((output / "measured").glob("*.csv")), NEEDLE.name)
    scene = Scene(NEEDLE, experiment, ts.load_material(material_file), material_file.name, measured)
    return run_viewer_page(scene, material_file.parent, make_page_options_dict(arguments), json=arguments.json)
