"""`tissue-sim devices`: list devices and report whether each can be opened."""

from __future__ import annotations

from argparse import Namespace
from typing import TYPE_CHECKING

from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.console import make_table_with_headings, print_sentence
from scenes.commands.shared.parsing import InputErrorArgumentParser

if TYPE_CHECKING:
    from rich.console import Console


def _add_device_names(parser: InputErrorArgumentParser) -> None:
    """Add the argument of the devices."""
    parser.add_argument("names", nargs="*", metavar="NAME",
                        help="devices to try, such as rdt://192.168.1.1 or tic:/dev/ttyACM0 (default: the devices that "
                        "are found)")


def _run(arguments: Namespace) -> CommandResult:
    """Print the devices; `ExitCode.DONE` even if no device can be opened."""
    from haptics.devices.back_ends import probe_devices

    found = probe_devices(arguments.names)

    def print_table(console: Console) -> None:
        """Print the table of the devices, and a hint if none was named."""
        table = make_table_with_headings("device", "kind", "opens", "message", text=4)
        table.columns[3].no_wrap = False
        for each in found:
            table.add_row(each.name, each.kind, "yes" if each.opens else "no", each.details)
        console.print(table)
        if not arguments.names:
            console.print()
            print_sentence(console, "To try a device with settings, give its name:  tissue-sim devices "
                           "tic:/dev/ttyACM0,steps_per_mm=800")

    return CommandResult(lambda: {"devices": [{"name": each.name, "kind": each.kind, "opens": each.opens,
                                               "says": each.details} for each in found]}, print_table)


COMMAND = Command("devices",
                  "list force sensors, stages and haptic devices, and report which can be opened and why others cannot",
                  "tissue-sim devices --json", _run, needs=(_add_device_names,))
