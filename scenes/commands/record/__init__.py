"""`tissue-sim record PROTOCOL.toml`: move a stage, measure, and write recordings that calibrate."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.parsing import Parser, add_json
from scenes.stop_signals import stopped_by_signals
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from haptics.recorder.recorder import RunProgress
    from haptics.recorder.run_folder import RunFolder
    from scenes.commands.record.protocol_file import ProtocolFile

SUMMARY = "record an experiment: find contact, move by a protocol, measure; on a virtual rig or on real devices"
EXAMPLE = "tissue-sim record protocol.toml -o run --dry-run"
CAMPAIGN = "campaign.toml"


def add_arguments(parser: Parser) -> None:
    parser.add_argument("protocol", type=Path, metavar="PROTOCOL.toml",
                        help="a campaign file whose tests have a protocol each, with [limits], [devices], [record] and "
                             "[virtual]")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="folder of the run; needed but for --dry-run")
    parser.add_argument("--test", metavar="NAME", help="record this test only; with real devices the specimen and the "
                                                       "tool of one test are mounted at a time")
    parser.add_argument("--arm", action="store_true", help="let a real motor move")
    parser.add_argument("--dry-run", action="store_true", help="print the motion, how long it takes and what would "
                                                               "stop it; nothing is started")
    parser.add_argument("--resume", action="store_true",
                        help="go on with the recordings that are missing: homes again, checks zero and contact")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    from scenes.commands.record.bench import is_virtual, open_bench
    from scenes.commands.record.protocol_file import read_protocol_file
    from scenes.commands.record.results import print_plans, print_run

    protocol = read_protocol_file(arguments.protocol)
    tests = _chosen(protocol, arguments.test)
    console = results_console(quiet=arguments.json)
    if arguments.dry_run:
        from haptics.recorder.plan import check_plans

        bench = open_bench(protocol, tests[0])
        seconds = sum(check_plans([protocol.plans[test.name]], protocol.limits, bench.stage, 1.0 / bench.sensor.rate)
                      for test in tests)
        if arguments.json:
            print_json({"state": "planned", "seconds": seconds, "tests": [
                {"name": test.name, "motion": protocol.plans[test.name].title,
                 "replicates": protocol.plans[test.name].replicates} for test in tests]})
        else:
            used = protocol.devices
            devices = ("On the virtual rig; nothing real moves." if is_virtual(protocol) else
                       f"Sensor {used.sensor}, stage {used.stage}; a real motor moves, with --arm only.")
            print_plans([protocol.plans[test.name] for test in tests], protocol.limits, bench, devices, seconds,
                        console)
        return 0
    if arguments.output is None:
        raise InputError("name the folder of the run with -o DIR", field="--output")
    virtual = is_virtual(protocol)
    if not virtual and not arguments.arm:
        raise InputError("this moves a real motor; look at --dry-run first, clear its way, and give --arm",
                         field="--arm")
    if not virtual and len(tests) > 1:
        raise InputError(f"one test is mounted at a time; name it with --test, one of "
                         f"{', '.join(test.name for test in tests)}", field="--test")
    return _record(arguments, protocol, tests, console, print_run)


def _chosen(protocol: ProtocolFile, name: str | None) -> list[Any]:
    tests = [test for test in protocol.campaign.tests if name in (None, test.name)]
    if not tests:
        from tissue_sim.errors import nearest

        raise InputError(f"no test {name!r}{nearest(str(name), list(protocol.plans))}", field="--test")
    return tests


def _record(arguments, protocol: ProtocolFile, tests: list[Any], console: Console,
            show: Callable[[RunFolder, Console], None]) -> int:
    from haptics.devices.contracts import DeviceError
    from haptics.recorder.guarded_motion import StoppedError
    from haptics.recorder.live import LiveFile
    from haptics.recorder.recorder import Recorder
    from haptics.recorder.run_folder import RunFolder
    from scenes.commands.record.bench import open_bench
    from tissue_sim import __version__

    folder = RunFolder(arguments.output, protocol.digest)
    if folder.is_begun and not arguments.resume:
        raise InputError("holds a run already; go on with it by --resume, or choose another folder",
                         file=arguments.output)
    about = {"program": f"tissue_sim {__version__}", "protocol": protocol.path.name,
             "protocol_sha256": protocol.digest, "devices": {"sensor": protocol.devices.sensor,
                                                             "stage": protocol.devices.stage}}
    stopped: str | None = None
    live = LiveFile(arguments.output)
    with folder, _wishes_to_stop(arguments.json) as asked, _shown(arguments.json) as show_here, live.publish():

        def watch(progress: RunProgress) -> None:
            live.show(progress)
            show_here(progress)

        for test in tests:
            plan = protocol.plans[test.name]
            if not folder.missing_replicates(plan.name, plan.replicates):
                continue
            try:
                recorder = Recorder(open_bench(protocol, test), plan, protocol.limits, folder, about=about,
                                    stop_request=asked, on_progress=watch)
                # Before anything moves: a file may change, or vanish, while the run goes.
                for path in protocol.files:
                    folder.copy_file(path)
                recorder.run()
            except (StoppedError, DeviceError) as error:
                stopped = str(error)
                break
        if not stopped and not any(folder.missing_replicates(plan.name, plan.replicates)
                                   for plan in protocol.plans.values()):
            folder.update(state="complete")
        _write_campaign(protocol, folder)
    if arguments.json:
        print_json({"state": "stopped" if stopped else folder.state["state"], "message": stopped,
                    "folder": arguments.output,
                    "recordings": folder.state["done"], "stops": folder.state["stops"],
                    "campaign": arguments.output / CAMPAIGN if folder.state["done"] else None})
    else:
        show(folder, console)
    if stopped:
        if not arguments.json:
            print(f"tissue-sim: {stopped}; what was recorded is in {arguments.output}, and --resume goes on",
                  file=sys.stderr)
        return 1
    return 0


def _write_campaign(protocol: ProtocolFile, folder: RunFolder) -> None:
    """The campaign of all that was recorded so far."""
    from tissue_sim.atomic_write import write_text

    done = set(folder.state["done"])
    recordings = {name: [f"{name}_{number}.csv" for number in range(1, plan.replicates + 1)
                         if f"{name}_{number}.csv" in done] for name, plan in protocol.plans.items()}
    if any(recordings.values()):
        missing = [f"{name}_{number}.csv" for name, plan in protocol.plans.items()
                   for number in folder.missing_replicates(name, plan.replicates)]
        words = f"# Not recorded yet, and not in here: {', '.join(missing)}.\n" if missing else ""
        write_text(folder.folder / CAMPAIGN, words + protocol.campaign_text(recordings, folder.copy_file))


@contextmanager
def _wishes_to_stop(quiet: bool) -> Iterator[Callable[[], str | None]]:
    """What somebody says who wants it to end: Ctrl-C, SIGTERM, or Enter at a terminal."""
    said: list[str] = []

    def listen() -> None:
        sys.stdin.readline()
        said.append("stopped at the keyboard")

    if not quiet and sys.stdin is not None and sys.stdin.isatty():
        threading.Thread(target=listen, name="emergency stop", daemon=True).start()
    with stopped_by_signals(lambda: said.append("stopped by a signal (Ctrl-C, or the end of the session)"),
                            patient=True):
        yield lambda: said[0] if said else None


@contextmanager
def _shown(quiet: bool) -> Iterator[Callable[[RunProgress], None]]:
    """Numbers as they come, and how far the run is; nothing where nobody looks."""
    console = progress_console(quiet=quiet)
    if console.quiet:
        yield lambda progress: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console,
                  transient=True) as progress:
        task = progress.add_task("starting; Enter stops", total=1.0)

        def watch(moment: RunProgress) -> None:
            replicate = f" {moment.replicate}" if moment.replicate else ""
            progress.update(task, completed=moment.fraction, description=(
                f"{moment.test}{replicate} {moment.phase}: {moment.position * 1e3:7.3f} mm {moment.force:7.3f} N; "
                "Enter stops"))

        yield watch
