"""Faceting error: flat sides of linear elements lie inside of the outline of a round tool."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.solid.contact import ContactNodes
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
