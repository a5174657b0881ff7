"""`tissue-sim serve`: simulate tissue for other programs; poses and forces over UDP, configuration over TCP."""

from __future__ import annotations

import gc
import json
import os
import sys
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.catalogue import SCENES
from scenes.commands.shared.command import Command, ExitCode
from scenes.commands.shared.console import make_progress_console
from scenes.commands.shared.experiment_flags import (
    add_experiment_flags,
    add_reduced_flag,
    add_resolution_and_solver_flags,
    load_reduced_model_and_set_flags,
    make_model_from_flags,
    refuse_tilt_and_slip_correction_flags,
    require_known_scene,
)
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    make_integer_parser,
    parse_non_negative_number,
    parse_positive_number,
)
from tissue_sim.errors import InputError
from tissue_sim.signals import call_stop_at_signals

if TYPE_CHECKING:
    from haptics.server.server import TissueServer
    from tissue_sim import Experiment


@dataclass(frozen=True)
class ServeFlagDefaults:
    """Default values of the flags, and fixed limits of the server.

    Attributes:
        port: port of the poses.
        budget_us: wall time of a simulation step for a client at 1 kHz, us.
        spin_us: busy-wait after a packet, us; longer than the period of a client at 1 kHz.
        silence_s: time without packets after which another client may take over, s, as in `haptics.server`.
        max_force: largest force of a reply, N, as in `haptics.server`.
        max_depth: largest depth of the tool, as a fraction of the height of the specimen; deeper poses are refused.
        max_port: largest number of a UDP or TCP port.
        max_session: largest session number, which has 64 bits in the wire protocol.
    """

    port: int = 47700
    budget_us: float = 800.0
    spin_us: float = 2000.0
    silence_s: float = 5.0
    max_force: float = 100.0
    max_depth: float = 0.9
    max_port: int = 65535
    max_session: int = 2**64 - 1


SETTINGS = ServeFlagDefaults()


def _add_scene_and_material_flags(parser: InputErrorArgumentParser) -> None:
    """Add ``--scene`` and ``--material``."""
    parser.add_argument("--scene", metavar="SCENE", default="needle_indentation",
                        help=f"test to simulate: {', '.join(SCENES)} (default: %(default)s)")
    parser.add_argument("--material", type=Path, metavar="FILE",
                        help="material file NAME.material.json; required without --reduced")


