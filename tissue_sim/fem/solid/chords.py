"""How far the flat sides of linear elements stay inside of a round tool whose nodes press them."""

from __future__ import annotations

import math

import numpy as np

from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.mesh.solid import SolidMesh

#: The force of a round tool goes with this power of its depth (Hertz), and this share of it is worth a sentence.
_POWER, _WORTH_A_WARNING = 1.5, 0.025


def doubts_of_chords(contact: ContactNodes, mesh: SolidMesh, displacement: np.ndarray) -> list[str]:
    """What to say of a force that is too small because the tool presses nodes only, and between nodes h apart a flat
    side is inside of it by h^2 (k1 + k2) / 12 in the mean, with the curvatures k1 and k2 of the tool.

    Args:
        contact: at an equilibrium. mesh: undeformed; of elements whose sides are not flat nothing is said.
        displacement: of all its nodes, m, shape (nodes, 3).
    """
    if len(mesh.element.corners) < mesh.element.nodes or not (contact.pressed & contact.moves).any():
        return []
    state, pressed = contact.state, contact.pressed & contact.moves
    areas = contact.areas[pressed]
    inside = float((areas * np.trace(state.curved[pressed], axis1=1, axis2=2)).mean()) / 12.0
    depth = float(np.abs(np.einsum("ni,ni->n", displacement[contact.nodes[pressed]], state.normals[pressed])).max())
    share = _POWER * inside / depth if depth > 0.0 else 0.0
    if share <= _WORTH_A_WARNING:
        return []
    size = 1e3 * math.sqrt(float(areas.mean()))
    return [f"the flat sides of the elements under the tool, {size:.2g} mm wide, are inside of its round outline by "
            f"{1e3 * inside:.2g} mm in the mean: the force is some {100.0 * share:.2g} % too small; use elements of "
            f"{size * math.sqrt(_WORTH_A_WARNING / share):.2g} mm there, or quadratic ones"]
