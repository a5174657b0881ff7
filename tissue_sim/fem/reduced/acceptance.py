"""At which missing forces the answers of a reduced solid are right, learned on the strokes that it was made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tissue_sim.fem.reduced.compliance import MissingForce, contact_compliance
from tissue_sim.fem.reduced.compliance_table import with_accepted
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.training import FINER, Snapshots
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose, between


def with_compliance(reduced: ReducedModel, solver: SolidSolver, poses: Sequence[Sequence[Pose]],
                    taken: Sequence[Snapshots], materials: Sequence[Material]) -> ReducedModel:
    """A reduced solid that knows the compliance of its contact nodes; one whose tool holds tissue stays as it is.

    The strokes are followed by the reduced solid and compared with the whole one, see `with_accepted`.

    Args:
        solver: the whole solid, of the model's material; it is at rest afterwards.
        poses: of each stroke. taken: of the whole solid there. materials: of the solid on each stroke.
    """
    if reduced.lifting:
        return reduced
    nodes = np.sort(solver.contact.nodes[solver.contact.moves])
    table = contact_compliance(reduced, solver, nodes)
    small = ReducedSolver(replace(reduced, compliance=table), reduced.model.material)
    missing_force = MissingForce(table, small.contact)
    forces, missing, errors = [], [], []
    for stroke, whole, material in zip(poses, taken, materials, strict=True):
        if material is not small.material:
            small.set_material(material)
        small.forget()
        here = stroke[0]
        for pose, wrench in zip(stroke, whole.wrenches, strict=True):
            steps = [small.step(between(here, pose, (k + 1) / FINER)) for k in range(FINER)]
            here = pose
            if steps[-1].status is StepStatus.CONVERGED and small.contact.touches:
                force = np.array(steps[-1].wrench[:3])
                forces.append(float(np.linalg.norm(force)))
                missing.append(missing_force.value())
                errors.append(float(np.linalg.norm(force - wrench[:3])))
    return replace(reduced, compliance=with_accepted(table, forces, missing, errors))
