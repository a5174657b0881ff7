"""Inertia of the mass between the sensor and the tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.fault import RigFault


@dataclass(frozen=True)
class Inertia(RigFault):
    """Add the inertial force of the tool to the reading of the sensor: F + mass times acceleration.

    The acceleration is that of the reported motion, by second differences. A report that shows the steps of the stage
    must be smoothed before.

    Attributes:
        mass: moving mass beyond the sensor, kg.
    """

    name = "inertia"
    title = "inertia of the tool"
    needs_time = True

    mass: float = parameter("m", "kg", key="mass_kg", bounds=(0.0, 100.0), absent=0.0)

    def __post_init__(self):
        if not 0 <= self.mass < np.inf:
            raise InputError(f"must be finite and 0 or more; got {self.mass:g} kg.", field="mass")

    def reading(self, recording: Recording) -> Recording:
        """Return the recording with the force mass times acceleration added; see `RigFault.reading`."""
        if not self.mass or len(recording) < 3:
            return recording
        speed = np.gradient(recording.displacement, recording.time)
        return recording.with_channels(force=recording.force + self.mass * np.gradient(speed, recording.time))
