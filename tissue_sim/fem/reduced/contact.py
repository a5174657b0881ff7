"""Contact of a reduced solid's surface with the tool.

Constraints at nodes would lock: there are as many of them as there are modes. Instead the tool wears a thin elastic
layer, whose springs are soft enough for the modes and stiff enough for the force.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.fem.reduced import contact_kernel as kernel
from tissue_sim.fem.solid.bodies import Body
from tissue_sim.fem.solid.contact import STICK
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK

#: Of an interface without slip that can lift off.
_NO_SLIP = 1e6
#: What is as near as this to the limit of friction is at it: more than a step leaves unbalanced.
_AT_LIMIT = 1e-2


class LayerContact:
    """The nodes that may meet the tool, on the modes of a reduced solid.

    Args:
        bodies: who may be met; those that move with the tool count.
        places: of all nodes, undeformed, m, shape (nodes, 3). areas: that each stands for, m2.
        basis: what the modes move, shape (freedoms, modes).
        reach: of the contact, m; the layer's stiffness is stated over it.
        softness: share of the way by which the layer gives way.

    Attributes:
        nodes: numbers, shape (n,). forces: on the tissue, of those that touch, N, shape (n, 3). touched:
            which of them press.
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
        self._moved = np.zeros((n, 3))
        self._modes = modes = self._rows.shape[1]
        # As the kernel says; and the products of what touches with how its forces change, shape (modes + 6, modes + 6).
        self._met, self._answers = np.zeros((2, 3 * n, modes + 6))
        self._pushes, self._twists, self._report = np.zeros(modes + 6), np.zeros((3, modes)), np.zeros(kernel.REPORT)
        self._products = np.zeros((modes + 6, modes + 6))
        self._arrays = {
            "settings": self._settings, "vertices": np.ascontiguousarray(profile.vertices),
            "shaft": np.array([profile.shaft], dtype=np.int32), "places": self.places, "moved": self._moved,
            "springs": self._springs, "friction": friction,
            "first": np.array([body.first_line for body in own], dtype=np.int32),
            "closed": np.array([body.closed for body in own], dtype=np.int32), "anchors": self.anchors,
            "touched": self.touched, "forces": self.forces, "rates": np.zeros((n, 3, 3)), "gaps": np.zeros(n),
            "new_anchors": self._new_anchors, "states": self._states, "rows": self._rows, "met": self._met,
            "answers": self._answers, "pushes": self._pushes, "twists": self._twists, "report": self._report}
        with LOCK:
            self._press = BoundKernel(kernel.contact_kernel(), self._arrays)

    def set_stiffness(self, moduli: np.ndarray) -> float:
        """A layer for tissue with these shear moduli at all nodes, Pa, shape (nodes,); returns the least of them where
        it touches."""
        own = moduli[self.nodes]
        self._springs[:] = own / (self._softness * self._reach) * self.areas
        return float(own.min())

    def evaluate(self, amplitudes: np.ndarray, frame: Frame, pressed_in: bool, *, slips_on: bool = False) -> None:
        """Find forces and their rates at these amplitudes, shape (modes,), under a tool there; `slips_on`: the rates of
        what is at the limit of friction are those of slip."""
        settings = self._settings
        settings[kernel.AT_LIMIT] = _AT_LIMIT * slips_on
        settings[kernel.ROTATION : kernel.ROTATION + 9] = frame.rotation.ravel()
        settings[kernel.ORIGIN : kernel.ORIGIN + 3] = frame.origin
        settings[kernel.PRESSED_IN] = pressed_in
        np.dot(self._rows, amplitudes, out=self._moved.reshape(-1))
        with LOCK:
            self._press()
        rows = 3 * int(self._report[kernel.TOUCHING])
        np.dot(self._met[:rows].T, self._answers[:rows], out=self._products)

    def on_modes(self) -> tuple[np.ndarray, np.ndarray]:
        """Forces of the tissue on the tool, on the modes, shape (modes,), and their derivatives, (modes, modes), which
        stand there until the next evaluation."""
        modes = self._modes
        return -self._pushes[:modes], self._products[:modes, :modes]

    @property
    def wrench(self) -> np.ndarray:
        """On the tool, about its deepest point, N and N m, shape (6,)."""
        return -self._pushes[self._modes :]

    @property
    def rates_of_modes(self) -> np.ndarray:
        """How the forces on the modes change as the tool moves and turns and the tissue does not, shape (modes, 6)."""
        modes = self._modes
        return -self._products[:modes, modes:]

    def force_of(self, change: np.ndarray) -> np.ndarray:
        """How the force on the tool, N, shape (3,), changes with the amplitudes, shape (modes,)."""
        modes = self._modes
        return self._products[modes : modes + 3, :modes] @ change

    def stiffness(self, answer: np.ndarray) -> np.ndarray:
        """Minus the derivative of the wrench with the pose of the tool, (6, 6), where the amplitudes answer it so,
        shape (modes, 6)."""
        modes = self._modes
        stiffness = self._products[modes:, modes:] - self._products[modes:, :modes] @ answer
        # The levers change, too.
        x, y, z = self._pushes[modes : modes + 3].tolist()
        stiffness[3:] += self._twists @ answer
        stiffness[3:, :3] += ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
        return stiffness

    @property
    def touches(self) -> bool:
        """Whether any node does."""
        return bool(self._report[kernel.TOUCHING])

    @property
    def slipping(self) -> int:
        """How many nodes slip."""
        return int(self._report[kernel.SLIPPING])

    @property
    def violation(self) -> float:
        """How far the tissue is in the tool, which is how far the layer gives way, m."""
        return float(self._report[kernel.DEPTH])

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
