"""Errors of coarse elements under a tool: rounded edges smaller than the elements, and faceting.

Faceting error: flat sides of linear elements lie inside of the outline of a round tool.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tissue_sim.experiment.tools.tool import OutlineLineColumn
from tissue_sim.fem.solid.contact import ContactNodes, ToolFrame
from tissue_sim.fem.solid.equations import SolidEquations
from tissue_sim.mesh.solid import SolidMesh

#: Exponent of the force of a round tool as a function of its depth (Hertz).
_HERTZ_EXPONENT = 1.5


@dataclass(frozen=True)
class FacetingSettings:
    """Settings of the estimate of the faceting error.

    Attributes:
        warning_fraction: fraction of the force, missing because of faceting, above which a warning is given, 1.
        largest_fraction: fraction of the force above which the linear estimate of the missing force is not valid, 1.
        edge_ratio: side length times curvature from which on a side spans an edge of the tool, 1; the estimate holds
            for smooth parts only.
    """

    warning_fraction: float = 0.025
    largest_fraction: float = 0.5
    edge_ratio: float = 2.0


_SETTINGS = FacetingSettings()


@dataclass(frozen=True)
class FacetInsetGeometry:
    """Geometry of the flat sides of elements under a round tool, means weighted by the contact forces.

    Attributes:
        inside: mean distance by which the sides lie inside the outline of the tool, m.
        depth: largest displacement under the tool, along its normal, m.
        size: mean width of the sides, m.
    """

    inside: float
    depth: float
    size: float

    @property
    def missing_force_fraction(self) -> float:
        """Fraction of the force that is missing, 1.5 inside / depth (Hertz: F ~ depth^1.5); infinite without depth."""
        return _HERTZ_EXPONENT * self.inside / self.depth if self.depth else math.inf


def estimate_facet_inset_geometry_or_none(contact: ContactNodes, mesh: SolidMesh,
                                          displacement: np.ndarray) -> FacetInsetGeometry | None:
    """Estimate how far flat sides of elements lie inside the outline of a round tool that presses on nodes only.

    A flat side between nodes at distance h is inside of a surface with principal curvatures k1 and k2 by
    h^2 (k1 + k2) / 12 in the mean.

    Args:
        contact: contact nodes at an equilibrium.
        mesh: undeformed mesh.
        displacement: displacement of all nodes, m, shape (nodes, 3).

    Returns:
        The geometry; None for elements with curved sides, and if no round face of the tool carries most of the force.
    """
    if len(mesh.element.local_corner_indices) < mesh.element.node_count or not (contact.pressed & contact.moves).any():
        return None
    state, areas = contact.state, contact.areas
    curvature = np.trace(state.curved, axis1=1, axis2=2)
    carried = np.where((state.pressed | state.held) & contact.moves, np.maximum(-state.normal, 0.0), 0.0)
    # Edges and shafts turn the normal by a right angle from node to node: they are not smooth parts.
    round_ones = np.where(np.sqrt(areas) * np.abs(curvature) < _SETTINGS.edge_ratio, carried, 0.0)
    if round_ones.sum() < 0.5 * carried.sum() or not carried.any():
        return None
    inside = float(np.average(areas * curvature, weights=round_ones)) / 12.0
    indentation = np.abs(np.einsum("ni,ni->n", displacement[contact.nodes], state.normals))
    return FacetInsetGeometry(inside, float(indentation[carried > 0.0].max()),
                              math.sqrt(float(np.average(areas, weights=round_ones))))


def estimate_faceting_force_error_or_none(contact: ContactNodes, mesh: SolidMesh, displacement: np.ndarray,
                                          force: float) -> float | None:
    """Estimate the force that is missing because of flat sides under a round tool, N.

    Args:
        contact: contact nodes at an equilibrium.
        mesh: undeformed mesh.
        displacement: displacement of all nodes, m, shape (nodes, 3).
        force: magnitude of the force on the tool, N.

    Returns:
        Missing force, N, positive; None if `estimate_facet_inset_geometry_or_none` returns None.
    """
    found = estimate_facet_inset_geometry_or_none(contact, mesh, displacement)
    if found is None:
        return None
    # The estimate holds for small fractions; beyond one half it is at least the whole force.
    fraction = found.missing_force_fraction
    return force * fraction / (1.0 - fraction) if fraction < _SETTINGS.largest_fraction else force


def faceting_warnings(contact: ContactNodes, mesh: SolidMesh, displacement: np.ndarray) -> list[str]:
    """Return a warning if the force is too small because of the faceting error.

    Coarse elements are also too stiff; this error of opposite sign may hide the faceting error.

    Args:
        contact: contact nodes at an equilibrium.
        mesh: undeformed mesh.
        displacement: displacement of all nodes, m, shape (nodes, 3).

    Returns:
        One message; an empty list if the error is small or the elements have curved sides.
    """
    found = estimate_facet_inset_geometry_or_none(contact, mesh, displacement)
    if found is None or not found.depth or found.missing_force_fraction <= _SETTINGS.warning_fraction:
        return []
    share, size = found.missing_force_fraction, 1e3 * found.size
    smaller = size * math.sqrt(_SETTINGS.warning_fraction / share)
    missing = "most of the force" if share > _SETTINGS.largest_fraction else f"about {100.0 * share:.2g} % of the force"
    return [f"faceting error: the flat sides of the elements under the tool, {size:.2g} mm wide, are inside of its "
            f"round outline by {1e3 * found.inside:.2g} mm in the mean, at a depth of {1e3 * found.depth:.2g} mm, so "
            f"that {missing} is missing; use elements of {smaller:.2g} mm there, "
            "or quadratic ones"]


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
