"""`tissue-sim material import`: write a material file from a file of another program."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    check_output_file,
)
from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words

if TYPE_CHECKING:
    from rich.console import Console

    from tissue_sim.material.material import Material

#: Suffix of a file -> its program, without --from.
_PROGRAMS = {".inp": "abaqus", ".feb": "febio"}


@dataclass(frozen=True)
class SoftMaterialRange:
    """Range of Young's modulus outside of which the unit system of an imported file is doubted.

    Attributes:
        min_young: Young's modulus of a very soft hydrogel, Pa.
        max_young: Young's modulus of a hard rubber, Pa.
    """

    min_young: float = 10.0
    max_young: float = 1e8


#: Range of all imports.
SOFT = SoftMaterialRange()


def _add_import_flags(parser: InputErrorArgumentParser) -> None:
    """Add the file of the other program, its unit system and the output file."""
    parser.add_argument("file", type=Path, metavar="FILE", help="file of the other program; may contain a whole model")
    parser.add_argument("--from", dest="program", metavar="PROGRAM",
                        help="abaqus, calculix or febio (default: by the suffix, .inp abaqus, .feb febio)")
    parser.add_argument("--units", required=True, metavar="NAME",
                        help="unit system of the file, which states none: SI, mm-N-MPa or mm-mN-kPa")
    parser.add_argument("--material", metavar="NAME", help="material of a file with several materials")
    parser.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT",
                        help="material file NAME.material.json")


def _import_material_file(arguments: Namespace) -> CommandResult:
    """Write a material file from a file of another program.

    Raises:
        InputError: an unknown program or unit system, a file or material that cannot be read, or an output file that
            cannot be written.
    """
    import tissue_sim as ts
    from tissue_sim.exports import find_export_target
    from tissue_sim.exports.unit_systems import find_unit_system
    from tissue_sim.files import decode_text_and_find_encoding, read_bytes

    check_output_file(arguments.output, "-o", overwrite=arguments.overwrite, suffixes=(".material.json",))
    path = arguments.file
    program = arguments.program or _PROGRAMS.get(path.suffix.lower())
    if program is None:
        raise InputError(f"must be given for a file that does not end in {' or '.join(_PROGRAMS)}.", field="--from")
    target, units = find_export_target(program, "--from"), find_unit_system(arguments.units)
    expected = f"a file of {target.title} with a material"
    text, _ = decode_text_and_find_encoding(read_bytes(path, expected), path, expected)
    with located_and_converted_errors(file=path):
        sections = target.split_materials(text)
        name = _choose_name(sections, arguments.material)
        imported = target.read_material(sections[name], units)
    material = imported.material
    ts.write_material_file(ts.MaterialFile.of(material, provenance={
        "method": "import", "settings": {"file": path.name, "from": program, "units": units.name, "material": name}}),
        arguments.output)
    warnings = _list_warnings(material)

    def print_moduli(console: Console) -> None:
        """Print the written file, the moduli by which a wrong unit is noticed, and remarks; warnings on stderr."""
        console.print(f"wrote {arguments.output}: {material.law} {name!r}, units {units.name}, E0 "
                      f"{material.E0 / 1e3:.6g} kPa, mu0 {material.mu0 / 1e3:.6g} kPa", markup=False, soft_wrap=True)
        for remark in imported.remarks:
            console.print(remark, markup=False, soft_wrap=True)
        for warning in warnings:
            print(f"tissue-sim: warning: {warning}", file=sys.stderr)

    return CommandResult(lambda: {
        "material_file": str(arguments.output), "from": program, "units": units.name, "material": name,
        "law": material.law, "E0_kPa": material.E0 / 1e3, "mu0_kPa": material.mu0 / 1e3,
        "remarks": list(imported.remarks), "warnings": warnings}, print_moduli)


def _choose_name(names: Collection[str], wanted: str | None) -> str:
    """Return the name of the material to import; upper and lower case are the same unless two names differ in them.

    Raises:
        InputError: the file has several materials and `wanted` is None, or it has no such material.
    """
    if wanted is None:
        if len(names) > 1:
            raise InputError(f"must be given for a file with {len(names)} materials: {', '.join(names)}.",
                             field="--material")
        return next(iter(names))
    found = [name for name in names if name == wanted] or [name for name in names if name.upper() == wanted.upper()]
    if len(found) != 1:
        raise InputError(f"the file has no material {wanted!r}{make_hint_with_similar_or_known_words(wanted, names)}",
                         field="--material")
    return found[0]


def _list_warnings(material: Material) -> list[str]:
    """Return warnings about a material with an unusual Young's modulus or bulk modulus."""
    warnings = []
    if not SOFT.min_young <= material.E0 <= SOFT.max_young:
        warnings.append(f"E0 = {material.E0 / 1e3:.4g} kPa is outside {SOFT.min_young / 1e3:g} to "
                        f"{SOFT.max_young / 1e3:g} kPa, the range of soft materials. Check --units")
    if not material.is_bulk_ratio_verified:
        low, high = material.bulk.verified_ratios
        warnings.append(f"K / mu0 = {material.bulk_modulus / material.mu0:.4g} is outside {low:g} to {high:g}, the "
                        "verified range of the finite elements")
    return warnings


IMPORT = Command("import", "convert a material of another program to a material file",
                 "tissue-sim material import job.inp --units mm-N-MPa -o m.material.json", _import_material_file,
                 needs=(add_json_flag, _add_import_flags, add_overwrite_flag))
