"""Prescribed modes of a reduced solid: the displacement that a bonded tool imposes on the tissue."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.solid.frame import ToolFrame, differentiate_rotated_forces


class PrescribedModeAmplitudes:
    """Amplitudes of the modes that are prescribed by the pose of a bonded tool.

    The amplitudes are the displacement of the tool (3) and the change of its rotation matrix row by row (9).

    Args:
        count: number of prescribed modes: 12 for a bonded tool, 0 for a tool that can lift off.
        first: frame of the tool at which all amplitudes are zero.
    """

    def __init__(self, count: int, first: ToolFrame):
        self.count, self.first = count, first
        self._frame: ToolFrame | None = None
        self._rates = np.zeros((count, 6))

    def compute_amplitudes(self, frame: ToolFrame) -> np.ndarray:
        """Return the amplitudes of the prescribed modes for a frame of the tool, shape (count,)."""
        return frame.compute_origin_and_matrix_change_from(self.first)[: self.count]

    def compute_amplitude_rates(self, frame: ToolFrame) -> np.ndarray:
        """Return the derivative of the amplitudes with respect to position and rotation of the tool.

        Returns:
            Shape (count, 6). The array is cached; the caller must not change it.
        """
        if self.count and frame is not self._frame:
            self._rates = np.zeros((self.count, 6))
            self._rates[:3, :3] = np.eye(3)
            self._rates[3:, 3:] = differentiate_rotated_forces(frame.rotation.T).transpose(1, 0, 2).reshape(9, 6)[:, 3:]
            self._frame = frame
        return self._rates
