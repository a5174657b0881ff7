"""Linear response of a reduced solid at an equilibrium: sensitivity, stiffness of the tool, estimated force error."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.reduced.compliance import MissingComplianceErrorEstimator
from tissue_sim.fem.reduced.contact import PenaltyContact
from tissue_sim.fem.reduced.linear import euclidean_norm, solve_dense_system_or_raise
from tissue_sim.fem.reduced.model import ErrorFactors, PoseBox


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
