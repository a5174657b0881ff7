"""Position of the tool at its first touch of the tissue, and the bonds of the contact points there."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.axisymmetric import contact_kernels
from tissue_sim.fem.axisymmetric.contact import Contact, ContactPoints
from tissue_sim.mesh import Mesh


def bring_down(mesh: Mesh, contact: Contact, surface: ContactPoints, displacement: np.ndarray) -> float:
    """Place the tool at its first touch of the surface, and bind the points that touch a body.

    Args:
        mesh: undeformed mesh.
        contact: contact pairs.
        surface: contact points; `anchors` are changed, under a plate also `places`.
        displacement: displacements of the nodes, m, shape (n, 2).

    Returns:
        z of the tool's deepest point at the first touch, m.
    """
    positions, datum = surface.positions(displacement), 0.0
    if surface.moves.any():
        datum = _find_first_touch_height(mesh, contact, displacement, positions[surface.moves])
    positions[surface.moves, 1] -= datum
    if contact.level:
        _shift_to_level_top(mesh, surface, displacement, positions, datum)
    touches = surface.gaps(positions) <= 1e-9 * np.ptp(mesh.nodes[:, 1])
    untouched = touches & (surface.anchors[:, 0] == contact_kernels.FREE)
    surface.anchors[untouched, 0] = np.where(surface.tied[untouched], contact_kernels.HELD, contact_kernels.TOUCHED)
    surface.anchors[untouched, 1:] = (positions - surface.places)[untouched]
    return datum


def bind_ahead(surface: ContactPoints, displacement: np.ndarray, lift: float, descent: float) -> None:
    """Bind the points with friction or without slip that the tool reaches in the first half of an increment.

    A point is bound to the position on the tool that would reach the point if the tissue did not move. Points that the
    tool reaches later slide freely until the end of the increment, so that the errors of both halves have opposite
    signs.

    Args:
        surface: contact points; `anchors` are changed.
        displacement: displacements of the nodes at the beginning of the increment, m, shape (n, 2).
        lift: difference between z in the frame of the tool and z, m.
        descent: downward motion of the tool in the increment, m.
    """
    free = (surface.anchors[:, 0] == contact_kernels.FREE) & surface.moves & surface.friction.any(axis=1)
    if descent <= 0.0 or not free.any():
        return
    positions = surface.positions(displacement)
    positions[:, 1] += lift
    gap = np.maximum(surface.gaps(positions), 0.0)
    # Within half of its gap a point stays at the same face, so that edges have no influence.
    ahead = positions.copy()
    ahead[:, 1] += 0.5 * gap
    closes = gap - surface.gaps(ahead)
    needed = np.where(gap > 0.0, 0.5 * gap**2 / np.maximum(closes, 1e-3 * gap + np.finfo(float).tiny), 0.0)
    meets = free & (needed <= 0.5 * descent)
    positions[meets, 1] += needed[meets]
    surface.anchors[meets, 0] = contact_kernels.TOUCHED
    surface.anchors[meets, 1:] = (positions - surface.places)[meets]


def _shift_to_level_top(mesh: Mesh, surface: ContactPoints, displacement: np.ndarray, positions: np.ndarray,
                        datum: float) -> None:
    """Shift the points so that a plate touches the whole unevenly settled top at once, as if the top were cut level.

    Without the shift a plate would touch the highest ring first.
    """
    top = mesh.sets["top"]
    lift = np.interp(surface.places[..., 0], mesh.nodes[top, 0], (mesh.nodes + displacement)[top, 1] - datum)
    lift[~surface.moves] = 0.0
    surface.places[..., 1] -= lift
    positions[..., 1] -= lift


def _find_first_touch_height(mesh: Mesh, contact: Contact, displacement: np.ndarray, points: np.ndarray) -> float:
    """Return z of the tool's deepest point at the first touch of the top nodes or of further points (n, 2), m."""
    profiles = [pair.profile for pair in contact.pairs if pair.moves]
    positions = np.concatenate([(mesh.nodes + displacement)[mesh.sets["top"]], points])

    def clearance(datum):
        return min(profile.gap(positions - [0.0, datum]).min() for profile in profiles)

    high = positions[:, 1].max()
    if clearance(high) <= 0.0:
        return high
    from scipy.optimize import brentq

    # The bracket grows from a small step: far below the surface a ball is inside the tissue and touches nothing.
    step = 1e-6 * np.ptp(mesh.nodes[:, 1])
    while clearance(high - step) > 0.0:
        step *= 2.0
    return brentq(clearance, high - step, high, xtol=1e-15)
