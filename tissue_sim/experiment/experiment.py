"""An experiment: specimen, tool, interfaces, protocol; and the model that a recording depends on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, require_length
from tissue_sim.experiment.interfaces import LARGEST_FRICTION, checked_interface
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.material.material import Material
from tissue_sim.parameters import parameter
from tissue_sim.pose import Pose
from tissue_sim.rig.rig import Rig

#: Gravity where nothing else is said, m/s2.
STANDARD_GRAVITY = 9.81
HEIGHTS = ("moulded", "placed")


@dataclass(frozen=True)
class Specimen:
    """A cylinder of the material, standing on its base.

    Attributes:
        radius, height: m; the radius is that of the undeformed cylinder, the height is what `height_is` says.
        name: for people and campaign files.
        density: kg/m3, or None where nobody said.
        gravity: m/s2, along the axis and towards the base; 0 leaves self-weight out.
        height_is: ``"moulded"``, the undeformed height, or ``"placed"``, measured on its base after it has settled.

    Raises:
        InputError: a size that is not positive, gravity without a density.
    """

    radius: float = parameter("R", "m", key="radius_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)
    height: float = parameter("H", "m", key="height_mm", factor=1e-3, bounds=(1e-5, 1.0), shapes_mesh=True)
    name: str = "specimen"
    density: float | None = parameter("rho", "kg/m3", key="density_kg_m3", bounds=(1.0, 1e5), default=None)
    gravity: float = parameter("g0", "m/s2", key="gravity_m_s2", bounds=(0.0, 100.0), absent=0.0, default=0.0)
    height_is: str = "moulded"

    def __post_init__(self):
        require_length(self.radius, "specimen.radius")
        require_length(self.height, "specimen.height")
        if self.density is not None and not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"{self.density:g} is not a positive density; give kg/m3", field="specimen.density")
        if not (np.isfinite(self.gravity) and self.gravity >= 0):
            raise InputError(f"{self.gravity:g} m/s2 is not a gravity towards the base; give 0 or {STANDARD_GRAVITY}",
                             field="specimen.gravity")
        if self.gravity and self.density is None:
            raise InputError("gravity needs a density; give density in kg/m3", field="specimen.density")
        if self.height_is not in HEIGHTS:
            raise InputError(f"{self.height_is!r} is not a way to measure a height; use 'moulded' or 'placed'",
                             field="specimen.height_is")

    @property
    def area(self) -> float:
        """Undeformed cross-section, m2."""
        return np.pi * self.radius**2

    @property
    def specific_weight(self) -> float:
        """Density times gravity, N/m3; 0 where self-weight is left out."""
        return self.density * self.gravity if self.gravity else 0.0


def _friction(symbol: str, key: str, default: str) -> Any:
    return parameter(symbol, "1", key=key, bounds=(0.0, LARGEST_FRICTION), absent=0.0, words={"frictionless": 0.0},
                     default=default)


@dataclass(frozen=True)
class Adhesion:
    """Pull between the tool and tissue that has touched it.

    Attributes:
        force: N, of the whole face at once, spread evenly over it.
        length: m, over which the pull falls to zero as the surfaces part.
    """

    force: float = parameter("F_ad", "N", key="adhesion_N", bounds=(0.0, 1e3), absent=0.0)
    length: float = parameter("l_ad", "m", key="adhesion_length_mm", factor=1e-3, bounds=(1e-7, 1.0))

    def __post_init__(self):
        if not (np.isfinite(self.force) and self.force >= 0):
            raise InputError(f"{self.force:g} N is not a pull-off force; give 0 or more", field="adhesion.force")
        require_length(self.length, "adhesion.length")


@dataclass(frozen=True)
class Experiment:
    """What is done to the specimen.

    Attributes:
        specimen: geometry, and whether it weighs.
        protocol: tool displacement against time, from where the tool touches the settled specimen.
        tool: what is pushed in.
        friction: interface of the tool's face; see `tissue_sim.experiment.interfaces`. A bonded needle holds what its
            flat face touches at the start, and its rounded edge holds what it meets.
        friction_base: interface of the base plate.
        friction_wall: interface of a needle's shaft; tissue meets it during the test, so it cannot be bonded.
        adhesion: pull of a tool that lifts off; None: none.
        tilt: height difference across the contact, m; see `tissue_sim.experiment.tilt`.

    Raises:
        InputError: an interface that does not fit, a protocol that goes through the specimen, a needle as wide as it.
    """

    specimen: Specimen
    protocol: Protocol
    tool: Tool = field(default_factory=Tool)
    friction: str | float = _friction("mu", "friction", "bonded")
    friction_base: str | float = _friction("mu_base", "friction_base", "bonded")
    friction_wall: str | float = _friction("mu_wall", "friction_wall", "frictionless")
    adhesion: Adhesion | None = None
    tilt: float = parameter("delta", "m", key="tilt_mm", factor=1e-3, bounds=(0.0, 1.0), absent=0.0, default=0.0)

    def __post_init__(self):
        for name in ("friction", "friction_base", "friction_wall"):
            object.__setattr__(self, name, checked_interface(getattr(self, name), name))
        if self.friction_wall == "bonded":
            raise InputError("tissue meets the shaft during the test and cannot be bonded to it; use 'stick', "
                             "'frictionless' or a coefficient of friction", field="friction_wall")
        if not (np.isfinite(self.tilt) and self.tilt >= 0):
            raise InputError(f"{self.tilt:g} m is not a height difference; give 0 or more", field="tilt")
        if self.protocol.depth >= self.specimen.height:
            raise InputError(f"{self.protocol.depth * 1e3:g} mm is deeper than the specimen is high "
                             f"({self.specimen.height * 1e3:g} mm)", field="protocol")
        if self.adhesion is not None and self.friction == "bonded":
            raise InputError("a bonded face never lifts off; use 'stick', 'frictionless' or a coefficient of friction "
                             "with adhesion", field="friction")
        if not self.tool.has_shaft and self.friction_wall != "frictionless":
            raise InputError(f"a {self.tool.shape} has no shaft; leave it out", field="friction_wall")
        if self.tool.is_plate:
            return
        if self.tool.radius >= self.specimen.radius:
            raise InputError(f"the tool's radius, {self.tool.radius * 1e3:g} mm, must be smaller than the specimen's, "
                             f"{self.specimen.radius * 1e3:g} mm", field="tool.radius")
        if self.tool.face_radius == 0 and self.friction == "bonded":
            raise InputError(f"a {self.tool.shape} tool has no flat face to be bonded to; use 'stick', 'frictionless' "
                             "or a coefficient of friction", field="friction")
        slides = self.friction not in ("bonded", "stick")
        if slides and self.tool.sharp_edge:
            raise InputError("tissue that slides round a sharp edge has no direction there; give the tool an edge "
                             "radius, or friction 'stick' or 'bonded'", field="tool.edge_radius")

    def tool_pose(self, displacement: float) -> Pose:
        """Where the tool is when the protocol says this displacement, m: pushed in along the axis."""
        return Pose.at_depth(displacement)

    @property
    def contact_radius(self) -> float:
        """About how wide the contact is at the largest depth, m; see `Tool.contact_radius`."""
        depth = max(self.protocol.depth, 1e-3 * (self.tool.radius or self.specimen.height))
        return self.tool.contact_radius(depth, self.specimen.radius)

    @property
    def slides(self) -> bool:
        """Whether tissue may slip against friction, so that the force depends on the way of the tool."""
        return any(isinstance(value, float) for value in (self.friction, self.friction_base, self.friction_wall))

    @property
    def homogeneous(self) -> bool:
        """Whether a specimen of one material deforms homogeneously, so that closed forms hold."""
        return (self.tool.is_plate and self.friction == self.friction_base == "frictionless"
                and not self.specimen.specific_weight)


@dataclass(frozen=True)
class Model:
    """Everything that a recording depends on."""

    experiment: Experiment
    material: Material
    rig: Rig = field(default_factory=Rig)
