"""A specimen that settles under its own weight before the tool comes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.solid.sensitivity import StartRates
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import Neighbours, StepStatus
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.specimen import Specimen

#: The weight is put on in no smaller parts than this.
_SMALLEST_PART = 2.0**-6
#: Of the logarithm of the height, a tenth of the half width of its differences.
_WIDTH = 1e-6


class Repeated(NamedTuple):
    """How a settled specimen changes with m parameters; see `StartRates`."""

    stretch: np.ndarray
    settled: list[np.ndarray]
    resting: np.ndarray


class Settling(NamedTuple):
    """How a specimen came to stand under its own weight.

    Attributes:
        stand: makes the solver of a mesh without a tool and without weight.
        mesh: as moulded. specimen: its weight, and what its height is.
        steps: specific weight of each, N/m3, and the state to which it led: displacements, pressures, contact forces.
    """

    stand: Callable[[SolidMesh], SolidSolver]
    mesh: SolidMesh
    specimen: Specimen
    steps: list[tuple[float, list[np.ndarray]]]

    def repeat(self, neighbours: Neighbours) -> Repeated | None:
        """The same steps once more with derivatives, from where each ended; None where there are none."""
        solver, m = self.stand(self.mesh), len(neighbours)
        # The moulded height, where it has to be found, is one parameter more.
        more = [(solver.material, solver.material, _WIDTH)] if self.specimen.height_is == "placed" else []
        derivatives = solver.differentiate([*neighbours, *more])
        if derivatives is None:
            return None
        derivatives.begin(StartRates.moulded(np.repeat([0.0, 1.0], [m, len(more)])))
        for weight, state in self.steps:
            solver.tissue.specific_weight = weight
            solver.contact.begin()
            for array, left in zip(_state(solver), state, strict=True):
                array[:] = left
            if solver.step(solver.pose, np.inf, resumes=True).status is not StepStatus.CONVERGED:
                return None
        carried, stretch = derivatives.carried, np.zeros(m)
        if more:
            rises = np.average(carried[0][:, 2::3], axis=1, weights=self.mesh.areas("top"))
            stretch = -rises[:m] / (rises[m] + float(np.ptp(self.mesh.nodes[:, 2])))
        return Repeated(stretch, [each[:m] + np.multiply.outer(stretch, each[m]) if more else each for each in carried],
                        solver.contact.nodes)


def settle(stand: Callable[[SolidMesh], SolidSolver], mesh: SolidMesh, specimen: Specimen
           ) -> tuple[SolidSolver, Settling]:
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
        steps = _let_settle(solver, specimen.specific_weight)
        stands = factor * height - solver.sag
        if specimen.height_is == "moulded" or abs(stands / height - 1) < 1e-10:
            return solver, Settling(stand, solver.mesh, specimen, steps)
        # The sag grows with the square of the height: one Newton step on factor - c factor^2 = 1.
        loss = (factor * height - stands) / (factor**2 * height)
        factor -= (factor - loss * factor**2 - 1) / (1 - 2 * loss * factor) if 2 * loss * factor < 1 else -0.1
    raise ConvergenceError(f"no moulded height settles to {height * 1e3:g} mm under a specific weight of "
                           f"{specimen.specific_weight:g} N/m3; check density and moduli")


def _let_settle(solver: SolidSolver, specific_weight: float) -> list[tuple[float, list[np.ndarray]]]:
    """Put weight on in as many parts as it takes; returns `Settling.steps`."""
    carried, part, steps = 0.0, 1.0, []
    while carried < 1.0:
        solver.tissue.specific_weight = min(1.0, carried + part) * specific_weight
        # It has stood for long.
        step = solver.step(solver.pose, np.inf)
        if step.status is StepStatus.CONVERGED:
            carried = min(1.0, carried + part)
            part *= 2.0
            steps.append((solver.tissue.specific_weight, [array.copy() for array in _state(solver)]))
        else:
            part /= 2.0
            if part < _SMALLEST_PART:
                raise ConvergenceError("the specimen does not stand under its own weight: it stopped settling at "
                                       f"{carried:.0%} of it ({step.status.message}); check density and moduli")
    solver.rest_here()
    return steps


def _state(solver: SolidSolver) -> tuple[np.ndarray, ...]:
    return solver.x, solver.batches.pressures, solver.contact.forces
