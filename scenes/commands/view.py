"""`tissue-sim view`: interactive page in the browser for a simulated test or a real test bench."""

from __future__ import annotations

import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

from scenes.catalogue import SCENES
from scenes.commands.shared.command import Command, CommandResult, ExitCode
from scenes.commands.shared.experiment_flags import (
    add_experiment_flags,
    add_reduced_flag,
    add_resolution_and_solver_flags,
    add_scene_and_optional_material_flag,
    get_tool_speed,
    load_reduced_model_and_set_flags,
    load_scene_material,
    make_model_from_flags,
    refuse_tilt_and_slip_correction_flags,
    require_known_scene,
)
from scenes.commands.shared.parsing import InputErrorArgumentParser, make_integer_parser, parse_positive_number
from tissue_sim.errors import InputError


def _add_folder_and_measurement_flags(parser: InputErrorArgumentParser) -> None:
    """Add the folder of the material files, and the recordings for comparison."""
    parser.add_argument("--materials", type=Path, metavar="DIR",
                        help="folder in which the page lists and saves material files (default: folder of --material, "
                        "otherwise the current folder)")
    parser.add_argument("--measured", type=Path, nargs="+", metavar="FILE", default=[],
                        help="recordings for comparison; a recording belongs to the kind of test that its sidecar "
                        "names, otherwise to SCENE")


def _add_device_and_bench_flags(parser: InputErrorArgumentParser) -> None:
    """Add the haptic device, and the flags of the page of a test bench."""
    from haptics.devices.back_ends import HAPTIC_DEVICES

    parser.add_argument("--device", metavar="NAME:SETTINGS",
                        help="haptic device that moves the tool and displays the force: one of "
                        f"{', '.join(HAPTIC_DEVICES)}")
    parser.add_argument("--no-real-time", action="store_true",
                        help="do not request real-time scheduling (SCHED_FIFO) and locked memory")
    bench = parser.add_argument_group("show a test bench instead of a simulation (the page only displays it)")
    bench.add_argument("--run", type=Path, metavar="DIR", dest="run_folder",
                       help="show the recording that 'tissue-sim record -o DIR' is making")
    bench.add_argument("--sensor", metavar="NAME:SETTINGS",
                       help="show the readings of a force sensor, such as rdt://192.168.1.1")
    bench.add_argument("--stage", metavar="NAME:SETTINGS", help="with --sensor: also show the position of this stage")


def _add_headless_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of a run without a browser."""
    headless = parser.add_argument_group("without a browser")
    headless.add_argument("--headless", action="store_true",
                          help="run --protocol without a page and print a summary; requires --seconds")
    headless.add_argument("--seconds", type=parse_positive_number, metavar="N",
                          help="end after this time (default: at Ctrl-C)")


def add_page_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of the page: address, access and graphics."""
    from scenes.doctor import VIEWER_PORT

    page = parser.add_argument_group("page")
    page.add_argument("--port", type=make_integer_parser(0, 65535), metavar="N", default=VIEWER_PORT,
                      help=f"port of the page; 0 selects a free port (default: {VIEWER_PORT})")
    page.add_argument("--host", metavar="ADDRESS", default="127.0.0.1",
                      help="network address of the page (default: 127.0.0.1, this computer only)")
    page.add_argument("--expose", action="store_true",
                      help="allow a --host that other computers can reach; they can see and control the page without "
                      "a password")
    page.add_argument("--no-token", action="store_true",
                      help="omit the access token from the address; every program on this computer can then open the "
                      "page")
    page.add_argument("--open", action="store_true", help="open the page in the browser of this computer")
    page.add_argument("--low-graphics", action="store_true",
                      help="simpler graphics at half the resolution, for computers without a graphics card")
    page.add_argument("--dark", action="store_true", help="start with the dark colour theme")


