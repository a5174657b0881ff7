"""State of the contact nodes at an equilibrium, and derivatives of their forces with respect to parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class NodalContactState(NamedTuple):
    """State of all contact nodes; see `tissue_sim.fem.solid.contact.ContactNodes`. Shapes are (n,) if not stated.

    Attributes:
        held: held where they touched, without slip.
        pressed: pressed against a body.
        sticks: pressed and stuck by friction.
        slides: pressed and slipping.
        goes: slipping far enough that the direction of slip is defined.
        keeps: whether the stick anchor stays.
        met: whether the node touches a body at this equilibrium and is bound to it in the next step.
        near: near enough for additional contact laws.
        gap: m.
        normal: force along the normal, N.
        limit: limit of friction, N.
        friction: coefficient of friction, 1.
        springs: penalty stiffness of the gap, N/m.
        holds: penalty stiffness of the slip, N/m.
        normals: outward normals of the bodies, shape (n, 3).
        slip: since the last equilibrium, m, shape (n, 3).
        ways: directions of slip, shape (n, 3).
        curved: derivative of the normals with respect to position, 1/m, shape (n, 3, 3).
        turn: rotation matrix from the frame of the body to that of the mesh, shape (n, 3, 3).
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

    def differentiate_forces_and_residuals(self, motion: np.ndarray, anchors: np.ndarray,
                                           forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Differentiate the contact forces and the constraint residuals with respect to m parameters.

        Args:
            motion: derivatives of the nodal positions with respect to m parameters, shape (n, 3, m).
            anchors: derivatives of the anchors in the frames of their bodies, shape (n, 3, m).
            forces: present iterate of the derivatives of the forces, shape (n, 3, m).

        Returns:
            Derivatives of the contact forces, and derivatives of the constraint residuals times the penalty stiffness,
            N per parameter, shape (n, 3, m) each.
        """
        n, way, springs = self.normals[:, :, None], self.ways[:, :, None], self.springs[:, None, None]
        gap = _compute_components_along(n, motion)
        slipped = motion - self.turn @ anchors
        tilt = self.curved @ motion
        # Derivative of the tangential part of the slip.
        slip = self.slip[:, :, None]
        along = slipped - (_compute_components_along(n, slipped)
                           + _compute_components_along(slip, tilt)) * n - _compute_components_along(slip, n) * tilt
        flat = self.slip - np.einsum("ni,ni->n", self.slip, self.normals)[:, None] * self.normals
        length = np.where(self.goes, np.linalg.norm(flat, axis=1), np.inf)
        steered = (along - _compute_components_along(way, along) * way) / length[:, None, None]
        limit, mu = self.limit[:, None, None], self.friction[:, None, None]
        free_normal = _compute_components_along(n, forces)
        normal = free_normal - np.where(_reshape_mask_for_broadcast(self.slides),
                                        limit * _compute_components_along(n, steered), 0.0)
        smooth = normal * n + self.normal[:, None, None] * tilt
        sliding = smooth - mu * normal * way + limit * steered
        stuck = _reshape_mask_for_broadcast(self.held | self.sticks)
        found = np.where(stuck, forces, np.where(_reshape_mask_for_broadcast(self.slides), sliding, smooth))
        acts = _reshape_mask_for_broadcast(self.held | self.pressed)
        missing = springs * gap * (n - np.where(_reshape_mask_for_broadcast(self.slides), mu * way, 0.0))
        holds = self.holds[:, None, None]
        missing = np.where(_reshape_mask_for_broadcast(self.sticks),
                           missing + holds * (slipped - _compute_components_along(n, slipped) * n), missing)
        missing = np.where(_reshape_mask_for_broadcast(self.held), holds * slipped, missing)
        return np.where(acts, found, 0.0), np.where(acts, missing, 0.0)

    def differentiate_anchors(self, motion: np.ndarray, anchors: np.ndarray) -> np.ndarray:
        """Return the derivatives of the anchors that follow from this equilibrium, m per parameter, shape (n, 3, m).

        The arguments are those of `differentiate_forces_and_residuals`.
        """
        n = self.normals[:, :, None]
        curvature = self.gap[:, None, None] * (self.curved @ motion)
        surface = self.turn.swapaxes(1, 2) @ (motion - _compute_components_along(n, motion) * n - curvature)
        return np.where(_reshape_mask_for_broadcast(self.held | self.keeps), anchors,
                        np.where(_reshape_mask_for_broadcast(self.met), surface, 0.0))

    @property
    def discrete_contact_flags(self) -> np.ndarray:
        """Flags held, pressed, sticks, slides and near of each node, shape (5, n).

        If a flag changes between two equilibria, the force has a kink as a function of the parameters.
        """
        return np.stack([self.held, self.pressed, self.sticks, self.slides, self.near])


def _compute_components_along(direction: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the components of vectors, shape (n, 3, m), along unit vectors, (n, 3, 1); shape (n, 1, m)."""
    return (direction * vectors).sum(axis=1, keepdims=True)


def _reshape_mask_for_broadcast(mask: np.ndarray) -> np.ndarray:
    """Reshape a mask of the nodes from (n,) to (n, 1, 1)."""
    return mask[:, None, None]
