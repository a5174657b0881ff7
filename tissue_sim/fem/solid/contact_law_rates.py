"""How forces of laws of contact change at an equilibrium, exactly; a law's own rates only help Newton's iteration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.fem.solid.frame import Frame

#: Steps of the differences: in units of the laws' reach, and of the force of a node, or of a share of the largest.
_STEP, _SMALL = 1e-5, 1e-3


class LawRates(NamedTuple):
    """Rates of the forces of nodes on the tool, zero where no law acts.

    Attributes:
        by_place: with the place of a node against the tool, its slip held, N/m, shape (n, 3, 3).
        by_slip: with its slip, N/m, shape (n, 3, 3). by_force: with the force of the contact along the normal, (n, 3).
        normals: out of the tool, shape (n, 3).
    """

    by_place: np.ndarray
    by_slip: np.ndarray
    by_force: np.ndarray
    normals: np.ndarray

    @classmethod
    def of(cls, contact: ContactNodes, displacement: np.ndarray, frame: Frame) -> LawRates | None:
        """At an equilibrium that was looked at last; None where no law acts.

        Args:
            contact: the nodes. displacement: of these, m, shape (n, 3). frame: of the tool.
        """
        state, laws, normals = contact.state, contact.laws, contact.normals.copy()
        near, nodes = state.near, contact.nodes[state.near]
        if not near.any():
            return None

        def forces(moved: np.ndarray, slip: np.ndarray, normal: np.ndarray) -> np.ndarray:
            _, gap, curved, _, _, meridians = contact.measure(displacement + moved, frame)
            out = contact.normals[near]
            along = slip[near] - np.einsum("ni,ni->n", slip[near], out)[:, None] * out
            return laws.act(nodes, gap[near], normal[near], along, out, meridians[near], curved[near], 0.0)[0]

        n, step, still, slip, normal = near.size, _STEP * laws.reach, np.zeros(3), state.slip, state.normal
        by_place, by_slip = np.zeros((2, n, 3, 3))
        by_force = np.zeros((n, 3))
        for i, way in enumerate(step * np.eye(3)):
            by_place[near, :, i] = (forces(way, slip, normal) - forces(-way, slip, normal)) / (2.0 * step)
            by_slip[near, :, i] = (forces(still, slip + way, normal) - forces(still, slip - way, normal)) / (2.0 * step)
        more = _STEP * np.maximum(np.abs(normal), _SMALL * np.abs(normal).max()) + 1e-300
        by_force[near] = ((forces(still, slip, normal + more) - forces(still, slip, normal - more))
                          / (2.0 * more[near, None]))
        contact.normals[:] = normals
        return cls(by_place, by_slip, by_force, normals)

    def forces(self, motion: np.ndarray, slipped: np.ndarray, contact_forces: np.ndarray) -> np.ndarray:
        """Rates of the forces with m parameters, from those of places against the tool, of slip and of the contact's
        forces, shape (n, 3, m) each."""
        normal = np.einsum("ni,nik->nk", self.normals, contact_forces)
        return self.by_place @ motion + self.by_slip @ slipped + self.by_force[:, :, None] * normal[:, None]

    def with_motion(self, rates: np.ndarray) -> np.ndarray:
        """Rates of the forces with the motion of the nodes, N/m, shape (n, 3, 3), where the contact's have these."""
        normal = np.einsum("ni,nij->nj", self.normals, rates)
        return self.by_place + self.by_slip + self.by_force[:, :, None] * normal[:, None]
