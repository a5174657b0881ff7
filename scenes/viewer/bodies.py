"""Drawable tissue: surfaces in bands of a field, element edges, contact lines and outline, in 2D and 3D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from scenes.viewer.cut_away import TriangulatedHalfSection
from scenes.viewer.revolution import TriangulatedSurface
from scenes.viewer.solid_body import ThreeDimensionalMeshBody
from scenes.viewer.tool_picture import find_tool_contact
from scenes.viewer.wedge import Wedge
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.result_views import DrawableFields, HalfSectionGeometry, SolidGeometry, TissueGeometry


class DrawableTissue(Protocol):
    """Interface of tissue that the page can draw, from an axisymmetric or a 3D geometry.

    In all methods, `positions` are the deformed positions of the nodes as `Snapshot.node_positions` gives them, and
    `wedge` is the wedge that is removed from the picture. Lengths are in m.
    """

    def evaluate_field_at_nodes_and_samples(self, fields: DrawableFields, name: str, positions: np.ndarray,
                                            wedge: Wedge) -> tuple[np.ndarray, np.ndarray, DrawableFields]:
        """Evaluate a field for the picture.

        Returns:
            Values at the nodes, of which the visible ones are valid, shape (nodes,); values at quadrature points that
            represent the whole body, shape (elements, q); and the fields to which these points belong.
        """

    def compute_band_surfaces(self, positions: np.ndarray, values: np.ndarray, levels: np.ndarray,
                              wedge: Wedge) -> list[TriangulatedSurface]:
        """Return the visible surface of each band between two levels."""

    def compute_element_edge_lines(self, positions: np.ndarray, wedge: Wedge) -> np.ndarray:
        """Return the visible element edges, shape (lines, 2, 3)."""

    def find_contact_lines_or_none(self, positions: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        """Return lines along the contact with the tool, shape (lines, 2, 3); None without contact."""

    def make_undeformed_outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        """Return a dashed outline of the undeformed tissue, shape (lines, 2, 3).

        Args:
            wedge: Wedge that is removed from the picture.
            tool: Radius and largest depth of the tool, m.
        """


@dataclass(frozen=True, eq=False)
class RevolvedBody:
    """Body of revolution of a half section.

    Attributes:
        cut_away: Half section of the body.
    """

    cut_away: TriangulatedHalfSection

    def evaluate_field_at_nodes_and_samples(self, fields: DrawableFields, name: str, positions: np.ndarray,
                                            wedge: Wedge) -> tuple[np.ndarray, np.ndarray, DrawableFields]:
        """Return nodal values, values at the quadrature points, and `fields`; shapes as in `DrawableTissue`."""
        at_points = fields.at_points(name)
        return fields.at_nodes(name, at_points=at_points), at_points, fields

    def compute_band_surfaces(self, positions: np.ndarray, values: np.ndarray, levels: np.ndarray,
                              wedge: Wedge) -> list[TriangulatedSurface]:
        """Return the surface of each colour band between two levels: section faces and outer surface."""
        return self.cut_away.compute_band_surfaces(positions, values, levels, wedge.opening)

    def compute_element_edge_lines(self, positions: np.ndarray, wedge: Wedge) -> np.ndarray:
        """Return the element edges on both section faces, shape (lines, 2, 3)."""
        return self.cut_away.compute_element_edge_lines(positions, wedge.opening)

    def find_contact_lines_or_none(self, positions: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        """Return lines along the contact on both section faces and around its rim; None without contact."""
        contact = find_tool_contact(self.cut_away.compute_possible_contact_boundary(positions), tool, wedge.pose.depth,
                                    wedge.opening)
        return None if contact is None else contact.lines

    def make_undeformed_outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        """Return the dashed outline of the undeformed body, m, shape (lines, 2, 3)."""
        return self.cut_away.make_undeformed_outline(wedge.opening, tool=tool)


def make_drawable_body(geometry: TissueGeometry) -> DrawableTissue:
    """Return the drawable body of a half section or of a solid in 3D.

    Raises:
        InputError: The fields of a solver return an object of another type.
    """
    if isinstance(geometry, SolidGeometry):
        return ThreeDimensionalMeshBody.from_geometry(geometry)
    if isinstance(geometry, HalfSectionGeometry):
        return RevolvedBody(TriangulatedHalfSection(geometry))
    raise InputError(f"geometry() of the fields must return a HalfSectionGeometry or a SolidGeometry; got "
                     f"{type(geometry).__name__}")
