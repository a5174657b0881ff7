"""How far the flat sides of linear elements stay inside of a round tool whose nodes press them."""

from __future__ import annotations

import math

import numpy as np

from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.mesh.solid import SolidMesh

#: The force of a round tool goes with this power of its depth (Hertz). This share of it is worth a sentence; more than
#: the other one is not told by a rule for small ones.
_POWER, _WORTH_A_WARNING, _MOST = 1.5, 0.025, 0.5
#: Where a side is longer than half as many radii it spans an edge, of which the rule says nothing.
_SPANS_AN_EDGE = 2.0


def doubts_of_chords(contact: ContactNodes, mesh: SolidMesh, displacement: np.ndarray) -> list[str]:
    """What to say of a force that is too small because the tool presses nodes only, and between nodes h apart a flat
    side is inside of it by h^2 (k1 + k2) / 12 in the mean, with the curvatures k1 and k2 of the tool. Coarse elements
    are too stiff besides, which may hide it.

    Args:
        contact: at an equilibrium. mesh: undeformed; of elements whose sides are not flat nothing is said.
        displacement: of all its nodes, m, shape (nodes, 3).
    """
    if len(mesh.element.corners) < mesh.element.nodes or not (contact.pressed & contact.moves).any():
        return []
    state, areas = contact.state, contact.areas
    curvature = np.trace(state.curved, axis1=1, axis2=2)
    carried = np.where((state.pressed | state.held) & contact.moves, np.maximum(-state.normal, 0.0), 0.0)
    # Of edges, and of shafts, which turn by a right angle from node to node.
    round_ones = np.where(np.sqrt(areas) * np.abs(curvature) < _SPANS_AN_EDGE, carried, 0.0)
    if round_ones.sum() < 0.5 * carried.sum() or not carried.any():
        return []
    inside = float(np.average(areas * curvature, weights=round_ones)) / 12.0
    way = np.abs(np.einsum("ni,ni->n", displacement[contact.nodes], state.normals))
    depth = float(way[carried > 0.0].max())
    if _POWER * inside <= _WORTH_A_WARNING * depth or not depth:
        return []
    share = _POWER * inside / depth
    size = 1e3 * math.sqrt(float(np.average(areas, weights=round_ones)))
    missing = "most of the force" if share > _MOST else f"some {100.0 * share:.2g} % of the force"
    return [f"the flat sides of the elements under the tool, {size:.2g} mm wide, are inside of its round outline by "
            f"{1e3 * inside:.2g} mm in the mean, where it is {1e3 * depth:.2g} mm deep: that alone takes {missing} "
            f"away; use elements of {size * math.sqrt(_WORTH_A_WARNING / share):.2g} mm there, or quadratic ones"]
