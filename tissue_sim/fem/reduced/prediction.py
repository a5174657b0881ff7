"""Where the amplitudes of a reduced solid will be after the tool's next motion."""

from __future__ import annotations

import numpy as np

#: A tool that gets faster by more than this is predicted as if it did not.
_MOST_FASTER = 2.0


class Prediction:
    """Amplitudes follow the tool linearly, are moved by what was left unbalanced, and miss what they missed last time.

    Args:
        modes: how many.
        reach: of the contact, m; a rotation counts as the way of a point so far from the axis.

    Attributes:
        answer: how the amplitudes follow the position and a rotation of the tool at the last equilibrium, (modes, 6).
        left: what was left unbalanced there would move them by this, shape (modes,).
    """

    def __init__(self, modes: int, reach: float):
        self.answer = np.zeros((modes, 6))
        self.left, self._missed, self._way = np.zeros(modes), np.zeros(modes), np.zeros(6)
        self._weights = np.array([1.0] * 3 + [reach**2] * 3)

    def change(self, way: np.ndarray) -> np.ndarray:
        """Of the amplitudes as the tool moves by this screw, shape (modes,)."""
        change = self.answer @ way + self.left
        last = float(self._weights @ self._way**2)
        if last > 0.0:
            # It is of second order in the way.
            share = min(max(float(self._weights @ (way * self._way)) / last, 0.0), _MOST_FASTER)
            change += share**2 * self._missed
        return change

    def learn(self, way: np.ndarray, change: np.ndarray, answer: np.ndarray, left: np.ndarray) -> None:
        """After a step by this way, which changed the amplitudes and left `left` to change."""
        self._missed[:] = change + left - self.left - self.answer @ way
        self._way[:], self.answer[:], self.left[:] = way, answer, left

    def forget(self) -> None:
        """Nothing follows."""
        for array in self.kept:
            array[:] = 0.0

    def forget_what_was_missed(self) -> None:
        """The material is another one."""
        self.left[:], self._missed[:], self._way[:] = 0.0, 0.0, 0.0

    @property
    def kept(self) -> tuple[np.ndarray, ...]:
        """All that a committed step leaves behind."""
        return self.answer, self.left, self._missed, self._way
