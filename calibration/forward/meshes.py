"""Which meshes a fit uses of each solver."""

from __future__ import annotations

from typing import NamedTuple


class Meshes(NamedTuple):
    """Resolutions of a solver that a fit uses, and how large their errors are.

    Attributes:
        fast: on which parameters move. accurate: whose difference to it is added.
        remainder: error of either against that of the axisymmetric solver, see `calibration.forward.forms`.
    """

    fast: str
    accurate: str
    remainder: float = 1.0


#: By the name of the solver; of another one as of the axisymmetric.
MESHES = {"axisymmetric": Meshes("fast", "accurate"), "solid": Meshes("realtime", "fast", 3.0)}


def meshes_of(solver: str) -> Meshes:
    """What is used of a solver, by its name."""
    return MESHES.get(solver, MESHES["axisymmetric"])
