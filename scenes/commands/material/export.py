"""`tissue-sim material export`: write a material in the format of another program."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    check_output_file,
)
from tissue_sim.errors import InputError


def _add_export_flags(parser: InputErrorArgumentParser) -> None:
    """Add the material file and the flags of the written file."""
    parser.add_argument("file", type=Path, metavar="FILE", help="material file NAME.material.json")
    parser.add_argument("--to", required=True, metavar="PROGRAM",
                        help="abaqus, or a program that an installed package adds")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="output file")
    parser.add_argument("--units", default="SI", metavar="NAME",
                        help="unit system of the file: SI, mm-N-MPa or mm-mN-kPa (default: %(default)s)")


def _export_material_file(arguments: Namespace) -> CommandResult:
    """Write a material in the format of another program.

    Raises:
        InputError: an unknown program or unit system, a material without an equivalent there, or an output file that
            cannot be written.
    """
    from tissue_sim import load_material
    from tissue_sim.exports import ExportContent, find_export_target
    from tissue_sim.exports.unit_systems import find_unit_system
    from tissue_sim.files import write_text

    check_output_file(arguments.output, "-o", overwrite=arguments.overwrite)
    target, units = find_export_target(arguments.to), find_unit_system(arguments.units)
    if units.name not in target.unit_systems:
        raise InputError(f"must be {' or '.join(target.unit_systems)} for {target.title}; got {units.name}. Change the "
                         "unit system", field="--units")
    material = load_material(arguments.file)
    try:
        text = target.write(ExportContent((material,), units))
    except InputError as error:
        raise error.with_location(file=arguments.file) from None
    write_text(arguments.output, text)
    return CommandResult(lambda: {"file": str(arguments.output), "to": arguments.to, "units": units.name},
                         lambda console: console.print(f"wrote {arguments.output} for {target.title}, units "
                                                       f"{units.name}", markup=False, soft_wrap=True))


EXPORT = Command("export", "convert a material file to the format of another program",
                 "tissue-sim material export m.material.json --to abaqus -o m.inp", _export_material_file,
                 needs=(add_json_flag, _add_export_flags, add_overwrite_flag))
