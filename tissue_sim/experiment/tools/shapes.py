"""Shapes of tools: needles with a flat face, a hemispherical or a conical tip; ball; plate."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import SHAFT_LENGTH, Profile, Tool, edge_radius, radius
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class HemisphericalNeedle(Tool):
    """A needle with a hemispherical tip.

    Attributes:
        radius: of tip and shaft, m.
    """

    name = "round"
    radius: float = radius()

    def __post_init__(self):
        self.require_valid_radius_and_roundings()

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        a = self.radius
        return Profile([(0.0, a), (0.0, SHAFT_LENGTH * a)], a, 0)

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        """Estimate the radius of the contact at a depth, m: sqrt(radius depth) (Hertz), at most `radius`."""
        return min(self.radius, math.sqrt(self.radius * depth))


#: Smallest half angle of a cone, rad.
_SHARPEST = 0.01


@dataclass(frozen=True)
class Cone(Tool):
    """A cone on a shaft, with rounded tip and shoulder.

    Attributes:
        radius: of the shaft, m.
        half_angle: between the axis and the side, rad.
        tip_radius: radius of the rounding of tip and shoulder, m.
    """

    name = "cone"
    radius: float = radius()
    half_angle: float = parameter("theta", "rad", key="half_angle_deg", factor=math.pi / 180,
                                  bounds=(_SHARPEST, 1.57))
    tip_radius: float = parameter("r_t", "m", key="tip_radius_mm", factor=1e-3, bounds=(0.0, 1.0), absent=0.0,
                                  default=0.0)

    def __post_init__(self):
        self.require_valid_radius_and_roundings("tip_radius")
        if not _SHARPEST <= self.half_angle < math.pi / 2:
            raise InputError("must be at least 0.6 degrees and below 90 degrees, between the axis and the side of "
                             f"the cone; got {math.degrees(self.half_angle):g} degrees.", field="tool.half_angle")

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        a, tip = self.radius, self.tip_radius
        shoulder = tip + (a - tip) / math.tan(self.half_angle)
        return Profile([(0.0, tip), (a - tip, shoulder), (a - tip, shoulder + SHAFT_LENGTH * a)], tip, 1)

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        """Estimate the radius of the contact at a depth, m: 2/pi depth tan(half angle) (Sneddon), at most `radius`."""
        pointed = 2.0 / math.pi * depth * math.tan(self.half_angle)
        return min(self.radius, max(pointed, math.sqrt(self.tip_radius * depth)))


@dataclass(frozen=True)
class Sphere(Tool):
    """Spherical tool (ball) without a shaft.

    Attributes:
        radius: m.
    """

    name = "sphere"
    has_shaft = False
    radius: float = radius()

    def __post_init__(self):
        self.require_valid_radius_and_roundings()

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        a = self.radius
        # A segment of negligible length; the ball is closed above it.
        return Profile([(0.0, a), (0.0, a * (1 + 1e-9))], a, 1)

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        """Estimate the radius of the contact at a depth, m: sqrt(radius depth) (Hertz), at most `radius`."""
        return min(self.radius, math.sqrt(self.radius * depth))


#: Radius of a plate, m; wider than any specimen.
PLATE_RADIUS = 10.0


@dataclass(frozen=True)
class Plate(Tool):
    """A plate; it has no sizes."""

    name = "plate"
    is_plate = True
    has_shaft = False

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        return Profile([(0.0, 0.0), (PLATE_RADIUS, 0.0)], 0.0, 1)

    @property
    def face_radius(self) -> None:
        """None: the face of the tool covers the whole specimen and has no edge; see `Tool.face_radius`."""
        return None

    def contact_radius(self, depth: float, specimen_radius: float = float("inf")) -> float:
        """Return the radius of the contact, that of the specimen, m."""
        return specimen_radius


@dataclass(frozen=True)
class Flat(Tool):
    """A flat punch with a rounded edge.

    Attributes:
        radius: of the shaft, m.
        edge_radius: radius of the rounding between face and shaft, m.
    """

    name = "flat"
    radius: float = radius()
    edge_radius: float = edge_radius()

    def __post_init__(self):
        self.require_valid_radius_and_roundings("edge_radius")

    @property
    def profile(self) -> Profile:
        """Outline of the tool in the half plane r >= 0; see `Profile`."""
        face, rounding = self.face_radius, self.edge_radius
        return Profile([(0.0, rounding), (face, rounding), (face, SHAFT_LENGTH * self.radius)], rounding, 1)

    @property
    def face_radius(self) -> float:
        """Radius of the flat part of the face, without the rounding, m."""
        return self.radius - self.edge_radius

    @property
    def has_sharp_edge(self) -> bool:
        """Whether the edge between face and shaft has no rounding."""
        return self.edge_radius == 0

    def contact_radius(self, depth: float, specimen_radius: float = float("inf")) -> float:
        """Return the radius of the contact, that of the shaft, m."""
        return self.radius
