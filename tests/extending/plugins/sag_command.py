"""Command `tissue-sim sag`: sag of a specimen under its own weight."""

from argparse import Namespace
from pathlib import Path

from scenes.commands import Command, CommandResult, ExitCode
from scenes.commands.shared.parsing import InputErrorArgumentParser, parse_positive_number


def _add_flags(parser: InputErrorArgumentParser) -> None:
    """Add the material file, the height and the tolerated sag."""
    parser.add_argument("material", type=Path, metavar="FILE", help="material file with a density")
    parser.add_argument("--height-mm", type=parse_positive_number, default=70.0, metavar="N",
                        help="height of the specimen (default: %(default)g)")
    parser.add_argument("--tolerated-percent", type=parse_positive_number, default=10.0, metavar="N",
                        help="tolerated sag, percent of the height (default: %(default)g)")


def _run(arguments: Namespace) -> CommandResult:
    """Estimate the sag rho g H^2 / (2 E) of a bar; `ExitCode.GOAL_MISSED` if it is too large."""
    import tissue_sim as ts
    from tissue_sim.specimen import STANDARD_GRAVITY

    material = ts.load_material(arguments.material)
    if material.density is None:
        raise ts.InputError("must state a density", file=arguments.material, field="density")
    height = 1e-3 * arguments.height_mm
    sag = 1e3 * material.density * STANDARD_GRAVITY * height**2 / (2 * material.E0)
    is_tolerated = sag <= 1e-2 * arguments.tolerated_percent * arguments.height_mm
    return CommandResult(lambda: {"sag_mm": sag, "tolerated": is_tolerated},
                         lambda console: console.print(f"the specimen sags by {sag:.2f} mm"),
                         ExitCode.DONE if is_tolerated else ExitCode.GOAL_MISSED)


COMMAND = Command("sag", "estimate by how much a specimen sags under its own weight",
                  "tissue-sim sag m.material.json --height-mm 40", _run, needs=(_add_flags,))