def _run(arguments: Namespace) -> CommandResult | int:
    """Serve the page until its end, or run without a browser and print a summary.

    Raises:
        InputError: flags that contradict each other, or values that scene, page or device do not accept.
    """
    require_known_scene(arguments.scene)
    if arguments.headless and arguments.seconds is None:
        raise InputError("is required with --headless. Give the duration in s", field="--seconds")
    refuse_tilt_and_slip_correction_flags(arguments)
    if arguments.run_folder or arguments.sensor or arguments.stage:
        return _serve_bench_page(arguments)
    reduced = load_reduced_model_and_set_flags(arguments)

    from scenes.viewer.live_simulation import PATIENT, SETTINGS
    from scenes.viewer.run import run_headless_and_return_results, run_viewer_page
    from scenes.viewer.scene import BUILT_IN, Scene, read_measurements_by_kind

    material = load_scene_material(arguments.material, reduced)
    model = make_model_from_flags(arguments, material, reduced)
    source = arguments.material or arguments.reduced
    scene = Scene(SCENES[arguments.scene], model.experiment, material, source.name if source else BUILT_IN,
                  read_measurements_by_kind(arguments.measured, arguments.scene), arguments.solver, reduced=reduced)
    # Other solvers may need more than a tick for a step. The page can wait for them; a haptic device cannot.
    other = arguments.solver not in (Scene.solver, "reduced")
    settings = PATIENT if other and not arguments.device else SETTINGS
    options: dict[str, Any] = {"resolution": arguments.resolution,
                               "settings": replace(settings, real_time=not arguments.no_real_time)}
    if other:
        options["curve_resolution"] = arguments.resolution
    if arguments.device:
        from haptics.devices.back_ends import make_haptic_device

        options["device"] = make_haptic_device(arguments.device)
    if arguments.headless:
        answer = run_headless_and_return_results(scene, arguments.seconds, protocol=arguments.protocol,
                                                 speed=get_tool_speed(arguments), **options)
        return CommandResult(lambda: answer, lambda _: _print_headless_summary(answer),
                             ExitCode.DONE if answer["phase"] != "stopped" else ExitCode.GOAL_MISSED)
    folder = arguments.materials or (arguments.material.parent if arguments.material else Path())
    return run_viewer_page(scene, folder, make_page_options_dict(arguments), seconds=arguments.seconds,
                           json=arguments.json, **options)


def _print_headless_summary(answer: dict[str, Any]) -> None:
    """Print the summary of a run without a browser, or on stderr the reason why the loop stopped."""
    if answer["phase"] == "stopped":
        print(f"tissue-sim: {answer['message']}", file=sys.stderr)
    else:
        print(f"{answer['frames']} frames in {answer['seconds']:.1f} s; {answer['phase']}; "
              f"largest force {answer['largest_force_N']:.3f} N")


def _serve_bench_page(arguments) -> int:
    """Serve the page of a test bench.

    Raises:
        InputError: flags that contradict each other, or an unknown device.
    """
    from haptics.devices.back_ends import make_sensor, make_stage
    from haptics.devices.contracts import DeviceError
    from scenes.viewer.bench_page import ConnectedDevicesSource, RunFolderSource, serve_bench_page_and_get_exit_code

    if arguments.run_folder and (arguments.sensor or arguments.stage):
        raise InputError("cannot be combined with --sensor and --stage. Give --run, or the devices", field="--run")
    if not arguments.run_folder and not arguments.sensor:
        raise InputError("requires a force sensor. Add --sensor", field="--stage")
    try:
        source = RunFolderSource(arguments.run_folder) if arguments.run_folder else ConnectedDevicesSource(
            make_sensor(arguments.sensor), make_stage(arguments.stage) if arguments.stage else None)
    except DeviceError as error:
        print(f"tissue-sim: {error}", file=sys.stderr)
        return ExitCode.GOAL_MISSED
    return serve_bench_page_and_get_exit_code(source, make_page_options_dict(arguments), seconds=arguments.seconds,
                                              json=arguments.json)


def make_page_options_dict(arguments) -> dict:
    """Return the options of the page for `scenes.viewer.run.run_viewer_page`."""
    from scenes.viewer.web_server import make_access_token

    return {"host": arguments.host, "port": arguments.port, "exposed": arguments.expose,
            "token": "" if arguments.no_token else make_access_token(), "open": arguments.open,
            "low_graphics": arguments.low_graphics, "dark": arguments.dark}


COMMAND = Command(
    "view", "simulate a test interactively on a page in the browser, and compare it with measurements",
    "tissue-sim view needle_indentation --material m.material.json --measured needle_1.csv needle_2.csv", _run,
    needs=(add_scene_and_optional_material_flag, _add_folder_and_measurement_flags, add_resolution_and_solver_flags,
           add_reduced_flag, _add_device_and_bench_flags, add_page_flags, _add_headless_flags, add_experiment_flags))
