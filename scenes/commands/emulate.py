"""`tissue-sim emulate NAME...`: devices that are not there, on real sockets and terminals."""

from __future__ import annotations

import threading
from typing import Any

from scenes.commands.shared.console import print_json, results_console
from scenes.commands.shared.parsing import Parser, add_json, positive
from scenes.stop_signals import stopped_by_signals

SUMMARY = "play devices that are not there: sensor, stage and hand by their real protocols, with faults on request"
EXAMPLE = "tissue-sim emulate rdt tic --faults loss=0.02 --seconds 60"
_NAMES = "rdt, ati-serial, tic, grbl, haply"


def add_arguments(parser: Parser) -> None:
    parser.add_argument("names", nargs="+", metavar="NAME[:SETTINGS]",
                        help=f"of {_NAMES}, or what a package adds; several share one virtual rig, so that what "
                             "the stage presses is what the sensor feels")
    parser.add_argument("--faults", default="", metavar="NAME=NUMBER,...",
                        help="loss, duplicate, reorder, garble (shares), delay_ms, disconnect_after_s, "
                             "saturate_after_s, stall_after_s, drift_N_per_s, seed")
    parser.add_argument("--rate-hz", type=positive, metavar="N", default=1000.0,
                        help="of the sensor (default: %(default)g)")
    parser.add_argument("--seconds", type=positive, metavar="N", help="how long (default: until Ctrl-C)")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    from contextlib import ExitStack

    from haptics.devices.contracts import DeviceError
    from haptics.devices.virtual.faults import read_faults
    from haptics.emulators.emulator import open_emulator

    faults = read_faults(arguments.faults)
    bench = _study_rig(arguments.rate_hz, faults).bench
    emulators = [open_emulator(name, bench, faults) for name in arguments.names]
    ending = threading.Event()
    with ExitStack() as stack, stopped_by_signals(ending.set):
        try:
            for emulator in emulators:
                stack.enter_context(emulator)
        except DeviceError as error:
            from tissue_sim.errors import InputError

            raise InputError(str(error)) from None
        addresses = {emulator.name: emulator.address for emulator in emulators}
        if arguments.json:
            print_json({"emulators": addresses})
        else:
            console = results_console()
            for name, address in addresses.items():
                console.print(f"{name}: open it as {address}", highlight=False)
            console.print("behind sensor and stage: the study's needle, 2 mm above its phantom where the stage is at "
                          "its zero", soft_wrap=True)
            console.print("Ctrl-C ends it" + (f", or {arguments.seconds:g} s" if arguments.seconds else ""))
        import sys

        sys.stdout.flush()
        ending.wait(arguments.seconds)
    return 0


def _study_rig(rate: float, faults: Any) -> Any:
    """The study's needle in its phantom."""
    import tissue_sim as ts
    from haptics.devices.virtual.rig import ElasticSpecimen, VirtualRig
    from scenes.commands.shared.tissue_flags import read_material

    needle = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(10e-3), tool=ts.Tool("flat", radius=8e-3),
        friction="bonded")
    return VirtualRig(ElasticSpecimen(ts.Model(needle, read_material(None), ts.Rig()), 10e-3), ts.Rig(force_noise=0.02),
                      channels=("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), rate=rate, faults=faults)
