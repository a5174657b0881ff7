"""`tissue-sim view`: push a needle into tissue in a browser."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from haptics.devices.back_ends import HAPTIC_DEVICES, open_haptic
from scenes.catalogue import SCENES
from scenes.commands.shared.console import print_json
from scenes.commands.shared.experiment_flags import (
    add_experiment_flags,
    check_scene,
    make_experiment,
    make_protocol,
)
from scenes.commands.shared.parsing import Parser, add_json, at_least, positive
from scenes.commands.shared.tissue_flags import (
    add_reduced_flag,
    add_solver_flags,
    check_solver,
    read_material,
    read_reduced,
)
from tissue_sim.errors import InputError

SUMMARY = "push a needle into tissue on a page in the browser, beside the measurement"
EXAMPLE = "tissue-sim view needle_indentation --material m.material.json --measured needle_1.csv needle_2.csv"
PORT = 8080


def add_arguments(parser: Parser) -> None:
    parser.add_argument("scene", metavar="SCENE", nargs="?", default="needle_indentation",
                        help=f"{' or '.join(SCENES)} (default: %(default)s)")
    parser.add_argument("--material", type=Path, metavar="FILE",
                        help="NAME.material.json (default: the study's silicone, reduced_polynomial_2)")
    parser.add_argument("--materials", type=Path, metavar="DIR",
                        help="folder of the material files to choose from and to save to (default: that of --material, "
                             "else the current one)")
    parser.add_argument("--measured", type=Path, nargs="+", metavar="FILE", default=[],
                        help="recordings to compare with; those whose sidecar names a kind of test go with that scene, "
                             "the others with SCENE")
    add_solver_flags(parser)
    add_reduced_flag(parser)
    parser.add_argument("--device", metavar="NAME:SETTINGS",
                        help=f"a haptic device that moves the tool and feels the force: one of "
                             f"{', '.join(HAPTIC_DEVICES)}")
    parser.add_argument("--no-real-time", action="store_true",
                        help="ask the system for nothing: no SCHED_FIFO, no locked memory")
    bench = parser.add_argument_group("a bench instead of a simulation; nothing on it is moved from the page")
    bench.add_argument("--run", type=Path, metavar="DIR", dest="run_folder",
                       help="watch the run that 'tissue-sim record -o DIR' makes, while it goes")
    bench.add_argument("--sensor", metavar="NAME:SETTINGS", help="watch a force sensor, such as rdt://192.168.1.1")
    bench.add_argument("--stage", metavar="NAME:SETTINGS", help="with --sensor: and where this stage is")
    add_page_flags(parser)
    headless = parser.add_argument_group("without a browser")
    headless.add_argument("--headless", action="store_true", help="show nothing: play the protocol, say what was felt")
    headless.add_argument("--seconds", type=positive, metavar="N", help="end after so long (default: at Ctrl-C)")
    add_experiment_flags(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def add_page_flags(parser: Parser) -> None:
    """Where the page is served, and how it draws."""
    page = parser.add_argument_group("page")
    page.add_argument("--port", type=at_least(0, 65535), metavar="N", default=PORT,
                      help=f"of the page; 0: any free one (default: {PORT})")
    page.add_argument("--host", metavar="ADDRESS", default="127.0.0.1",
                      help="address to serve on (default: 127.0.0.1, this computer only)")
    page.add_argument("--expose", action="store_true",
                      help="allow a --host that others reach: they can watch and steer without a password")
    page.add_argument("--no-token", action="store_true",
                      help="open the page to every program of this computer, not only to who has the printed address")
    page.add_argument("--open", action="store_true", help="open the page in the browser of this computer")
    page.add_argument("--low-graphics", action="store_true",
                      help="coarser pictures at half the resolution, for browsers without a graphics card")
    page.add_argument("--dark", action="store_true", help="begin with a dark page")


def run(arguments) -> int:
    check_scene(arguments.scene)
    if arguments.headless and arguments.seconds is None:
        raise InputError("a viewer without a browser needs an end; say after how many seconds", field="--seconds")
    if arguments.tilt_mm is not None:
        raise InputError("a tilted tool is a correction of whole recordings and has no place in real time; leave it "
                         "out", field="--tilt-mm")
    if arguments.slip:
        raise InputError("a face that slips in part is a correction of whole recordings and has no place in real time; "
                         "leave it out, or use --friction", field="--slip")
    if arguments.run_folder or arguments.sensor or arguments.stage:
        return _watch(arguments)
    check_solver(arguments.solver)
    reduced = read_reduced(arguments)

    from scenes.viewer.live_simulation import PATIENT, SETTINGS
    from scenes.viewer.run import run_headless, run_page
    from scenes.viewer.scene import BUILT_IN, Scene, read_measurements

    material = reduced.model.material if reduced and not arguments.material else read_material(arguments.material)
    experiment = reduced.model.experiment if reduced else make_experiment(arguments, make_protocol(arguments), material)
    source = arguments.material or arguments.reduced
    scene = Scene(SCENES[arguments.scene], experiment, material, source.name if source else BUILT_IN,
                  read_measurements(arguments.measured, arguments.scene), arguments.solver, reduced=reduced)
    # Other solvers than the usual one may take longer than a tick for an equilibrium, which no hand may wait for.
    other = arguments.solver not in (Scene.solver, "reduced")
    settings = PATIENT if other and not arguments.device else SETTINGS
    options: dict[str, Any] = {"resolution": arguments.resolution,
                               "settings": replace(settings, real_time=not arguments.no_real_time)}
    if other:
        options["curve_resolution"] = arguments.resolution
    if arguments.device:
        options["device"] = open_haptic(arguments.device)
    if arguments.headless:
        answer = run_headless(scene, arguments.seconds, protocol=arguments.protocol,
                              speed=arguments.speed_mm_s * 1e-3, **options)
        if arguments.json:
            print_json(answer)
        elif answer["phase"] == "stopped":
            print(f"tissue-sim: {answer['message']}", file=sys.stderr)
        else:
            print(f"{answer['frames']} frames in {answer['seconds']:.1f} s; {answer['phase']}; "
                  f"largest force {answer['largest_force_N']:.3f} N", file=sys.stdout)
        return 0 if answer["phase"] != "stopped" else 1
    folder = arguments.materials or (arguments.material.parent if arguments.material else Path())
    return run_page(scene, folder, page_options(arguments), seconds=arguments.seconds, json=arguments.json, **options)


def _watch(arguments) -> int:
    """Serve the page of a bench."""
    from haptics.devices.back_ends import open_sensor, open_stage
    from haptics.devices.contracts import DeviceError
    from scenes.viewer.bench.page import run_bench_page
    from scenes.viewer.bench.sources import DevicesSource, RunSource

    if arguments.run_folder and (arguments.sensor or arguments.stage):
        raise InputError("a run has its own devices; give --run or --sensor, not both", field="--run")
    if not arguments.run_folder and not arguments.sensor:
        raise InputError("a stage alone shows no force; give --sensor too", field="--stage")
    try:
        source = RunSource(arguments.run_folder) if arguments.run_folder else DevicesSource(
            open_sensor(arguments.sensor), open_stage(arguments.stage) if arguments.stage else None)
    except DeviceError as error:
        print(f"tissue-sim: {error}", file=sys.stderr)
        return 1
    return run_bench_page(source, page_options(arguments), seconds=arguments.seconds, json=arguments.json)


def page_options(arguments) -> dict:
    """The dictionary `page` of `scenes.viewer.run.run_page`."""
    from scenes.viewer.page_token import new_token

    return {"host": arguments.host, "port": arguments.port, "exposed": arguments.expose,
            "token": "" if arguments.no_token else new_token(), "open": arguments.open,
            "low_graphics": arguments.low_graphics, "dark": arguments.dark}
