"""Errors of coarse elements under a tool: rounded edges smaller than the elements, and faceting."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.experiment.tools.outline import OutlineLineColumn
from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.fem.solid.equations import SolidEquations
from tissue_sim.fem.solid.faceting import estimate_faceting_force_error_or_none, faceting_warnings
from tissue_sim.fem.solid.frame import ToolFrame

#: Fraction of the surface under the face that has moved past the edge, above which a warning is given, 1.
WARNING_FRACTION = 0.025
#: Sine of the angle along the rounded edge beyond which a node has left the face, 1.
EDGE_SINE = 0.5
#: Distance from the edge of the face up to which a node is under the face, over the radius of the rounded edge, 1.
FACE_MARGIN = 0.01
#: Fraction of the force from which on the missing force is at least the whole force, 1.
LARGEST_FRACTION = 0.5


class SlidFaceSurface(NamedTuple):
    """Surface under a flat face that has slid onto a rounded edge smaller than the elements there.

    Attributes:
        fraction: its area over that of the surface under the face, 1; about the missing fraction of the force.
        size: size of the largest of its elements, m.
        radius: radius of the edge, m.
    """

    fraction: float
    size: float
    radius: float


def find_slid_face_surface_or_none(contact: ContactNodes, displacement: np.ndarray, first: ToolFrame,
                                   frame: ToolFrame) -> SlidFaceSurface | None:
    """Find the nodes that have slid from a flat face onto an edge that is smaller than the elements there.

    Contact acts at nodes. Where a node leaves the face, the tissue up to the next node carries no force, although the
    face still presses on it: the force is too small.

    Args:
        contact: contact nodes at an equilibrium.
        displacement: displacement of all nodes, m, shape (nodes, 3).
        first: frame of the tool at its first touch.
        frame: frame of the tool.

    Returns:
        None if few nodes have left the face, or if the elements are smaller than the edge.
    """
    left = under = radius = 0.0
    sizes = [0.0]
    for pair, own in contact.parts:
        profile = pair.profile
        has_flat_face = profile.shaft == 1 and profile.lines[0, OutlineLineColumn.DIRECTION_Z] == 0.0
        if not (pair.moves and profile.rounding and has_flat_face and len(profile.lines) > 1):
            continue
        face, radius = float(profile.vertices[1, 0]), profile.rounding
        places, limit = contact.places[own], face + FACE_MARGIN * radius
        # The undeformed nodes under the face, at the first touch and now: the tool may have moved sideways.
        is_under = (_compute_radii(first, places) < limit) & (_compute_radii(frame, places) < limit)
        has_left = is_under & (_compute_radii(frame, places + displacement[contact.nodes[own]])
                               > face + EDGE_SINE * radius)
        areas = contact.areas[own]
        under, left = under + float(areas[is_under].sum()), left + float(areas[has_left].sum())
        sizes += np.sqrt(areas[has_left]).tolist()
    if max(sizes) < radius or left <= WARNING_FRACTION * under:
        return None
    return SlidFaceSurface(left / under, max(sizes), radius)


def _compute_radii(frame: ToolFrame, points: np.ndarray) -> np.ndarray:
    """Return the distances of points, m, shape (n, 3), from the axis of the tool, m, shape (n,)."""
    at = frame.transform_to_tool(points)
    return np.hypot(at[:, 0], at[:, 1])


def estimate_coarse_surface_error_or_none(equations: SolidEquations, force: float) -> float | None:
    """Estimate the force that is missing at the committed state because of coarse elements under the tool, N.

    Args:
        equations: equations of the solid.
        force: magnitude of the force on the tool, N.

    Returns:
        Missing force, N, positive; None if no estimate is available.
    """
    contact, displacement = equations.contact, equations.committed[0].reshape(-1, 3)
    faceting = estimate_faceting_force_error_or_none(contact, equations.mesh, displacement, force)
    slid = _find_slid_surface_at_committed_state_or_none(equations)
    if slid is None:
        return faceting
    missing = force * (slid.fraction / (1.0 - slid.fraction) if slid.fraction < LARGEST_FRACTION else 1.0)
    return (faceting or 0.0) + missing


def coarse_surface_warnings(equations: SolidEquations) -> list[str]:
    """Return messages about the errors of coarse elements under the tool at the committed state."""
    warnings = faceting_warnings(equations.contact, equations.mesh, equations.committed[0].reshape(-1, 3))
    slid = _find_slid_surface_at_committed_state_or_none(equations)
    if slid is not None:
        warnings.append(
            f"coarse edge: {100.0 * slid.fraction:.2g} % of the surface under the face has slid around the edge of the "
            f"tool, whose radius, {1e3 * slid.radius:.2g} mm, is smaller than the elements there, "
            f"{1e3 * slid.size:.2g} mm. The force is too small by about this fraction. Use elements of "
            f"{1e3 * slid.radius:.2g} mm at the edge, or a larger edge radius")
    return warnings


def _find_slid_surface_at_committed_state_or_none(equations: SolidEquations) -> SlidFaceSurface | None:
    return find_slid_face_surface_or_none(equations.contact, equations.committed[0].reshape(-1, 3),
                                          equations.first_frame, ToolFrame(equations.pose, equations.datum))
