"""`tissue-sim loop`: run the 1 kHz force loop and report its timing."""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.command import Command, CommandResult, ExitCode
from scenes.commands.shared.console import make_progress_console, make_table_with_headings, print_sentence
from scenes.commands.shared.experiment_flags import (
    MOTION_FLAGS,
    add_experiment_flags,
    add_reduced_flag,
    add_resolution_and_solver_flags,
    add_scene_and_optional_material_flag,
    load_reduced_model_and_set_flags,
    load_scene_material,
    make_model_from_flags,
    make_protocol_from_flags,
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

if TYPE_CHECKING:
    from rich.console import Console

    from haptics.loop.loop import LoopReport
    from haptics.loop.ring import RingReader

#: Interval between updates of the status line, s.
_UPDATE_INTERVAL = 0.25
#: Flag of a tick in the report -> its description; see `haptics.safety.rendering.RenderFlag`.
_FLAG_DESCRIPTIONS = {
    "limited": "with the force at its limit",
    "rate_limited": "with a limited change of the force",
    "invalid": "with a force that was not a finite number",
    "lost_pose": "without a pose from the device",
    "active": "in which the hand had received more energy than it put in",
    "energy": "with the force switched off by the energy limit",
    "paused": "in pause",
}


@dataclass(frozen=True)
class LoopFlagDefaults:
    """Default values of the flags.

    Coupling, passivity controller and energy limit apply to devices with a force limit only. Their values keep the
    simulated hands of docs/haptic_rendering.md stable.

    Attributes:
        force_limit: largest rendered force, N. It catches mistyped motions; it does not protect a device.
        force_rate: largest change of the rendered force per tick, N.
        budget_us: wall time of a simulation step, us; the rest of the tick of 1000 us is for rendering, ring buffer and
            surface.
        coupling_stiffness: stiffness of the virtual coupling, N/m.
        coupling_damping: damping of the virtual coupling, N s/m.
        passivity_damping: largest damping of the passivity controller, N s/m.
        energy_limit: net energy output at which the force is switched off, J.
    """

    force_limit: float = 100.0
    force_rate: float = 1.0
    budget_us: float = 800.0
    coupling_stiffness: float = 1000.0
    coupling_damping: float = 1.0
    passivity_damping: float = 2.0
    energy_limit: float = 1.0


DEFAULTS = LoopFlagDefaults()


def _add_duration_flag(parser: InputErrorArgumentParser) -> None:
    """Add ``--seconds``."""
    parser.add_argument("--seconds", type=parse_positive_number, metavar="N", default=60.0,
                        help="duration of the loop; Ctrl-C ends it earlier (default: 60)")


def _add_motion_source_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of the prescribed motion and of the haptic device."""
    from haptics.devices.back_ends import HAPTIC_DEVICES, MOTIONS

    source = parser.add_argument_group("source of the motion")
    source.add_argument("--motion", metavar="NAME[:SETTINGS]",
                        help=f"prescribed motion: one of {', '.join(MOTIONS)}. random: like a hand, with lift-off; "
                        "sine: periodic along the axis; protocol: motion of --protocol, repeated if it ends where "
                        "it starts; hand: the tool rests (default: random, or protocol with --protocol)")
    source.add_argument("--device", metavar="NAME:SETTINGS",
                        help="haptic device that moves the tool and displays the force, instead of --motion: one of "
                        f"{', '.join(HAPTIC_DEVICES)}; 'virtual:sine:depth_mm=5' simulates a hand that follows a "
                        "sine motion and yields to the force")
    source.add_argument("--top-speed-mm-s", type=parse_positive_number, metavar="N", default=200.0,
                        help="speed limit of the random motion (default: 200)")
    source.add_argument("--frequency-hz", type=parse_positive_number, metavar="N", default=1.0,
                        help="frequency of the sine motion (default: 1)")
    source.add_argument("--sideways-mm", type=parse_non_negative_number, metavar="N",
                        help="largest lateral displacement of the random motion, along x and y in both directions "
                        "(default: 0; with --reduced the size of its box of poses)")
    source.add_argument("--turn-deg", type=parse_non_negative_number, metavar="N",
                        help="largest rotation of the random motion, about any axis (default: 0; with --reduced the "
                        "size of its box of poses)")
    source.add_argument("--seed", type=make_integer_parser(0), metavar="N", default=0,
                        help="seed of the random motion (default: 0)")


def _add_timing_and_safety_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of timing, force limits, coupling and ring buffer."""
    timing = parser.add_argument_group("timing and safety")
    timing.add_argument("--spin-us", type=parse_non_negative_number, metavar="N", default=0.0,
                        help="busy-wait this long before each tick instead of sleeping: more exact ticks, but a higher "
                        "processor load (default: 0)")
    timing.add_argument("--budget-us", type=parse_non_negative_number, metavar="N", default=DEFAULTS.budget_us,
                        help="time limit of a simulation step; a step that reaches it returns the force of the last "
                        "equilibrium, extrapolated with its stiffness; 0: no limit (default: "
                        f"{DEFAULTS.budget_us:g})")
    timing.add_argument("--inertia", choices=("auto", "on", "off"), default="auto",
                        help="inertia of the tissue; auto: on where the tool is fast, but off with a coupling "
                        "(default: auto)")
    timing.add_argument("--no-real-time", action="store_true",
                        help="do not request real-time scheduling (SCHED_FIFO) and locked memory")
    timing.add_argument("--force-limit-N", type=parse_positive_number, metavar="N",
                        help=f"largest rendered force (default: {DEFAULTS.force_limit:g}, or the limit of the device)")
    timing.add_argument("--force-rate-N", type=parse_positive_number, metavar="N", default=DEFAULTS.force_rate,
                        help=f"largest change of the rendered force per tick (default: {DEFAULTS.force_rate:g})")
    timing.add_argument("--coupling-stiffness-N-m", type=parse_non_negative_number, metavar="N",
                        help="stiffness of the virtual coupling, a spring between device and tool; 0: no coupling "
                        f"(default: {DEFAULTS.coupling_stiffness:g} for a device with a force limit, otherwise 0)")
    timing.add_argument("--coupling-damping-N-s-m", type=parse_non_negative_number, metavar="N",
                        help=f"damping of the virtual coupling (default: {DEFAULTS.coupling_damping:g})")
    timing.add_argument("--passivity-damping-N-s-m", type=parse_non_negative_number, metavar="N",
                        help="largest damping of the passivity controller, which acts while the hand has received more "
                        "energy than it put in; 0: no controller (default: "
                        f"{DEFAULTS.passivity_damping:g} for a device with a force limit, otherwise 0)")
    timing.add_argument("--energy-limit-J", type=parse_positive_number, metavar="N",
                        help="switch the force off when the hand has received this much more energy than it put in "
                        f"(default: {DEFAULTS.energy_limit:g} for a device with a force limit, otherwise none)")
    timing.add_argument("--ring", type=Path, metavar="FILE",
                        help="file of the ring buffer, from which viewers and recorders read the ticks (default: a "
                        "temporary file in memory)")


def _run(arguments: Namespace) -> CommandResult | int:
    """Run the loop.

    Raises:
        InputError: flags that contradict each other, or values that scene, motion or device do not accept.
    """
    require_known_scene(arguments.scene)
    refuse_tilt_and_slip_correction_flags(arguments)
    name = arguments.device or arguments.motion or ("protocol" if arguments.protocol else "random")
    if arguments.device and arguments.motion:
        raise InputError("cannot be combined with --device. Give one of them", field="--motion")
    if name != "protocol" and arguments.protocol:
        raise InputError(f"applies only to --motion protocol; got the motion {name!r}. Leave one of the flags out",
                         field="--protocol")
    for flag in ("sideways_mm", "turn_deg"):
        if getattr(arguments, flag) is not None and name != "random":
            raise InputError("applies only to the random motion of the other flags; leave --motion and --device out, "
                             "or write random:sideways_mm=...,turn_deg=...", field="--" + flag.replace("_", "-"))
    reduced = load_reduced_model_and_set_flags(arguments)

    from haptics.loop.loop import LoopSettings
    from haptics.loop.multirate import make_real_time_tissue_factory
    from haptics.loop.process import LoopError, LoopProcess

    material = load_scene_material(arguments.material, reduced)
    protocol = make_protocol_from_flags(arguments)
    model = make_model_from_flags(arguments, material, reduced)
    settings = LoopSettings(seconds=arguments.seconds, spin=arguments.spin_us * 1e-6,
                            real_time=not arguments.no_real_time)
    if reduced:
        fill_motion_ranges_from_box_or_refuse(arguments, reduced)
    device = make_motion_or_haptic_device_from_flags(arguments, name, protocol,
                                                     lifts=reduced is None or reduced.lifting == 0)
    device.set_approach(model.experiment.approach)
    rendering = make_force_rendering_from_flags(arguments, device.largest_force)
    # With a coupling, inertia is stable in time; but if inertia makes most steps late, the force is up to six times too
    # large (docs/haptic_rendering.md).
    inertia = "off" if rendering.coupling is not None and arguments.inertia == "auto" else arguments.inertia
    make_tissue = make_real_time_tissue_factory(model, resolution=arguments.resolution, inertia=inertia,
                                                looks_ahead=rendering.coupling is not None,
                                                budget=arguments.budget_us * 1e-6 or None, solver=arguments.solver,
                                                mesh=reduced)
    process = LoopProcess(make_tissue, device, rendering, settings, ring_path=arguments.ring)
    try:
        report, interrupted = run_loop_and_tell_if_interrupted(process, arguments.seconds, quiet=arguments.json)
    except LoopError as error:
        print(f"tissue-sim: {error}", file=sys.stderr)
        return ExitCode.GOAL_MISSED
    return CommandResult(lambda: {"scene": arguments.scene, "motion": name, **report.as_json()},
                         lambda console: print_loop_report(report, console),
                         ExitCode.INTERRUPTED if interrupted else ExitCode.DONE)


def fill_motion_ranges_from_box_or_refuse(arguments, reduced) -> None:
    """Set ``sideways_mm`` and ``turn_deg`` of the arguments to the box of poses of a reduced model where they are None.

    A tilted tool moves sideways as it goes deeper, which leaves less of the box for lateral motion.

    Raises:
        InputError: the flags ask for a motion beyond the box.
    """
    box, approach = reduced.box, reduced.model.experiment.approach
    drift = abs(math.tan(approach.angle)) * box.depth if approach is not None else 0.0
    for name, size in (("sideways_mm", max(box.sideways - drift, 0.0) * 1e3), ("turn_deg", math.degrees(box.turn))):
        asked = getattr(arguments, name)
        if asked is None:
            setattr(arguments, name, size)
        elif asked > size * (1.0 + 1e-9):
            why = ", because a tilted tool moves sideways as it goes deeper" if drift and name == "sideways_mm" else ""
            raise InputError(f"must be at most {size:.4g} to stay in the box of poses of the reduced model{why}; got "
                             f"{asked:g}", field=f"--{name.replace('_', '-')}")


def make_motion_or_haptic_device_from_flags(arguments, name: str, protocol, *, lifts: bool = True):
    """Open the motion or the haptic device that moves the tool.

    Args:
        arguments: parsed arguments.
        name: name of the motion or device, with its settings.
        protocol: protocol of the motion ``protocol``.
        lifts: whether the motions ``random`` and ``sine`` lift the tool off the tissue.

    Raises:
        InputError: unknown motion or device, or invalid settings.
    """
    from haptics.devices.back_ends import make_haptic_device, make_motion
    from haptics.devices.motions import make_protocol_motion_repeated_if_closed

    if arguments.device:
        return make_haptic_device(name)
    if name == "protocol":
        return make_protocol_motion_repeated_if_closed(protocol)
    depth = f"depth_mm={arguments.depth_mm or MOTION_FLAGS.depth_mm!r}" + ("" if lifts else ",lift=0")
    motions_of_flags = {
        "random": f"random:{depth},top_speed_mm_s={arguments.top_speed_mm_s!r},seed={arguments.seed},"
                  f"sideways_mm={arguments.sideways_mm or 0.0!r},turn_deg={arguments.turn_deg or 0.0!r}",
        "sine": f"sine:{depth},frequency_hz={arguments.frequency_hz!r}"}
    return make_motion(motions_of_flags.get(name, name))


def make_force_rendering_from_flags(arguments, largest_force: float):
    """Return the force rendering of the flags: limits, virtual coupling, passivity controller and energy limit.

    Args:
        arguments: parsed arguments.
        largest_force: force limit of the device, N; infinite for motions and virtual devices.

    Raises:
        InputError: the force limit exceeds that of the device, or damping is given without coupling stiffness.
    """
    from haptics.safety.coupling import VirtualCoupling
    from haptics.safety.limits import ForceLimiter
    from haptics.safety.passivity import ReturnedEnergyCutoff
    from haptics.safety.rendering import ForceRendering

    limit = arguments.force_limit_N or DEFAULTS.force_limit
    if arguments.force_limit_N and limit > largest_force:
        raise InputError(f"must be at most {largest_force:g} N, the limit of the device; got {limit:g} N. Choose a "
                         "smaller limit, or raise the limit in the settings of the device", field="--force-limit-N")
    has_limit = math.isfinite(largest_force)

    def get_flag_or_device_default_or_zero(value: float | None, device_default: float) -> float:
        """Return the given value, else the default of a device with a force limit, else 0."""
        return value if value is not None else device_default if has_limit else 0.0

    stiffness = get_flag_or_device_default_or_zero(arguments.coupling_stiffness_N_m, DEFAULTS.coupling_stiffness)
    damping = arguments.coupling_damping_N_s_m
    if damping and not stiffness:
        raise InputError("requires a coupling. Add --coupling-stiffness-N-m", field="--coupling-damping-N-s-m")
    coupling = VirtualCoupling(stiffness, DEFAULTS.coupling_damping if damping is None else damping) \
        if stiffness else None
    passivity_damping = get_flag_or_device_default_or_zero(arguments.passivity_damping_N_s_m,
                                                           DEFAULTS.passivity_damping)
    energy_limit = arguments.energy_limit_J or (DEFAULTS.energy_limit if has_limit else math.inf)
    return ForceRendering(ForceLimiter(limit, arguments.force_rate_N), coupling,
                          controller_damping=passivity_damping or None, energy_limit=ReturnedEnergyCutoff(energy_limit))


def run_loop_and_tell_if_interrupted(process, seconds: float, *, quiet: bool):
    """Run the loop process to its end, with a status line on a terminal.

    Args:
        process: loop process, not started.
        seconds: planned duration, s.
        quiet: show no status line.

    Returns:
        Report of the loop, and whether Ctrl-C ended it.

    Raises:
        InputError, LoopError: the loop process ended early.
        KeyboardInterrupt: Ctrl-C before the first tick.
    """
    from haptics.loop.process import LoopError

    console = make_progress_console(quiet=quiet)
    with process, console.status("starting") as status:
        try:
            process.wait_until_ready(progress=status.update)
            with process.open_ring_reader() as ring:
                live = LoopStatusLine(ring, seconds)
                console.print(f"ring: {process.ring_path}", markup=False, soft_wrap=True)
                while (report := process.wait(_UPDATE_INTERVAL)) is None:
                    if not console.quiet:
                        status.update(live.format_status_line())
            return report, False
        except KeyboardInterrupt:
            # The loop may tick already although this process has not read the message yet.
            report = process.stop()
            if report is not None:
                return report, True
            if not process.ready:
                raise
            raise LoopError(f"stopped by Ctrl-C before the loop wrote a report: {process.message}") from None


class LoopStatusLine:
    """Status of a running loop in one line, read from its ring buffer without disturbing the loop.

    Args:
        ring: reader of the ring buffer.
        seconds: planned duration of the loop, s.
    """

    def __init__(self, ring: RingReader, seconds: float):
        self._ring, self._seconds, self._number = ring, seconds, 0

    def format_status_line(self) -> str:
        """Return the status line at every call; its quantiles are those of the ticks since the last call."""
        import numpy as np

        ticks = self._ring.read_ticks_after(self._number)
        self._number, records = ticks.number, ticks.records
        if not len(records):
            return "waiting for the next tick"
        newest = records[-1]
        compute, lateness = (np.quantile(records[name], 0.99) * 1e6 for name in ("compute_time", "lateness"))
        return (f"{newest['time']:.0f} of {self._seconds:g} s: {newest['tool_depth'] * 1e3:.2f} mm, "
                f"{newest['force']:.3f} N; p99 compute {compute:.0f}, lateness {lateness:.0f} us; "
                f"late {newest['late']}, missed {newest['missed']}")


def print_loop_report(report: LoopReport, console: Console) -> None:
    """Print the report of the loop: a table of lateness and compute time, then one sentence for each other result."""
    from rich.text import Text

    from haptics.loop.ticker import TICKER

    table = make_table_with_headings("", "p50", "p99", "p99.9", "max")
    answer = report.as_json()
    for title, key in (("lateness [us]", "lateness_us"), ("compute time [us]", "compute_us")):
        # As text: rich reads brackets as markup.
        table.add_row(Text(title), *(f"{value:.1f}" for value in answer[key].values()))
    console.print(table)
    print_sentence(console, f"{report.ticks} ticks in {report.seconds:.4g} s: {report.late} late (more than "
                   f"{TICKER.late * 1e3:g} ms), {report.missed} missed ({answer['missed_percent']:.3g} %)")
    answers = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in report.statuses.items() if count)
    if answers:
        print_sentence(console, f"simulation steps: {answers}")
    for name, count in report.flagged.items():
        if count:
            print_sentence(console, f"ticks {_FLAG_DESCRIPTIONS.get(name, name)}: {count}")
    if report.resolution not in ("", "own mesh"):
        error = "" if report.force_error is None else f", force error at most {100 * report.force_error:.2g} %"
        print_sentence(console, f"mesh: {report.resolution}{error}")
    print_sentence(console, f"largest force: {report.largest_force:.4g} N")
    if report.device.get("trouble"):
        print_sentence(console, f"the connection to the device was lost: {report.device['trouble']}")
    if report.peak_memory is not None:
        print_sentence(console, f"peak memory: {answer['peak_memory_MB']:.0f} MB")
    obtained = [feature.name for feature in report.real_time if feature.obtained]
    print_sentence(console, f"real time: {', '.join(obtained) if report.real_time else 'not requested'}")
    for feature in report.real_time:
        if not feature.obtained:
            print_sentence(console, f"real time: {feature.message}")


COMMAND = Command(
    "loop", "run the force loop at 1 kHz with a prescribed motion or a haptic device, and report its timing",
    "tissue-sim loop needle_indentation --material m.material.json --seconds 60 --motion random", _run,
    needs=(add_scene_and_optional_material_flag, _add_duration_flag, add_resolution_and_solver_flags, add_reduced_flag,
           _add_motion_source_flags, _add_timing_and_safety_flags, add_experiment_flags))
