"""`tissue-sim record PROTOCOL.toml`: perform tests on a rig and write their recordings and a campaign."""

from __future__ import annotations

import math
import sys
import threading
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.commands.shared.command import Command, CommandResult, ExitCode
from scenes.commands.shared.console import make_progress_console, make_table_with_headings, print_sentence
from scenes.commands.shared.experiment_flags import load_material_or_study_silicone
from scenes.commands.shared.parsing import InputErrorArgumentParser
from tissue_sim.errors import InputError
from tissue_sim.signals import call_stop_at_signals

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.campaign.campaign import Test
    from haptics.devices.contracts import Bench
    from haptics.devices.virtual.rig import SpecimenForceModel, VirtualRig
    from haptics.recorder.plan import BenchTestPlan
    from haptics.recorder.recorder import RunProgress
    from haptics.recorder.run_folder import RunFolder
    from haptics.safety.motion_guard import MotionLimits
    from scenes.commands.record.protocol_file import ProtocolFile

#: Name of the campaign file in the folder of a run.
CAMPAIGN = "campaign.toml"
#: Device name of the virtual rig.
VIRTUAL = "virtual:"
#: Back-ends that are not coupled to real hardware.
_SIMULATED_BACK_ENDS = ("virtual", "replay")


def _add_protocol_and_run_flags(parser: InputErrorArgumentParser) -> None:
    """Add the protocol file, the folder of the run, and the flags of the motor and the dry run."""
    parser.add_argument("protocol", type=Path, metavar="PROTOCOL.toml",
                        help="campaign file with a protocol for each test and the tables [limits], [devices], [record] "
                        "and [virtual]")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR",
                        help="folder of the run; required without --dry-run")
    parser.add_argument("--test", metavar="NAME",
                        help="record only this test; required with real devices if the file has several tests, since "
                        "only one specimen and tool are mounted")
    parser.add_argument("--arm", action="store_true", help="allow the motor of a real stage to move")
    parser.add_argument("--dry-run", action="store_true",
                        help="print the motion, its duration and the stop conditions without starting a device")
    parser.add_argument("--resume", action="store_true",
                        help="record the missing recordings of an interrupted run; the stage is homed, and zero and "
                        "contact are checked again")


def _run(arguments: Namespace) -> CommandResult:
    """Record the tests, or plan them in a dry run; `ExitCode.GOAL_MISSED` if the run was stopped.

    Raises:
        InputError: an invalid protocol file, or flags that do not suit its tests and devices.
    """
    from scenes.commands.record.protocol_file import read_protocol_file

    protocol = read_protocol_file(arguments.protocol)
    tests = _find_test_or_list_all_tests(protocol, arguments.test)
    if arguments.dry_run:
        from haptics.recorder.plan import check_plans_and_compute_duration

        bench = make_unstarted_bench(protocol, tests[0])
        seconds = sum(check_plans_and_compute_duration([protocol.plans[test.name]], protocol.limits, bench.stage,
                                                       1.0 / bench.sensor.rate)
                      for test in tests)
        plans, used = [protocol.plans[test.name] for test in tests], protocol.devices
        devices = ("Devices: virtual rig; no motor moves." if uses_virtual_rig(protocol) else
                   f"Devices: sensor {used.sensor}, stage {used.stage}; the motor moves only with --arm.")
        return CommandResult(
            lambda: {"state": "planned", "seconds": seconds, "tests": [
                {"name": plan.name, "motion": plan.motion_summary, "replicates": plan.replicates} for plan in plans]},
            lambda console: print_recording_plans(plans, protocol.limits, bench, devices, seconds, console))
    if arguments.output is None:
        raise InputError("is required without --dry-run. Name the folder of the run with -o DIR", field="--output")
    virtual = uses_virtual_rig(protocol)
    if not virtual and not arguments.arm:
        raise InputError("is required, because a real motor moves. Check the motion with --dry-run, clear the path of "
                         "the stage, then add --arm", field="--arm")
    if not virtual and len(tests) > 1:
        raise InputError("is required, because only one test can be mounted. Name it: "
                         f"{', '.join(test.name for test in tests)}", field="--test")
    return _record_tests(arguments, protocol, tests)


