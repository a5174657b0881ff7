"""Simulate the loop of hand, device and tissue without a clock, and measure sustained oscillation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from haptics.devices.contracts import HapticDevice
from haptics.safety.rendering import ForceRendering
from tissue_sim.tool_force import Tissue


@dataclass(frozen=True)
class OscillationCriteria:
    """Criteria of a sustained oscillation of the device.

    Attributes:
        window: length of the two successive windows in which the motion is compared, s. A longer window detects slower
            oscillations.
        smallest: smallest peak-to-peak amplitude of an oscillation, m.
        lasting: smallest ratio of the amplitudes of the second and the first window; a smaller ratio means decay.
        largest: distance from the start at which the simulation ends because the device is unstable, m.
    """

    window: float = 0.5
    smallest: float = 0.05e-3
    lasting: float = 0.9
    largest: float = 0.05


#: Criteria of `simulate_device_depths` and `measure_sustained_peak_to_peak`.
OSCILLATION = OscillationCriteria()


def simulate_device_depths(tissue: Tissue, device: HapticDevice, rendering: ForceRendering, seconds: float,
                           tick: float = 1e-3) -> np.ndarray:
    """Simulate a loop without delays and return the depth of the device at each tick.

    The simulation ends early if the device is more than 50 mm from its start. An unknown pose is replaced by the
    previous one.

    Args:
        tissue: the tissue, see `haptics.loop.loop.Loop`.
        device: the device, which is started and stopped here.
        rendering: conversion of poses and forces.
        seconds: simulated time, s.
        tick: period of the loop, s.

    Returns:
        Depths, m, shape (n,).
    """
    device.start()
    depths: list[float] = []
    for number in range(round(seconds / tick)):
        pose = device.pose(number * tick)
        rendered = rendering.render(tissue.step(rendering.advance_proxy(pose, tick), tick), tick)
        device.render(rendered.wrench)
        depth = pose.depth if pose is not None else depths[-1] if depths else 0.0
        depths.append(depth)
        if abs(depth - depths[0]) > OSCILLATION.largest:
            break
    device.stop()
    return np.array(depths)


def measure_sustained_peak_to_peak(depths: np.ndarray, tick: float = 1e-3) -> float:
    """Return the peak-to-peak amplitude, m, of the last half second if it is a sustained oscillation, otherwise 0.

    An oscillation is sustained (growing, or a limit cycle) if its amplitude exceeds 0.05 mm and has not decreased by a
    tenth from the half second before. The hand must hold still, because its own motion counts as oscillation.

    Args:
        depths: depths from `simulate_device_depths`, m, for at least two windows or until the device was unstable.
        tick: period of the loop, s.

    Returns:
        The amplitude; 0 for a small or decaying motion.
    """
    window = round(OSCILLATION.window / tick)
    if np.ptp(depths) > OSCILLATION.largest:
        return float(np.ptp(depths[-window:]))
    now, before = float(np.ptp(depths[-window:])), float(np.ptp(depths[-2 * window:-window]))
    return now if now > OSCILLATION.smallest and now > OSCILLATION.lasting * before else 0.0
