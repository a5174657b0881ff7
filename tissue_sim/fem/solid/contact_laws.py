"""Laws of contact in the solid in space: tractions between the tool and what has touched it, at nodes."""

from __future__ import annotations

import numpy as np

from tissue_sim.experiment.contact_law import ContactLaw, Traction, strength, traction_of

#: Of a gap, in units of the reach, by which it is seen how the pull falls.
_STEP = 1e-6


class NodeLaws:
    """All laws of a contact together.

    Args:
        laws: tractions beside contact and friction.
        face: area of the tool's face at the largest depth, m2.
        areas: on which each node of the mesh stands for tractions, m2, shape (nodes,).

    Attributes:
        reach: gap from which on none does anything, m; 0 where there is none.
        strength: pull of all where the surfaces touch without pressure, Pa.
    """

    def __init__(self, laws: tuple[ContactLaw, ...] = (), face: float = 1.0, areas: np.ndarray | None = None):
        self._laws, self._face, self._areas = laws, face, areas
        self.reach = max((law.reach for law in laws), default=0.0)
        self.strength = strength(laws, face)

    def __bool__(self) -> bool:
        return bool(self._laws)

    def pull_of(self, nodes: np.ndarray) -> np.ndarray:
        """Largest pull that nodes bear where they touch without pressure, N, shape (n,)."""
        return np.zeros(nodes.size) if self._areas is None else self.strength * self._areas[nodes]

    def act(self, nodes: np.ndarray, gap: np.ndarray, normal: np.ndarray, slip: np.ndarray, normals: np.ndarray,
            meridians: np.ndarray, curved: np.ndarray, bending: float) -> tuple[np.ndarray, np.ndarray]:
        """Forces of nodes on the tool, N, shape (n, 3), and their rates with the way of the nodes, N/m, (n, 3, 3).

        Args:
            nodes: their numbers, shape (n,).
            gap: m, shape (n,). normal: force of the contact, below 0 where it presses, N, shape (n,).
            slip: from where each touched, m, shape (n, 3).
            normals: out of the tool; meridians: along its outline, shape (n, 3).
            curved: how the normals turn with the place, 1/m, shape (n, 3, 3).
            bending: 1 where the rates know how a pull turns with the surface and falls with the gap, which leads astray
                far from equilibrium and where the surfaces tear apart; 0: they are those that the laws state.

        Raises:
            InputError: a law whose traction is none.
        """
        assert self._areas is not None
        areas, along = self._areas[nodes], (meridians, np.cross(normals, meridians))
        slips = tuple(np.einsum("ni,ni->n", slip, way) for way in along)
        safe = np.where(areas > 0.0, areas, 1.0)
        pressure = np.maximum(-normal, 0.0) / safe
        pull, pull_rate, drag, drag_rates = 0.0, 0.0, np.zeros((2, gap.size)), np.zeros((2, 2, gap.size))
        for law in self._laws:
            found = self._traction(law, gap, pressure, slips)
            # Each ends at its own reach; that of the furthest one is the contact's.
            near = gap < law.reach
            pull = pull + near * found.pull
            rate = np.broadcast_to(found.pull_rate, gap.shape)
            if bending:
                step = _STEP * law.reach
                further = self._traction(law, gap + step, pressure, slips).pull
                rate = rate + bending * ((further - np.asarray(found.pull)) / step - rate)
            pull_rate = pull_rate + near * rate
            for i in range(2):
                drag[i] += near * found.drag[i]
                for j in range(2):
                    drag_rates[i, j] += near * found.drag_rates[i][j]
        forces = (areas * pull)[:, None] * normals
        rates = (areas * pull_rate)[:, None, None] * normals[:, :, None] * normals[:, None]
        rates = rates + (bending * areas * pull)[:, None, None] * curved
        for i in range(2):
            forces = forces + (areas * drag[i])[:, None] * along[i]
            for j in range(2):
                rates = rates + (areas * drag_rates[i, j])[:, None, None] * along[i][:, :, None] * along[j][:, None]
        return forces, rates

    def _traction(self, law: ContactLaw, gap: np.ndarray, pressure: np.ndarray, slips: tuple[np.ndarray, ...]
                  ) -> Traction:
        # Copies: a formula may add in place, and the next law is asked about the same.
        return traction_of(law, gap.copy(), pressure.copy(), (slips[0].copy(), slips[1].copy()), self._face)
