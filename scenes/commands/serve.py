"""`tissue-sim serve`: a tissue for programs that are not ours, over UDP."""

from __future__ import annotations

import gc
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.catalogue import SCENES
from scenes.commands.shared.console import progress_console
from scenes.commands.shared.experiment_flags import add_experiment_flags, check_scene, make_experiment, make_protocol
from scenes.commands.shared.parsing import Parser, add_json, at_least, not_negative, positive
from scenes.commands.shared.tissue_flags import add_reduced_flag, add_solver_flags, check_solver, read_reduced
from scenes.stop_signals import stopped_by_signals
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from haptics.server.server import TissueServer
    from tissue_sim import Experiment

SUMMARY = "serve forces to a program of your own: poses in, forces out over UDP, configuration as JSON over TCP"
EXAMPLE = "tissue-sim serve --scene needle_indentation --material m.material.json --port 47700"
PORT = 47700
_LAST_PORT, _LARGEST_SESSION = 65535, 2**64 - 1
#: Of a step at 1 kHz, us; and from one packet of a 1 kHz client to the next, with a margin.
BUDGET_US, SPIN_US = 800.0, 2000.0
#: As `haptics.server` has them.
SILENCE_S, LARGEST_FORCE_N = 5.0, 100.0
#: A tool that is deeper than this share of the specimen's height is none of the scene.
DEEPEST = 0.9


