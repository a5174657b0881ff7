"""A specimen that settles under its own weight before the tool comes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.specimen import Specimen

#: The weight is put on in no smaller parts than this.
_SMALLEST_PART = 2.0**-6


def settle(stand: Callable[[SolidMesh], SolidSolver], mesh: SolidMesh, specimen: Specimen) -> SolidSolver:
    """The specimen as moulded, standing under its own weight without a tool.

    One whose height was measured as placed gets the moulded height that settles to it, and the solver's mesh with it.

    Args:
        stand: the solver of a mesh without a tool and without weight. mesh: as high as the specimen says it is.
        specimen: its weight, and what its height is.

    Raises:
        ConvergenceError: it does not stand under its own weight.
    """
    height = float(np.ptp(mesh.nodes[:, 2]))
    factor = 1.0
    for _ in range(50):
        solver = stand(mesh.stretched(factor))
        _let_settle(solver, specimen.specific_weight)
        stands = factor * height - solver.sag
        if specimen.height_is == "moulded" or abs(stands / height - 1) < 1e-10:
            return solver
        # The sag grows with the square of the height: one Newton step on factor - c factor^2 = 1.
        loss = (factor * height - stands) / (factor**2 * height)
        factor -= (factor - loss * factor**2 - 1) / (1 - 2 * loss * factor) if 2 * loss * factor < 1 else -0.1
    raise ConvergenceError(f"no moulded height settles to {height * 1e3:g} mm under a specific weight of "
                           f"{specimen.specific_weight:g} N/m3; check density and moduli")


def _let_settle(solver: SolidSolver, specific_weight: float) -> None:
    """Put weight on in as many parts as it takes."""
    carried, part = 0.0, 1.0
    while carried < 1.0:
        solver.tissue.specific_weight = min(1.0, carried + part) * specific_weight
        # It has stood for long.
        step = solver.step(solver.pose, np.inf)
        if step.status is StepStatus.CONVERGED:
            carried = min(1.0, carried + part)
            part *= 2.0
        else:
            part /= 2.0
            if part < _SMALLEST_PART:
                raise ConvergenceError("the specimen does not stand under its own weight: it stopped settling at "
                                       f"{carried:.0%} of it ({step.status.message}); check density and moduli")
    solver.rest_here()
