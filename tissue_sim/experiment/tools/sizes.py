"""Declarations of sizes that several shapes share."""

from __future__ import annotations

from typing import Any

from tissue_sim.parameters import parameter

#: Smallest and largest radius in a fit, m.
_RADII = (1e-6, 1.0)


def radius() -> Any:
    """Declare the field `radius` of a tool: radius of the shaft, or of the ball, m."""
    return parameter("a", "m", key="tool_radius_mm", factor=1e-3, bounds=_RADII, shapes_mesh=True)


def edge_radius() -> Any:
    """Declare the field `edge_radius` of a tool: radius of the rounding between a flat face and the shaft, m."""
    return parameter("r_e", "m", key="edge_radius_mm", factor=1e-3, bounds=(0.0, _RADII[1]), absent=0.0,
                     shapes_mesh=True, default=0.0)
