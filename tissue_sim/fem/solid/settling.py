"""Equilibrium of a specimen under its own weight, before the tool touches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.solid.sensitivity import FirstTouchDerivatives
from tissue_sim.fem.solid.settings import SETTLING
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import Neighbours, StepStatus
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.specimen import Specimen


class SettledStateDerivatives(NamedTuple):
    """Derivatives of a settled specimen with respect to m parameters.

    The attributes are those of `FirstTouchDerivatives` with the same names.
    """

    stretch: np.ndarray
    settled: list[np.ndarray]
    resting: np.ndarray


class SelfWeightLoadStepRecord(NamedTuple):
    """Load steps by which a specimen came into equilibrium under its weight.

    Attributes:
        stand: makes the solver of a mesh without tool and weight.
        mesh: undeformed mesh.
        specimen: specimen with its weight; `height_is` states whether its height is that before settling.
        steps: specific weight of each load step, N/m3, and its equilibrium: displacements, m, pressures, Pa, contact
            forces, N.
    """

    stand: Callable[[SolidMesh], SolidSolver]
    mesh: SolidMesh
    specimen: Specimen
    steps: list[tuple[float, list[np.ndarray]]]

    def differentiate_state_settled_by_weight_or_none(self, neighbours: Neighbours) -> SettledStateDerivatives | None:
        """Repeat the load steps from their stored equilibria, and differentiate the last one.

        Args:
            neighbours: see `tissue_sim.fem.solver.Neighbours`.

        Returns:
            Derivatives; None if the solver has none or a step does not converge.
        """
        solver, m = self.stand(self.mesh), len(neighbours)
        # An undeformed height that was determined from the settled one is an additional parameter.
        height = (solver.material, solver.material, SETTLING.height_width)
        more = [height] if self.specimen.height_is == "placed" else []
        derivatives = solver.differentiate([*neighbours, *more])
        if derivatives is None:
            return None
        derivatives.set_first_touch_derivatives(FirstTouchDerivatives.from_undeformed_specimen(np.repeat([0.0, 1.0],
                                                                                                         [m,
                                                                                                          len(more)])))
        for weight, state in self.steps:
            solver.tissue.specific_weight = weight
            solver.contact.copy_committed_bonds_to_step()
            for array, left in zip(_get_iterate_arrays(solver), state, strict=True):
                array[:] = left
            if solver.step(solver.pose, np.inf, resumes=True).status is not StepStatus.CONVERGED:
                return None
        carried, stretch = derivatives.state_derivatives, np.zeros(m)
        if more:
            rises = np.average(carried[0][:, 2::3], axis=1, weights=self.mesh.compute_node_areas_of_named_faces("top"))
            stretch = -rises[:m] / (rises[m] + float(np.ptp(self.mesh.nodes[:, 2])))
        settled = [each[:m] + np.multiply.outer(stretch, each[m]) if more else each for each in carried]
        return SettledStateDerivatives(stretch, settled, solver.contact.nodes)


def settle_and_get_solver_and_load_steps(stand: Callable[[SolidMesh], SolidSolver], mesh: SolidMesh, specimen: Specimen
                                         ) -> tuple[SolidSolver, SelfWeightLoadStepRecord]:
    """Compute the equilibrium of a specimen under its weight, without a tool.

    If the height of the specimen is the settled one, the undeformed height is determined by Newton's method.

    Args:
        stand: makes the solver of a mesh without tool and weight.
        mesh: mesh with the stated height of the specimen.
        specimen: specimen with its weight; `height_is` states whether its height is that before settling.

    Returns:
        Solver in equilibrium under the weight, and the load steps.

    Raises:
        ConvergenceError: the specimen has no equilibrium under its weight.
    """
    height = float(np.ptp(mesh.nodes[:, 2]))
    factor = 1.0
    for _ in range(50):
        solver = stand(mesh.scale_height(factor))
        steps = _apply_weight_and_record_steps(solver, specimen.specific_weight)
        stands = factor * height - solver.sag
        if specimen.height_is == "moulded" or abs(stands / height - 1) < 1e-10:
            return solver, SelfWeightLoadStepRecord(stand, solver.mesh, specimen, steps)
        # The sag grows with the square of the height: one Newton step on factor - c factor^2 = 1.
        loss = (factor * height - stands) / (factor**2 * height)
        factor -= (factor - loss * factor**2 - 1) / (1 - 2 * loss * factor) if 2 * loss * factor < 1 else -0.1
    raise ConvergenceError(f"no undeformed height settles to {height * 1e3:g} mm under a specific weight of "
                           f"{specimen.specific_weight:g} N/m3. Check density and moduli")


def _apply_weight_and_record_steps(solver: SolidSolver, specific_weight: float) -> list[tuple[float, list[np.ndarray]]]:
    """Apply the weight in as few load steps as converge; return them as in `SelfWeightLoadStepRecord.steps`."""
    carried, part, steps = 0.0, 1.0, []
    while carried < 1.0:
        solver.tissue.specific_weight = min(1.0, carried + part) * specific_weight
        # An infinite time step: the fully relaxed state.
        step = solver.step(solver.pose, np.inf)
        if step.status is StepStatus.CONVERGED:
            carried = min(1.0, carried + part)
            part *= 2.0
            steps.append((solver.tissue.specific_weight, [array.copy() for array in _get_iterate_arrays(solver)]))
        else:
            part /= 2.0
            if part < SETTLING.smallest_part:
                raise ConvergenceError("the specimen has no equilibrium under its own weight: the solver stopped at "
                                       f"{carried:.0%} of the weight ({step.status.message}). Check density and moduli")
    solver.make_committed_state_the_resting_state()
    return steps


def _get_iterate_arrays(solver: SolidSolver) -> tuple[np.ndarray, ...]:
    """Return displacements, pressures and contact forces of the present iterate, not copied."""
    return solver.x, solver.batches.pressures, solver.contact.forces
