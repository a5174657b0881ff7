"""Faults of a rig: a sensor that saturates gently, and a screw whose pitch wanders."""

from dataclasses import dataclass

import numpy as np

import tissue_sim as ts


@dataclass(frozen=True)
class SoftSensor(ts.RigFault):
    """The sensor reads F / (1 + softness |F|)."""

    name = "soft_sensor"
    title = "a sensor that gives way"
    softness: float = ts.parameter("k", "1/N", key="softness_per_N", bounds=(0.0, 10.0), absent=0.0)

    def reading(self, recording):
        return recording.with_channels(force=recording.force / (1.0 + self.softness * np.abs(recording.force)))


@dataclass(frozen=True)
class WanderingPitch(ts.RigFault):
    """The tool goes d + amplitude sin(2 pi d / pitch) where the stage reports d."""

    name = "wandering_pitch"
    amplitude: float = ts.parameter("w", "m", key="amplitude_mm", factor=1e-3, bounds=(0.0, 1e-3), absent=0.0)
    pitch: float = ts.parameter("p", "m", key="pitch_mm", factor=1e-3, bounds=(1e-4, 1e-1))

    def tool_motion(self, displacement):
        return displacement + self.amplitude * np.sin(2 * np.pi * displacement / self.pitch)
