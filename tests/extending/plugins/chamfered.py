"""A shape of tool in one file: a flat punch with a chamfer of 45 degrees as an additional dimension."""

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import SHAFT_LENGTH, Profile, Tool, radius
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Chamfered(Tool):
    """A flat punch of `radius`, whose edge is cut by `chamfer`, both m."""

    name = "chamfered"
    radius: float = radius()
    chamfer: float = parameter("c", "m", key="chamfer_mm", factor=1e-3, bounds=(0.0, 1.0), shapes_mesh=True)

    def __post_init__(self):
        self.require_valid_radius_and_roundings("chamfer")
        if not self.chamfer:
            raise InputError("a chamfer of 0 is no chamfer; use the flat tool", field="tool.chamfer")

    @property
    def profile(self) -> Profile:
        a, face = self.radius, self.face_radius
        return Profile([(0.0, 0.0), (face, 0.0), (a, self.chamfer), (a, SHAFT_LENGTH * a)], 0.0, 2)

    @property
    def face_radius(self) -> float:
        return self.radius - self.chamfer

    @property
    def has_sharp_edge(self) -> bool:
        return True

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        return self.radius if depth > self.chamfer else self.face_radius
