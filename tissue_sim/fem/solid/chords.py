"""How far the flat sides of linear elements stay inside of a round tool whose nodes press them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.mesh.solid import SolidMesh

#: The force of a round tool goes with this power of its depth (Hertz). This share of it is worth a sentence; more than
#: the other one is not told by a rule for small ones.
_POWER, _WORTH_A_WARNING, _MOST = 1.5, 0.025, 0.5
#: Where a side is longer than half as many radii it spans an edge, of which the rule says nothing.
_SPANS_AN_EDGE = 2.0


@dataclass(frozen=True)
class Faceting:
    """How far flat sides of elements are inside of the round outline of the tool.

    Attributes:
        inside: mean distance of the sides from the outline, m.
        depth: largest displacement under the tool, along its normal, m.
        size: width of the sides, m.
    """

    inside: float
    depth: float
    size: float

    @property
    def share(self) -> float:
        """Fraction of the force that is missing; infinite without depth."""
        return _POWER * self.inside / self.depth if self.depth else math.inf


def faceting(contact: ContactNodes, mesh: SolidMesh, displacement: np.ndarray) -> Faceting | None:
    """Faceting error of a tool that presses nodes only.

    Between nodes h apart a flat side is inside of the tool by h^2 (k1 + k2) / 12 in the mean, with the curvatures k1
    and k2 of the tool.

    Args:
        contact: at an equilibrium.
        mesh: undeformed.
        displacement: of all its nodes, m, shape (nodes, 3).

    Returns:
        None for elements with curved sides, and where no round part of the tool carries most of the force.
    """
    if len(mesh.element.corners) < mesh.element.nodes or not (contact.pressed & contact.moves).any():
        return None
    state, areas = contact.state, contact.areas
    curvature = np.trace(state.curved, axis1=1, axis2=2)
    carried = np.where((state.pressed | state.held) & contact.moves, np.maximum(-state.normal, 0.0), 0.0)
    # Of edges, and of shafts, which turn by a right angle from node to node.
    round_ones = np.where(np.sqrt(areas) * np.abs(curvature) < _SPANS_AN_EDGE, carried, 0.0)
    if round_ones.sum() < 0.5 * carried.sum() or not carried.any():
        return None
    inside = float(np.average(areas * curvature, weights=round_ones)) / 12.0
    way = np.abs(np.einsum("ni,ni->n", displacement[contact.nodes], state.normals))
    return Faceting(inside, float(way[carried > 0.0].max()), math.sqrt(float(np.average(areas, weights=round_ones))))


def faceting_error(contact: ContactNodes, mesh: SolidMesh, displacement: np.ndarray, force: float) -> float | None:
    """Estimated error of a force, N, by flat sides under a round tool; None if it is not known. Arguments as of
    `faceting`."""
    found = faceting(contact, mesh, displacement)
    if found is None:
        return None
    # The estimate holds for small fractions; beyond one half it is at least the whole force.
    return force * found.share / (1.0 - found.share) if found.share < _MOST else force


def doubts_of_chords(contact: ContactNodes, mesh: SolidMesh, displacement: np.ndarray) -> list[str]:
    """Warning of a force that is too small by the faceting error. Coarse elements are too stiff besides, which may hide
    it. Arguments as of `faceting`; of elements with curved sides nothing is said."""
    found = faceting(contact, mesh, displacement)
    if found is None or not found.depth or found.share <= _WORTH_A_WARNING:
        return []
    share, size = found.share, 1e3 * found.size
    missing = "most of the force" if share > _MOST else f"some {100.0 * share:.2g} % of the force"
    return [f"the flat sides of the elements under the tool, {size:.2g} mm wide, are inside of its round outline by "
            f"{1e3 * found.inside:.2g} mm in the mean, where it is {1e3 * found.depth:.2g} mm deep: that alone takes "
            f"{missing} away; use elements of {size * math.sqrt(_WORTH_A_WARNING / share):.2g} mm there, or quadratic "
            "ones"]
