"""Estimate the step of a coarse sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.recording.saturation import find_last_digit_step_or_zero


@dataclass(frozen=True)
class ResolutionSettings:
    """Settings of `find_rounding_step_or_zero`.

    Attributes:
        whole: largest difference of a step from a whole multiple of the step of the sensor, as a fraction of that step.
        fine_digit: largest last digit of the numbers in the file, in steps of the sensor, by which the steps may
            differ.
    """

    whole: float = 1e-3
    fine_digit: float = 0.1


#: Settings that the functions of this module use.
_SETTINGS = ResolutionSettings()


def find_rounding_step_or_zero(values: np.ndarray) -> float:
    """Return the step of a sensor with few different values; 0 for a fine sensor.

    The numbers of a file are rounded, too: steps may differ from whole multiples by the last digit of the numbers.

    Args:
        values: in any unit, shape (n,).
    """
    levels = np.unique(values)
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * np.abs(levels).max()]
    if not steps.size or levels.size > 0.5 * values.size:
        return 0.0
    counts = np.round(steps / steps.min())
    step = float(steps.sum() / counts.sum())
    digit = find_last_digit_step_or_zero(values)
    allowed = max(_SETTINGS.whole * step, 1.5 * digit if digit < _SETTINGS.fine_digit * step else 0.0)
    return step if np.abs(steps - counts * step).max() <= allowed else 0.0
