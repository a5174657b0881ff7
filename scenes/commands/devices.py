"""`tissue-sim devices`: what could be opened here, and why the rest could not."""

from __future__ import annotations

from scenes.commands.shared.console import print_json, results_console
from scenes.commands.shared.parsing import Parser, add_json

SUMMARY = "list the sensors, stages and haptic devices that could be opened here, and why the rest could not"
EXAMPLE = "tissue-sim devices --json"


def add_arguments(parser: Parser) -> None:
    parser.add_argument("names", nargs="*", metavar="NAME",
                        help="devices to try, such as rdt://192.168.1.1 or tic:/dev/ttyACM0 (default: what "
                             "can be found)")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    from haptics.devices.discovery import find_devices
    from scenes.commands.shared.text_table import print_sentence, text_table

    found = find_devices(arguments.names)
    if arguments.json:
        print_json({"devices": [{"name": each.name, "kind": each.kind, "opens": each.opens, "says": each.details}
                                for each in found]})
        return 0
    table = text_table("device", "kind", "opens", "says", text=4)
    table.columns[3].no_wrap = False
    for each in found:
        table.add_row(each.name, each.kind, "yes" if each.opens else "no", each.details)
    console = results_console()
    console.print(table)
    if not arguments.names:
        console.print()
        print_sentence(console, "One with settings is tried by its name:  tissue-sim devices "
                                "tic:/dev/ttyACM0,steps_per_mm=800")
    return 0
