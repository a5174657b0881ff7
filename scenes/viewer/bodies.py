"""Tissue as the page draws it: surfaces in bands of a field, and lines; one way for a section and for a solid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from scenes.viewer.cut_away import CutAway
from scenes.viewer.revolution import Surface
from scenes.viewer.solid_body import SolidBody
from scenes.viewer.tool_picture import contact_picture
from scenes.viewer.wedge import Wedge
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.fem.fields import extrapolate
from tissue_sim.fem.solid.fields import SolidFields


class Body(Protocol):
    """What is drawn of tissue. Places are those of its nodes, as `Snapshot.place` gives them; all lengths are in m."""

    def values(self, fields: Any, name: str, place: np.ndarray, wedge: Wedge) -> tuple[np.ndarray, np.ndarray, Any]:
        """A field at the nodes that are seen, at points that stand for the whole body, and the fields of these."""

    def bands(self, place: np.ndarray, values: np.ndarray, levels: np.ndarray, wedge: Wedge) -> list[Surface]:
        """One surface for each band between levels."""

    def mesh_lines(self, place: np.ndarray, wedge: Wedge) -> np.ndarray:
        """Element edges, shape (lines, 2, 3)."""

    def contact_lines(self, place: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        """Where tissue touches the tool, shape (lines, 2, 3); None where it does not."""

    def outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        """Of the undeformed tissue, shape (lines, 2, 3).

        Args:
            wedge: that is cut out.
            tool: its radius and largest depth, m.
        """


@dataclass(frozen=True, eq=False)
class RevolvedBody:
    """A half section, turned about its axis.

    Attributes:
        cut_away: the section.
    """

    cut_away: CutAway

    def values(self, fields: Fields, name: str, place: np.ndarray,
               wedge: Wedge) -> tuple[np.ndarray, np.ndarray, Fields]:
        at_points = fields.at_points(name)
        nodal = fields.at_nodes(name) if name == "displacement" else extrapolate(fields.mesh, at_points)
        return nodal, at_points, fields

    def bands(self, place: np.ndarray, values: np.ndarray, levels: np.ndarray, wedge: Wedge) -> list[Surface]:
        return self.cut_away.bands(place, values, levels, wedge.opening)

    def mesh_lines(self, place: np.ndarray, wedge: Wedge) -> np.ndarray:
        return self.cut_away.mesh_lines(place, wedge.opening)

    def contact_lines(self, place: np.ndarray, tool: Tool, wedge: Wedge) -> np.ndarray | None:
        contact = contact_picture(self.cut_away.surface_line(place), tool, wedge.pose.depth, wedge.opening)
        return None if contact is None else contact.lines

    def outline(self, wedge: Wedge, tool: tuple[float, float]) -> np.ndarray:
        return self.cut_away.undeformed_outline(wedge.opening, tool=tool)


def body_of(mesh: Any) -> Body:
    """What is drawn of a mesh, of a section or in space."""
    return SolidBody.of(mesh) if mesh.nodes.shape[1] == 3 else RevolvedBody(CutAway.of(mesh))


def drawable(fields: Any) -> bool:
    """Whether a body can be drawn of these fields."""
    return isinstance(fields, Fields | SolidFields)
