"""Where the tool and the tissue first touch."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.axisymmetric import contact_kernels
from tissue_sim.fem.axisymmetric.contact import Contact, ContactPoints
from tissue_sim.mesh import Mesh


def bring_down(mesh: Mesh, contact: Contact, surface: ContactPoints, displacement: np.ndarray) -> float:
    """Bring the tool down on the surface as it stands, and bind what meets a body with friction or without slip.

    Args:
        mesh: undeformed mesh.
        contact: bodies, and who may meet them.
        surface: its points; `anchors`, and of a plate `places`, are changed.
        displacement: of the nodes, m, shape (n, 2).

    Returns:
        z of the tool's deepest point there, m.
    """
    place, datum = surface.positions(displacement), 0.0
    if surface.moves.any():
        datum = _touching_height(mesh, contact, displacement, place[surface.moves])
    place[surface.moves, 1] -= datum
    if contact.level:
        _level(mesh, surface, displacement, place, datum)
    touches = surface.gaps(place) <= 1e-9 * np.ptp(mesh.nodes[:, 1])
    untouched = touches & (surface.anchors[:, 0] == contact_kernels.FREE)
    surface.anchors[untouched, 0] = np.where(surface.tied[untouched], contact_kernels.HELD, contact_kernels.TOUCHED)
    surface.anchors[untouched, 1:] = (place - surface.places)[untouched]
    return datum


def bind_ahead(surface: ContactPoints, displacement: np.ndarray, lift: float, descent: float) -> None:
    """Bind the points with friction or without slip that the tool meets in the first half of an increment.

    A point is bound to the place of the tool that would reach it if the tissue stood still. Points that the tool
    reaches later slide freely until the end of the increment, so that the errors of both halves have opposite signs.

    Args:
        surface: its points; `anchors` are changed.
        displacement: of the nodes at the beginning of the increment, m, shape (n, 2).
        lift: what is added to z in the frame of the tool there, m.
        descent: of the tool in the increment, m.
    """
    free = (surface.anchors[:, 0] == contact_kernels.FREE) & surface.moves & surface.friction.any(axis=1)
    if descent <= 0.0 or not free.any():
        return
    place = surface.positions(displacement)
    place[:, 1] += lift
    gap = np.maximum(surface.gaps(place), 0.0)
    # A point does not get past the nearest face within half of its gap, so that an edge does not matter.
    ahead = place.copy()
    ahead[:, 1] += 0.5 * gap
    closes = gap - surface.gaps(ahead)
    needed = np.where(gap > 0.0, 0.5 * gap**2 / np.maximum(closes, 1e-3 * gap + np.finfo(float).tiny), 0.0)
    meets = free & (needed <= 0.5 * descent)
    place[meets, 1] += needed[meets]
    surface.anchors[meets, 0] = contact_kernels.TOUCHED
    surface.anchors[meets, 1:] = (place - surface.places)[meets]


def _level(mesh: Mesh, surface: ContactPoints, displacement: np.ndarray, place: np.ndarray, datum: float) -> None:
    """Let a plate meet a top that has settled unevenly all at once, as if the top had been cut level as it stands.

    Without it a plate would touch the highest ring first.
    """
    top = mesh.sets["top"]
    lift = np.interp(surface.places[..., 0], mesh.nodes[top, 0], (mesh.nodes + displacement)[top, 1] - datum)
    lift[~surface.moves] = 0.0
    surface.places[..., 1] -= lift
    place[..., 1] -= lift


def _touching_height(mesh: Mesh, contact: Contact, displacement: np.ndarray, points: np.ndarray) -> float:
    """z of the tool's deepest point where it first touches the nodes of the top or these points (n, 2)."""
    profiles = [pair.profile for pair in contact.pairs if pair.moves]
    place = np.concatenate([(mesh.nodes + displacement)[mesh.sets["top"]], points])

    def clearance(datum):
        return min(profile.gap(place - [0.0, datum]).min() for profile in profiles)

    high = place[:, 1].max()
    if clearance(high) <= 0.0:
        return high
    from scipy.optimize import brentq

    # Lowered by more and more; far below the surface a ball would be in the tissue as a whole, and touch nothing.
    step = 1e-6 * np.ptp(mesh.nodes[:, 1])
    while clearance(high - step) > 0.0:
        step *= 2.0
    return brentq(clearance, high - step, high, xtol=1e-15)
