"""`tissue-sim emulate NAME...`: emulate devices on network sockets and pseudo-terminals."""

from __future__ import annotations

import sys
import threading
from argparse import Namespace
from typing import Any

from scenes.commands.shared.command import Command, ExitCode
from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.parsing import InputErrorArgumentParser, parse_positive_number
from tissue_sim.signals import call_stop_at_signals

#: Emulators for the help, which imports no emulator.
_NAMES = "rdt, ati-serial, tic, grbl, haply"


def _add_emulator_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of emulated devices, faults, rate and duration."""
    parser.add_argument("names", nargs="+", metavar="NAME[:SETTINGS]",
                        help=f"emulated device: {_NAMES}, or an emulator of an installed package; all devices share "
                        "one virtual rig, so that the sensor measures the specimen that the stage presses")
    parser.add_argument("--faults", default="", metavar="NAME=NUMBER,...",
                        help="faults of the devices: loss, duplicate, reorder, garble (fraction of the packets), "
                        "delay_ms, disconnect_after_s, saturate_after_s, stall_after_s, drift_N_per_s, seed")
    parser.add_argument("--rate-hz", type=parse_positive_number, metavar="N", default=1000.0,
                        help="sampling rate of the sensor (default: %(default)g)")
    parser.add_argument("--seconds", type=parse_positive_number, metavar="N", help="duration (default: until Ctrl-C)")


def _run(arguments: Namespace) -> int:
    """Emulate the devices until Ctrl-C or the end of the duration.

    Raises:
        InputError: an unknown emulator or fault, or an address that cannot be used.
    """
    from contextlib import ExitStack

    from haptics.devices.contracts import DeviceError
    from haptics.devices.virtual.faults import parse_faults
    from haptics.emulators.emulator import make_emulator

    faults = parse_faults(arguments.faults)
    bench = _make_virtual_reference_study_rig(arguments.rate_hz, faults).bench
    emulators = [make_emulator(name, bench, faults) for name in arguments.names]
    stop = threading.Event()
    with ExitStack() as stack, call_stop_at_signals(stop.set):
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
            console = make_results_console()
            for name, address in addresses.items():
                console.print(f"{name}: its address is {address}", highlight=False)
            console.print("virtual rig: the needle of the reference study, 2 mm above its silicone specimen when the "
                          "stage is at zero", soft_wrap=True)
            after = f" (automatic end after {arguments.seconds:g} s)" if arguments.seconds else ""
            console.print(f"Ctrl-C ends the emulation{after}")
        sys.stdout.flush()
        stop.wait(arguments.seconds)
    return ExitCode.DONE


def _make_virtual_reference_study_rig(rate: float, faults: Any) -> Any:
    """Return a virtual rig with the needle and the silicone specimen of the reference study.

    Args:
        rate: sampling rate of the sensor, Hz.
        faults: faults of the devices (`haptics.devices.virtual.faults.Faults`).
    """
    import tissue_sim as ts
    from haptics.devices.virtual.rig import ElasticSpecimenForceModel, VirtualRig
    from scenes.commands.shared.experiment_flags import load_material_or_study_silicone

    needle = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(10e-3), tool=ts.Tool("flat", radius=8e-3),
        friction="bonded")
    return VirtualRig(ElasticSpecimenForceModel(ts.Model(needle, load_material_or_study_silicone(None), ts.Rig()),
                                                10e-3),
                      ts.Rig(force_noise=0.02),
                      channels=("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), rate=rate, faults=faults)


COMMAND = Command("emulate",
                  "emulate force sensors, stages and a haptic device with their own protocols, and faults on request",
                  "tissue-sim emulate rdt tic --faults loss=0.02 --seconds 60", _run, needs=(_add_emulator_flags,))