def _find_test_or_list_all_tests(protocol: ProtocolFile, name: str | None) -> list[Any]:
    """Return the test of a name, or all tests for None.

    Raises:
        InputError: unknown name; the message names the nearest test.
    """
    tests = [test for test in protocol.campaign.tests if name in (None, test.name)]
    if not tests:
        from tissue_sim.errors import make_hint_with_similar_or_known_words

        raise InputError(
            f"unknown test {name!r}{make_hint_with_similar_or_known_words(str(name), list(protocol.plans))}",
            field="--test")
    return tests


def _record_tests(arguments: Namespace, protocol: ProtocolFile, tests: list[Any]) -> CommandResult:
    """Record the tests into the run folder.

    Args:
        arguments: parsed arguments.
        protocol: protocol file.
        tests: tests to record.

    Raises:
        InputError: the folder holds another run, or a run without ``--resume``.
    """
    from haptics.devices.contracts import DeviceError
    from haptics.recorder.guarded_motion import StoppedError
    from haptics.recorder.recorder import LiveProgressFile, Recorder
    from haptics.recorder.run_folder import RunFolder
    from tissue_sim import __version__

    folder = RunFolder(arguments.output, protocol.digest)
    if folder.has_started_run and not arguments.resume:
        raise InputError("contains a run already. Resume the run with --resume, or choose another folder",
                         file=arguments.output)
    about = {"program": f"tissue_sim {__version__}", "protocol": protocol.path.name,
             "protocol_sha256": protocol.digest, "devices": {"sensor": protocol.devices.sensor,
                                                             "stage": protocol.devices.stage}}
    stopped: str | None = None
    live = LiveProgressFile(arguments.output)
    with (folder, _watch_for_stop_request(arguments.json) as stop_request,
          _display_run_status(arguments.json) as show_status, live.run_writing_thread()):

        def publish_and_show_progress(moment: RunProgress) -> None:
            """Store the progress for the live file, and show it on the terminal."""
            live.set_progress(moment)
            show_status(moment)

        for test in tests:
            plan = protocol.plans[test.name]
            if not folder.list_missing_replicate_numbers(plan.name, plan.replicates):
                continue
            try:
                recorder = Recorder(make_unstarted_bench(protocol, test), plan, protocol.limits, folder, about=about,
                                    stop_request=stop_request, on_progress=publish_and_show_progress)
                # Copied before the motion starts, because a file may change or disappear during the run.
                for path in protocol.mesh_profile_and_rig_files:
                    folder.copy_input_file_once(path)
                recorder.run()
            except (StoppedError, DeviceError) as error:
                stopped = str(error)
                break
        if not stopped and not any(folder.list_missing_replicate_numbers(plan.name, plan.replicates)
                                   for plan in protocol.plans.values()):
            folder.update_state(state="complete")
        _write_campaign_file(protocol, folder)

    def print_state_and_stop(console: Console) -> None:
        """Print the state of the run, and on stderr the reason of a stop."""
        print_run_state(folder, console)
        if stopped:
            print(f"tissue-sim: {stopped}; the recordings are in {arguments.output}. Continue with --resume",
                  file=sys.stderr)

    return CommandResult(
        lambda: {"state": "stopped" if stopped else folder.state["state"], "message": stopped,
                 "folder": arguments.output, "recordings": folder.state["done"], "stops": folder.state["stops"],
                 "left_out": folder.state.get("left_out", {}),
                 "campaign": arguments.output / CAMPAIGN if folder.state["done"] else None},
        print_state_and_stop, ExitCode.GOAL_MISSED if stopped else ExitCode.DONE)


def _write_campaign_file(protocol: ProtocolFile, folder: RunFolder) -> None:
    """Write the campaign file of the finished recordings; without recordings write nothing."""
    from tissue_sim.files import write_text

    done = set(folder.state["done"])
    recordings = {name: [f"{name}_{number}.csv" for number in range(1, plan.replicates + 1)
                         if f"{name}_{number}.csv" in done] for name, plan in protocol.plans.items()}
    if any(recordings.values()):
        missing = [f"{name}_{number}.csv" for name, plan in protocol.plans.items()
                   for number in folder.list_missing_replicate_numbers(name, plan.replicates)]
        words = f"# Not recorded yet: {', '.join(missing)}.\n" if missing else ""
        write_text(folder.folder / CAMPAIGN,
                   words + protocol.make_campaign_text(recordings, folder.copy_input_file_once))


