"""Linear response of a reduced solid at an equilibrium: sensitivity, stiffness, and estimated force error.

The error estimate is a-posteriori. It uses the compliance that the contact nodes of the reduced solid lack. A reduced
basis represents displacements under the contact forces of the training paths. It contains almost no motion of
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
from tissue_sim.fem.linear.dense import euclidean_norm, solve_dense_system_or_raise
from tissue_sim.fem.reduced.contact import PenaltyContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.model import ContactNodeComplianceTable, ErrorFactors, PoseBox, ReducedModel
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


class LinearResponse:
    """Linear response at an equilibrium: sensitivity to the tool, tool stiffness, and estimated force error.

    One factorisation of the tangent solves all linear systems.

    Args:
        tangent: stiffness of tissue and contact between the modes, N/m, shape (modes, modes).
        contact: contact, evaluated at the equilibrium.
        prescribed_rates: derivative of the prescribed amplitudes with respect to position and rotation of the tool,
            shape (prescribed, 6).
        free: range of the unknown modes; before it are the modes prescribed by the tool, behind it the error modes.
        residual: modal residual, N m per m, shape (modes,).

    Attributes:
        sensitivity: derivative of the amplitudes with respect to position and rotation of the tool, shape (modes, 6);
            zero for the error modes.
        correction: change of the amplitudes that would remove the residual, shape (modes,).
    """

    def __init__(self, tangent: np.ndarray, contact: PenaltyContact, prescribed_rates: np.ndarray, free: slice,
                 residual: np.ndarray):
        self._tangent, self._contact, self._prescribed_rates = tangent, contact, prescribed_rates
        self._free, self._residual = free, residual
        modes, held = len(residual), free.start
        error_modes = slice(free.stop, modes)
        right = np.empty((free.stop - held, 7 + modes - free.stop), order="F")
        right[:, :6] = contact.modal_force_derivative_by_pose[free]
        if held:
            right[:, :6] += tangent[free, :held] @ prescribed_rates
        right[:, 6] = residual[free]
        right[:, 7:] = tangent[free, error_modes]
        found = solve_dense_system_or_raise(tangent[free, free], right)
        changes = np.zeros((modes, 7))
        changes[:held, :6] = prescribed_rates
        changes[free] = -found[:, :7]
        self.sensitivity, self.correction = changes[:, :6], changes[:, 6]
        self._static_modes = found[:, 7:]

    def estimate_total_force_error_or_none(self, factors: ErrorFactors, force: np.ndarray,
                                           missing: MissingComplianceErrorEstimator | None = None) -> float | None:
        """Estimate the error of a force on the tool, N: missing modes, missing compliance, and lateral error.

        The error by missing modes is c_1 |dF| + c_2 |F|. dF is the change of the force F if the error modes were
        unknowns, too (hierarchical error estimate: Bank and Weiser, Math. Comp. 44 (1985) 283).
        `verification.verify_and_get_report_and_factors` calibrates the factors. The lateral error is c_3 times the
        largest lateral force, see `calibrate_lateral_error_to_force_ratio`.

        Args:
            factors: c_1, c_2 and c_3, see `ReducedModel.error_factors`.
            force: force on the tool, N, shape (3,).
            missing: missing force of the contact at this equilibrium; None: unknown.

        Returns:
            Estimated error, N; None without error modes and without `missing`.
        """
        known = self._estimate_missing_mode_error(factors, force) if self._free.stop < len(self._residual) else None
        if missing is not None:
            known = (known or 0.0) + missing.estimate_missing_compliance_error(euclidean_norm(force))
        if known is not None and self._contact.has_friction:
            known += factors[2] * self._contact.largest_lateral_tool_force_since_touch
        return known

    def _estimate_missing_mode_error(self, factors: ErrorFactors, force: np.ndarray) -> float:
        """Return the error of the force on the tool by missing modes, N, see `estimate_total_force_error_or_none`."""
        free, held = self._free, self._free.start
        tangent = self._tangent
        # The residual of the unknown modes is an iteration error; only the residual of the error modes counts.
        change = np.zeros(len(self._residual))
        change[free.stop :] = moved = solve_dense_system_or_raise(
            tangent[free.stop :, free.stop :] - tangent[free.stop :, free] @ self._static_modes,
            -self._residual[free.stop :])
        change[free] = -self._static_modes @ moved
        added = self._contact.compute_force_change_by_amplitudes(change)
        if held:
            added = added - (self._prescribed_rates.T @ (tangent[:held] @ change))[:3]
        changed, own, _ = factors
        return changed * euclidean_norm(added) + own * euclidean_norm(force)

    def compute_combined_stiffness_at_tool(self, box: PoseBox) -> np.ndarray:
        """Compute the stiffness of tissue and contact at the tool: minus d wrench / d pose, shape (6, 6).

        The entries of directions in which the box has no size are 0.
        """
        held, contact, sensitivity = self._free.start, self._contact, self.sensitivity
        stiffness = contact.compute_contact_stiffness_at_tool(sensitivity)
        if held:
            # The prescribed modes move nodes outside the bonded face, whose contact forces are part of the residual.
            forces = self._tangent[:held] @ sensitivity + contact.modal_force_derivative_by_pose[:held]
            return stiffness + sensitivity[:held].T @ forces
        # In directions without training data the modes have no response; the result would be the layer stiffness.
        known = np.array([box.sideways > 0.0] * 2 + [True] + [box.turn > 0.0] * 3)
        return np.where(known[:, None] & known, stiffness, 0.0)
