"""`tissue-sim loop`: the 1 kHz loop, and how well this computer keeps its time."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from haptics.devices.back_ends import HAPTIC_DEVICES, MOTIONS
from scenes.catalogue import SCENES
from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.experiment_flags import (
    DEPTH_MM,
    add_experiment_flags,
    check_scene,
    make_experiment,
    make_protocol,
)
from scenes.commands.shared.parsing import Parser, add_json, at_least, not_negative, positive
from scenes.commands.shared.tissue_flags import (
    add_reduced_flag,
    add_solver_flags,
    check_solver,
    read_material,
    read_reduced,
)
from tissue_sim.errors import InputError

SUMMARY = "run the 1 kHz loop, along a motion or with a haptic device, and report how well it keeps its time"
EXAMPLE = "tissue-sim loop needle_indentation --material m.material.json --seconds 60 --motion random"
#: What stops a mistyped motion, not what a device bears, N and N per tick.
FORCE_LIMIT, FORCE_RATE = 100.0, 1.0
#: Of real devices, unless the flags say otherwise: the hands of docs/haptic_rendering.md that do not shake with it.
COUPLING, CONTROLLER, ENERGY_LIMIT = (1000.0, 1.0), 2.0, 1.0
#: Wall time of a step in a tick of 1000, us: the rest is for rendering, ring and surface.
BUDGET = 800.0
INTERRUPTED = 130
_LOOK_EVERY = 0.25  # s


def add_arguments(parser: Parser) -> None:
    parser.add_argument("scene", metavar="SCENE", nargs="?", default="needle_indentation",
                        help=f"{' or '.join(SCENES)} (default: %(default)s)")
    parser.add_argument("--material", type=Path, metavar="FILE",
                        help="NAME.material.json (default: the study's silicone, reduced_polynomial_2)")
    parser.add_argument("--seconds", type=positive, metavar="N", default=60.0,
                        help="how long; Ctrl-C ends it earlier (default: 60)")
    add_solver_flags(parser)
    add_reduced_flag(parser)
    source = parser.add_argument_group("source of the motion")
    source.add_argument("--motion", metavar="NAME[:SETTINGS]",
                        help=f"one of {', '.join(MOTIONS)}. random: as of a hand, with lift-offs; sine: up and down; "
                             "protocol: that of --protocol, repeated where it closes; hand: stays where it is "
                             "(default: random, or protocol where one is stated)")
    source.add_argument("--device", metavar="NAME:SETTINGS",
                        help="a haptic device, which also feels the force, in place of a motion: one of "
                             f"{', '.join(HAPTIC_DEVICES)}; 'virtual:sine:depth_mm=5' is a hand that follows that "
                             "motion and gives way to the force")
    source.add_argument("--top-speed-mm-s", type=positive, metavar="N", default=200.0,
                        help="that a random motion never exceeds (default: 200)")
    source.add_argument("--frequency-hz", type=positive, metavar="N", default=1.0, help="of a sine (default: 1)")
    source.add_argument("--sideways-mm", type=not_negative, metavar="N",
                        help="how far aside a random motion goes, along x and y either way (default: 0, or as far as "
                             "the box of --reduced)")
    source.add_argument("--turn-deg", type=not_negative, metavar="N",
                        help="how far a random motion turns the tool, about any axis (default: 0, or as far as that "
                             "box)")
    source.add_argument("--seed", type=at_least(0), metavar="N", default=0, help="of a random motion (default: 0)")
    timing = parser.add_argument_group("timing and safety")
    timing.add_argument("--spin-us", type=not_negative, metavar="N", default=0.0,
                        help="watch the clock so long before each tick in place of sleeping (default: 0)")
    timing.add_argument("--budget-us", type=not_negative, metavar="N", default=BUDGET,
                        help="wall time of a step after which the last equilibrium's force is carried on; 0: however "
                             f"long it takes (default: {BUDGET:g})")
    timing.add_argument("--inertia", choices=("auto", "on", "off"), default="auto",
                        help="the mass of the tissue counts; auto: where the tool is fast, and not behind a coupling "
                             "(default: auto)")
    timing.add_argument("--no-real-time", action="store_true",
                        help="ask the system for nothing: no SCHED_FIFO, no locked memory")
    timing.add_argument("--force-limit-N", type=positive, metavar="N",
                        help=f"largest rendered force (default: {FORCE_LIMIT:g}, or what the device allows)")
    timing.add_argument("--force-rate-N", type=positive, metavar="N", default=FORCE_RATE,
                        help=f"its largest change in a tick (default: {FORCE_RATE:g})")
    timing.add_argument("--coupling-stiffness-N-m", type=not_negative, metavar="N",
                        help="a spring between the device and the tool; 0: none (default: none, and "
                             f"{COUPLING[0]:g} for a device that allows a certain force only)")
    timing.add_argument("--coupling-damping-N-s-m", type=not_negative, metavar="N",
                        help=f"damper beside that spring (default: {COUPLING[1]:g})")
    timing.add_argument("--passivity-damping-N-s-m", type=not_negative, metavar="N",
                        help="most that the passivity controller adds while more energy has come out than was put in; "
                             f"0: no controller (default: none, and {CONTROLLER:g} for such a device)")
    timing.add_argument("--energy-limit-J", type=positive, metavar="N",
                        help="no force any more where so much more energy has come out than was put in (default: none, "
                             f"and {ENERGY_LIMIT:g} for a device)")
    timing.add_argument("--ring", type=Path, metavar="FILE",
                        help="where viewers and recorders read the ticks (default: a file in memory)")
    add_experiment_flags(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    check_scene(arguments.scene)
    name = arguments.device or arguments.motion or ("protocol" if arguments.protocol else "random")
    if arguments.device and arguments.motion:
        raise InputError("a device brings its motion with it; give --motion or --device, not both", field="--motion")
    if name != "protocol" and arguments.protocol:
        raise InputError(f"a {name} motion has none; leave it out, or give --motion protocol", field="--protocol")
    for flag in ("sideways_mm", "turn_deg"):
        if getattr(arguments, flag) is not None and name != "random":
            raise InputError("only the random motion of the other flags takes it; leave --motion and --device out, or "
                             "write random:sideways_mm=...,turn_deg=...", field="--" + flag.replace("_", "-"))
    check_solver(arguments.solver)
    reduced = read_reduced(arguments)

    from haptics.loop.loop import LoopSettings
    from haptics.loop.multirate import real_time_tissue
    from haptics.loop.process import LoopError, LoopProcess
    from tissue_sim import Model

    material = reduced.model.material if reduced and not arguments.material else read_material(arguments.material)
    protocol = make_protocol(arguments)
    model = Model(reduced.model.experiment if reduced else make_experiment(arguments, protocol, material), material)
    settings = LoopSettings(seconds=arguments.seconds, spin=arguments.spin_us * 1e-6,
                            real_time=not arguments.no_real_time)
    if reduced:
        stay_in_box(arguments, reduced)
    device = open_named(arguments, name, protocol, lifts=reduced is None or reduced.lifting == 0)
    device.set_approach(model.experiment.approach)
    rendering = make_rendering(arguments, device.largest_force)
    # Behind a coupling the mass of the tissue is stable in time; but where it makes most answers late, the force is up
    # to six times too large (docs/haptic_rendering.md).
    inertia = "off" if rendering.coupling is not None and arguments.inertia == "auto" else arguments.inertia
    make_tissue = real_time_tissue(model, resolution=arguments.resolution, inertia=inertia,
                                   looks_ahead=rendering.coupling is not None,
                                   budget=arguments.budget_us * 1e-6 or None, solver=arguments.solver, mesh=reduced)
    process = LoopProcess(make_tissue, device, rendering, settings, ring_path=arguments.ring)
    try:
        report, interrupted = follow(process, arguments.seconds, quiet=arguments.json)
    except LoopError as error:
        print(f"tissue-sim: {error}", file=sys.stderr)
        return 1
    if arguments.json:
        print_json({"scene": arguments.scene, "motion": name, **report.as_json()})
    else:
        from scenes.commands.loop.report import print_report

        print_report(report, results_console())
    return INTERRUPTED if interrupted else 0


def stay_in_box(arguments, reduced) -> None:
    """Let a random motion go as far as a reduced solid knows; a tool that leans goes aside as it goes down.

    Raises:
        InputError: it is to go further.
    """
    box, approach = reduced.box, reduced.model.experiment.approach
    aside = abs(math.tan(approach.angle)) * box.depth if approach is not None else 0.0
    for name, size in (("sideways_mm", max(box.sideways - aside, 0.0) * 1e3), ("turn_deg", math.degrees(box.turn))):
        asked = getattr(arguments, name)
        if asked is None:
            setattr(arguments, name, size)
        elif asked > size * (1.0 + 1e-9):
            why = ", as a tool that leans goes aside as it goes down" if aside and name == "sideways_mm" else ""
            raise InputError(f"{asked:g} leads out of the box of the reduced solid{why}; give {size:.4g} at most, or "
                             "leave it out", field=f"--{name.replace('_', '-')}")


def open_named(arguments, name: str, protocol, *, lifts: bool = True):
    """The motion or the device that the flags ask for.

    Args:
        lifts: whether a random motion or a sine lifts the tool off.

    Raises:
        InputError: no such motion or device, or what it refuses.
    """
    from haptics.devices.back_ends import open_haptic, open_motion
    from haptics.devices.motions import follow_protocol

    if arguments.device:
        return open_haptic(name)
    if name == "protocol":
        return follow_protocol(protocol)
    depth = f"depth_mm={arguments.depth_mm or DEPTH_MM!r}" + ("" if lifts else ",lift=0")
    by_flags = {"random": f"random:{depth},top_speed_mm_s={arguments.top_speed_mm_s!r},seed={arguments.seed},"
                          f"sideways_mm={arguments.sideways_mm or 0.0!r},turn_deg={arguments.turn_deg or 0.0!r}",
                "sine": f"sine:{depth},frequency_hz={arguments.frequency_hz!r}"}
    return open_motion(by_flags.get(name, name))


def make_rendering(arguments, largest_force: float):
    """From the device's pose to its force, as the flags say.

    Args:
        largest_force: of the device, N.

    Raises:
        InputError: a limit above it, or a damper without its spring.
    """
    from haptics.safety.coupling import VirtualCoupling
    from haptics.safety.limits import ForceLimits
    from haptics.safety.passivity import EnergyLimit
    from haptics.safety.rendering import ForceRendering

    limit = arguments.force_limit_N or FORCE_LIMIT
    if arguments.force_limit_N and limit > largest_force:
        raise InputError(f"{limit:g} N, but the device allows {largest_force:g} N; give no more, or set the device "
                         "otherwise", field="--force-limit-N")
    real = math.isfinite(largest_force)

    def asked(value: float | None, for_real: float) -> float:
        return value if value is not None else for_real if real else 0.0

    stiffness = asked(arguments.coupling_stiffness_N_m, COUPLING[0])
    damping = arguments.coupling_damping_N_s_m
    if damping and not stiffness:
        raise InputError("a damper needs a spring beside it; give --coupling-stiffness-N-m, too",
                         field="--coupling-damping-N-s-m")
    coupling = VirtualCoupling(stiffness, COUPLING[1] if damping is None else damping) if stiffness else None
    return ForceRendering(ForceLimits(limit, arguments.force_rate_N), coupling,
                          controller_damping=asked(arguments.passivity_damping_N_s_m, CONTROLLER) or None,
                          energy_limit=EnergyLimit(arguments.energy_limit_J or (ENERGY_LIMIT if real else math.inf)))


def follow(process, seconds: float, *, quiet: bool):
    """Run the loop to its end, with a live line on a terminal.

    Returns:
        Its report, and whether Ctrl-C ended it.

    Raises:
        InputError, LoopError: it ended before its time.
        KeyboardInterrupt: before its first tick.
    """
    from haptics.loop.process import LoopError
    from scenes.commands.loop.report import LiveLine

    console = progress_console(quiet=quiet)
    with process, console.status("starting") as status:
        try:
            process.wait_until_ready(progress=status.update)
            with process.ring() as ring:
                live = LiveLine(ring, seconds)
                console.print(f"ring: {process.ring_path}", markup=False, soft_wrap=True)
                while (report := process.wait(_LOOK_EVERY)) is None:
                    if not console.quiet:
                        status.update(live.text())
            return report, False
        except KeyboardInterrupt:
            # The loop may tick already, and this process not know it yet.
            report = process.stop()
            if report is not None:
                return report, True
            if not process.ready:
                raise
            raise LoopError(f"stopped by Ctrl-C, without a report: {process.message}") from None
