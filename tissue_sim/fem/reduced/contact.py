"""Contact of a reduced solid's surface with the tool.

Constraints at nodes would lock: there are as many of them as there are modes. Instead the tool wears a thin elastic
layer, whose springs are soft enough for the modes and stiff enough for the force.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.fem.reduced import contact_kernel as kernel
from tissue_sim.fem.solid.contact import STICK, Body
from tissue_sim.fem.solid.frame import Frame, turned_with
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK

#: Of an interface without slip that can lift off.
_NO_SLIP = 1e6


class LayerContact:
    """The nodes that may meet the tool, on the modes of a reduced solid.

    Args:
        bodies: who may be met; those that move with the tool count.
        places: of all nodes, undeformed, m, shape (nodes, 3). areas: that each stands for, m2.
        basis: what the modes move, shape (freedoms, modes).
        reach: of the contact, m; the layer's stiffness is stated over it.
        softness: share of the way by which the layer gives way.

    Attributes:
        nodes: numbers, shape (n,). forces: on the tissue, N, shape (n, 3). touched: which of them press.
    """

    def __init__(self, bodies: Sequence[Body], places: np.ndarray, areas: np.ndarray, basis: np.ndarray, *,
                 reach: float, softness: float):
        moving = [body for body in bodies if body.moves]
        owner: dict[int, Body] = {}
        for body in moving:
            for node in body.nodes.tolist():
                owner.setdefault(node, body)
        self.nodes = np.array(sorted(owner), dtype=np.intp)
        own = [owner[node] for node in self.nodes.tolist()]
        n = self.nodes.size
        self.places = np.ascontiguousarray(places[self.nodes])
        self.areas = areas[self.nodes]
        self._rows = np.ascontiguousarray(basis.reshape(-1, 3, basis.shape[1])[self.nodes].reshape(3 * n, -1))
        self._rows_of_nodes = self._rows.reshape(n, 3, -1)
        self._settings = np.zeros(kernel.SETTINGS)
        profile = moving[0].profile
        self._settings[kernel.ROUNDING], self._settings[kernel.ZONE] = profile.rounding, softness * reach
        self._reach, self._softness = reach, softness
        friction = np.array([body.friction for body in own], dtype=float).reshape(n, 2)
        friction[friction == STICK] = _NO_SLIP
        self.has_friction = bool((friction > 0.0).any())
        self._springs, self.touched = np.zeros(n), np.zeros(n, dtype=np.int32)
        self._states = np.zeros(n, dtype=np.int32)
        self.anchors, self._new_anchors, self.forces = np.zeros((3, n, 3))
        self._rates, self.gaps, self._moved = np.zeros((n, 3, 3)), np.zeros(n), np.zeros((n, 3))
        self._touching = np.zeros(0, dtype=np.intp)
        self._touching_rows = self._rows_of_nodes[self._touching]
        #: Of the tool's place at the last evaluation, which is the frame that the others are asked with.
        self._levers: np.ndarray | None = None
        self._driven: np.ndarray | None = None
        self._arrays = {
            "settings": self._settings, "vertices": np.ascontiguousarray(profile.vertices),
            "shaft": np.array([profile.shaft], dtype=np.int32), "places": self.places, "moved": self._moved,
            "springs": self._springs, "friction": friction,
            "first": np.array([body.first_line for body in own], dtype=np.int32),
            "closed": np.array([body.closed for body in own], dtype=np.int32), "anchors": self.anchors,
            "touched": self.touched, "forces": self.forces, "rates": self._rates, "gaps": self.gaps,
            "new_anchors": self._new_anchors, "states": self._states}
        with LOCK:
            self._press = BoundKernel(kernel.contact_kernel(), self._arrays)

    def set_stiffness(self, modulus: float) -> None:
        """A layer for tissue of this shear modulus, Pa."""
        self._springs[:] = modulus / (self._softness * self._reach) * self.areas

    def evaluate(self, amplitudes: np.ndarray, frame: Frame, pressed_in: bool) -> None:
        """Find forces and their rates at these amplitudes, shape (modes,), under a tool there."""
        settings = self._settings
        settings[kernel.ROTATION : kernel.ROTATION + 9] = frame.rotation.ravel()
        settings[kernel.ORIGIN : kernel.ORIGIN + 3] = frame.origin
        settings[kernel.PRESSED_IN] = pressed_in
        np.dot(self._rows, amplitudes, out=self._moved.reshape(-1))
        with LOCK:
            self._press()
        self._touching = np.flatnonzero(self._states)
        self._touching_rows = self._rows_of_nodes[self._touching]
        self._levers = self._driven = None

    def on_modes(self) -> tuple[np.ndarray, np.ndarray]:
        """Forces of the tissue on the tool, on the modes, shape (modes,), and their derivatives, (modes, modes)."""
        rows, rates = self._touching_rows, self._rates[self._touching]
        # Written out: a product of stacks of small matrices takes several times as long.
        pushed = rates[:, :, 0, None] * rows[:, None, 0] + rates[:, :, 1, None] * rows[:, None, 1] \
            + rates[:, :, 2, None] * rows[:, None, 2]
        flat = rows.reshape(-1, rows.shape[-1])
        return -(self.forces[self._touching].ravel() @ flat), flat.T @ pushed.reshape(flat.shape)

    def wrench(self, frame: Frame) -> np.ndarray:
        """On the tool, about its deepest point, N and N m, shape (6,)."""
        if not self._touching.size:
            return np.zeros(6)
        return np.einsum("nik,ni->k", self._way(frame), -self.forces[self._touching])

    def force_of(self, change: np.ndarray) -> np.ndarray:
        """How the force on the tool, N, shape (3,), changes with the amplitudes, shape (modes,)."""
        if not self._touching.size:
            return np.zeros(3)
        return np.einsum("nij,nj->i", self._rates[self._touching], self._touching_rows @ change)

    def _way(self, frame: Frame) -> np.ndarray:
        """How what touches would move if it were fixed to the tool, shape (n, 3, 6)."""
        if self._levers is None:
            self._levers = frame.rates((self.places + self._moved)[self._touching])
        return self._levers

    def pushed_by(self, frame: Frame) -> np.ndarray:
        """How the forces of the touching nodes on the tissue change as the tool moves and turns and the tissue does
        not, shape (n, 3, 6)."""
        if self._driven is None:
            self._driven = np.matmul(self._rates[self._touching], self._way(frame)) + turned_with(
                self.forces[self._touching])
        return self._driven

    def stiffness(self, frame: Frame, answer: np.ndarray) -> np.ndarray:
        """Minus the derivative of the wrench with the pose of the tool, (6, 6), where the amplitudes answer it so,
        shape (modes, 6)."""
        if not self._touching.size:
            return np.zeros((6, 6))
        moves = np.matmul(self._touching_rows, answer)
        change = self.pushed_by(frame) - np.matmul(self._rates[self._touching], moves)
        moves[:, :, :3] -= np.eye(3)
        stiffness = self._way(frame).reshape(-1, 6).T @ change.reshape(-1, 6)
        # The levers change, too: the sum of the moves cross the forces.
        pairs = np.tensordot(self.forces[self._touching], moves, axes=(0, 0))
        stiffness[3:] += pairs[[2, 0, 1], [1, 2, 0]] - pairs[[1, 2, 0], [2, 0, 1]]
        return stiffness

    def rates_of_modes(self, frame: Frame) -> np.ndarray:
        """How the forces on the modes change as the tool moves and turns and the tissue does not, shape (modes, 6)."""
        if not self._touching.size:
            return np.zeros((self._rows.shape[1], 6))
        rows = self._touching_rows
        return -rows.reshape(-1, rows.shape[-1]).T @ self.pushed_by(frame).reshape(-1, 6)

    @property
    def touches(self) -> bool:
        """Whether any node does."""
        return bool(self._touching.size)

    @property
    def slipping(self) -> int:
        """How many nodes slip."""
        return int((self._states == kernel.SLIPS).sum()) if self.has_friction else 0

    @property
    def violation(self) -> float:
        """How far the tissue is in the tool, which is how far the layer gives way, m."""
        return float(max(0.0, -self.gaps[self._touching].min(initial=0.0)))

    def commit(self) -> None:
        """After a step that converged."""
        self.anchors[:] = self._new_anchors
        self.touched[:] = self._states != kernel.FREE

    def forget(self) -> None:
        """Nothing touches."""
        self.touched[:] = 0

    @property
    def kept(self) -> tuple[np.ndarray, ...]:
        """All that a committed step leaves behind."""
        return self.anchors, self.touched
