"""Experiment: specimen, tool and its approach, interfaces, protocol, and contact laws."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.experiment.adhesion import Adhesion
from tissue_sim.experiment.contact_law import AS_TOOL, LARGEST_FRICTION, ContactLaw, validate_and_normalise_interface
from tissue_sim.experiment.grip import GripMotion
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.parameters import parameter
from tissue_sim.pose import Pose, Screw, Vector
from tissue_sim.public_names import OldName, with_old_names
from tissue_sim.settings import make_shallow_read_only_copy
from tissue_sim.specimen import Specimen


@dataclass(frozen=True)
class Approach:
    """Straight path of a tool that is off the axis of the specimen, or tilted.

    Attributes:
        offset: distance from the axis, along x, of the deepest point of the upright tool, m.
        angle: between the axes of tool and specimen, rad; a positive angle moves the tool towards +x as it goes in. The
            tool is rotated about its deepest point.

    Raises:
        InputError: a number that is not finite, or an angle of more than 80 degrees.
    """

    offset: float = parameter("x0", "m", key="offset_mm", factor=1e-3, bounds=(-1.0, 1.0), absent=0.0, default=0.0,
                              shapes_mesh=True)
    angle: float = parameter("theta", "rad", key="tilt_deg", factor=math.pi / 180.0, bounds=(-1.4, 1.4), absent=0.0,
                             default=0.0)

    def __post_init__(self):
        if not math.isfinite(self.offset):
            raise InputError(f"must be finite; got {self.offset} m.", field="approach.offset")
        if not abs(self.angle) <= 1.4:
            raise InputError(f"must be at most 80 degrees; got {math.degrees(self.angle):g} degrees.",
                             field="approach.angle")

    def pose(self, displacement: float) -> Pose:
        """Return the pose of the tool at a displacement, m, from its first touch, positive into the tissue."""
        sine, cosine = math.sin(self.angle), math.cos(self.angle)
        half = 0.5 * self.angle
        return Pose((self.offset + sine * displacement, 0.0, -cosine * displacement),
                    (math.cos(half), 0.0, -math.sin(half), 0.0))

    #: Old name.
    against = OldName("direction_against_motion")

    @property
    def direction_against_motion(self) -> Vector:
        """Unit vector opposite to the tool's direction of motion, in the frame of the scene."""
        return -math.sin(self.angle), 0.0, math.cos(self.angle)

    def compute_force_against_motion(self, wrench: Screw) -> float:
        """Return the component of a wrench's force opposite to the tool's direction of motion, N."""
        return sum(one * other for one, other in zip(self.direction_against_motion, wrench, strict=False))


def _declare_friction_parameter(symbol: str, key: str, default: str | None) -> Any:
    """Declare the friction coefficient of a face as a parameter; the word ``frictionless`` is the value 0."""
    return parameter(symbol, "1", key=key, bounds=(0.0, LARGEST_FRICTION), absent=0.0, words={"frictionless": 0.0},
                     default=default)


@dataclass(frozen=True)
class SharpFaceDepthLimits:
    """Largest depth of a sharp face without friction.

    The tissue under the face slides in its plane, and no tissue slides around the edge. The force is exact for small
    depths. At these limits it is larger than that of edge radii of 1 and 2 % of the radius, extrapolated to zero, by
    0.5 % (a thick block) and 2 % (an incompressible layer as thick as the radius).

    Attributes:
        radius_fraction: depth over the radius of the tool, 1.
        height_fraction: depth over the thickness of the specimen, 1.
    """

    radius_fraction: float = 0.25
    height_fraction: float = 0.02


#: Limits of all experiments.
SHARP_FACE = SharpFaceDepthLimits()


