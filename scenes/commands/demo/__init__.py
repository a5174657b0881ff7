"""`tissue-sim demo`: the main job on a virtual specimen, or one in which something is hidden."""

from __future__ import annotations

import os
from contextlib import contextmanager
from pathlib import Path

from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.log_lines import LogLines
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite, at_least
from scenes.commands.view import add_page_flags, page_options

SUMMARY = "measure a virtual specimen, calibrate it, predict a test that the calibration never saw"
EXAMPLE = "tissue-sim demo --hidden --view -o my-demo"
FOLDER, HIDDEN_FOLDER = Path("tissue-sim-demo"), Path("tissue-sim-demo-hidden")
#: Seeds that are drawn where none is given stay short enough to be typed.
_SEEDS = 10_000


def add_arguments(parser: Parser) -> None:
    parser.add_argument("--hidden", action="store_true",
                        help="hide an effect in the specimen or the rig, or nothing, diagnose what a plain model "
                             "misses, and tell the truth only then")
    parser.add_argument("-o", dest="output", type=Path, metavar="DIR",
                        help=f"folder of the results (default: {FOLDER} or {HIDDEN_FOLDER}, replaced on every run)")
    parser.add_argument("--seed", type=at_least(0), metavar="N",
                        help="seed of the measurement noise (default: 0), and of what is hidden (default: another one "
                             "each time)")
    parser.add_argument("--view", action="store_true",
                        help="then show the calibrated needle and the measurements on a page in the browser; of what "
                             "was hidden, the models without and with what was found")
    add_overwrite(parser)
    add_page_flags(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="run it again with --overwrite")


def run(arguments) -> int:
    # The default folder belongs to the demo, so that running it twice works; a folder that a user named is the user's.
    overwrite = arguments.overwrite or arguments.output is None
    if arguments.hidden:
        return _run_hidden(arguments, arguments.output or HIDDEN_FOLDER, overwrite)
    from scenes.demo.virtual_test import run_demo

    output = arguments.output or FOLDER
    answer = run_demo(output, overwrite=overwrite, console=results_console(quiet=arguments.json),
                      seed=arguments.seed or 0)
    if arguments.json:
        print_json(answer)
    if arguments.view:
        return _view(arguments, output, Path(answer["material_file"]))
    return 0


def _run_hidden(arguments, output: Path, overwrite: bool) -> int:
    import random

    from calibration import Workers
    from scenes.demo.hidden_test import run_hidden_demo

    seed = random.SystemRandom().randrange(_SEEDS) if arguments.seed is None else arguments.seed
    answer = run_hidden_demo(output, seed=seed, overwrite=overwrite, progress=_progress(quiet=arguments.json),
                             console=results_console(quiet=arguments.json),
                             workers=Workers(min(2, os.cpu_count() or 1)))
    if arguments.json:
        print_json(answer.to_json())
    if arguments.view:
        from scenes.commands.demo.found_scene import before_and_after_scene
        from scenes.viewer.run import run_page

        return run_page(before_and_after_scene(answer.result, output / "measured"), answer.result.output,
                        page_options(arguments), json=arguments.json)
    return 0


@contextmanager
def _progress(*, quiet: bool):
    """Gone before anything else is printed."""
    from scenes.commands.shared.progress import CampaignProgress

    with CampaignProgress(progress_console(quiet=quiet), lines=LogLines(quiet=quiet)) as progress:
        yield progress.say


def _view(arguments, output: Path, material_file: Path) -> int:
    """Push the needle into the calibrated material, beside what was measured."""
    import tissue_sim as ts
    from scenes.demo.specimen import DEPTH, SPECIMEN
    from scenes.viewer.run import run_page
    from scenes.viewer.scene import Scene, read_measurements
    from tissue_sim.experiment.kinds.indentation import NEEDLE

    experiment = NEEDLE.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(DEPTH))
    measured = read_measurements(sorted((output / "measured").glob("*.csv")), NEEDLE.name)
    scene = Scene(NEEDLE, experiment, ts.load_material(material_file), material_file.name, measured)
    return run_page(scene, material_file.parent, page_options(arguments), json=arguments.json)
