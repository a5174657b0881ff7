"""Step of a coarse sensor."""

from __future__ import annotations

import numpy as np

from tissue_sim.recording.saturation import last_digit

#: Largest difference of a step from a whole multiple of the step of the sensor, as a fraction of that step.
_WHOLE = 1e-3
#: Last digit of the numbers in the file, in steps, up to which the steps may differ by this digit.
_FINE = 0.1


def rounding_step(values: np.ndarray) -> float:
    """Step of a sensor that shows few different values; 0 where there is none.

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
    digit = last_digit(values)
    allowed = max(_WHOLE * step, 1.5 * digit if digit < _FINE * step else 0.0)
    return step if np.abs(steps - counts * step).max() <= allowed else 0.0
