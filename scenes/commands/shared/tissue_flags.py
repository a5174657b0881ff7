"""The flags that choose how the tissue is computed, and the material where none is stated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.parsing import Parser
from tissue_sim.errors import InputError, nearest

if TYPE_CHECKING:
    from tissue_sim import Material

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
