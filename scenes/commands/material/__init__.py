"""`tissue-sim material new|show|check|export`: material files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from scenes.commands.shared.console import print_json, results_console
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite, new_file, positive
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from tissue_sim.material.material import Material
    from tissue_sim.material.viscoelasticity import Prony

SUMMARY = "make, read, check and export material files"
EXAMPLE = "tissue-sim material show phantom.material.json"
ACTIONS = ("new", "show", "check", "export")
LATER = ("import",)

_NEW = ("write a material file from parameters",
        "tissue-sim material new --law reduced_polynomial_2 --set C10=1404.9 --set C20=699.4 --bulk-ratio 1000 "
        "-o m.material.json")
_SHOW = ("formula, parameters, moduli, stability and provenance of a material file",
         "tissue-sim material show m.material.json")
_CHECK = ("exit 0 when the file is good, 2 when it cannot be read, 1 when the law is unstable in its valid range",
          "tissue-sim material check m.material.json")
_EXPORT = ("write a material for another program",
           "tissue-sim material export m.material.json --to abaqus -o m.inp")


def add_arguments(parser: Parser) -> None:
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)

    def action(name, texts, run) -> Parser:
        inner = actions.add_parser(name, help=texts[0], description=texts[0], epilog=f"example:\n  {texts[1]}")
        inner.set_defaults(run=run)
        add_json(inner)
        return inner

    new = action("new", _NEW, run_new)
    new.add_argument("--law", required=True, help="neo_hooke, mooney_rivlin, reduced_polynomial_1 to _3, ogden_1 to _3")
    new.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE",
                     help="a parameter of the law, Pa (exponents: 1); once for each")
    bulk = new.add_mutually_exclusive_group()
    bulk.add_argument("--bulk-ratio", type=positive, metavar="N", help="K / mu0, 2 to 1e6")
    bulk.add_argument("--bulk-modulus-pa", type=positive, metavar="N", help="K in Pa, 2 to 1e6 times mu0")
    bulk.add_argument("--incompressible", action="store_true", help="no change of volume (default)")
    new.add_argument("--prony", action="append", default=[], metavar="G,TAU_S",
                     help="a term of the Prony series: share of the instantaneous modulus that relaxes, relaxation "
                          "time in s; 1 to 4 times")
    new.add_argument("--moduli", choices=("instantaneous", "long_term"), default="instantaneous",
                     help="what the parameters of a law with --prony stand for (default: %(default)s)")
    new.add_argument("--region", action="append", default=[], metavar="NAME=FILE",
                     help="what the tissue is in a region of the specimen's mesh: the material of another file, whose "
                          "numbers are copied, without standard errors; once for each region")
    new.add_argument("--name", default="", help="name for people")
    new.add_argument("--density-kg-m3", type=positive, metavar="N", help="density")
    new.add_argument("-o", dest="output", type=Path, required=True, metavar="FILE", help="NAME.material.json")
    add_overwrite(new)
    action("show", _SHOW, run_show).add_argument("file", type=Path, metavar="FILE")
    action("check", _CHECK, run_check).add_argument("file", type=Path, metavar="FILE")
    export = action("export", _EXPORT, run_export)
    export.add_argument("file", type=Path, metavar="FILE")
    export.add_argument("--to", required=True, metavar="PROGRAM", help="abaqus (CalculiX reads it), or what an "
                                                                       "installed package adds")
    export.add_argument("-o", dest="output", type=Path, required=True, metavar="OUT", help="file to write")
    add_overwrite(export)


def run_new(arguments) -> int:
    import tissue_sim as ts

    new_file(arguments.output, "-o", overwrite=arguments.overwrite, suffixes=(".material.json",))
    if arguments.bulk_ratio is not None:
        bulk = ts.Bulk("bulk_ratio", arguments.bulk_ratio)
    elif arguments.bulk_modulus_pa is not None:
        bulk = ts.Bulk("K_Pa", arguments.bulk_modulus_pa)
    else:
        bulk = ts.Bulk()
    material = ts.Material(arguments.law, read_settings(arguments.settings), bulk, density=arguments.density_kg_m3,
                           name=arguments.name, viscoelastic=read_prony(arguments.prony, arguments.moduli),
                           regions=read_regions(arguments.region))
    check_bulk(material, "--bulk-ratio" if arguments.bulk_ratio is not None else "--bulk-modulus-pa")
    ts.write_material_file(ts.MaterialFile.of(material), arguments.output)
    if arguments.json:
        print_json({"material_file": str(arguments.output)})
    else:
        from calibration.report.units import format_pressure

        relaxed = "" if material.viscoelastic is None else f", long-term mu {format_pressure(material.mu_long_term)}"
        results_console().print(f"wrote {arguments.output}: E0 {format_pressure(material.E0)}, "
                                f"mu0 {format_pressure(material.mu0)}{relaxed}", markup=False, soft_wrap=True)
    return 0


def check_bulk(material, option: str) -> None:
    """Refuse a bulk response that `simulate` would refuse.

    Raises:
        InputError: K / mu0 outside `BULK_RATIOS`, with the option that states it.
    """
    from tissue_sim.material.material import BULK_RATIOS

    ratio = material.bulk_modulus / material.mu0
    low, high = BULK_RATIOS
    if material.bulk.kind != "incompressible" and not low <= ratio <= high:
        stated = "" if option == "--bulk-ratio" else f"; give {low * material.mu0:.4g} to {high * material.mu0:.4g} Pa"
        raise InputError(f"K / mu0 is {ratio:.4g}, outside {low:g} to {high:g}, which the finite elements are checked "
                         f"for{stated}, or --incompressible", field=option)


def read_settings(settings: list[str]) -> dict[str, float]:
    """``["C10=1404.9"]`` -> ``{"C10": 1404.9}``.

    Raises:
        InputError: no ``=``, a value that is not a number, or a name given twice.
    """
    parameters: dict[str, float] = {}
    for setting in settings:
        name, sign, text = setting.partition("=")
        name = name.strip()
        if not sign or not name:
            raise InputError(f"{setting!r} is not NAME=VALUE; write it like C10=1404.9", field="--set")
        if name in parameters:
            raise InputError(f"{name} is given twice; give it once", field="--set")
        try:
            parameters[name] = float(text)
        except ValueError:
            raise InputError(f"{text!r} is not a number; write it like {name}=1404.9", field="--set") from None
    return parameters


def read_prony(terms: list[str], moduli: Literal["instantaneous", "long_term"]) -> Prony | None:
    """``["0.3,2"]`` -> a `Prony` series with g 0.3 and tau 2 s; None of no terms.

    Raises:
        InputError: a term that is not two numbers, or one that `Prony` refuses.
    """
    from tissue_sim.material.viscoelasticity import Prony, PronyTerm

    if not terms:
        if moduli != "instantaneous":
            raise InputError("needs a Prony series; give --prony G,TAU_S as well", field="--moduli")
        return None
    try:
        pairs = [tuple(map(float, term.split(","))) for term in terms]
    except ValueError:
        pairs = [()]
    if any(len(pair) != 2 for pair in pairs):
        raise InputError(f"{', '.join(map(repr, terms))}: expected a share and a time in s, such as 0.3,2",
                         field="--prony")
    try:
        return Prony(tuple(PronyTerm(*pair) for pair in pairs), moduli)
    except InputError as error:
        raise error.located(field="--prony") from None


def read_regions(regions: list[str]) -> dict[str, Material]:
    """``["tumour=stiff.material.json"]`` -> the material of that file, by the name of the region.

    Raises:
        InputError: no ``=``, a name given twice, or a file that is no material.
    """
    from tissue_sim import load_material

    read: dict[str, Material] = {}
    for region in regions:
        name, sign, file = region.partition("=")
        if not sign or not name or not file:
            raise InputError(f"{region!r} is not NAME=FILE; write it like tumour=stiff.material.json", field="--region")
        if name in read:
            raise InputError(f"{name} is given twice; give it once", field="--region")
        read[name] = load_material(file)
    return read


def run_show(arguments) -> int:
    from scenes.commands.material.summary import print_summary, summarise
    from tissue_sim import read_material_file

    summary = summarise(read_material_file(arguments.file))
    if arguments.json:
        print_json(summary)
    else:
        print_summary(summary, results_console())
    return 0


def run_check(arguments) -> int:
    from scenes.commands.material.summary import effects, loss_of_stability, moduli, summarise
    from tissue_sim import read_material_file

    material_file = read_material_file(arguments.file)
    lost = loss_of_stability(material_file)
    summary = summarise(material_file)
    notes = effects(summary)
    # The moduli are worth telling where there is more than one of each.
    notes = [*moduli(summary), *notes] if notes else []
    if arguments.json:
        print_json({"material_file": str(arguments.file), "stable": lost is None, "message": lost or "good",
                    "notes": notes})
    else:
        for sentence in (*notes, f"{arguments.file}: {lost or 'good'}"):
            results_console().print(sentence, markup=False, soft_wrap=True)
    return 0 if lost is None else 1


def run_export(arguments) -> int:
    from tissue_sim import load_material
    from tissue_sim.atomic_write import write_text
    from tissue_sim.exports import EXPORTERS

    new_file(arguments.output, "-o", overwrite=arguments.overwrite)
    write = EXPORTERS.find(arguments.to, "--to")
    material = load_material(arguments.file)
    try:
        text = write(material)
    except InputError as error:
        raise error.located(file=arguments.file) from None
    write_text(arguments.output, text)
    if arguments.json:
        print_json({"file": str(arguments.output), "to": arguments.to})
    else:
        results_console().print(f"wrote {arguments.output} for {arguments.to}", markup=False, soft_wrap=True)
    return 0
