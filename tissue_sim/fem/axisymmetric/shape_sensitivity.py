"""Derivatives of the equilibrium equations with respect to sizes of specimen and tool at constant unknowns.

The residual of two neighbouring problems, whose nodes, tool and supports have the sizes theta + h and theta - h, is
evaluated at the displacements, contact forces and history of the present step:

    dR/dtheta = (R(x; theta + h) - R(x; theta - h)) / (2 h).

This is the semi-analytical method of shape sensitivity analysis; source: Haftka and Adelman, Struct. Optim. 1 (1989)
137. The displacements are those of material points, so that moved nodes keep their displacements.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.contact import ContactLinearisationColumn
from tissue_sim.fem.axisymmetric.equations import EquilibriumEquations
from tissue_sim.fem.taichi.runtime import LANES


class ResidualTerms(NamedTuple):
    """Terms of the residual of a problem at given unknowns, or their derivatives with respect to a size.

    Attributes:
        forces: condensed forces of the tissue on the degrees of freedom, N, shape (freedoms,); meaningless at degrees
            of freedom without an equation.
        centre_displacements: inverse stiffness of the interior node times its force, r and z, m, shape
            (2, batches, LANES).
        contact_forces: contact forces at constant multipliers, N, shape (points, 2).
        constraints: residuals of the contact constraints, m, shape (points, 2).
        stresses: isochoric second Piola-Kirchhoff stresses of the law with softening, Pa, shape (elements, q, 4).
        energies: energy densities of the law, J/m3, shape (elements, q).
    """

    forces: np.ndarray
    centre_displacements: np.ndarray
    contact_forces: np.ndarray
    constraints: np.ndarray
    stresses: np.ndarray
    energies: np.ndarray


class ShapeDerivative:
    """Derivative of the equations of a problem with respect to one size, from two neighbouring problems.

    Args:
        equations: equations of the problem.
        neighbours: equations of the problems with the size increased and decreased, before their first step. They are
            evaluated at the state of `equations`.
        width: difference of the two sizes, m.

    Attributes:
        first_anchor_rates: derivatives of the anchors of the contact points at the first touch, 1, shape (points, 2).

    Raises:
        InputError: the neighbouring problems have other contact points.
    """

    def __init__(self, equations: EquilibriumEquations,
                 neighbours: tuple[EquilibriumEquations, EquilibriumEquations], width: float):
        self._equations, self._neighbours, self._width = equations, neighbours, width
        more, less = neighbours
        bonds = [each.surface.anchors[:, 0] for each in (equations, more, less)]
        if not all(np.array_equal(bonds[0], bond) for bond in bonds[1:]):
            raise InputError("must touch the same points at the first touch if a size changes by "
                             f"{0.5 * width:.2g} m; got other points. Use a size at which the first touch is regular.",
                             field="experiment")
        self.first_anchor_rates = (more.surface.anchors[:, 1:] - less.surface.anchors[:, 1:]) / width

    def evaluate(self) -> ResidualTerms:
        """Return the derivatives at the present state of the problem, per metre of the size."""
        more, less = (self._evaluate_neighbour(each) for each in self._neighbours)
        found = ResidualTerms(*((above - below) / self._width for above, below in zip(more, less, strict=True)))
        # The contact forces are separate terms.
        surface = self._equations.surface
        np.subtract.at(found.forces.reshape(-1, 2), surface.nodes,
                       surface.shapes[..., None] * found.contact_forces[:, None])
        return found

    def _evaluate_neighbour(self, neighbour: EquilibriumEquations) -> ResidualTerms:
        """Evaluate a neighbouring problem at the state of the problem; `forces` includes the contact forces."""
        self._copy_state_to(neighbour)
        neighbour.assemble_at_present_state(newton.StartMode.RESIDUAL_ONLY)
        surface, memory, column = neighbour.surface, neighbour.memory, ContactLinearisationColumn
        history = (memory.stresses.copy(), memory.energies.copy()) if memory.works else (np.zeros(0), np.zeros(0))
        return ResidualTerms(neighbour.residual[neighbour.equation], np.array(neighbour.batches.centre_force),
                             surface.forces.copy(), surface.rates[:, column.MISSED_R: column.MISSED_Z + 1].copy(),
                             *history)

    def _copy_state_to(self, neighbour: EquilibriumEquations) -> None:
        """Copy unknowns, contact states, history and condensation matrices of the problem to a neighbouring problem."""
        equations, index = self._equations, newton.StepSettingIndex
        neighbour.state.x[:] = equations.state.x
        for name in ("held", "pressed", "slip_signs"):
            getattr(neighbour.surface, name)[:] = getattr(equations.surface, name)
        neighbour.settings[[index.DEPTH, index.FLOOR]] = equations.settings[[index.DEPTH, index.FLOOR]]
        for own, other in zip((*equations.batches.centre_rows, *equations.batches.centre_inverse),
                              (*neighbour.batches.centre_rows, *neighbour.batches.centre_inverse), strict=True):
            other[:] = own
        memory, near = equations.memory, neighbour.memory
        if memory.works:
            near.past[:], near.inherited[:], near.largest[:] = memory.past, memory.inherited, memory.largest


def add_shape_derivatives(derivatives: dict[int, ShapeDerivative], equations: EquilibriumEquations,
                          arrays: dict[str, np.ndarray]) -> None:
    """Add the derivatives at constant unknowns with respect to sizes to the arrays of the sensitivity kernels.

    Args:
        derivatives: index of the parameter -> its derivative.
        equations: equations of the problem.
        arrays: arrays of `tissue_sim.fem.axisymmetric.array_layouts.RATE_ARRAYS`, changed in place.
    """
    batches, parameters = equations.batches, len(arrays["forces"])
    shared = equations.equation >= 0
    for k, derivative in derivatives.items():
        terms = derivative.evaluate()
        arrays["forces"][k, equations.equation[shared]] += terms.forces[shared]
        arrays["fixed_force_rates"][k] = terms.contact_forces
        arrays["constraint_rates"][k] = terms.constraints
        for name, along in zip(("centre_r", "centre_z"), terms.centre_displacements, strict=True):
            arrays[name].reshape(parameters, batches.batches, LANES)[k] += along
        if equations.memory.works:
            points = equations.memory.energies.shape[1]
            for name, values in (("stress_rates", terms.stresses), ("energy_rates", terms.energies[..., None])):
                shape = batches.batches, points, values.shape[-1], LANES
                arrays[name].reshape(*shape[:2], parameters, *shape[2:])[:, :, k] += batches.arrange_in_lanes(
                    values).reshape(shape)
