"""Verification of a reduced solid on test paths, and calibration of its error estimate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.training import simulate_snapshots
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose, interpolate_pose


def verify_and_get_report_and_factors(reduced: ReducedModel, solver: SolidSolver, strokes: Sequence[Sequence[Pose]],
                                      progress: Callable[[int, int], None] | None = None, *,
                                      materials: Sequence[Material] = (),
                                      memory: Sequence[np.ndarray] = ()) -> tuple[dict[str, Any], tuple[float, float]]:
    """Compare the reduced with the full-order solid on test paths, and calibrate the error estimate.

    Non-negative least squares fit the error factors to the error beyond the estimate by missing compliance. The factors
    are then enlarged until the estimate covers enough states, see `find_covering_factor`.

    Args:
        reduced: the reduced solid.
        solver: the full-order solver.
        strokes: poses of each test path.
        progress: called with the number of finished paths and the number of all paths.
        materials: materials that are used in turn; none: the present material.
        memory: material history at rest, see `get_rest_history_under_self_weight`.

    Returns:
        The report and the first two error factors of `ReducedModel`. The report contains ``force_rms_error`` and
        ``force_largest_error`` over the rms force with the same material, ``force_rms_N``, the rms force over all
        paths, ``not_converged``, the fraction of failed steps, and ``warnings`` of the full-order solver if any.
    """
    from scipy.optimize import nnls

    # A second solid with fewer modes adds states whose error is caused by modes rather than by sampled elements.
    more = (reduced.basis.shape[1] - reduced.lifting - reduced.watched) // VERIFICATION.modes_per_omitted_mode
    table = reduced.compliance
    plain = replace(reduced, error_factors=(1.0, 0.0, 0.0),
                    compliance=None if table is None else table.unlimited_acceptance_copy)
    small, fewer = (ReducedSolver(replace(plain, watched=reduced.watched + each), reduced.model.material)
                    for each in (0, more if reduced.watched else 0))
    missed, forces, estimates, explained, kinds, lost, steps = [], [], [], [], [], 0, 0
    others: list[tuple[float, float, float]] = []
    doubts: Sequence[str] = ()
    for done, poses in enumerate(strokes):
        for each in (solver, small, fewer) if materials else ():
            if each.material is not (material := materials[done % len(materials)]):
                each.set_material(material)
        whole = simulate_snapshots(solver, poses, memory=memory)
        true, doubts = whole.wrenches, whole.doubts or doubts
        for each in (small, fewer):
            each.reset_to_rest()
        here = poses[0]
        for pose, wrench in zip(poses, true, strict=True):
            for k in range(VERIFICATION.substeps):
                there = interpolate_pose(here, pose, (k + 1) / VERIFICATION.substeps)
                step, coarse = small.step(there), fewer.step(there)
                steps += 1
                lost += step.status is not StepStatus.CONVERGED
            here = pose
            missed.append(np.subtract(step.wrench[:3], wrench[:3]))
            forces.append(wrench[:3])
            kinds.append(done % max(1, len(materials)))
            estimates.append(step.force_error or 0.0)
            explained.append(0.0 if table is None or small.missing_force is None else max(
                0.0, small.missing_force.compute_missing_axial_force()
                - table.get_accepted_missing_force_at_tool_force(float(np.linalg.norm(step.wrench[:3])))))
            others.append((coarse.force_error or 0.0, float(np.linalg.norm(wrench[:3])),
                           float(np.linalg.norm(np.subtract(coarse.wrench[:3], wrench[:3])))))
        if progress:
            progress(done + 1, len(strokes))
    error, force = (np.linalg.norm(np.array(each), axis=1) for each in (missed, forces))
    # Relative to the rms force with the same material, so that soft and stiff materials have equal weight.
    of_kind = [np.sqrt(np.mean(force[np.array(kinds) == kind] ** 2)) for kind in range(max(kinds) + 1)]
    rms = np.array(of_kind)[kinds]
    largest = np.array([force[np.array(kinds) == kind].max() for kind in range(max(kinds) + 1)])[kinds]
    left = np.maximum(0.0, error - explained)
    known = np.concatenate([np.column_stack([estimates, force, left]), others]) / np.tile(rms, 2)[:, None]
    factors, _ = nnls(known[:, :2], known[:, 2])
    factors *= max(1.0, find_covering_factor(known[: len(error), :2] @ factors, left / rms,
                                             VERIFICATION.substantial_error * largest / rms))
    return {"force_rms_error": float(np.sqrt(np.mean((error / rms) ** 2))),
            "force_largest_error": float((error / rms).max()), "force_rms_N": float(np.sqrt(np.mean(force**2))),
            "not_converged": lost / steps, **({"warnings": list(doubts)} if doubts else {})}, (
        float(factors[0]), float(factors[1]))


def find_covering_factor(estimates: np.ndarray, errors: np.ndarray, substantial: np.ndarray) -> float:
    """Return the smallest factor c with which c estimate + negligible error covers enough of the errors.

    The fraction `VerificationSettings.coverage` of all states is covered, and every state with a substantial error.

    Args:
        estimates: estimated errors over the rms force, shape (states,). States with an estimate of zero are left out.
        errors: true errors over the rms force, shape (states,).
        substantial: errors over the rms force above which each state is covered, shape (states,).

    Returns:
        The factor; 0 without a positive estimate, or if the negligible error covers enough states.
    """
    known = estimates > 0.0
    if not known.any():
        return 0.0
    ratios = (errors[known] - VERIFICATION.negligible_error) / estimates[known]
    required = ratios[errors[known] > substantial[known]]
    return float(max(0.0, np.quantile(ratios, VERIFICATION.coverage), required.max(initial=0.0)))
