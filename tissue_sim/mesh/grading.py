"""Grading of three-dimensional meshes: sizes of the elements and position of the smallest ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.axisymmetric import divide_into_growing_intervals, insert_interfaces_and_refine_layers
from tissue_sim.mesh.hexahedra import Hexahedron


@dataclass(frozen=True)
class OGridSettings:
    """Proportions of an O-grid: rings of elements around a square core.

    Attributes:
        plate_ring: radius of the circle of the O-grid under a plate, as a fraction of the radius of the specimen, 1.
        core: size of the square core, as a fraction of the radius of the tool, 1.
    """

    plate_ring: float = 0.6
    core: float = 0.5


#: Proportions of every O-grid.
O_GRID = OGridSettings()


@dataclass(frozen=True)
class Grading:
    """Sizes of elements: smallest at the edge of the tool's face, or of a specimen under a plate, growing from there.

    Attributes:
        element: element type; a mesh from a file uses its own shape of element with the same order.
        smallest: length of the smallest interval, m; see `divide_into_growing_intervals`.
        growth: ratio of successive intervals.
        largest: limit of the length of an interval, m.
        around: number of elements along a quarter of the edge of a needle's face.
        radius: radius of the circle under a needle, m; None: a plate covers the whole top.
        centre: (x, y) of the centre of the circle, m.
        interfaces: depths below the top of required element boundaries, ascending, m.
        least: minimum number of elements between two interfaces.
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

    def divide_line(self, length: float) -> np.ndarray:
        """Divide a line of `length`, m, into intervals that grow from its start; return their boundaries from 0, m."""
        return divide_into_growing_intervals(length, self.smallest, self.growth, self.largest)

    def divide_line_from_both_ends(self, length: float) -> np.ndarray:
        """Divide a line of `length`, m, with small intervals at both ends; return their boundaries from 0, m."""
        half = self.divide_line(0.5 * length)
        return np.concatenate([half, length - half[-2::-1]])

    def insert_interface_heights(self, heights: np.ndarray, height: float) -> np.ndarray:
        """Return the heights of element boundaries with the interfaces added, ascending to 0, m.

        Args:
            heights: heights of element boundaries, ascending to 0, m.
            height: height of the specimen, m.

        Raises:
            InputError: the layers are thicker than the specimen.
        """
        if not self.interfaces:
            return heights
        if self.interfaces[-1] >= height * (1.0 - 1e-9):
            raise InputError(f"the layers must be thinner than the specimen, height {height * 1e3:g} mm; got "
                             f"{self.interfaces[-1] * 1e3:g} mm", field="layers")
        return insert_interfaces_and_refine_layers(heights, [-depth for depth in self.interfaces], self.least)
