"""A scene: an experiment ready to run and to look at."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from tissue_sim.experiment.experiment import Experiment, Specimen
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.experiment.tools.tool import Tool


@dataclass(frozen=True)
class Scene:
    """An experiment with everything but its specimen and its protocol.

    Attributes:
        name: as on the command line.
        title: for figures.
        friction: interface of the tool's face: bonded, stick, frictionless or Coulomb's coefficient of friction.
        friction_base: interface of the base.
        friction_wall: interface of a needle's shaft.
        tool: what is pushed in.
    """

    name: str
    title: str
    friction: str | float
    friction_base: str | float
    friction_wall: str | float = "frictionless"
    tool: Tool = field(default_factory=Tool)

    def experiment(self, *, specimen: Specimen, protocol: Protocol, **overrides: Any) -> Experiment:
        """The experiment on this specimen.

        Args:
            specimen: geometry, and whether it weighs.
            protocol: motion of the tool.
            overrides: other fields of `Experiment`; `tool`, `friction`, `friction_base` and `friction_wall` in place
                of the scene's own.

        Raises:
            InputError: what `Experiment` refuses.
        """
        own = {"tool": self.tool, "friction": self.friction, "friction_base": self.friction_base,
               "friction_wall": self.friction_wall}
        return Experiment(specimen, protocol, **(own | overrides))