def add_arguments(parser: Parser) -> None:
    parser.add_argument("--scene", metavar="SCENE", default="needle_indentation",
                        help=f"{' or '.join(SCENES)} (default: %(default)s)")
    parser.add_argument("--material", type=Path, metavar="FILE",
                        help="NAME.material.json; only a reduced solid brings its own")
    add_solver_flags(parser)
    add_reduced_flag(parser)
    network = parser.add_argument_group("network")
    network.add_argument("--port", type=at_least(0, _LAST_PORT), metavar="N", default=PORT,
                         help=f"UDP port of the poses; 0 chooses a free one (default: {PORT})")
    network.add_argument("--configuration-port", type=at_least(0, _LAST_PORT), metavar="N",
                         help="TCP port of the configuration; 0 chooses a free one (default: as --port)")
    network.add_argument("--host", metavar="ADDRESS", default="127.0.0.1",
                         help="address of the network interface (default: 127.0.0.1, this machine only)")
    network.add_argument("--expose", action="store_true",
                         help="allow a --host that other machines can reach: they need no password")
    network.add_argument("--session", type=at_least(1, _LARGEST_SESSION), metavar="N",
                         help="the one client that may have the tissue shows this number in its packets (default: "
                              "whoever comes first)")
    network.add_argument("--silence-s", type=positive, metavar="T", default=SILENCE_S,
                         help="a client that is silent for so long loses the tissue to another (default: %(default)g)")
    safety = parser.add_argument_group("safety")
    safety.add_argument("--largest-force-N", type=positive, metavar="F", default=LARGEST_FORCE_N,
                        help=f"no reply has more; at most {LARGEST_FORCE_N:g} (default: %(default)g)")
    timing = parser.add_argument_group("timing")
    timing.add_argument("--budget-us", type=not_negative, metavar="N",
                        help="wall time of a step after which the last equilibrium's force is carried on; 0: however "
                             f"long it takes (default: {BUDGET_US:g}, with --resolution accurate 0)")
    timing.add_argument("--inertia", choices=("auto", "on", "off"), default="auto",
                        help="the mass of the tissue counts; auto: where the tool is fast (default: auto)")
    timing.add_argument("--spin-us", type=not_negative, metavar="N",
                        help="watch the port so long after a packet before sleeping; takes a processor while a client "
                             f"is there (default: {SPIN_US:g}; 0 on a single processor and with --real-time)")
    timing.add_argument("--real-time", action="store_true",
                        help="ask the system for SCHED_FIFO and locked memory: for machines that are busy otherwise")
    add_experiment_flags(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    check_scene(arguments.scene)
    check_solver(arguments.solver)
    reduced = read_reduced(arguments)
    if arguments.material is None and reduced is None:
        raise InputError("the tissue needs a material; give NAME.material.json", field="--material")
    # Before numpy comes: a thread that waits for helpers keeps no time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

    import tissue_sim as ts
    from haptics.loop.multirate import real_time_tissue
    from haptics.loop.real_time import real_time
    from haptics.server.scene_limits import SceneLimits
    from haptics.server.server import TissueServer
    from haptics.server.steps import ServedTissue
    from tissue_sim.parameters import parameter_values

    if arguments.largest_force_N > LARGEST_FORCE_N:
        raise InputError(f"{arguments.largest_force_N:g} N is more than a scene gives; {LARGEST_FORCE_N:g} N is the "
                         "most", field="--largest-force-N")

    if reduced is not None and arguments.material is None:
        material_file = ts.MaterialFile.of(reduced.model.material)
    else:
        material_file = ts.read_material_file(arguments.material)
    material = material_file.material
    experiment = reduced.model.experiment if reduced else make_experiment(arguments, make_protocol(arguments), material)
    port = arguments.port if arguments.configuration_port is None else arguments.configuration_port
    progress = progress_console(quiet=arguments.json)

    build = real_time_tissue(ts.Model(experiment, material), resolution=arguments.resolution,
                             budget=budget(arguments), inertia=arguments.inertia, solver=arguments.solver, mesh=reduced)

    def rebuild() -> ServedTissue:
        another = build()
        another.warm_up()
        return another

    with progress.status("making the mesh"):
        simulator = build()
    limits = SceneLimits(deepest=DEEPEST * experiment.specimen.height, force=arguments.largest_force_N)
    # The ports come before the compilation: one that is taken should be known at once.
    with TissueServer(simulator, host=arguments.host, port=arguments.port, configuration_port=port,
                      description=lambda: describe(arguments, experiment, material_file, simulator, reduced),
                      parameters={} if reduced and reduced.rest else parameter_values(material),
                      silence=arguments.silence_s, limits=limits,
                      rebuild=rebuild, session=arguments.session, spin=spin(arguments),
                      expose=arguments.expose) as server:
        with progress.status("loading the solver (a machine's first run compiles it)"):
            simulator.warm_up()
        gc.collect()
        gc.freeze()  # what is there stays, and need not be looked through between two steps
        with real_time(arguments.real_time) as features, stopped_by_signals(server.stop):
            announce(arguments, server, features)
            server.run()
    report(server, sys.stderr if arguments.json else sys.stdout)
    return 0


def budget(arguments) -> float | None:
    """Wall time of a step, s; None: however long it takes."""
    default = 0.0 if arguments.resolution == "accurate" else BUDGET_US
    return (default if arguments.budget_us is None else arguments.budget_us) * 1e-6 or None


def spin(arguments) -> float:
    """How long the server watches its port before it sleeps, s."""
    if arguments.spin_us is not None:
        return arguments.spin_us * 1e-6
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # Under SCHED_FIFO a server that never sleeps would keep its own client from running.
    return 0.0 if processors == 1 or arguments.real_time else SPIN_US * 1e-6


def describe(arguments, experiment: Experiment, material_file, simulator, reduced=None) -> dict[str, Any]:
    """What is served, for the command ``describe``; in SI."""
    import numpy as np

    from scenes.commands.material.summary import summarise
    from tissue_sim.parameters import declared

    specimen, tool, mesh = experiment.specimen, experiment.tool, simulator.mesh
    first, further = (experiment.tool_pose(depth) for depth in (0.0, 1.0))
    box = None if reduced is None else {name: getattr(reduced.box, name) for name in ("sideways", "depth", "turn")}
    return {
        "scene": arguments.scene,
        "specimen": {"shape": specimen.shape, "height": specimen.height} | {
            name: getattr(specimen, name) for name in declared(type(specimen))},
        "tool": {"shape": tool.shape, "radius": tool.radius} | {name: getattr(tool, name)
                                                                for name in declared(type(tool))},
        "interfaces": {name: getattr(experiment, name) for name in ("friction", "friction_base", "friction_wall")},
        "first_touch": {"position": first.position, "orientation": first.orientation,
                        "way": np.subtract(further.position, first.position).tolist()},
        "box": box,
        "material_file": arguments.material,
        "material": summarise(material_file),
        "resolution": simulator.resolution,
        "force_error": simulator.force_error if reduced is None else reduced.report.get("force_rms_error"),
        "inertia": arguments.inertia,
        "budget": simulator.budget,
        "limits": {"deepest": DEEPEST * specimen.height, "force": arguments.largest_force_N},
        "solver": arguments.solver,
        "mesh": None if mesh is None else {"elements": len(mesh.connectivity), "element": mesh.element.name},
    }


def announce(arguments, server: TissueServer, features) -> None:
    """Say that the server is ready, on one line that a program can wait for."""
    host, port = server.address
    configuration_port = None if server.configuration_address is None else server.configuration_address[1]
    if arguments.json:
        print(json.dumps({"host": host, "port": port, "configuration_port": configuration_port,
                          "real_time": {feature.name: feature.obtained for feature in features}}), flush=True)
        return
    print(f"serving {arguments.scene} on {host}:{port} (UDP), configuration on {host}:{configuration_port} (TCP); "
          "Ctrl-C stops", flush=True)
    if arguments.expose:
        print(f"tissue-sim: warning: every machine that reaches {host} can move the tool, change the parameters and "
              "read the material, without a password", file=sys.stderr)
    for feature in features:
        if feature.message and arguments.real_time:
            print(f"tissue-sim: warning: {feature.message}", file=sys.stderr)


def report(server: TissueServer, stream) -> None:
    """The counters in two sentences."""
    counters = server.counters
    print(f"answered {counters.steps} poses of {counters.clients} clients: {counters.converged} converged, "
          f"{counters.late} late, {counters.stopped} stopped, {counters.refused} refused, {counters.fading} fading, "
          f"{counters.returning} returning, {counters.failed} failed", file=stream)
    print(f"not answered: {counters.skipped} skipped for newer ones, {counters.stale} stale, {counters.malformed} "
          f"malformed; turned away: {counters.turned_away} of other clients, {counters.other_version} of another "
          f"version, {counters.flooded} of who sends too many", file=stream)
