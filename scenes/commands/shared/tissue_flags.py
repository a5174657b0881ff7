"""Flags that select solver and resolution, and the default material."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.parsing import InputErrorArgumentParser
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words

if TYPE_CHECKING:
    from tissue_sim import Material, ReducedModel

#: Meshes for real time, finest first; the number counts the elements of the mesh for the reference needle test.
_REALTIME_LEVELS = ("realtime_120", "realtime_63", "realtime_35", "realtime_20")
#: Resolution -> description in the help.
_RESOLUTIONS = {"realtime": f"realtime (the finest of {', '.join(_REALTIME_LEVELS)} that this computer solves within "
                "the time budget of a step; naming one of these selects it)",
                "fast": "fast (force error about 1 %%)", "accurate": "accurate (force error about 0.2 %%)"}


def add_resolution_and_solver_flags(parser: InputErrorArgumentParser,
                                    resolutions: Sequence[str] = tuple(_RESOLUTIONS)) -> None:
    """Add the flags of the solver and its resolution.

    Args:
        parser: parser of the command.
        resolutions: allowed resolutions, keys of `_RESOLUTIONS`; the first one is the default.
    """
    levels = _REALTIME_LEVELS if "realtime" in resolutions else ()
    parser.add_argument("--resolution", choices=(*resolutions, *levels), default=resolutions[0],
                        help=f"mesh: {', '.join(_RESOLUTIONS[name] for name in resolutions)} (default: %(default)s)")
    parser.add_argument("--solver", metavar="NAME", default="axisymmetric",
                        help="axisymmetric, solid (three-dimensional), or a solver of an installed package (default: "
                        "%(default)s)")
    parser.add_argument("--solid", dest="solver", action="store_const", const="solid",
                        help="same as --solver solid")


def add_reduced_flag(parser: InputErrorArgumentParser) -> None:
    """Add ``--reduced FILE``, a reduced model that replaces specimen, tool and solver of the other flags."""
    parser.add_argument("--reduced", type=Path, metavar="FILE",
                        help="reduced model from `tissue-sim reduce` (NAME.reduced.npz); it contains specimen, tool "
                        "and interfaces")


def load_reduced_model_and_set_flags(arguments) -> ReducedModel | None:
    """Load the reduced model of ``--reduced``, and set ``solver`` and the default ``depth_mm`` of the arguments.

    Returns:
        The reduced model; None without ``--reduced``.

    Raises:
        InputError: a flag of specimen, tool or solver is given too, or the file is invalid.
    """
    if arguments.reduced is None:
        return None
    if arguments.solver != "axisymmetric":
        raise InputError("cannot be combined with --reduced, which selects its solver. Leave this flag out",
                         field="--solver")
    from tissue_sim.experiment.tools.tool import list_all_tool_sizes_by_key
    from tissue_sim.specimen.specimen import specimen_sizes

    stated = ("tool", "friction", "friction_base", "friction_wall", "offset_mm", "tilt_deg", "shape", "mesh",
              "mesh_unit", "mesh_base", "mesh_top", "gravity", *list_all_tool_sizes_by_key(), *specimen_sizes())
    for name in stated:
        if getattr(arguments, name, None) not in (None, False):
            raise InputError("cannot be combined with --reduced, whose file defines it. Leave this flag out, or "
                             "make another reduced model", field=f"--{name.replace('_', '-')}")
    from tissue_sim import load_reduced

    reduced = load_reduced(arguments.reduced)
    arguments.solver = "reduced"
    if arguments.protocol is None and arguments.depth_mm is None:
        # The default motion stays inside the box of poses of the reduced model.
        arguments.depth_mm = reduced.box.depth * 1e3
    return reduced


def require_known_solver(name: str) -> None:
    """Raise an error if no solver has this name; solvers are not imported.

    Raises:
        InputError: unknown solver; the message names the nearest one.
    """
    from tissue_sim.fem.solver import SOLVERS

    if name not in SOLVERS:
        raise InputError(f"unknown solver {name!r}{make_hint_with_similar_or_known_words(name, SOLVERS)}",
                         field="--solver")


def load_scene_material(path: Path | None, reduced: ReducedModel | None) -> Material:
    """Return the material of a file, or for None that of the reduced model, or without one that of the study."""
    return reduced.model.material if reduced and path is None else load_material_or_study_silicone(path)


def load_material_or_study_silicone(path: Path | None) -> Material:
    """Return the material of a file, or for None the silicone of the reference study."""
    import tissue_sim as ts

    if path is not None:
        return ts.load_material(path)
    from scenes.demo.specimen import BULK_RATIO, PHANTOM

    return ts.Material("reduced_polynomial_2", PHANTOM, ts.Bulk("bulk_ratio", BULK_RATIO), name="silicone of the study",
                       density=1040.0)
