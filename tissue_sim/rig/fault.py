"""Faults of a rig that can be added: a file each, by name in rig files.

A fault is a frozen dataclass that derives from `RigFault` and declares its numbers with
`tissue_sim.parameters.parameter`. `FAULTS` knows the classes by name; a `Rig` carries the faults themselves.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from tissue_sim.parameters import declaring
from tissue_sim.recording.recording import Recording
from tissue_sim.registry import Registry


class RigFault:
    """What a load frame or a sensor does that `Rig` has no field for. Override one of the two methods, or both.

    Attributes:
        name: key in rig files.
        title: for people.
        needs_time: whether what it does depends on the time, or on the speed, of the motion.
    """

    name: ClassVar[str]
    title: ClassVar[str] = ""
    needs_time: ClassVar[bool] = False

    @property
    def moves_tool(self) -> bool:
        """Whether the tool goes elsewhere than the stage reports."""
        return type(self).tool_motion is not RigFault.tool_motion

    @property
    def reads(self) -> bool:
        """Whether the sensor reads something else than the true force."""
        return type(self).reading is not RigFault.reading

    def tool_motion(self, displacement: np.ndarray) -> np.ndarray:
        """Where the tool goes when the stage reports these displacements, m, in the order of time, shape (n,)."""
        return displacement

    def reading(self, recording: Recording) -> Recording:
        """What is read of a recording of reported displacement and true force, noise apart."""
        return recording


#: Name -> class.
FAULTS: Registry[type[RigFault]] = Registry(
    "fault of a rig", "tissue_sim.rig_faults", {"inertia": "tissue_sim.rig.inertia:Inertia"},
    accepts=declaring(RigFault),
    expected="a frozen dataclass that derives from tissue_sim.RigFault and declares its parameters")
