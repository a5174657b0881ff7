"""`tissue-sim material new|show|check|export|import`: write, print, check and convert material files."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from scenes.commands.material.export import EXPORT
from scenes.commands.material.importing import IMPORT
from scenes.commands.shared.command import Command, CommandResult, ExitCode
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    check_output_file,
    parse_positive_number,
)
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from tissue_sim.material.material import Material
    from tissue_sim.material.viscoelasticity import Prony


def _add_new_material_flags(new: InputErrorArgumentParser) -> None:
    """Add the flags of ``material new``."""
    new.add_argument("--law", required=True,
                     help="material law: neo_hooke, mooney_rivlin, reduced_polynomial_1 to _3 (3: yeoh), biderman, "
                     "gent, arruda_boyce, fung_demiray, ogden_1 to _4, hyperfoam_1 to _3, or a law of an installed "
                     "package")
    new.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE",
                     help="value of a parameter of the law, in Pa (exponents without unit); once for each parameter")
    bulk = new.add_mutually_exclusive_group()
    bulk.add_argument("--bulk-ratio", type=parse_positive_number, metavar="N",
                      help="bulk modulus K over shear modulus mu0, 2 to 1e6")
    bulk.add_argument("--bulk-modulus-pa", type=parse_positive_number, metavar="N",
                      help="bulk modulus K in Pa, 2 to 1e6 times mu0")
    bulk.add_argument("--incompressible", action="store_true", help="incompressible material (default, except of "
                      "the hyperfoam laws, which state the bulk modulus)")
    new.add_argument("--prony", action="append", default=[], metavar="G,TAU_S",
                     help="term of a Prony series: fraction of the instantaneous modulus that relaxes, and relaxation "
                     "time in s; once for each of 1 to 13 terms")
    new.add_argument("--moduli", choices=("instantaneous", "long_term"), default="instantaneous",
                     help="whether the parameters of a law with --prony are instantaneous or long-term moduli "
                     "(default: %(default)s)")
    new.add_argument("--region", action="append", default=[], metavar="NAME=FILE",
                     help="material of a named region of the specimen mesh, from another material file; its parameters "
                     "are copied without standard errors; once for each region")
    new.add_argument("--name", default="", help="name of the material")
    new.add_argument("--density-kg-m3", type=parse_positive_number, metavar="N", help="density of the material")
    new.add_argument("-o", dest="output", type=Path, required=True, metavar="FILE",
                     help="material file NAME.material.json")


def _add_material_file(parser: InputErrorArgumentParser) -> None:
    """Add the material file of the other actions."""
    parser.add_argument("file", type=Path, metavar="FILE", help="material file NAME.material.json")


def _write_new_material(arguments: Namespace) -> CommandResult:
    """Write a material file from the parameters of the flags.

    Raises:
        InputError: invalid parameters, or an output file that cannot be written.
    """
    import tissue_sim as ts

    check_output_file(arguments.output, "-o", overwrite=arguments.overwrite, suffixes=(".material.json",))
    if arguments.bulk_ratio is not None:
        bulk = ts.Bulk("bulk_ratio", arguments.bulk_ratio)
    elif arguments.bulk_modulus_pa is not None:
        bulk = ts.Bulk("K_Pa", arguments.bulk_modulus_pa)
    else:
        bulk = ts.Bulk()
    material = ts.Material(arguments.law, parse_parameter_settings(arguments.settings), bulk,
                           density=arguments.density_kg_m3,
                           name=arguments.name,
                           viscoelastic=parse_prony_series_or_none(arguments.prony, arguments.moduli),
                           regions=load_region_materials(arguments.region))
    if arguments.incompressible and material.bulk.kind == "of_law":
        raise InputError(f"must not be given for {material.law}, whose parameters state the volumetric response. Leave "
                         "it out", field="--incompressible")
    require_verified_bulk_ratio(material, "--bulk-ratio" if arguments.bulk_ratio is not None else "--bulk-modulus-pa")
    ts.write_material_file(ts.MaterialFile.of(material), arguments.output)

    def print_moduli(console: Console) -> None:
        """Print the written file and the moduli of the material."""
        from calibration.report.quantities import format_pressure

        relaxed = "" if material.viscoelastic is None else f", long-term mu {format_pressure(material.mu_long_term)}"
        console.print(f"wrote {arguments.output}: E0 {format_pressure(material.E0)}, "
                      f"mu0 {format_pressure(material.mu0)}{relaxed}", markup=False, soft_wrap=True)

    return CommandResult(lambda: {"material_file": str(arguments.output)}, print_moduli)


def require_verified_bulk_ratio(material, option: str) -> None:
    """Raise an error if a stated ratio K / mu0 of a material is outside the verified range of the finite elements.

    The bulk modulus of a compressible law follows from its parameters; the solvers and not the file restrict it.

    Args:
        material: new material.
        option: command line option that states the bulk modulus, for the error message.

    Raises:
        InputError: K / mu0 is outside `tissue_sim.Bulk.verified_ratios`.
    """
    if material.bulk.value is not None and not material.is_bulk_ratio_verified:
        low, high = material.bulk.verified_ratios
        pressures = "" if option == "--bulk-ratio" else f" ({low * material.mu0:.4g} to {high * material.mu0:.4g} Pa)"
        raise InputError(f"K / mu0 must be {low:g} to {high:g}{pressures}, the verified range of the finite elements; "
                         f"got {material.bulk_modulus / material.mu0:.4g}. Change the value, or use --incompressible",
                         field=option)


def parse_parameter_settings(settings: list[str]) -> dict[str, float]:
    """Read parameters from texts such as ``C10=1404.9``.

    Returns:
        Value of each parameter by its name.

    Raises:
        InputError: a text without ``=``, a value that is not a number, or a repeated name.
    """
    parameters: dict[str, float] = {}
    for setting in settings:
        name, sign, text = setting.partition("=")
        name = name.strip()
        if not sign or not name:
            raise InputError(f"must have the form NAME=VALUE, such as C10=1404.9; got {setting!r}", field="--set")
        if name in parameters:
            raise InputError(f"{name} is given twice. Give it once", field="--set")
        try:
            parameters[name] = float(text)
        except ValueError:
            raise InputError(f"the value of {name} must be a number; got {text!r}", field="--set") from None
    return parameters


def parse_prony_series_or_none(terms: list[str], moduli: Literal["instantaneous", "long_term"]) -> Prony | None:
    """Read a Prony series from texts such as ``0.3,2`` (g = 0.3, tau = 2 s).

    Args:
        terms: one text for each term.
        moduli: whether the parameters of the law are instantaneous or long-term moduli.

    Returns:
        The series; None without terms.

    Raises:
        InputError: a text that is not two numbers, values that `Prony` does not accept, or `moduli` without terms.
    """
    from tissue_sim.material.viscoelasticity import Prony, PronyTerm

    if not terms:
        if moduli != "instantaneous":
            raise InputError("requires a Prony series. Add --prony G,TAU_S", field="--moduli")
        return None
    try:
        pairs = [tuple(map(float, term.split(","))) for term in terms]
    except ValueError:
        pairs = [()]
    if any(len(pair) != 2 for pair in pairs):
        raise InputError("must be a fraction and a time in s, such as 0.3,2; got "
                         f"{', '.join(map(repr, terms))}", field="--prony")
    try:
        return Prony(tuple(PronyTerm(*pair) for pair in pairs), moduli)
    except InputError as error:
        raise error.with_location(field="--prony") from None


def load_region_materials(regions: list[str]) -> dict[str, Material]:
    """Load the materials of regions from texts such as ``tumour=stiff.material.json``.

    Returns:
        Material of each region by its name.

    Raises:
        InputError: a text without ``=``, a repeated name, or an invalid material file.
    """
    from tissue_sim import load_material

    read: dict[str, Material] = {}
    for region in regions:
        name, sign, file = region.partition("=")
        if not sign or not name or not file:
            raise InputError(f"must have the form NAME=FILE, such as tumour=stiff.material.json; got {region!r}",
                             field="--region")
        if name in read:
            raise InputError(f"{name} is given twice. Give it once", field="--region")
        read[name] = load_material(file)
    return read


def _summarise_material(arguments: Namespace) -> CommandResult:
    """Summarise a material file."""
    from scenes.commands.material.summary import print_material_summary_as_text, summarise_material_file
    from tissue_sim import read_material_file

    summary = summarise_material_file(read_material_file(arguments.file))
    return CommandResult(lambda: summary, lambda console: print_material_summary_as_text(summary, console))


def _check_material_stability(arguments: Namespace) -> CommandResult:
    """Check the stability of a material; `ExitCode.GOAL_MISSED` if it is unstable in its valid range."""
    from scenes.commands.material.summary import (
        describe_drucker_instability,
        list_effect_and_region_lines,
        list_moduli_lines,
        summarise_material_file,
    )
    from tissue_sim import read_material_file

    material_file = read_material_file(arguments.file)
    instability = describe_drucker_instability(material_file)
    summary = summarise_material_file(material_file)
    notes = list_effect_and_region_lines(summary)
    # The moduli are printed only where effects may make instantaneous and long-term moduli differ.
    notes = [*list_moduli_lines(summary), *notes] if notes else []
    message = instability or "good"

    def print_notes_and_message(console: Console) -> None:
        """Print the notes, then the result of the check."""
        for sentence in (*notes, f"{arguments.file}: {message}"):
            console.print(sentence, markup=False, soft_wrap=True)

    return CommandResult(lambda: {"material_file": str(arguments.file), "stable": instability is None,
                                  "message": message, "notes": notes}, print_notes_and_message,
                         ExitCode.DONE if instability is None else ExitCode.GOAL_MISSED)


COMMAND = Command(
    "material", "write, print, check and convert material files", "tissue-sim material show phantom.material.json",
    actions=(
        Command("new", "write a material file from the parameters of a law",
                "tissue-sim material new --law reduced_polynomial_2 --set C10=1404.9 --set C20=699.4 --bulk-ratio 1000 "
                "-o m.material.json", _write_new_material,
                needs=(add_json_flag, _add_new_material_flags, add_overwrite_flag)),
        Command("show", "print formula, parameters, moduli, stability and provenance of a material file",
                "tissue-sim material show m.material.json", _summarise_material,
                needs=(add_json_flag, _add_material_file)),
        Command("check", "check a material file; exit code 0: valid, 1: the law is unstable in its valid range, "
                "2: unreadable", "tissue-sim material check m.material.json", _check_material_stability,
                needs=(add_json_flag, _add_material_file)),
        EXPORT,
        IMPORT))
