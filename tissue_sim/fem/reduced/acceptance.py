"""Calibration of the missing-compliance error estimate on the training paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tissue_sim.fem.reduced.compliance import MissingComplianceErrorEstimator, reset_and_compute_compliance_table
from tissue_sim.fem.reduced.compliance_table import calibrate_accepted_missing_forces
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.path_steps import simulate_reduced_path
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.training import TrainingDisplacementsAndWrenches
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose


def with_calibrated_compliance_table(reduced: ReducedModel, solver: SolidSolver, poses: Sequence[Sequence[Pose]],
                                     snapshots: Sequence[TrainingDisplacementsAndWrenches],
                                     materials: Sequence[Material]) -> ReducedModel:
    """Return a copy of a reduced solid with the calibrated compliance table of its contact nodes.

    The reduced solid is simulated along the training paths. Its missing force and its true force error give the
    missing forces that are accepted, see `calibrate_accepted_missing_forces`. A reduced solid with a bonded tool is
    returned unchanged.

    Args:
        reduced: the reduced solid.
        solver: full-order solver with the material of the model; it is at rest afterwards.
        poses: poses of each training path.
        snapshots: full-order states on each training path.
        materials: material on each training path.
    """
    if reduced.lifting:
        return reduced
    nodes = np.sort(solver.contact.nodes[solver.contact.moves])
    table = reset_and_compute_compliance_table(reduced, solver, nodes)
    small = ReducedSolver(replace(reduced, compliance=table), reduced.model.material)
    missing_force = MissingComplianceErrorEstimator(table, small.contact)
    forces, missing, errors = [], [], []
    for path, full_order, material in zip(poses, snapshots, materials, strict=True):
        if material is not small.material:
            small.set_material(material)
        for step, wrench in zip(simulate_reduced_path(small, path), full_order.wrenches, strict=True):
            if step.status is StepStatus.CONVERGED and small.contact.has_touching_nodes:
                force = np.array(step.wrench[:3])
                forces.append(float(np.linalg.norm(force)))
                missing.append(missing_force.compute_missing_axial_force())
                errors.append(float(np.linalg.norm(force - wrench[:3])))
    return replace(reduced, compliance=calibrate_accepted_missing_forces(table, forces, missing, errors))