@contextmanager
def _watch_for_stop_request(quiet: bool) -> Iterator[Callable[[], str | None]]:
    """Watch for a request of the user to stop the run: Ctrl-C, SIGTERM, or Enter on a terminal.

    Args:
        quiet: do not read the keyboard (``--json``).

    Yields:
        Function that returns the reason of the first request, or None without a request.
    """
    requests: list[str] = []

    def append_stop_request_on_enter() -> None:
        """Wait for a line from the keyboard, then append a stop request."""
        sys.stdin.readline()
        requests.append("stopped at the keyboard")

    if not quiet and sys.stdin is not None and sys.stdin.isatty():
        threading.Thread(target=append_stop_request_on_enter, name="emergency stop", daemon=True).start()
    with call_stop_at_signals(lambda: requests.append("stopped by a signal (Ctrl-C, or the end of the session)"),
                              ignore_repeats=True):
        yield lambda: requests[0] if requests else None


@contextmanager
def _display_run_status(quiet: bool) -> Iterator[Callable[[RunProgress], None]]:
    """Show position, force and progress of the run on a terminal; elsewhere, or if `quiet`, show nothing.

    Yields:
        Function that displays a state of the run.
    """
    console = make_progress_console(quiet=quiet)
    if console.quiet:
        yield lambda progress: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console,
                  transient=True) as progress:
        task = progress.add_task("starting; press Enter to stop", total=1.0)

        def update_status_line(moment: RunProgress) -> None:
            """Show test, phase, position and force of the run on the terminal."""
            replicate = f" {moment.replicate}" if moment.replicate else ""
            progress.update(task, completed=moment.fraction, description=(
                f"{moment.test}{replicate} {moment.phase}: {moment.position * 1e3:7.3f} mm {moment.force:7.3f} N; "
                "press Enter to stop"))

        yield update_status_line


def print_recording_plans(plans: Sequence[BenchTestPlan], limits: MotionLimits, bench: Bench, devices: str,
                          seconds: float, console: Console) -> None:
    """Print the planned motion, its duration, the devices and the stop conditions.

    Args:
        plans: plans of the tests.
        limits: limits of the motion.
        bench: devices.
        devices: sentence on the devices.
        seconds: least duration of all recordings, s.
        console: console of the results.
    """
    table = make_table_with_headings("test", "motion", "recordings", "preconditioning", "duration", text=2)
    table.columns[1].no_wrap = False
    for plan in plans:
        table.add_row(plan.name, plan.motion_summary, f"{plan.replicates}", f"{plan.preconditioning}",
                      f"{plan.replicate_duration:.4g} s each")
    console.print(table)
    console.print()
    print_sentence(console, devices)
    print_sentence(console, f"Duration: at least {seconds:.0f} s, plus the time to find contact.")
    print_sentence(console, f"The run stops at a force above {limits.force:g} N, a position outside "
                   f"{limits.lowest * 1e3:g} to {limits.highest * 1e3:g} mm, a speed above "
                   f"{limits.speed * 1e3:g} mm/s, a duration above {limits.duration:g} s, a sensor that is "
                   f"saturated, faulty or silent for {limits.sensor_silence:g} s, or a fault of the stage. "
                   "After a stop the tool "
                   + ("retracts, unless the position of the stage is unreliable." if limits.retracts else
                      "stays where it is."))
    print_sentence(console, f"{_describe_motion_after_program_crash(bench.stage.runs_on)} "
                   + ("The encoder detects a stalled motor." if bench.stage.measures_position else
                      "A stalled motor is not detected, because the stage reports its commanded position."))


def _describe_motion_after_program_crash(seconds: float) -> str:
    """Describe the behaviour of the stage after a crash of the program; `seconds` is how long it can move on."""
    if seconds == 0.0:
        return "If this program crashes, the stage stops."
    return ("If this program crashes, the stage moves on to its target." if math.isinf(seconds) else
            f"If this program crashes, the stage moves on for at most {seconds:g} s.")


