"""Predictor of the modal amplitudes for the next pose of the tool."""

from __future__ import annotations

import numpy as np

#: Largest ratio of the present to the last step of the tool that scales the second-order correction. A tool that
#: accelerates more is predicted as if it accelerated by this ratio.
_MAX_STEP_RATIO = 2.0


class AmplitudePredictor:
    """Predictor of the modal amplitudes: second-order extrapolation along the motion of the tool.

    The prediction is du = S dx + c + a^2 e with the sensitivity S, the correction c by the remaining residual, the
    error e of the last linear prediction and the ratio a of the present to the last step of the tool.

    Args:
        modes: number of modes.
        reach: radius of the contact, m; a rotation is measured by the displacement of a point at this distance.

    Attributes:
        sensitivity: derivative of the amplitudes with respect to position and rotation of the tool at the last
            equilibrium, shape (modes, 6).
        correction: change of the amplitudes that would remove the remaining residual, shape (modes,).
    """

    def __init__(self, modes: int, reach: float):
        self.sensitivity = np.zeros((modes, 6))
        self.correction, self._error, self._last_step = np.zeros(modes), np.zeros(modes), np.zeros(6)
        self._weights = np.array([1.0] * 3 + [reach**2] * 3)

    def predict_amplitude_change(self, tool_step: np.ndarray) -> np.ndarray:
        """Predict the change of the amplitudes in the next step, shape (modes,).

        Args:
            tool_step: displacement, m, and rotation vector, rad, of the tool in the next step, shape (6,).
        """
        change = self.sensitivity @ tool_step + self.correction
        last = float(self._weights @ self._last_step**2)
        if last > 0.0:
            # The error of a linear prediction is of second order in the step of the tool.
            ratio = min(max(float(self._weights @ (tool_step * self._last_step)) / last, 0.0), _MAX_STEP_RATIO)
            change += ratio**2 * self._error
        return change

    def record_step(self, tool_step: np.ndarray, change: np.ndarray, sensitivity: np.ndarray,
                    correction: np.ndarray) -> None:
        """Record a converged step for the next predictions.

        Args:
            tool_step: displacement, m, and rotation vector, rad, of the tool in the step, shape (6,).
            change: change of the amplitudes in the step, shape (modes,).
            sensitivity: derivative at the new equilibrium, shape (modes, 6).
            correction: change of the amplitudes that would remove the remaining residual, shape (modes,).
        """
        self._error[:] = change + correction - self.correction - self.sensitivity @ tool_step
        self._last_step[:], self.sensitivity[:], self.correction[:] = tool_step, sensitivity, correction

    def reset_predictions(self) -> None:
        """Discard all recorded steps; the predicted change is then zero."""
        for array in self.state_arrays:
            array[:] = 0.0

    def clear_corrections(self) -> None:
        """Set the corrections to zero and keep the sensitivity, after a change of the material."""
        self.correction[:], self._error[:], self._last_step[:] = 0.0, 0.0, 0.0

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the recorded steps; writing saved copies into them restores an earlier state."""
        return self.sensitivity, self.correction, self._error, self._last_step
