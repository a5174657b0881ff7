"""Additional faults of a rig: contract, registry by name, and inertia of the mass between the sensor and the tissue.

A fault is a frozen dataclass that derives from `RigFault` and declares its parameters with
`tissue_sim.parameters.parameter`. `FAULTS` contains the classes by name; a `Rig` contains the faults.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import make_parameter_dataclass_predicate, parameter
from tissue_sim.recording.recording import Recording
from tissue_sim.registry import Registry


class RigFault:
    """Effect of a load frame or a sensor for which `Rig` has no field. A subclass overrides one or both methods.

    Attributes:
        name: key in rig files.
        title: name in reports.
        needs_time: whether the effect depends on the time or the speed of the motion.
    """

    name: ClassVar[str]
    title: ClassVar[str] = ""
    needs_time: ClassVar[bool] = False

    @property
    def moves_tool(self) -> bool:
        """Whether the fault changes the motion of the tool."""
        return type(self).tool_motion is not RigFault.tool_motion

    @property
    def reads(self) -> bool:
        """Whether the fault changes the reading of the sensor."""
        return type(self).reading is not RigFault.reading

    def tool_motion(self, displacement: np.ndarray) -> np.ndarray:
        """Displacement of the tool for displacements that the stage reports, m, in order of time, shape (n,)."""
        return displacement

    def reading(self, recording: Recording) -> Recording:
        """Reading, without noise, of a recording of reported displacement and true force."""
        return recording


#: Name -> class of a fault.
FAULTS: Registry[type[RigFault]] = Registry(
    "fault of a rig", "tissue_sim.rig_faults", {"inertia": "tissue_sim.rig.fault:Inertia"},
    accepts=make_parameter_dataclass_predicate(RigFault),
    expected="a frozen dataclass that derives from tissue_sim.RigFault and declares its parameters")


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