def print_run_state(folder: RunFolder, console: Console) -> None:
    """Print the recordings of a run, its stops and the next command."""
    state = folder.state
    print_sentence(console, f"{len(state['done'])} recordings in {folder.folder}: {', '.join(state['done']) or 'none'}")
    for name, left_out in state.get("left_out", {}).items():
        print_sentence(console, f"{name}: {left_out['samples']} samples are left out: {left_out['reason']}")
    for stop in state["stops"]:
        print_sentence(console, f"stopped ({stop['cause']}) in {stop['test']}, {stop['phase']}: {stop['message']}")
    if state["done"]:
        print_sentence(console, f"next: tissue-sim calibrate {folder.folder / 'campaign.toml'} -o OUT")


def uses_virtual_rig(protocol: ProtocolFile) -> bool:
    """Return whether the run uses the virtual rig.

    Raises:
        InputError: a virtual sensor with a real stage or vice versa (the sensor would not measure the specimen that the
            stage presses), a replayed sensor, or settings of the virtual rig outside ``[virtual]``.
    """
    sensor, stage = (name.partition(":")[0] for name in (protocol.devices.sensor, protocol.devices.stage))
    if (sensor in _SIMULATED_BACK_ENDS) != (stage in _SIMULATED_BACK_ENDS) or (sensor == "replay"):
        raise InputError(f"the sensor {sensor!r} cannot measure the specimen that the stage {stage!r} presses. Make "
                         "both virtual, or give the sensor at the tool", field="devices", file=protocol.path)
    for name, field in ((protocol.devices.sensor, "devices.sensor"), (protocol.devices.stage, "devices.stage")):
        if sensor == "virtual" and name != VIRTUAL:
            raise InputError(f"must be {VIRTUAL!r}; got {name!r}. Settings of the virtual rig belong under [virtual]",
                             field=field, file=protocol.path)
    return sensor == "virtual"


def make_unstarted_bench(protocol: ProtocolFile, test: Test) -> Bench:
    """Return the devices for a test, not started.

    Raises:
        InputError: an unknown device, or a specimen that cannot be simulated.
    """
    from haptics.devices.back_ends import make_sensor, make_stage
    from haptics.devices.contracts import Bench

    if not uses_virtual_rig(protocol):
        return Bench(make_sensor(protocol.devices.sensor), make_stage(protocol.devices.stage))
    return make_virtual_rig(protocol, test).bench


def make_virtual_rig(protocol: ProtocolFile, test: Test) -> VirtualRig:
    """Return the virtual rig of a test; its specimen has the material of ``[virtual]``.

    Raises:
        InputError: the test is not simulated with a tool, or an invalid material or rig file.
    """
    from haptics.devices.contracts import StageLimits
    from haptics.devices.virtual.faults import parse_faults
    from haptics.devices.virtual.rig import ElasticSpecimenForceModel, HistoryDependentForceModel, VirtualRig
    from tissue_sim import Model, Rig, load_rig

    table, limits, folder = protocol.virtual, protocol.limits, protocol.path.parent
    rig = Rig() if table.rig is None else load_rig(folder / table.rig)
    plan = protocol.plans[test.name]
    compliance = 0.0 if table.remembers else rig.compliance
    material = load_material_or_study_silicone(None if table.material is None else folder / table.material)
    if test.experiment is None:
        raise InputError("the kind of test has no tool, so that the virtual rig cannot perform it. Leave the test out",
                         field=test.place, file=protocol.path)
    model = Model(test.experiment, material, replace(Rig(), compliance=compliance))
    specimen: SpecimenForceModel = (HistoryDependentForceModel(model) if table.remembers else
                                    ElasticSpecimenForceModel(model, 1.05 * plan.largest_depth))
    surface = 0.0 if plan.contact == "here" else table.surface_mm * 1e-3
    return VirtualRig(specimen, rig, surface=surface,
                      limits=StageLimits(min(limits.lowest, -0.01), max(limits.highest, 0.01), limits.speed),
                      sign=plan.sign, rate=table.rate_Hz, reach=table.range_N, resolution=table.resolution_N,
                      encoder=table.encoder, faults=parse_faults(table.faults))


COMMAND = Command(
    "record", "record tests on real devices or a virtual rig: find contact, move along a protocol, measure the force",
    "tissue-sim record protocol.toml -o run --dry-run", _run, needs=(_add_protocol_and_run_flags,))
