"""The flags that choose how the tissue is computed, and the material where none is stated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.parsing import Parser
from tissue_sim.errors import InputError, nearest

if TYPE_CHECKING:
    from tissue_sim import Material, ReducedModel

#: Meshes for real time; with a budget "realtime" is the finest of them that the computer steps in it.
_RUNGS = ("realtime_120", "realtime_63", "realtime_35", "realtime_20")
_RESOLUTIONS = {"realtime": f"realtime (within a budget the finest of {', '.join(_RUNGS)} that this computer steps in "
                            "it; one of these fixes it)",
                "fast": "fast (force within 1 %%)", "accurate": "accurate (within 0.2 %%)"}


def add_solver_flags(parser: Parser, resolutions: Sequence[str] = tuple(_RESOLUTIONS)) -> None:
    """The solver, and its resolution: one of `resolutions`, by default the first."""
    parser.add_argument("--resolution", choices=(*resolutions, *(_RUNGS if "realtime" in resolutions else ())),
                        default=resolutions[0],
                        help=f"{', '.join(_RESOLUTIONS[name] for name in resolutions)} (default: %(default)s)")
    parser.add_argument("--solver", metavar="NAME", default="axisymmetric",
                        help="axisymmetric, solid (in space), or one that an installed package adds (default: "
                             "%(default)s)")
    parser.add_argument("--solid", dest="solver", action="store_const", const="solid",
                        help="the same as --solver solid")


def add_reduced_flag(parser: Parser) -> None:
    """A reduced solid in place of the scene that the other flags state."""
    parser.add_argument("--reduced", type=Path, metavar="FILE",
                        help="step this reduced solid (NAME.reduced.npz of `tissue-sim reduce`), with its specimen, "
                             "tool and interfaces")


def read_reduced(arguments) -> ReducedModel | None:
    """The reduced solid that is asked for; None where none is.

    Raises:
        InputError: flags of a scene or a solver beside it.
    """
    if arguments.reduced is None:
        return None
    if arguments.solver != "axisymmetric":
        raise InputError("a reduced solid is stepped by a solver of its own; leave this out", field="--solver")
    from tissue_sim.experiment.tools.tool import tool_sizes
    from tissue_sim.specimen.specimen import specimen_sizes

    stated = ("tool", "friction", "friction_base", "friction_wall", "offset_mm", "tilt_deg", "shape", "mesh",
              "mesh_unit", "mesh_base", "mesh_top", "gravity", *tool_sizes(), *specimen_sizes())
    for name in stated:
        if getattr(arguments, name, None) not in (None, False):
            raise InputError("a reduced solid has it from its file; leave this out, or make another one",
                             field=f"--{name.replace('_', '-')}")
    from tissue_sim import load_reduced

    reduced = load_reduced(arguments.reduced)
    arguments.solver = "reduced"
    if arguments.protocol is None and arguments.depth_mm is None:
        # No motion leaves the box unless it is told to.
        arguments.depth_mm = reduced.box.depth * 1e3
    return reduced


def check_solver(name: str) -> None:
    """Refuse the name of a solver that is not there, without importing one that is.

    Raises:
        InputError: no such solver; names the nearest.
    """
    from tissue_sim.fem.solver import SOLVERS

    if name not in SOLVERS:
        raise InputError(f"unknown solver {name!r}{nearest(name, SOLVERS)}", field="--solver")


def read_material(path: Path | None) -> Material:
    """The material of a file, or the study's silicone."""
    import tissue_sim as ts

    if path is not None:
        return ts.load_material(path)
    from scenes.demo.specimen import BULK_RATIO, PHANTOM

    return ts.Material("reduced_polynomial_2", PHANTOM, ts.Bulk("bulk_ratio", BULK_RATIO), name="silicone of the study",
                       density=1040.0)
