"""An experiment: specimen, tool, interfaces, protocol; and the model that a recording depends on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.material import Material
from tissue_sim.rig import Rig


def _positive(value: float, name: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{value:g} is not positive; give a length in m above zero", field=name)


@dataclass(frozen=True)
class Specimen:
    """A cylinder of the material.

    Attributes:
        radius, height: undeformed, m.
        name: for people and campaign files.
    """

    radius: float
    height: float
    name: str = "specimen"

    def __post_init__(self):
        _positive(self.radius, "specimen.radius")
        _positive(self.height, "specimen.height")

    @property
    def area(self) -> float:
        """Undeformed cross-section, m2."""
        return np.pi * self.radius**2


@dataclass(frozen=True)
class Tool:
    """A rigid body that is moved into the specimen.

    Attributes:
        shape: ``"plate"`` covers the whole top face.
    """

    shape: str = "plate"

    def __post_init__(self):
        if self.shape != "plate":
            raise InputError(f"tool shape {self.shape!r} is not available in this version; use 'plate'", field="tool")


#: How a face holds the tissue: ``"bonded"`` (no motion against the face) or ``"frictionless"`` (free to slide along
#: it). Coulomb friction and lift-off need contact and are not available in this version.
INTERFACES = ("bonded", "frictionless")


@dataclass(frozen=True, eq=False)
class Protocol:
    """True tool displacement against time: straight lines between its points.

    The motion of a measured recording is what the rig reported: take its contact offset off first,
    ``Protocol(recording.time, recording.displacement - offset)``.

    Attributes:
        time: s, strictly increasing, shape (n,).
        displacement: m, positive into the tissue, shape (n,). Below zero a bonded plate pulls.
    """

    time: np.ndarray
    displacement: np.ndarray

    def __post_init__(self):
        for name in ("time", "displacement"):
            array = np.array(getattr(self, name), dtype=float)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.time.ndim != 1 or self.time.shape != self.displacement.shape or self.time.size == 0:
            raise InputError(f"time {self.time.shape} and displacement {self.displacement.shape} must be two lists of "
                             "the same length", field="protocol")
        if not (np.isfinite(self.time).all() and np.isfinite(self.displacement).all()):
            raise InputError("time and displacement must be finite", field="protocol")
        if (np.diff(self.time) <= 0).any():
            raise InputError("time must increase from point to point", field="protocol.time")

    @classmethod
    def ramp(cls, depth: float, points: int = 21, speed: float = 0.248e-3) -> Protocol:
        """A ramp to `depth` (m) at `speed` (m/s), `points` samples with rest included; the study's speed by default."""
        _positive(depth, "protocol.depth")
        _positive(speed, "protocol.speed")
        if points < 2:
            raise InputError(f"{points} points cannot make a ramp; give at least 2", field="protocol.points")
        displacement = np.linspace(0.0, depth, points)
        return cls(displacement / speed, displacement)

    @property
    def depth(self) -> float:
        """Largest displacement, m."""
        return float(self.displacement.max())


@dataclass(frozen=True)
class Experiment:
    """What is done to the specimen.

    Attributes:
        specimen: geometry.
        protocol: tool displacement against time.
        tool: what is pushed in.
        friction: interface of the tool's face; see `INTERFACES`.
        friction_base: interface of the base plate.

    Raises:
        InputError: unknown interface, or a protocol that goes through the specimen.
    """

    specimen: Specimen
    protocol: Protocol
    tool: Tool = field(default_factory=Tool)
    friction: str = "bonded"
    friction_base: str = "bonded"

    def __post_init__(self):
        for name in ("friction", "friction_base"):
            value = getattr(self, name)
            if value not in INTERFACES:
                raise InputError(f"{value!r} is not available in this version; use 'bonded' or 'frictionless'",
                                 field=name)
        if self.protocol.depth >= self.specimen.height:
            raise InputError(f"{self.protocol.depth * 1e3:g} mm is deeper than the specimen is high "
                             f"({self.specimen.height * 1e3:g} mm)", field="protocol")

    @property
    def homogeneous(self) -> bool:
        """Whether the deformation is a homogeneous uniaxial one, for which closed forms hold."""
        return self.tool.shape == "plate" and self.friction == self.friction_base == "frictionless"


@dataclass(frozen=True)
class Model:
    """Everything that a recording depends on."""

    experiment: Experiment
    material: Material
    rig: Rig = field(default_factory=Rig)
