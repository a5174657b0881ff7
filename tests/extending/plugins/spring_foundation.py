"""An engine of the benchmark: the tissue as independent springs on a rigid base (Winkler foundation)."""

import numpy as np

from calibration.targets.runner import TargetCurve, TargetRunner
from tissue_sim.errors import InputError


class SpringFoundation(TargetRunner):
    """Flat punch or ball on springs of stiffness E (1 - nu) / ((1 + nu) (1 - 2 nu) h) per area; no friction."""

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
            r, radius = np.hypot(*(nodes - position).T[:2]), test.tool.radius
            height = 0.0 if test.tool.name == "flat" else radius - np.sqrt(np.maximum(radius**2 - r**2, 0.0))
            depths = np.where(r <= 1.001 * radius, nodes[:, 2] - position[2] - height, 0.0)
            forces.append([0.0, 0.0, float(stiffness * areas @ np.maximum(depths, 0.0))])
        return TargetCurve(test.positions, np.array(forces), version="1")


ENGINE = SpringFoundation()
