"""Recordings whose force is controlled: recognition, and noise of both channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Test
from calibration.statistics.sensor_noise import ForceControlNoise, SensorNoise, Signal, estimate_pooled_sensor_noise
from tissue_sim.recording.screening import Screening


def is_force_controlled(screening: Screening, test: Test, time: np.ndarray | None) -> bool:
    """Return whether the machine controls the force of a recording, as the test states or the signals show.

    Args:
        screening: findings about the signals, with the controlled quantity.
        test: test that may state the controlled quantity.
        time: time, s, shape (n,); None: the signals do not show the controlled quantity.
    """
    if test.control != "find":
        return test.control == "force" and time is not None
    return time is not None and screening.control is not None and screening.control.quantity == "force"


def estimate_force_control_noise(displacements: Sequence[Signal], forces: Sequence[Signal],
                                 stated: tuple[float | None, float | None], correlation_time: float | None
                                 ) -> tuple[ForceControlNoise, list[SensorNoise]]:
    """Estimate the noise of both channels of recordings of one test whose force is controlled.

    Args:
        displacements: displacement, m, time and segment labels of each recording.
        forces: force, N, time and segment labels of each recording.
        stated: stated standard deviations of displacement, m, and force, N; None: estimated.
        correlation_time: correlation time of the noise of the displacement, s; None: estimated.

    Returns:
        Noise of both channels, and for each recording the noise of the force at the measured displacement. Its standard
        deviation is hypot(sigma_f, k sigma_d) with the secant stiffness k of the recording.
    """
    displacement = estimate_pooled_sensor_noise(displacements, deviation=stated[0], correlation_time=correlation_time)
    force = estimate_pooled_sensor_noise(forces, deviation=stated[1], correlation_time=0.0)
    stiffness = [float(np.abs(load).max() / np.abs(motion).max())
                 for (motion, *_), (load, *_) in zip(displacements, forces, strict=True)]
    return ForceControlNoise(displacement.deviation, force.deviation), [
        replace(displacement, deviation=float(np.hypot(force.deviation, k * displacement.deviation)))
        for k in stiffness]
