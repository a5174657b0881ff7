"""A block whose top is longer than its base, as a shape of specimen."""

from dataclasses import dataclass, replace

import numpy as np

import tissue_sim as ts
from tissue_sim.mesh.solid import create_block_mesh_under_plate, create_block_mesh_under_tool


@dataclass(frozen=True)
class Wedge(ts.Specimen):
    """A block whose sides lean outwards along x.

    Attributes:
        length: of the top along x, m. base_length: of the base, m. width: along y, m. height: m.
    """

    shape = "wedge"
    is_prism = False
    length: float = ts.parameter("L", "m", key="length_mm", factor=1e-3, bounds=(1e-3, 1.0), shapes_mesh=True)
    base_length: float = ts.parameter("L0", "m", key="base_length_mm", factor=1e-3, bounds=(1e-3, 1.0),
                                      shapes_mesh=True)
    width: float = ts.parameter("B", "m", key="width_mm", factor=1e-3, bounds=(1e-3, 1.0), shapes_mesh=True)
    height: float = ts.parameter("H", "m", key="height_mm", factor=1e-3, bounds=(1e-3, 1.0), shapes_mesh=True)

    def margin(self, x=0.0, y=0.0):
        return min(0.5 * self.length - abs(x), 0.5 * self.width - abs(y))

    @property
    def outer_radius(self):
        return 0.5 * np.hypot(max(self.length, self.base_length), self.width)

    def solid_mesh(self, grading):
        mesh = (create_block_mesh_under_plate if grading.radius is None else create_block_mesh_under_tool)(
            self.length, self.width, self.height, grading)
        share = -mesh.nodes[:, 2] / self.height
        stretch = 1.0 + share * (self.base_length / self.length - 1.0)
        return replace(mesh, nodes=mesh.nodes * np.column_stack([stretch, np.ones((len(share), 2))]))
