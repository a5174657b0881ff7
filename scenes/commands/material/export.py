"""`tissue-sim material export`: write a material in the format of another program."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.material.match import (
    add_match_flags,
    find_export_content,
    make_comparison_json_object,
    print_comparison,
)
from scenes.commands.shared.command import Command, CommandResult, ExitCode
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    check_output_file,
)
from tissue_sim.errors import InputError, located_and_converted_errors

if TYPE_CHECKING:
    from rich.console import Console


def _add_export_flags(parser: InputErrorArgumentParser) -> None:
    """Add the material file and the flags of the written file."""
    parser.add_argument("file", type=Path, metavar="FILE", help="material file NAME.material.json")
    parser.add_argument("--to", required=True, metavar="PROGRAM",
                        help="abaqus, calculix, febio, felupe, mujoco, newton, sofa, usd, or a program that an "
                        "installed package adds")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="output file")
    parser.add_argument("--units", default="SI", metavar="NAME",
                        help="unit system of the file: SI, mm-N-MPa or mm-mN-kPa (default: %(default)s)")


def _export_material_file(arguments: Namespace) -> CommandResult:
    """Write a material in the format of another program.

    Raises:
        InputError: an unknown program or unit system, a material without an equivalent there, a test that the program
            cannot run, or an output file that cannot be written.
        ConvergenceError: the calibrated test of ``--match`` did not converge.
    """
    from tissue_sim import read_material_file
    from tissue_sim.exports import ExportContent, find_export_target
    from tissue_sim.exports.unit_systems import find_unit_system
    from tissue_sim.files import write_text
    from tissue_sim.material.file import convert_material_file_to_json_data

    check_output_file(arguments.output, "-o", overwrite=arguments.overwrite)
    check_output_file(arguments.figure, "--figure", overwrite=arguments.overwrite, suffixes=(".png", ".svg", ".pdf"))
    target, units = find_export_target(arguments.to), find_unit_system(arguments.units)
    if units.name not in target.unit_systems:
        raise InputError(f"must be {' or '.join(target.unit_systems)} for {target.title}; got {units.name}. Change the "
                         "unit system", field="--units")
    file = read_material_file(arguments.file)
    with located_and_converted_errors(file=arguments.file):
        target.require_available_parts(file.material)
    found = find_export_content(arguments, target, file)
    content = ExportContent(found.materials, units, found.constants, found.remarks, found.mesh,
                            convert_material_file_to_json_data(file))
    with located_and_converted_errors(file=arguments.file):
        text, remarks = target.write(content), target.list_file_remarks(content)
    write_text(arguments.output, text)
    if arguments.figure is not None and found.comparison is not None:
        from scenes.figures import draw_target_comparison

        draw_target_comparison(found.comparison, target.title, arguments.figure)

    def print_text(console: Console) -> None:
        """Print the comparison, the further remarks that the file states as comments, and the written file."""
        print_comparison(found, console)
        for line in (*(remark for remark in remarks if remark not in found.remarks),
                     f"wrote {arguments.output} for {target.title}, units {units.name}"):
            console.print(line, markup=False, soft_wrap=True)

    reached = found.comparison is None or found.comparison.reaches_all_depths
    return CommandResult(lambda: {"file": str(arguments.output), "to": arguments.to, "units": units.name,
                                  "remarks": list(remarks), **make_comparison_json_object(found)}, print_text,
                         ExitCode.DONE if reached else ExitCode.GOAL_MISSED)


EXPORT = Command("export", "convert a material file to the format of another program",
                 "tissue-sim material export m.material.json --to abaqus -o m.inp", _export_material_file,
                 needs=(add_json_flag, _add_export_flags, add_match_flags, add_overwrite_flag))
