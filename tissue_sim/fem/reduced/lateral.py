"""Calibration of the lateral error estimate of a reduced solid with friction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.path_steps import simulate_reduced_path
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.training import simulate_snapshots
from tissue_sim.fem.reduced.verification import find_covering_factor
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose


def calibrate_lateral_error_to_force_ratio(reduced: ReducedModel, solver: SolidSolver, paths: Sequence[Sequence[Pose]],
                                           materials: Sequence[Material], *,
                                           memory: Sequence[np.ndarray] = ()) -> float:
    """Compute the ratio of the lateral force error and the largest lateral force since the first touch.

    With friction, the force depends on the path. On paths with a reversal, the lateral error stays about constant while
    the lateral force decreases; the error modes and the missing compliance (`MissingComplianceErrorEstimator`) estimate
    the error at the present contact forces only and become small. The largest lateral force since the first touch
    scales with the error on such paths. An indentation along the axis has almost no lateral force, so that its estimate
    hardly changes.

    The product of the factor and the largest lateral force, plus the negligible error, covers the lateral errors on
    the paths as `find_covering_factor` states. It is added to the estimate at the present contact forces.

    Args:
        reduced: the reduced solid.
        solver: full-order solver.
        paths: poses of the tool on paths with a reversal of the lateral motion.
        materials: materials that are used in turn.
        memory: material history at rest, see `get_rest_history_under_self_weight`.

    Returns:
        The factor; 0 for a bonded tool, without friction, and without a lateral force.
    """
    small = ReducedSolver(reduced, reduced.model.material)
    if reduced.lifting or not small.contact.has_friction or not reduced.box.sideways:
        return 0.0
    axis = np.array(reduced.model.experiment.tool_pose(0.0).rotation_matrix)[:, 2]
    largest, errors, substantial = [], [], []
    for number, path in enumerate(paths):
        for each in (solver, small):
            if each.material is not (material := materials[number % len(materials)]):
                each.set_material(material)
        forces = simulate_snapshots(solver, path, memory=memory).wrenches[:, :3]
        norms = np.linalg.norm(forces, axis=1)
        rms = np.sqrt(np.mean(norms**2))
        for step, force in zip(simulate_reduced_path(small, path), forces, strict=True):
            error = np.subtract(step.wrench[:3], force)
            lateral = float(small.contact.largest_lateral[0])
            if step.status is StepStatus.CONVERGED and lateral > VERIFICATION.negligible_error * rms:
                largest.append(lateral / rms)
                errors.append(float(np.linalg.norm(error - (error @ axis) * axis)) / rms)
                substantial.append(VERIFICATION.substantial_error * norms.max() / rms)
    return find_covering_factor(np.array(largest), np.array(errors), np.array(substantial))