def _add_network_safety_and_timing_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of ports and clients, of the largest force, and of the timing."""
    network = parser.add_argument_group("network")
    network.add_argument("--port", type=make_integer_parser(0, SETTINGS.max_port), metavar="N", default=SETTINGS.port,
                         help=f"UDP port of the poses; 0 selects a free port (default: {SETTINGS.port})")
    network.add_argument("--configuration-port", type=make_integer_parser(0, SETTINGS.max_port), metavar="N",
                         help="TCP port of the configuration; 0 selects a free port (default: value of --port)")
    network.add_argument("--host", metavar="ADDRESS", default="127.0.0.1",
                         help="address of the network interface (default: 127.0.0.1, this computer only)")
    network.add_argument("--expose", action="store_true",
                         help="allow a --host that other computers can reach; they need no password")
    network.add_argument("--session", type=make_integer_parser(1, SETTINGS.max_session), metavar="N",
                         help="serve only clients whose packets carry this session number (default: the first client)")
    network.add_argument("--silence-s", type=parse_positive_number, metavar="T", default=SETTINGS.silence_s,
                         help="time without packets after which another client may take over (default: %(default)g)")
    safety = parser.add_argument_group("safety")
    safety.add_argument("--largest-force-N", type=parse_positive_number, metavar="F", default=SETTINGS.max_force,
                        help=f"largest force of a reply, at most {SETTINGS.max_force:g} (default: %(default)g)")
    timing = parser.add_argument_group("timing")
    timing.add_argument("--budget-us", type=parse_non_negative_number, metavar="N",
                        help="time limit of a simulation step; a step that reaches it returns the force of the last "
                        "equilibrium, extrapolated with its stiffness; 0: no limit (default: "
                        f"{SETTINGS.budget_us:g}; with --resolution accurate 0)")
    timing.add_argument("--inertia", choices=("auto", "on", "off"), default="auto",
                        help="inertia of the tissue; auto: on where the tool is fast (default: auto)")
    timing.add_argument("--spin-us", type=parse_non_negative_number, metavar="N",
                        help="busy-wait this long for the next packet before sleeping; occupies one processor while a "
                        f"client is active (default: {SETTINGS.spin_us:g}; 0 on a single processor and with "
                        "--real-time)")
    timing.add_argument("--real-time", action="store_true",
                        help="request real-time scheduling (SCHED_FIFO) and locked memory; useful where other programs "
                        "load the computer")


def _run(arguments: Namespace) -> int:
    """Serve the tissue until Ctrl-C or SIGTERM, then print the counters.

    Raises:
        InputError: missing material, unknown scene or solver, or values that scene or server do not accept.
    """
    require_known_scene(arguments.scene)
    refuse_tilt_and_slip_correction_flags(arguments)
    reduced = load_reduced_model_and_set_flags(arguments)
    if arguments.material is None and reduced is None:
        raise InputError("is required without --reduced. Give a material file NAME.material.json", field="--material")
    # This must precede the import of numpy: waiting for helper threads of BLAS would make steps late.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

    import tissue_sim as ts
    from haptics.loop.multirate import make_real_time_tissue_factory
    from haptics.loop.ticker import request_real_time_features
    from haptics.server.server import TissueServer
    from haptics.server.steps import ServedTissue, ServerLimits
    from tissue_sim.parameters import parameter_values

    if arguments.largest_force_N > SETTINGS.max_force:
        raise InputError(f"must be at most {SETTINGS.max_force:g} N; got {arguments.largest_force_N:g} N",
                         field="--largest-force-N")

    if reduced is not None and arguments.material is None:
        material_file = ts.MaterialFile.of(reduced.model.material)
    else:
        material_file = ts.read_material_file(arguments.material)
    model = make_model_from_flags(arguments, material_file.material, reduced)
    port = arguments.port if arguments.configuration_port is None else arguments.configuration_port
    progress = make_progress_console(quiet=arguments.json)

    build = make_real_time_tissue_factory(model, resolution=arguments.resolution,
                                          budget=get_step_budget_or_none(arguments), inertia=arguments.inertia,
                                          solver=arguments.solver, mesh=reduced)

    def build_warmed_up_tissue() -> ServedTissue:
        """Build a new simulator of the served tissue, and warm it up."""
        simulator = build()
        simulator.warm_up()
        return simulator

    with progress.status("generating the mesh"):
        simulator = build()
    limits = ServerLimits(deepest=SETTINGS.max_depth * model.experiment.specimen.height,
                          force=arguments.largest_force_N)
    # The ports are opened before the compilation, so that a port in use is reported at once.
    with TissueServer(simulator, host=arguments.host, port=arguments.port, configuration_port=port,
                      description=lambda: make_served_scene_json_object(arguments, model.experiment, material_file,
                                                                        simulator, reduced),
                      parameters={} if reduced and reduced.rest else parameter_values(model.material),
                      silence=arguments.silence_s, limits=limits,
                      rebuild=build_warmed_up_tissue, session=arguments.session,
                      spin=get_busy_wait_time(arguments),
                      expose=arguments.expose) as server:
        with progress.status("loading the solver (the first run on a computer compiles it)"):
            simulator.warm_up()
        gc.collect()
        gc.freeze()  # keeps existing objects out of garbage collections between two steps
        with request_real_time_features(arguments.real_time) as features, call_stop_at_signals(server.stop):
            print_ready_line(arguments, server, features)
            server.run()
    print_packet_counters(server, sys.stderr if arguments.json else sys.stdout)
    return ExitCode.DONE


def get_step_budget_or_none(arguments) -> float | None:
    """Return the time limit of a simulation step, s; None for no limit."""
    default = 0.0 if arguments.resolution == "accurate" else SETTINGS.budget_us
    return (default if arguments.budget_us is None else arguments.budget_us) * 1e-6 or None


def get_busy_wait_time(arguments) -> float:
    """Return the time for which the server busy-waits for the next packet before it sleeps, s."""
    if arguments.spin_us is not None:
        return arguments.spin_us * 1e-6
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # With SCHED_FIFO a server that never sleeps would prevent its client from running on the same processor.
    return 0.0 if processors == 1 or arguments.real_time else SETTINGS.spin_us * 1e-6


def make_served_scene_json_object(arguments, experiment: Experiment, material_file, simulator,
                                  reduced=None) -> dict[str, Any]:
    """Return the answer to the configuration command ``describe``: scene, specimen, tool, material and solver.

    Args:
        arguments: parsed arguments of the command.
        experiment: served experiment.
        material_file: served material file.
        simulator: simulator of the server.
        reduced: reduced model that is served; None otherwise.

    Returns:
        JSON object in SI units; docs/wire_protocol.md documents its keys.
    """
    import numpy as np

    from scenes.commands.material.summary import summarise_material_file
    from tissue_sim.parameters import list_field_declarations

    specimen, tool, mesh = experiment.specimen, experiment.tool, simulator.mesh
    touch, deeper = (experiment.tool_pose(depth) for depth in (0.0, 1.0))
    box = None if reduced is None else {name: getattr(reduced.box, name) for name in ("sideways", "depth", "turn")}
    return {
        "scene": arguments.scene,
        "specimen": {"shape": specimen.shape, "height": specimen.height} | {
            name: getattr(specimen, name) for name in list_field_declarations(type(specimen))},
        "tool": {"shape": tool.shape, "radius": tool.radius} | {name: getattr(tool, name)
                                                                for name in list_field_declarations(type(tool))},
        "interfaces": {name: getattr(experiment, name) for name in ("friction", "friction_base", "friction_wall")},
        "first_touch": {"position": touch.position, "orientation": touch.orientation,
                        "way": np.subtract(deeper.position, touch.position).tolist()},
        "box": box,
        "material_file": arguments.material,
        "material": summarise_material_file(material_file),
        "resolution": simulator.resolution,
        "force_error": simulator.force_error if reduced is None else reduced.report.get("force_rms_error"),
        "inertia": arguments.inertia,
        "budget": simulator.budget,
        "limits": {"deepest": SETTINGS.max_depth * specimen.height, "force": arguments.largest_force_N},
        "solver": arguments.solver,
        "mesh": None if mesh is None else {"elements": len(mesh.connectivity), "element": mesh.element.name},
    }


def print_ready_line(arguments, server: TissueServer, features) -> None:
    """Print addresses and ports of the ready server on one line, for which a program can wait."""
    host, port = server.address
    configuration_port = None if server.configuration_address is None else server.configuration_address[1]
    if arguments.json:
        print(json.dumps({"host": host, "port": port, "configuration_port": configuration_port,
                          "real_time": {feature.name: feature.obtained for feature in features}}), flush=True)
        return
    print(f"serving {arguments.scene} on {host}:{port} (UDP), configuration on {host}:{configuration_port} (TCP); "
          "Ctrl-C stops", flush=True)
    if arguments.expose:
        print(f"tissue-sim: warning: every computer that can reach {host} can move the tool, change the parameters and "
              "read the material without a password", file=sys.stderr)
    for feature in features:
        if feature.message and arguments.real_time:
            print(f"tissue-sim: warning: {feature.message}", file=sys.stderr)


def print_packet_counters(server: TissueServer, stream) -> None:
    """Print the packet counters of the server in two sentences."""
    counters = server.counters
    print(f"answered {counters.steps} poses of {counters.clients} clients: {counters.converged} converged, "
          f"{counters.late} late, {counters.stopped} stopped, {counters.refused} refused, {counters.fading} fading, "
          f"{counters.returning} returning, {counters.failed} failed", file=stream)
    print(f"not answered: {counters.skipped} superseded by newer poses, {counters.stale} stale, {counters.malformed} "
          f"malformed; rejected: {counters.turned_away} of other clients, {counters.other_version} of another protocol "
          f"version, {counters.flooded} above the rate limit", file=stream)


COMMAND = Command(
    "serve", "run a force server for other programs: poses in and forces out over UDP, configuration as JSON over TCP",
    "tissue-sim serve --scene needle_indentation --material m.material.json --port 47700", _run,
    needs=(_add_scene_and_material_flags, add_resolution_and_solver_flags, add_reduced_flag,
           _add_network_safety_and_timing_flags, add_experiment_flags))
