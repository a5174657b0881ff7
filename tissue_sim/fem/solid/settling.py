"""Self-weight of a solid, and the derivatives of its equilibrium under the weight."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tissue_sim.fem.solid.sensitivity import FirstTouchDerivatives
from tissue_sim.fem.solid.settings import SETTLING
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import Neighbours, Step, StepStatus
from tissue_sim.fem.stepping.settling import solve_self_weight_equilibrium
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.specimen import Specimen


class SettledStateDerivatives(NamedTuple):
    """Derivatives of a settled specimen with respect to m parameters.

    The attributes are those of `FirstTouchDerivatives` with the same names.
    """

    stretch: np.ndarray
    settled: list[np.ndarray]
    resting: np.ndarray


class SolidSelfWeightProblem:
    """Self-weight of a solid, and the load steps that led to equilibrium; see `SelfWeightProblem`.

    Args:
        stand: makes the solver of a mesh without tool and weight.
        mesh: mesh with the stated height of the specimen.
        specimen: specimen with its weight; `height_is` states whether its height is that before settling.

    Attributes:
        mesh: undeformed mesh of the last solver.
        steps: specific weight of each converged load step of the last solver, N/m3, and its equilibrium: displacements,
            m, pressures, Pa, contact forces, N.
    """

    smallest_increment = SETTLING.smallest_part

    def __init__(self, stand: Callable[[SolidMesh], SolidSolver], mesh: SolidMesh, specimen: Specimen):
        self._stand, self._stated_mesh, self._specimen = stand, mesh, specimen
        self.mesh = mesh
        self.steps: list[tuple[float, tuple[np.ndarray, ...]]] = []

    def make_solver(self, stretch: float) -> SolidSolver:
        """See `SelfWeightProblem.make_solver`."""
        solver = self._stand(self._stated_mesh.scale_height(stretch))
        self.mesh, self.steps = solver.mesh, []
        return solver

    def solve_equilibrium_under_weight(self, solver: SolidSolver, specific_weight: float) -> Step:
        """See `SelfWeightProblem.solve_equilibrium_under_weight`. A converged step is recorded."""
        solver.tissue.specific_weight = specific_weight
        step = solver.step(solver.pose, np.inf)
        if step.status is StepStatus.CONVERGED:
            self.steps.append((specific_weight, solver.equations.copy_iterate()))
        return step

    def store_resting_state(self, solver: SolidSolver) -> None:
        """See `SelfWeightProblem.store_resting_state`."""
        solver.equations.make_committed_state_the_resting_state()

    def differentiate_state_settled_by_weight_or_none(self, neighbours: Neighbours) -> SettledStateDerivatives | None:
        """Repeat the load steps from their stored equilibria, and differentiate the last one.

        Args:
            neighbours: see `tissue_sim.fem.solver.Neighbours`.

        Returns:
            Derivatives; None if the solver has none or a step does not converge.
        """
        solver, m = self._stand(self.mesh), len(neighbours)
        # An undeformed height that was determined from the settled one is an additional parameter.
        height = (solver.material, solver.material, SETTLING.height_width)
        more = [height] if self._specimen.height_is == "placed" else []
        derivatives = solver.enable_force_derivatives([*neighbours, *more])
        if derivatives is None:
            return None
        stretches = np.repeat([0.0, 1.0], [m, len(more)])
        derivatives.set_first_touch_derivatives(FirstTouchDerivatives.from_undeformed_specimen(stretches))
        for weight, state in self.steps:
            solver.tissue.specific_weight = weight
            solver.contact.copy_committed_bonds_to_step()
            solver.equations.set_iterate(state)
            if solver.step(solver.pose, np.inf, resumes=True).status is not StepStatus.CONVERGED:
                return None
        carried, stretch = derivatives.state_derivatives, np.zeros(m)
        if more:
            rises = np.average(carried[0][:, 2::3], axis=1, weights=self.mesh.compute_node_areas_of_named_faces("top"))
            stretch = -rises[:m] / (rises[m] + float(np.ptp(self.mesh.nodes[:, 2])))
        settled = [each[:m] + np.multiply.outer(stretch, each[m]) if more else each for each in carried]
        return SettledStateDerivatives(stretch, settled, solver.contact.nodes)


def solve_solid_self_weight_equilibrium(stand: Callable[[SolidMesh], SolidSolver], mesh: SolidMesh, specimen: Specimen
                                        ) -> tuple[SolidSolver, SolidSelfWeightProblem]:
    """Compute the equilibrium of a solid under its weight, without a tool (`tissue_sim.fem.stepping.settling`).

    Args:
        stand: makes the solver of a mesh without tool and weight.
        mesh: mesh with the stated height of the specimen.
        specimen: specimen with its weight.

    Returns:
        Solver in equilibrium under the weight, and its load steps.

    Raises:
        ConvergenceError: the specimen has no equilibrium under its weight.
    """
    problem = SolidSelfWeightProblem(stand, mesh, specimen)
    return solve_self_weight_equilibrium(problem, specimen, float(np.ptp(mesh.nodes[:, 2]))), problem
