"""Additional faults of a rig: contract, and registry by name.

A fault is a frozen dataclass that derives from `RigFault` and declares its parameters with
`tissue_sim.parameters.parameter`. `FAULTS` contains the classes by name; a `Rig` contains the faults.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from tissue_sim.parameters import make_parameter_dataclass_predicate
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
    "fault of a rig", "tissue_sim.rig_faults", {"inertia": "tissue_sim.rig.inertia:Inertia"},
    accepts=make_parameter_dataclass_predicate(RigFault),
    expected="a frozen dataclass that derives from tissue_sim.RigFault and declares its parameters")
