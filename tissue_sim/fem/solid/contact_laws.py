"""Additional contact laws of a three-dimensional solid: tractions between tool and tissue at the nodes."""

from __future__ import annotations

import numpy as np

from tissue_sim.experiment.contact_law import (
    ContactLaw,
    Traction,
    evaluate_traction,
    sum_attractive_tractions_at_zero_gap,
)

#: Step of the difference quotient of a pull with respect to the gap, in units of the reach.
_STEP = 1e-6


class NodalContactLaws:
    """Sum of all additional contact laws.

    Args:
        laws: laws besides contact and friction.
        face: area of the tool's face at the largest depth, m2.
        areas: area that each node of the mesh represents, m2, shape (nodes,).

    Attributes:
        reach: gap from which on no law has an effect, m; 0 without laws.
        strength: sum of the pulls at zero gap and pressure, Pa.
    """

    def __init__(self, laws: tuple[ContactLaw, ...] = (), face: float = 1.0, areas: np.ndarray | None = None):
        self._laws, self._face, self._areas = laws, face, areas
        self.reach = max((law.reach for law in laws), default=0.0)
        self.strength = sum_attractive_tractions_at_zero_gap(laws, face)

    def __bool__(self) -> bool:
        return bool(self._laws)

    def compute_adhesive_pull_of_nodes_at_touch(self, nodes: np.ndarray) -> np.ndarray:
        """Return the adhesive force on nodes at zero gap and zero pressure, N, shape (n,)."""
        return np.zeros(nodes.size) if self._areas is None else self.strength * self._areas[nodes]

    def compute_law_forces_and_derivatives(self, nodes: np.ndarray, gap: np.ndarray, normal: np.ndarray,
                                           slip: np.ndarray,
                                           normals: np.ndarray, meridians: np.ndarray, curved: np.ndarray,
                                           bending: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute the forces on the tool, N, shape (n, 3), and their derivatives, N/m, shape (n, 3, 3).

        Args:
            nodes: indices of the nodes, shape (n,).
            gap: m, shape (n,).
            normal: contact force along the normal, negative in compression, N, shape (n,).
            slip: since each node touched, m, shape (n, 3).
            normals: outward normals of the tool, shape (n, 3).
            meridians: directions along its outline, shape (n, 3).
            curved: derivative of the normals with respect to position, 1/m, shape (n, 3, 3).
            bending: 1: the derivatives contain the rotation of a pull with the surface and its decrease with the gap,
                which is inaccurate far from equilibrium and where surfaces separate; 0: only those that the laws state.

        Raises:
            InputError: a law does not return a `Traction`.
        """
        assert self._areas is not None
        areas, along = self._areas[nodes], (meridians, np.cross(normals, meridians))
        slips = tuple(np.einsum("ni,ni->n", slip, way) for way in along)
        safe = np.where(areas > 0.0, areas, 1.0)
        pressure = np.maximum(-normal, 0.0) / safe
        pull, pull_rate, drag, drag_rates = 0.0, 0.0, np.zeros((2, gap.size)), np.zeros((2, 2, gap.size))
        for law in self._laws:
            found = self._evaluate_traction(law, gap, pressure, slips)
            # Each law ends at its own reach.
            near = gap < law.reach
            pull = pull + near * found.pull
            rate = np.broadcast_to(found.pull_rate, gap.shape)
            if bending:
                step = _STEP * law.reach
                further = self._evaluate_traction(law, gap + step, pressure, slips).pull
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

    def _evaluate_traction(self, law: ContactLaw, gap: np.ndarray, pressure: np.ndarray, slips: tuple[np.ndarray, ...]
                           ) -> Traction:
        """Evaluate a law at gaps, m, pressures, Pa, and two components of the slip, m, shape (n,) each."""
        # Copies, because a formula may change its arguments, which are passed to the next law.
        return evaluate_traction(law, gap.copy(), pressure.copy(), (slips[0].copy(), slips[1].copy()), self._face)
