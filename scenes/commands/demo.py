"""`tissue-sim demo`: the main job on a virtual specimen."""

from __future__ import annotations

from pathlib import Path

from scenes.commands.shared.console import print_json, results_console
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite, at_least
from scenes.commands.view import add_page_flags, page_options

SUMMARY = "measure a virtual specimen, calibrate it, predict a test that the calibration never saw"
EXAMPLE = "tissue-sim demo -o my-demo"
FOLDER = Path("tissue-sim-demo")


def add_arguments(parser: Parser) -> None:
    parser.add_argument("-o", dest="output", type=Path, default=FOLDER, metavar="DIR",
                        help=f"folder of the results (default: {FOLDER}, replaced on every run)")
    parser.add_argument("--seed", type=at_least(0), metavar="N", default=0,
                        help="seed of the measurement noise (default: 0)")
    parser.add_argument("--view", action="store_true",
                        help="then show the calibrated needle and the measurements on a page in the browser")
    add_overwrite(parser)
    add_page_flags(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="run it again with --overwrite")


def run(arguments) -> int:
    from scenes.demo.virtual_test import run_demo

    # The default folder belongs to the demo, so that running it twice works; a folder that a user named is the user's.
    overwrite = arguments.overwrite or arguments.output == FOLDER
    answer = run_demo(arguments.output, overwrite=overwrite, console=results_console(quiet=arguments.json),
                      seed=arguments.seed)
    if arguments.json:
        print_json(answer)
    if arguments.view:
        return _view(arguments, Path(answer["material_file"]))
    return 0


def _view(arguments, material_file: Path) -> int:
    """Push the needle into the calibrated material, beside what was measured."""
    import tissue_sim as ts
    from scenes.demo.specimen import DEPTH, SPECIMEN
    from scenes.viewer.run import run_page
    from scenes.viewer.scene import Scene, read_measurements
    from tissue_sim.experiment.kinds.indentation import NEEDLE

    experiment = NEEDLE.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(DEPTH))
    measured = read_measurements(sorted((arguments.output / "measured").glob("*.csv")), NEEDLE.name)
    scene = Scene(NEEDLE, experiment, ts.load_material(material_file), material_file.name, measured)
    return run_page(scene, material_file.parent, page_options(arguments), json=arguments.json)
