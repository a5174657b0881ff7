"""The modes of a reduced solid that the tool's pose says."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.solid.frame import Frame, turned_with


class Lifting:
    """What a tool that holds tissue carries along: its way, and how its axes turned.

    Args:
        count: of these modes, 12 or, of a tool that only touches, none.
        first: where the tool is when none of them is moved.
    """

    def __init__(self, count: int, first: Frame):
        self.count, self.first = count, first
        self._frame: Frame | None = None
        self._rates = np.zeros((count, 6))

    def amplitudes(self, frame: Frame) -> np.ndarray:
        """Of these modes, shape (count,)."""
        return frame.motion_from(self.first)[: self.count]

    def rates(self, frame: Frame) -> np.ndarray:
        """How these change with the position and a rotation of the tool, shape (count, 6); not to be changed."""
        if self.count and frame is not self._frame:
            self._rates = np.zeros((self.count, 6))
            self._rates[:3, :3] = np.eye(3)
            self._rates[3:, 3:] = turned_with(frame.rotation.T).transpose(1, 0, 2).reshape(9, 6)[:, 3:]
            self._frame = frame
        return self._rates