@with_old_names(resistance="compute_force_against_motion", homogeneous="has_homogeneous_deformation")
@dataclass(frozen=True)
class Experiment:
    """Specimen, tool, interfaces and protocol of one test.

    Attributes:
        specimen: geometry, density and gravity.
        protocol: displacement of the tool or force on it against time, from the first touch of the specimen in
            equilibrium.
        tool: rigid tool that is moved into the specimen.
        friction: interface of the tool's face; see `tissue_sim.experiment.contact_law`. A bonded needle holds the
            tissue under its flat face from the start, and its rounded edge holds the tissue that it meets.
        friction_base: interface of the base plate; ``"as_tool"``: that of the upper plate. None: ``"bonded"`` under a
            needle and below a curved specimen; between two plates the interface of the tool, as ``"as_tool"`` if it is
            a coefficient of friction, so that a fit changes both together.
        friction_wall: interface of a needle's shaft; tissue meets it during the test, so that it cannot be bonded.
        adhesion: attraction of a tool that lifts off; None: no adhesion.
        tilt: height difference across the contact, m; see `tissue_sim.simulation`.
        slip: fraction of the bonded area that slips; see `tissue_sim.simulation`. It applies to both bonded faces of
            plates, and to the face of a needle. None if the tool's face is not bonded.
        contact_laws: additional laws by name; see `tissue_sim.experiment.contact_law`. A sequence of laws is accepted.
        approach: offset and angle of the tool; None: on the axis. Only three-dimensional solvers accept another one.
        has_lateral_wall: whether rigid walls without friction hold the side of the specimen between two bonded plates.
        grip: motion of the upper plate along the displacements or angles of the protocol if rigid grips hold both ends;
            both plates are then bonded. None: the tool moves along -z, or along `approach`.

    Raises:
        InputError: an interface that does not fit, a protocol deeper than the specimen, a needle as wide as the
            specimen.
    """

    depends_on_way = OldName("is_path_dependent")
    specimen: Specimen
    protocol: Protocol
    tool: Tool = field(default_factory=Tool)
    friction: str | float = _declare_friction_parameter("mu", "friction", "bonded")
    friction_base: str | float = _declare_friction_parameter("mu_base", "friction_base", None)
    friction_wall: str | float = _declare_friction_parameter("mu_wall", "friction_wall", "frictionless")
    adhesion: Adhesion | None = None
    tilt: float = parameter("delta", "m", key="tilt_mm", factor=1e-3, bounds=(0.0, 1.0), absent=0.0, default=0.0)
    slip: float | None = parameter("s", "1", key="slip", bounds=(0.0, 1.0), absent=0.0, default=None)
    contact_laws: Mapping[str, ContactLaw] = field(default_factory=dict)
    approach: Approach | None = None
    has_lateral_wall: bool = False
    grip: GripMotion | None = None
    with_free_faces = OldName("with_slipping_faces_frictionless")
    base_interface = OldName("resolved_base_interface")

    def __post_init__(self):
        if not isinstance(self.tool, Tool):
            raise InputError(
                f"must be one Tool; got {_describe_type_and_length(self.tool)}. An experiment has one tool: "
                "make one experiment for each.", field="tool")
        given = self.contact_laws.values() if isinstance(self.contact_laws, Mapping) else self.contact_laws
        object.__setattr__(self, "contact_laws", make_shallow_read_only_copy({law.name: law for law in given}))
        if self.friction_base is None:
            object.__setattr__(self, "friction_base", self._make_default_base_interface())
        for name in ("friction", "friction_base", "friction_wall"):
            object.__setattr__(self, name, validate_and_normalise_interface(getattr(self, name), name))
        if self.friction_wall == "bonded":
            raise InputError("must not be 'bonded': tissue meets the shaft during the test. Use 'stick', "
                             "'frictionless' or a coefficient of friction", field="friction_wall")
        if not (np.isfinite(self.tilt) and self.tilt >= 0):
            raise InputError(f"must be a height difference of 0 or more; got {self.tilt:g} m.", field="tilt")
        slip = self.slip or 0.0
        if not 0 <= slip <= 1:
            raise InputError(f"must be a fraction from 0 to 1; got {slip:g}.", field="slip")
        if slip and self.friction != "bonded":
            raise InputError(f"requires friction 'bonded'; got {self.friction!r}. Leave the slip out",
                             field="slip")
        object.__setattr__(self, "slip", slip if self.friction == "bonded" else None)
        position = () if self.approach is None else (self.approach.offset,)
        if (thickness := self.thickness) <= 0.0 and self.approach is not None:
            raise InputError(f"the specimen has no tissue {abs(self.approach.offset) * 1e3:g} mm off the axis, "
                             f"{self.specimen.in_words}", field="approach.offset")
        if self.grip is not None:
            self._check_gripped_experiment(self.grip)
        elif self.protocol.prescribes_angle:
            raise InputError("must prescribe displacements or forces of a tool; got angles. State lengths, such as "
                             "ramp 10mm", field="protocol")
        elif self.protocol.depth >= thickness:
            raise InputError(f"a depth of {self.protocol.depth * 1e3:g} mm is deeper than the specimen is high "
                             f"({thickness * 1e3:g} mm)", field="protocol")
        if (self.adhesion or self.contact_laws) and self.friction == "bonded":
            raise InputError("a bonded face never lifts off; use 'stick', 'frictionless' or a coefficient of friction "
                             f"with {next(iter(self.contact_laws), 'adhesion')}", field="friction")
        if self.friction_base == AS_TOOL and not self.tool.is_plate:
            raise InputError(f"friction_base={AS_TOOL!r} requires a plate; the tool is a {self.tool.shape}. State the "
                             "interface of the base",
                             field="friction_base")
        if not self.tool.has_shaft and self.friction_wall != "frictionless":
            raise InputError(f"requires a tool with a shaft; got a {self.tool.shape}. Leave friction_wall out",
                             field="friction_wall")
        if self.has_lateral_wall and not self.friction == self.resolved_base_interface == "bonded":
            raise InputError("must be 'bonded' on both faces between lateral walls, where tissue does not slide; got "
                             f"{self.friction!r} and {self.friction_base!r}. Use 'bonded'", field="friction")
        if self.has_lateral_wall and not (self.tool.is_plate and self.specimen.is_prism):
            raise InputError("requires a plate and a specimen of constant cross-section; got a "
                             f"{self.tool.shape} on {self.specimen.in_words}. Leave the wall out",
                             field="has_lateral_wall")
        radius = self.tool.radius
        if self.tool.is_plate and self.approach is not None:
            raise InputError("a plate covers the whole top and comes down its axis; leave the approach out",
                             field="approach")
        if self.tool.is_plate or radius is None:
            return
        if self.approach is not None and radius > self.specimen.margin(*position):
            raise InputError(f"a tool of radius {radius * 1e3:g} mm that is {abs(self.approach.offset) * 1e3:g} mm off "
                             f"the axis reaches beyond the specimen, {self.specimen.in_words}", field="approach.offset")
        if radius >= (margin := self.specimen.margin()):
            raise InputError(f"the tool's radius, {radius * 1e3:g} mm, must be smaller than the specimen's, "
                             f"{margin * 1e3:g} mm", field="tool.radius")
        if self.tool.face_radius == 0 and self.friction == "bonded":
            raise InputError(f"a {self.tool.shape} tool has no flat face to be bonded to; use 'stick', 'frictionless' "
                             "or a coefficient of friction", field="friction")
        if self.tool.has_sharp_edge and not isinstance(self.friction, str):
            raise InputError("must be positive with a coefficient of friction: at a sharp edge the slip has no "
                             "direction. Give the tool an edge radius, or use friction 'frictionless', 'stick' or "
                             "'bonded'", field="tool.edge_radius")
        if self.protocol.depth > (limit := self.largest_accurate_depth):
            raise InputError(f"must be positive without friction at a depth of {self.protocol.depth * 1e3:g} mm: "
                             f"beyond {limit * 1e3:.3g} mm tissue slides around the sharp edge. Give the tool an edge "
                             "radius",
                             field="tool.edge_radius")
        if self.slip:
            self.with_slipping_faces_frictionless()

    def _check_gripped_experiment(self, grip: GripMotion) -> None:
        """Check that the finite elements model the experiment with a gripped specimen.

        Raises:
            InputError: plates that are not bonded, a specimen that is not a prism, self-weight, a tilted face, slip, a
                protocol of another quantity, an approach, or grips that meet.
        """
        if not (self.tool.is_plate and self.friction == self.resolved_base_interface == "bonded"):
            raise InputError(f"both grips must be plates with bonded contact; got a {self.tool.shape} with "
                             f"{self.friction!r} contact and a base with {self.resolved_base_interface!r} contact. "
                             "Remove tool, friction and base interface", field="friction")
        if not self.specimen.is_prism:
            raise InputError(f"must have a constant cross-section between grips; got {self.specimen.in_words}. Use a "
                             "cylinder or a block", field="specimen")
        gravity = self.specimen.gravity if self.specimen.specific_weight else 0.0
        for name, value in (("specimen.gravity", gravity), ("tilt", self.tilt), ("slip", self.slip or 0.0)):
            if value:
                raise InputError(f"must be 0 for a gripped specimen; got {value:g}. Remove {name}", field=name)
        if self.protocol.prescribes_angle != grip.is_rotation:
            found, remedy = ("angles", "a length, such as ramp 10mm") if not grip.is_rotation else (
                "forces, and a torque cannot be prescribed" if self.protocol.uses_force_control else "lengths",
                "an angle, such as ramp 30deg @1deg/s")
            raise InputError(f"must prescribe the motion of the grip; got {found}. State {remedy}", field="protocol")
        if self.protocol.segment is not None and "approach" in self.protocol.segment:
            raise InputError("must not approach the specimen, which the grips hold from the start; got an approach. "
                             "Start with a ramp; a retract reverses the motion of the grip", field="protocol")
        closest = float(np.nanmin(np.append(grip.axis[2] * self.protocol.displacement, np.inf)))
        if not grip.is_rotation and closest <= -self.specimen.height:
            raise InputError(f"must be above {-self.specimen.height * 1e3:g} mm, where the grips meet; got "
                             f"{closest * 1e3:g} mm. Prescribe a smaller displacement", field="protocol")

    def _make_default_base_interface(self) -> str:
        """Return the interface of the base if the experiment does not state one."""
        if not self.tool.is_plate or not self.specimen.is_flat:
            return "bonded"
        return self.friction if isinstance(self.friction, str) else AS_TOOL

    def with_slipping_faces_frictionless(self) -> Experiment:
        """Return the experiment without slip fraction and with frictionless instead of bonded faces.

        The face of the tool becomes frictionless; between plates, a bonded base becomes frictionless too.

        Raises:
            InputError: tissue would slide around a sharp edge.
        """
        base = "frictionless" if self.tool.is_plate and self.resolved_base_interface == "bonded" else self.friction_base
        return replace(self, friction="frictionless", friction_base=base, slip=None)

    @property
    def thickness(self) -> float:
        """Thickness of the specimen under the axis of the tool, m."""
        return self.specimen.vertical_thickness(*(() if self.approach is None else (self.approach.offset,)))

    @property
    def largest_accurate_depth(self) -> float:
        """Largest depth for a sharp face without friction, m (`SharpFaceDepthLimits`); infinite for other contacts."""
        if not self.tool.has_sharp_edge or self.friction != "frictionless":
            return float("inf")
        return min(SHARP_FACE.radius_fraction * self.tool.require_radius(), SHARP_FACE.height_fraction * self.thickness)

    def tool_pose(self, displacement: float) -> Pose:
        """Pose of the tool at a displacement of the protocol, m, or at an angle of a grip, rad."""
        path = self._path
        return Pose.at_depth(displacement) if path is None else path.pose(displacement)

    def compute_force_against_motion(self, wrench: Screw) -> float:
        """Return the load that a cell on the stage measures: the component of the force, N, against the tool's motion.

        For a grip that rotates the load is the component of the torque, N m.

        Args:
            wrench: force and torque on the tool, N and N m. For an upright tool the result is the force along z.
        """
        path = self._path
        return wrench[2] if path is None else path.compute_force_against_motion(wrench)

    @property
    def _path(self) -> Approach | GripMotion | None:
        """Path of the tool if it does not move along -z on the axis of the specimen."""
        return self.grip or self.approach

    @property
    def channels(self) -> tuple[str, str]:
        """Names of the channels of motion and load in a simulated recording."""
        is_rotation = self.grip is not None and self.grip.is_rotation
        return ("angle", "torque") if is_rotation else ("displacement", "force")

    def format_displacement(self, value: float, digits: int = 4) -> str:
        """Return a displacement, m, or an angle, rad, with its unit mm or deg, for messages."""
        is_angle = self.protocol.prescribes_angle
        return f"{math.degrees(value):.{digits}g} deg" if is_angle else f"{value * 1e3:.{digits}g} mm"

    def compute_displacement_on_path(self, pose: Pose, near: float) -> float:
        """Return the displacement, m, or the angle, rad, at a pose on the path of the tool; the inverse of `tool_pose`.

        Args:
            pose: pose on the path.
            near: an angle within half a turn of the result.
        """
        if self.grip is not None:
            return self.grip.compute_amount(pose, near)
        return pose.depth / (1.0 if self.approach is None else math.cos(self.approach.angle))

    @property
    def resolved_base_interface(self) -> str | float:
        """Interface of the base, with ``"as_tool"`` replaced by that of the tool."""
        return self.friction if self.friction_base == AS_TOOL else self.friction_base

    @property
    def acting_laws(self) -> tuple[ContactLaw, ...]:
        """Adhesion and additional contact laws that have an effect."""
        built_in = () if self.adhesion is None else (self.adhesion,)
        return tuple(law for law in (*built_in, *self.contact_laws.values()) if law.acts)

    @property
    def contact_radius(self) -> float:
        """Approximate radius of the contact at the largest depth, m; see `Tool.contact_radius`."""
        depth = max(self.protocol.depth, 1e-3 * (self.tool.radius or self.specimen.height))
        return self.tool.contact_radius(depth, self.specimen.margin())

    @property
    def is_path_dependent(self) -> bool:
        """Whether the force depends on the path of the tool, because of friction, adhesion or other contact laws."""
        return self.adhesion is not None or bool(self.contact_laws) or any(isinstance(value, float) for value in (
            self.friction, self.resolved_base_interface, self.friction_wall))

    @property
    def has_homogeneous_deformation(self) -> bool:
        """Whether a specimen of one material deforms homogeneously, so that closed forms are valid."""
        slides = self.friction == self.resolved_base_interface == "frictionless"
        return (self.tool.is_plate and (slides or self.has_lateral_wall) and self.specimen.is_prism
                and not self.specimen.specific_weight and not self.contact_laws)


def _describe_type_and_length(value: object) -> str:
    """Description of a value's type for messages: ``list of 2``, ``str``."""
    name = type(value).__name__
    return f"{name} of {len(value)}" if isinstance(value, list | tuple | set | dict) else name
