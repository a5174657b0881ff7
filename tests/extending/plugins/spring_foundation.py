"""An engine of the benchmark: the tissue as independent springs on a rigid base (Winkler foundation)."""

import numpy as np

from calibration.targets.runner import TargetCurve, TargetRunner
from tissue_sim.errors import InputError


class SpringFoundation(TargetRunner):
    """Springs of stiffness E (1 - nu) / ((1 + nu) (1 - 2 nu) h) per area below the tool; no friction, no inertia."""

    title = "spring foundation"

    def describe_missing_program(self):
        return ""

    def run(self, test, material, progress=None):
        nodes = test.mesh.nodes[test.mesh.sets["top"]]
        areas = test.mesh.surface_node_areas[test.mesh.sets["top"]]
        E, nu, height = material.young, material.poisson, np.ptp(test.mesh.nodes[:, 2])
        stiffness = E * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu) * height)
        if test.positions[0, 2] < 0.0:
            raise InputError("must not touch the tissue at first; move the tool up.", field="positions")
        forces = []
        for position in test.positions:
            offsets = nodes - position
            gaps = test.tool.profile.gap(np.column_stack([np.hypot(offsets[:, 0], offsets[:, 1]), offsets[:, 2]]))
            forces.append([0.0, 0.0, float(stiffness * areas @ np.maximum(-gaps, 0.0))])
        return TargetCurve(test.positions, np.array(forces), version="1")


ENGINE = SpringFoundation()
