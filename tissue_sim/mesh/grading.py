"""How fine a mesh in space is, and where it is finest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.axisymmetric import growing_line, with_lines
from tissue_sim.mesh.hexahedra import Hexahedron

#: Radius of the circle that takes a needle's place under a plate, over the distance from the axis to the side.
PLATE_RING = 0.6
#: Share of the tool's radius to which the square core of an O-grid reaches.
CORE = 0.5


@dataclass(frozen=True)
class Grading:
    """Sizes of elements that lead away from the edge of a tool's face, or from the edges under a plate.

    Attributes:
        element: element type; a mesh of a file takes those of its own of the same order.
        smallest, growth, largest: of the intervals, m; see `growing_line`.
        around: elements along a quarter of the edge of a needle's face.
        radius: of the circle under a needle, m; None: a plate covers the whole top.
        centre: of the circle, seen from above, m.
        interfaces: depths below the top at which element boundaries lie, ascending, m.
        least: elements between two of them.
    """

    element: Hexahedron
    smallest: float
    growth: float
    largest: float
    around: int
    radius: float | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    interfaces: tuple[float, ...] = ()
    least: int = 1

    def line(self, length: float) -> np.ndarray:
        """Break points from 0 to a length, m."""
        return growing_line(length, self.smallest, self.growth, self.largest)

    def line_between(self, length: float) -> np.ndarray:
        """Break points from 0 to a length, m, fine towards both ends."""
        half = self.line(0.5 * length)
        return np.concatenate([half, length - half[-2::-1]])

    def with_interfaces(self, heights: np.ndarray, height: float) -> np.ndarray:
        """Heights of element boundaries below 0, base first, that meet the interfaces too, m.

        Raises:
            InputError: interfaces that do not lie inside.
        """
        if not self.interfaces:
            return heights
        if self.interfaces[-1] >= height * (1.0 - 1e-9):
            raise InputError(f"the layers are {self.interfaces[-1] * 1e3:g} mm thick, the specimen only "
                             f"{height * 1e3:g} mm high", field="layers")
        return with_lines(heights, [-depth for depth in self.interfaces], self.least)
