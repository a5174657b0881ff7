"""A model: everything that a recording depends on."""

from __future__ import annotations

from dataclasses import dataclass, field

from tissue_sim.experiment.experiment import Experiment
from tissue_sim.material.material import Material
from tissue_sim.rig.rig import Rig


@dataclass(frozen=True)
class Model:
    """Everything that a recording depends on."""

    experiment: Experiment
    material: Material
    rig: Rig = field(default_factory=Rig)

    @property
    def depends_on_way(self) -> bool:
        """Whether the force depends on how the tool came to where it is, and not on its place alone."""
        return self.material.remembers or self.experiment.depends_on_way
