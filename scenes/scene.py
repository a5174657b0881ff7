"""A scene: an experiment ready to run and to look at."""

from __future__ import annotations

from dataclasses import dataclass

from tissue_sim.experiment import Experiment, Protocol, Specimen


@dataclass(frozen=True)
class Scene:
    """An experiment with everything but its size and its protocol.

    Attributes:
        name: as on the command line.
        title: for figures.
        friction: interface of the tool's face.
        friction_base: interface of the base.
    """

    name: str
    title: str
    friction: str
    friction_base: str

    def experiment(self, *, radius: float, height: float, protocol: Protocol) -> Experiment:
        """The experiment on a cylinder of this radius and height, m."""
        return Experiment(Specimen(radius, height), protocol, friction=self.friction, friction_base=self.friction_base)
