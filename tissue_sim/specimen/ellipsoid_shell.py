"""Half a shell between two ellipsoids, such as the tissue of a brain over a stiffer core."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter
from tissue_sim.specimen.specimen import Specimen

if TYPE_CHECKING:
    from tissue_sim.mesh.solid import Grading, SolidMesh


def _declare_size(symbol: str, key: str) -> Any:
    """Declare a field for a size in m, with its symbol in reports and its key (mm) in files."""
    return parameter(symbol, "m", key=key, factor=1e-3, bounds=(1e-4, 1.0), shapes_mesh=True)


@dataclass(frozen=True)
class EllipsoidShell(Specimen):
    """The upper half of a shell of soft tissue between two ellipsoids.

    The inner surface is fixed to a rigid core, the rim is free.

    Attributes:
        semi_axis_x, semi_axis_y, semi_axis_z: semi-axes of the outer surface, m; its apex is the origin.
        thickness: difference between the semi-axes of outer and inner surface, m.

    Raises:
        InputError: the thickness is at least a semi-axis, so that no core remains.
    """

    shape = "ellipsoid_shell"
    is_prism = False
    is_flat = False
    semi_axis_x: float = _declare_size("a_x", "semi_axis_x_mm")
    semi_axis_y: float = _declare_size("a_y", "semi_axis_y_mm")
    semi_axis_z: float = _declare_size("a_z", "semi_axis_z_mm")
    thickness: float = _declare_size("t", "thickness_mm")

    def __post_init__(self):
        super().__post_init__()
        if self.thickness >= min(self.semi_axes):
            raise InputError(f"a shell of {self.thickness * 1e3:g} mm leaves no core in an ellipsoid whose shortest "
                             f"semi-axis is {min(self.semi_axes) * 1e3:g} mm; give less", field="specimen.thickness")

    @property
    def semi_axes(self) -> tuple[float, float, float]:
        """Semi-axes of the outer surface along x, y and z, m."""
        return self.semi_axis_x, self.semi_axis_y, self.semi_axis_z

    @property
    def height(self) -> float:
        """Height of the apex above the rim, the semi-axis along z, m."""
        return self.semi_axis_z

    def margin(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return a lower bound of the distance of a point from the rim, in plan view, m; negative outside."""
        # A lower bound: the distance from a similar ellipse through the point to the rim.
        return (1.0 - math.hypot(x / self.semi_axis_x, y / self.semi_axis_y)) * min(self.semi_axis_x, self.semi_axis_y)

    @property
    def outer_radius(self) -> float:
        """Longer semi-axis of the rim, m."""
        return max(self.semi_axis_x, self.semi_axis_y)

    def vertical_thickness(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return the vertical distance between outer and inner surface at a point, m."""
        outer, inner = (
            c * math.sqrt(max(0.0, 1.0 - (x / a) ** 2 - (y / b) ** 2)) for a, b, c in (
                self.semi_axes, tuple(axis - self.thickness for axis in self.semi_axes)))
        return outer - inner

    def solid_mesh(self, grading: Grading) -> SolidMesh:
        """Make the mesh of hexahedra; see `Specimen.solid_mesh`."""
        from tissue_sim.mesh.solid import create_half_ellipsoid_shell_mesh

        return create_half_ellipsoid_shell_mesh(self.semi_axes, self.thickness, grading)
