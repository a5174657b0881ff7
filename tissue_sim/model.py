"""Complete model of a test: experiment, material and rig."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.material.material import Material
from tissue_sim.public_names import OldName
from tissue_sim.rig.rig import Rig


@dataclass(frozen=True)
class Model:
    """Experiment, material and rig: together they determine a recording.

    Attributes:
        experiment: specimen, tool, interfaces and protocol.
        material: material of the tissue.
        rig: load frame and sensor.

    Raises:
        InputError: lateral walls around an incompressible material, whose force would be infinite; or a rig that is not
            ideal for a grip that rotates.

    Examples:
        >>> from tissue_sim import KINDS, Bulk, Protocol, Specimen, simulate
        >>> plates = KINDS["lubricated_compression"].experiment(
        ...     specimen=Specimen(0.040, 0.070), protocol=Protocol.ramp(0.007, points=3))
        >>> model = Model(plates, Material("neo_hooke", {"C10": 1000.0}, Bulk("bulk_ratio", 1e3)))
        >>> simulate(model).force.round(2)  # N
        array([0.  , 1.59, 3.36])
    """

    depends_on_way = OldName("is_path_dependent")
    experiment: Experiment
    material: Material
    rig: Rig = field(default_factory=Rig)

    def __post_init__(self):
        if self.experiment.has_lateral_wall and math.isinf(self.material.bulk_modulus):
            raise InputError("must be finite between lateral walls; got an incompressible material. State bulk.K_Pa or "
                             "another bulk response", field="bulk")
        if self.experiment.grip is not None and self.experiment.grip.is_rotation and not self.rig.is_ideal:
            raise InputError("must be ideal for angle and torque, because its effects are those on displacement and "
                             "force; got another rig. Leave the rig out", field="rig")

    @property
    def is_path_dependent(self) -> bool:
        """Whether the force depends on the path of the tool, not only on its present pose."""
        return self.material.is_history_dependent or self.experiment.is_path_dependent
