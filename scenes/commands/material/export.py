"""`tissue-sim material export`: write a material in the format of another program."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    check_output_file,
)
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console


def _add_export_flags(parser: InputErrorArgumentParser) -> None:
    """Add the material file and the flags of the written file."""
    parser.add_argument("file", type=Path, metavar="FILE", help="material file NAME.material.json")
    parser.add_argument("--to", required=True, metavar="PROGRAM",
                        help="abaqus, calculix, febio, felupe, sofa, usd, or a program that an installed package adds")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="output file")
    parser.add_argument("--units", default="SI", metavar="NAME",
                        help="unit system of the file: SI, mm-N-MPa or mm-mN-kPa (default: %(default)s)")


def _export_material_file(arguments: Namespace) -> CommandResult:
    """Write a material in the format of another program.

    Raises:
        InputError: an unknown program or unit system, a material without an equivalent there, or an output file that
            cannot be written.
    """
    from tissue_sim import read_material_file
    from tissue_sim.exports import ExportContent, find_export_target
    from tissue_sim.exports.elastic_constants import linearise_material
    from tissue_sim.exports.unit_systems import find_unit_system
    from tissue_sim.files import write_text
    from tissue_sim.material.file import convert_material_file_to_json_data

    check_output_file(arguments.output, "-o", overwrite=arguments.overwrite)
    target, units = find_export_target(arguments.to), find_unit_system(arguments.units)
    if units.name not in target.unit_systems:
        raise InputError(f"must be {' or '.join(target.unit_systems)} for {target.title}; got {units.name}. Change the "
                         "unit system", field="--units")
    material_file = read_material_file(arguments.file)
    material = material_file.material
    content = ExportContent((material,), units, material_file=convert_material_file_to_json_data(material_file))
    if target.uses_elastic_constants:
        content = replace(content, constants=(linearise_material(material, target.max_poisson),), remarks=(
            "The elastic constants are those of the calibrated material at rest; their force error is unknown.",))
    try:
        text, remarks = target.write(content), target.list_file_remarks(content)
    except InputError as error:
        raise error.with_location(file=arguments.file) from None
    write_text(arguments.output, text)

    def print_file_and_remarks(console: Console) -> None:
        """Print the written file, and the remarks that the file states as comments."""
        for line in (f"wrote {arguments.output} for {target.title}, units {units.name}", *remarks):
            console.print(line, markup=False, soft_wrap=True)

    return CommandResult(lambda: {"file": str(arguments.output), "to": arguments.to, "units": units.name,
                                  "remarks": list(remarks)}, print_file_and_remarks)


EXPORT = Command("export", "convert a material file to the format of another program",
                 "tissue-sim material export m.material.json --to abaqus -o m.inp", _export_material_file,
                 needs=(add_json_flag, _add_export_flags, add_overwrite_flag))
