"""A-posteriori error estimate of a reduced solid by the compliance that its contact nodes lack.

A reduced basis represents displacements under the contact forces of the training paths. It contains almost no motion of
a node that no training path loaded, so that the reduced solid is too stiff at this node. The residual on further modes
of the same training paths cannot show the error. The difference between the nodal compliance G of the full-order solid
and the compliance G_r = Phi (Phi' K Phi)^-1 Phi' of the reduced solid does (residual attachment modes: MacNeal,
Computers & Structures 1 (1971) 581; a-posteriori error of a reduced basis: Rozza, Huynh and Patera, Arch. Comput.
Methods Eng. 15 (2008) 229).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import lapack

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.reduced.compliance_table import ContactNodeComplianceTable
from tissue_sim.fem.reduced.contact import PenaltyContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.solid.equations import SolidEquations
from tissue_sim.fem.solid.solver import SolidSolver


class MissingComplianceErrorEstimator:
    """Estimate of the force error of a reduced solid by missing compliance of its contact nodes.

    With the missing compliance D = G - G_r, contact forces f would displace the nodes by D f more. A rigid tool that
    prescribes the displacement then needs forces that are smaller by G^-1 D f. The missing force is the sum
    1' G^-1 D f over the touching nodes. The sum depends on ratios of compliances only, so it holds for other moduli.

    The compliance of a deformed solid differs from the compliance at rest, so an accurate force has a missing force
    above zero. The error estimate is the excess over the missing force of accurate states on the training paths
    (`ContactNodeComplianceTable.accepted`).

    Args:
        table: compliances of the contact nodes.
        contact: contact whose nodal forces are used; its nodes are the nodes of the table.
    """

    def __init__(self, table: ContactNodeComplianceTable, contact: PenaltyContact):
        self._table, self._contact = table, contact
        #: Contact state of the nodes, as bytes, for which the weights were computed.
        self._touching = b""
        self._weights = np.zeros((table.nodes.size, 3))

    def compute_missing_axial_force(self) -> float:
        """Return the missing force for the contact forces of the last evaluation, N."""
        touching = self._contact.touching_mask
        if (key := touching.tobytes()) != self._touching:
            self._touching = key
            self._weights = self._derive_missing_force_by_nodal_forces(np.flatnonzero(touching))
        return abs(float(np.vdot(self._weights, self._contact.forces)))

    def estimate_missing_compliance_error(self, force: float) -> float:
        """Return the force error from missing compliance, N, for a force on the tool of this norm, N.

        The error is the excess of `compute_missing_axial_force` over the value of accurate training states at this
        force.
        """
        return max(0.0, self.compute_missing_axial_force()
                   - self._table.get_accepted_missing_force_at_tool_force(force))

    def _derive_missing_force_by_nodal_forces(self, nodes: np.ndarray) -> np.ndarray:
        """Return the derivative of the missing force with respect to the nodal forces if these nodes touch, (n, 3)."""
        weights = np.zeros(self._weights.shape)
        if nodes.size:
            block = np.ix_(nodes, nodes)
            _, pressure, failed = lapack.dposv(self._table.whole[block], np.ones(nodes.size))
            assert not failed, "the compliance of a supported solid is positive definite"
            weights[nodes] = (pressure @ self._table.missing[block])[:, None] * self._table.axis
        return weights


def make_missing_compliance_estimator_or_none(reduced: ReducedModel,
                                              contact: PenaltyContact) -> MissingComplianceErrorEstimator | None:
    """Return the error estimate by missing compliance for the contact of a reduced solid; None for a bonded tool."""
    if reduced.lifting:
        return None
    return MissingComplianceErrorEstimator(reduced.compliance or compute_compliance_table_of_old_model(reduced),
                                           contact)


def reset_and_compute_compliance_table(reduced: ReducedModel, solver: SolidSolver,
                                       nodes: np.ndarray) -> ContactNodeComplianceTable:
    """Compute the compliance table of the contact nodes, in which all of the missing force counts as error.

    Args:
        reduced: modes, sampled elements and material.
        solver: full-order solver with the same material; it is at rest afterwards.
        nodes: indices of the nodes that may touch the tool, shape (n,).

    Raises:
        ConvergenceError: the tangent at rest is singular or indefinite.
    """
    axis = np.array(reduced.model.experiment.tool_pose(0.0).rotation_matrix)[:, 2]
    whole = _reset_and_compute_axial_compliance(solver.equations, nodes, axis)
    free = slice(reduced.lifting, reduced.basis.shape[1] - reduced.watched)
    moved = reduced.basis.reshape(-1, 3, reduced.basis.shape[1])[nodes][:, :, free].transpose(0, 2, 1) @ axis
    stiffness = _compute_resting_modal_stiffness(reduced)[free, free]
    kept = moved @ np.linalg.solve(stiffness, moved.T)
    return ContactNodeComplianceTable(nodes, axis, whole, whole - 0.5 * (kept + kept.T), np.zeros(1), np.zeros(1))


def _reset_and_compute_axial_compliance(equations: SolidEquations, nodes: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the compliance matrix of nodes of the resting solid along one axis, m/N, shape (n, n).

    Column k contains the displacements of the nodes along the axis under a unit force on node k along the axis.

    Raises:
        ConvergenceError: the tangent at rest is singular or indefinite.
    """
    factor = equations.reset_and_factorise_or_none()
    loads = np.zeros((equations.x.size, nodes.size))
    loads[(3 * nodes[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(nodes.size), 3)] = np.tile(axis, nodes.size)
    loads = loads[equations.free]
    if factor is None:
        raise ConvergenceError("The tangent at rest is singular or indefinite. Hold the specimen, or use a finer mesh.")
    moved = loads.T @ factor.solve(loads)
    return 0.5 * (moved + moved.T)


def _compute_resting_modal_stiffness(reduced: ReducedModel) -> np.ndarray:
    """Compute the modal stiffness of the sampled elements at rest, without contact, N/m, shape (modes, modes)."""
    experiment = reduced.model.experiment
    elements = SampledElements(reduced.mesh, reduced.basis, reduced.elements, reduced.shares, rest=reduced.rest,
                               layers=reduced.element_layers, contact_radius=experiment.contact_radius)
    elements.set_material(reduced.model.material, reduced.bulk_ratio)
    elements.initialise_rest_state()
    rest = np.zeros(reduced.basis.shape[1])
    elements.pressures[:] = elements.rest_pressures
    elements.evaluate_forces_and_invalidate_stiffness(rest)
    elements.evaluate_forces_and_stiffness(rest, False, 1)
    return elements.modal_stiffness


@lru_cache(maxsize=2)
def compute_compliance_table_of_old_model(reduced: ReducedModel) -> ContactNodeComplianceTable:
    """Compute the compliance table of a reduced solid whose file was written by an older version without the table.

    The table accepts no missing force: all of the missing force counts as error.
    """
    from tissue_sim.fem.solid.discretisation import make_solver

    solver = make_solver(reduced.model, mesh=reduced.mesh)
    return reset_and_compute_compliance_table(reduced, solver, np.sort(solver.contact.nodes[solver.contact.moves]))
