"""Cylinder as a specimen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter
from tissue_sim.specimen.specimen import Specimen, add_indefinite_article

if TYPE_CHECKING:
    from tissue_sim.mesh.mesh_mapping import Circle
    from tissue_sim.mesh.solid import Grading, SolidMesh


@dataclass(frozen=True)
class Cylinder(Specimen):
    """A cylinder that stands on its base.

    Attributes:
        radius: of the undeformed cylinder, m.
        height: m.
    """

    shape = "cylinder"
    is_round = True
    radius: float = parameter("R", "m", key="radius_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)
    height: float = parameter("H", "m", key="height_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)

    @property
    def area(self) -> float:
        """Undeformed cross-section, pi times the radius squared, m2."""
        return math.pi * self.radius**2

    def margin(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return the distance of a position (x, y) from the edge of the top, in plan view, m; negative outside."""
        return self.radius - math.hypot(x, y)

    @property
    def outer_radius(self) -> float:
        """Radius of the cylinder, m."""
        return self.radius

    def solid_mesh(self, grading: Grading) -> SolidMesh:
        """Make the O-grid mesh of hexahedra; see `Specimen.solid_mesh`."""
        from tissue_sim.mesh.solid import create_graded_cylinder_mesh

        return create_graded_cylinder_mesh(self.radius, self.height, grading)

    def moved_mesh(self, mesh: SolidMesh, before: Specimen, circles: tuple[Circle, Circle]) -> SolidMesh:
        """Move the mesh of another cylinder to this cylinder; see `Specimen.moved_mesh`."""
        from tissue_sim.mesh.mesh_mapping import CylinderWithTopCircle, map_cylinder

        assert isinstance(before, Cylinder)
        old, new = (CylinderWithTopCircle(body.radius, body.height, *circle)
                    for body, circle in zip((before, self), circles, strict=True))
        return map_cylinder(mesh, old, new)


def require_cylinder(specimen: Specimen, who: str, instead: str = 'take the solver "solid" (--solid)') -> Cylinder:
    """Return a specimen that is a cylinder.

    Args:
        specimen: specimen of any shape.
        who: the caller that supports cylinders only, for the message.
        instead: remedy, for the message.

    Raises:
        InputError: the specimen is not a cylinder.
    """
    if not isinstance(specimen, Cylinder):
        raise InputError(f"{who} requires a cylinder; the specimen is {add_indefinite_article(specimen.shape)}; "
                         f"{instead}",
                         field="specimen.shape")
    return specimen
