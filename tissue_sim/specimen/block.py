"""Rectangular block as a specimen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tissue_sim.parameters import parameter
from tissue_sim.specimen.specimen import Specimen

if TYPE_CHECKING:
    import numpy as np

    from tissue_sim.mesh.mesh_mapping import Circle
    from tissue_sim.mesh.solid import Grading, SolidMesh


@dataclass(frozen=True)
class Block(Specimen):
    """A rectangular block that stands on its base.

    Attributes:
        length: along x, m.
        width: along y, m.
        height: m.
    """

    shape = "block"
    length: float = parameter("L", "m", key="length_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)
    width: float = parameter("B", "m", key="width_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)
    height: float = parameter("H", "m", key="height_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)

    @property
    def area(self) -> float:
        """Undeformed cross-section, length times width, m2."""
        return self.length * self.width

    def margin(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return the distance of a position (x, y) from the edge of the top, in plan view, m; negative outside."""
        return min(0.5 * self.length - abs(x), 0.5 * self.width - abs(y))

    @property
    def outer_radius(self) -> float:
        """Half of the diagonal of the top, m."""
        return 0.5 * math.hypot(self.length, self.width)

    def solid_mesh(self, grading: Grading) -> SolidMesh:
        """Make the mesh of hexahedra; see `Specimen.solid_mesh`."""
        from tissue_sim.mesh.solid import create_block_mesh_under_plate, create_block_mesh_under_tool

        mesh = create_block_mesh_under_plate if grading.radius is None else create_block_mesh_under_tool
        return mesh(self.length, self.width, self.height, grading)

    def moved_mesh(self, mesh: SolidMesh, before: Specimen, circles: tuple[Circle, Circle]) -> SolidMesh:
        """Move the mesh of another block to this block; see `Specimen.moved_mesh`."""
        from tissue_sim.mesh.mesh_mapping import map_block

        assert isinstance(before, Block)
        return map_block(mesh, (before.extent, self.extent), circles)

    @property
    def extent(self) -> np.ndarray:
        """Sizes along x, y and z, m, shape (3,)."""
        import numpy as np

        return np.array([self.length, self.width, self.height])
