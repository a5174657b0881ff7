"""Compute the time from the displacement, or the displacement from the time, of a test at constant speed."""

from __future__ import annotations

import sys
from numbers import Real
from pathlib import Path

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.recording import Recording


def add_time_or_motion_from_speed(recording: Recording, speed: float, path: Path) -> Recording:
    """Return a recording of a test at constant speed with the missing time, s, or displacement, m, added.

    Args:
        recording: recording without time or without displacement; a recording with both is returned without a change.
        speed: speed of the test, m/s.
        path: file name for messages.

    Raises:
        InputError: not a positive speed; neither time nor displacement.
    """
    if isinstance(speed, bool) or not isinstance(speed, Real) or not 0 < speed <= sys.float_info.max:
        raise InputError(f"must be a positive number in m/s; got {speed!r}", field="speed")
    if "displacement" in recording:
        if "time" in recording:
            return recording
        path_length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(recording.displacement)))])
        return recording.with_channels(time=path_length / speed)
    if "time" in recording and "force" in recording:
        return recording.with_channels(displacement=speed * (recording.time - recording.time[0]))
    raise InputError("requires a displacement, from which it gives the time, or time and force, from which it gives "
                     f"the displacement; this file has {', '.join(recording.channels)}", file=path, field="speed")
