"""What the nodes of a contact do at an equilibrium, and how their forces change with a parameter there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class ContactState(NamedTuple):
    """Of all nodes, see `tissue_sim.fem.solid.contact.ContactNodes`.

    Attributes:
        held, pressed, sticks, slides, goes, keeps, met: held where they touched; pressed against a body; of these,
            stuck by friction, slipping, and slipping far enough to have a way; whether their anchor stays, and whether
            they are bound to a body from now on; near: near enough for laws beside contact and friction; shape (n,).
        gap: m; normal: force along the normal, N; limit: of friction, N; friction: its coefficient, shape (n,).
        springs: of gaps, and holds: of slip, N/m, shape (n,).
        normals: out of the bodies; slip: since the last equilibrium, m; ways: of slip, shape (n, 3).
        curved: how the normals turn with the place, 1/m; turn: from the frame of the body to that of the mesh, shape
            (n, 3, 3).
    """

    held: np.ndarray
    pressed: np.ndarray
    sticks: np.ndarray
    slides: np.ndarray
    goes: np.ndarray
    keeps: np.ndarray
    met: np.ndarray
    near: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    limit: np.ndarray
    friction: np.ndarray
    springs: np.ndarray
    holds: np.ndarray
    normals: np.ndarray
    slip: np.ndarray
    ways: np.ndarray
    curved: np.ndarray
    turn: np.ndarray

    def force_rates(self, motion: np.ndarray, anchors: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rates of the forces that the laws of the contact allow, and what its constraints still miss, in N, shape
        (n, 3, m) each.

        Args:
            motion: rates of the nodes' places with m parameters, shape (n, 3, m).
            anchors: of where they are bound, in the frames of their bodies, shape (n, 3, m).
            forces: of their forces, as found so far, shape (n, 3, m).
        """
        n, way, springs = self.normals[:, :, None], self.ways[:, :, None], self.springs[:, None, None]
        gap = _along(n, motion)
        slipped = motion - self.turn @ anchors
        tilt = self.curved @ motion
        # The way is that of the slip's part along the surface.
        slip = self.slip[:, :, None]
        along = slipped - (_along(n, slipped) + _along(slip, tilt)) * n - _along(slip, n) * tilt
        flat = self.slip - np.einsum("ni,ni->n", self.slip, self.normals)[:, None] * self.normals
        length = np.where(self.goes, np.linalg.norm(flat, axis=1), np.inf)
        steered = (along - _along(way, along) * way) / length[:, None, None]
        limit, mu = self.limit[:, None, None], self.friction[:, None, None]
        free_normal = _along(n, forces)
        normal = free_normal - np.where(_wide(self.slides), limit * _along(n, steered), 0.0)
        smooth = normal * n + self.normal[:, None, None] * tilt
        sliding = smooth - mu * normal * way + limit * steered
        stuck = _wide(self.held | self.sticks)
        found = np.where(stuck, forces, np.where(_wide(self.slides), sliding, smooth))
        acts = _wide(self.held | self.pressed)
        missing = springs * gap * (n - np.where(_wide(self.slides), mu * way, 0.0))
        holds = self.holds[:, None, None]
        missing = np.where(_wide(self.sticks), missing + holds * (slipped - _along(n, slipped) * n), missing)
        missing = np.where(_wide(self.held), holds * slipped, missing)
        return np.where(acts, found, 0.0), np.where(acts, missing, 0.0)

    def anchor_rates(self, motion: np.ndarray, anchors: np.ndarray) -> np.ndarray:
        """Rates of where the nodes are bound after this equilibrium; arguments as of `force_rates`."""
        n = self.normals[:, :, None]
        beside = self.gap[:, None, None] * (self.curved @ motion)
        surface = self.turn.swapaxes(1, 2) @ (motion - _along(n, motion) * n - beside)
        return np.where(_wide(self.held | self.keeps), anchors, np.where(_wide(self.met), surface, 0.0))

    @property
    def kinds(self) -> np.ndarray:
        """What each node does, to be compared with another equilibrium, shape (5, n)."""
        return np.stack([self.held, self.pressed, self.sticks, self.slides, self.near])


def _along(direction: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Their component, kept as an axis of one: (n, 3, m) times (n, 3, m or 1) -> (n, 1, m)."""
    return (direction * vectors).sum(axis=1, keepdims=True)


def _wide(mask: np.ndarray) -> np.ndarray:
    return mask[:, None, None]
