"""`tissue-sim devices`: list devices and report whether each can be opened."""

from __future__ import annotations

from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.parsing import InputErrorArgumentParser, add_json_flag

SUMMARY = "list force sensors, stages and haptic devices, and report which can be opened and why others cannot"
EXAMPLE = "tissue-sim devices --json"


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim devices`."""
    parser.add_argument("names", nargs="*", metavar="NAME",
                        help="devices to try, such as rdt://192.168.1.1 or tic:/dev/ttyACM0 (default: the devices that "
                        "are found)")
    add_json_flag(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    """Print the devices; `ExitCode.DONE` even if no device can be opened."""
    from haptics.devices.discovery import probe_devices
    from scenes.commands.shared.text_table import make_table_with_headings, print_sentence

    found = probe_devices(arguments.names)
    if arguments.json:
        print_json({"devices": [{"name": each.name, "kind": each.kind, "opens": each.opens, "says": each.details}
                                for each in found]})
        return ExitCode.DONE
    table = make_table_with_headings("device", "kind", "opens", "message", text=4)
    table.columns[3].no_wrap = False
    for each in found:
        table.add_row(each.name, each.kind, "yes" if each.opens else "no", each.details)
    console = make_results_console()
    console.print(table)
    if not arguments.names:
        console.print()
        print_sentence(console, "To try a device with settings, give its name:  tissue-sim devices "
                       "tic:/dev/ttyACM0,steps_per_mm=800")
    return ExitCode.DONE
