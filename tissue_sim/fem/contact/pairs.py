"""Contact pairs of an experiment: parts of the tissue surface, and the rigid bodies that they may touch.

The axisymmetric solver states a part of the surface by element edges, the three-dimensional solver by nodes.

The algorithms of all solvers share the definitions of bonds, tolerances, penalty stiffness and active sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from tissue_sim.experiment.contact_law import ContactLaw
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.tools.shapes import PLATE_RADIUS, Plate
from tissue_sim.experiment.tools.tool import Profile
from tissue_sim.fem.solver import ExperimentDerivatives

#: Coefficient of friction that stands for an interface without slip, 1.
STICK = -1.0
#: Value of `changeable` with which all points may change their contact state in one evaluation.
ALL_POINTS = 1_000_000


class ContactBondState(IntEnum):
    """State of the bond between a contact point of the tissue and a rigid body.

    Attributes:
        FREE: the point has not touched the body.
        HELD: an interface without slip holds the point at its anchor, the position where the point touched.
        TOUCHED: the point touches the body with friction; the anchor is the origin of the elastic slip.
    """

    FREE = 0
    HELD = 1
    TOUCHED = 2


@dataclass(frozen=True)
class RelativeContactTolerances:
    """Largest violation of a contact condition (penetration, or slip of a point that sticks) at an equilibrium.

    Attributes:
        needle: under a needle, over the contact radius, 1. A larger value saves iterations and makes the force less
            accurate.
        plate: between plates, over the margin of the specimen (the radius of a cylinder), 1.
        homogeneous: between plates where the deformation is homogeneous, over the margin of the specimen, 1; so small
            that forces agree with closed forms.
    """

    needle: float = 1e-4
    plate: float = 1e-7
    homogeneous: float = 1e-11


@dataclass(frozen=True)
class PenaltySettings:
    """Penalty stiffness of contact points (augmented Lagrangian), relative to the stiffness of the tissue.

    Attributes:
        normal: normal penalty stiffness of a point, in units of the shear modulus times the size of the surface that
            the point represents (axisymmetric: its area over the length of its edge; solid: the square root of its
            area), 1. Each iteration divides the remaining gap by about this number.
        stick_factor: tangential penalty stiffness of a point that sticks over its normal penalty stiffness, 1.
    """

    normal: float
    stick_factor: float


@dataclass(frozen=True)
class ActiveSetSettings:
    """Settings of the primal-dual active set strategy, which decides the contact state of each point.

    Attributes:
        augmentation_factor: augmentation parameter over the penalty stiffness of the point, 1. Gap and slip are
            multiplied by the augmentation parameter and added to the contact force; the sign of the sum decides the
            state. The parameter must be about the stiffness of the tissue: with a much larger one the active set
            cycles.
        draw_interval: a value of `changeable` between 0 and `ALL_POINTS` lets one of `draw_interval` points change its
            state; each value selects other points, so that the active set does not cycle.
    """

    augmentation_factor: float
    draw_interval: int = 4


#: Tolerances of all solvers.
TOLERANCES = RelativeContactTolerances()
#: Penalty stiffness of the solid and of its condensed contact.
SOLID_PENALTY = PenaltySettings(normal=3e5, stick_factor=3.0)


#: Smallest tip radius, over the radius of the contact, with which contact conditions at Gauss points are accurate.
BLUNT = 0.5


@dataclass(frozen=True, eq=False)
class ContactPair:
    """Part of the tissue surface, and the rigid body of revolution with which it may come into contact.

    Attributes:
        profile: outline of the body, in the frame of the tool if the body moves with the tool.
        surface: node numbers of element edges, shape (m, nodes of an edge), or of single nodes, shape (m,).
        friction: Coulomb coefficients of the body's face and of its shaft, 1; 0: frictionless,
            `tissue_sim.fem.contact.pairs.STICK`: no slip.
        moves: whether the body moves with the tool; otherwise the body rests.
        tied: whether an interface without slip holds the surface from the first touch on.
        stays: whether the surface stays in contact under tension.
        first_line: index of the first line segment of the outline that the surface may meet.
        closed: whether a sharp shaft is extended downwards while the tool is pressed in, because the tissue that is
            held below an upright face occupies the space there.
        between_nodes: whether the contact conditions of edges hold at the Gauss points of an edge (as many points as
            the edge adds normal degrees of freedom) instead of its nodes. On a surface that slides around an edge no
            larger than an element, or up a sphere, Gauss points reduce the geometric error by a factor of ten. A
            pointed tip would penetrate between Gauss points.
    """

    profile: Profile
    surface: np.ndarray
    friction: tuple[float, float]
    moves: bool = True
    tied: bool = False
    stays: bool = False
    first_line: int = 0
    closed: bool = True
    between_nodes: bool = False


@dataclass(frozen=True, eq=False)
class ContactPairs:
    """All contact pairs of a boundary-value problem, with the tolerance and the contact laws.

    Attributes:
        pairs: contact pairs, those of bodies that rest first, then those of bodies that move with the tool.
        tolerance: largest violation of a contact condition (penetration, or slip where the tissue sticks), m.
        laws: additional tractions, as of adhesion, at points that have touched the tool.
        face: contact area of the tool at the largest depth, m2.
        level: whether the moving body is a plate, which touches the whole settled top at once.
        largest_depth: largest depth at which the contact conditions are accurate, m.
    """

    pairs: tuple[ContactPair, ...]
    tolerance: float
    laws: tuple[ContactLaw, ...] = ()
    face: float = 1.0
    level: bool = False
    largest_depth: float = np.inf

    @property
    def tool_profile(self) -> Profile:
        """Outline of the tool, in the frame of the tool: that of the last pair.

        The pair of a sharp face without friction has a plane instead.
        """
        return self.pairs[-1].profile


@dataclass(frozen=True, eq=False)
class SurfaceParts:
    """Parts of the tissue surface that may come into contact, each as in `ContactPair.surface`.

    Attributes:
        bottom: height of the base, m.
        base: surface on the base.
        low_side, high_side: lower and upper half of the side; empty where the side cannot touch a body.
        top: surface below the tool.
        face: part of `top` below the flat face of a needle; empty without a flat face.
        free: part of `top` next to this face.
    """

    bottom: float
    base: np.ndarray
    low_side: np.ndarray
    high_side: np.ndarray
    top: np.ndarray
    face: np.ndarray
    free: np.ndarray


def friction_coefficient_or_stick_marker(interface: str | float) -> float:
    """Return the Coulomb coefficient of an interface for tissue that touches the interface during the test.

    Args:
        interface: coefficient of friction, or ``"bonded"``, ``"stick"`` (both give `STICK`: no slip) or
            ``"frictionless"`` (0).
    """
    if not isinstance(interface, str):
        return interface
    return {"bonded": STICK, "stick": STICK, "frictionless": 0.0}[interface]


def differentiate_friction_coefficients(more: Experiment, less: Experiment, width: float) -> ExperimentDerivatives:
    """Return the derivatives of the coefficients of friction by a difference of two experiments.

    Args:
        more: experiment with the parameter increased.
        less: experiment with the parameter decreased; its interfaces are of the same kinds.
        width: difference of the two values of the parameter.
    """
    def list_coefficients(experiment: Experiment) -> list[float]:
        """Return the coefficients of face, shaft and base."""
        shaft = experiment.friction if experiment.tool.is_plate else experiment.friction_wall
        return [friction_coefficient_or_stick_marker(interface)
                for interface in (experiment.friction, shaft, experiment.resolved_base_interface)]

    face, shaft, base = ((above - below) / width for above, below in zip(
        list_coefficients(more), list_coefficients(less), strict=True))
    return ExperimentDerivatives(face, shaft, base)


def build_contact_pairs(experiment: Experiment, parts: SurfaceParts, *, tool: bool = True, homogeneous: bool = False,
                        upright: bool = True) -> ContactPairs:
    """Return the contact pairs: the base with the lower half of the side, the tool with the rest of the surface.

    Args:
        experiment: specimen, tool, interfaces.
        parts: parts of the surface.
        tool: whether the tool is present; it is absent while the specimen settles under its weight.
        homogeneous: whether the deformation of the specimen is homogeneous, so that plates have a smaller tolerance.
        upright: whether the axis of the tool is vertical at the first touch.
    """
    is_plate = experiment.tool.is_plate
    # The side of the specimen does not touch grips, which are as wide as the specimen.
    pairs = [] if experiment.grip is not None else _make_base_pairs(experiment, parts)
    if tool and experiment.grip is None:
        pairs += _make_plate_pairs(experiment, parts) if is_plate else _make_needle_pairs(experiment, parts, upright)
    if is_plate:
        relative = TOLERANCES.homogeneous if homogeneous else TOLERANCES.plate
        tolerance = relative * experiment.specimen.margin()
    else:
        tolerance = TOLERANCES.needle * experiment.tool.require_radius()
    return ContactPairs(tuple(pairs), tolerance, experiment.acting_laws if tool else (),
                        np.pi * experiment.contact_radius**2, tool and is_plate, experiment.largest_accurate_depth)


def _make_base_pairs(experiment: Experiment, parts: SurfaceParts) -> list[ContactPair]:
    """Return the contact pairs of the tissue with the base plate.

    The side may bulge onto the base. A base with friction also holds the bottom, which stays in contact.
    """
    plane = Profile(np.array([[PLATE_RADIUS, parts.bottom], [0.0, parts.bottom]]), 0.0, 1)
    mu = friction_coefficient_or_stick_marker(experiment.resolved_base_interface)
    pairs = [ContactPair(plane, parts.low_side, (mu, mu), moves=False)]
    if experiment.resolved_base_interface not in ("bonded", "frictionless"):
        pairs.insert(0, ContactPair(plane, parts.base, (mu, mu), moves=False, tied=mu == STICK, stays=True))
    return pairs


def _make_plate_pairs(experiment: Experiment, parts: SurfaceParts) -> list[ContactPair]:
    """Return the contact pairs of a plate: the top, unless bonded, and the upper half of the side."""
    profile, mu = experiment.tool.profile, friction_coefficient_or_stick_marker(experiment.friction)
    pairs = [ContactPair(profile, parts.high_side, (mu, mu))]
    if experiment.friction != "bonded":
        pairs.insert(0, ContactPair(profile, parts.top, (mu, mu), tied=mu == STICK))
    return pairs


def _make_needle_pairs(experiment: Experiment, parts: SurfaceParts, upright: bool) -> list[ContactPair]:
    """Return the contact pairs of the needle and the top; with a bonded face, only the top next to the face."""
    tool = experiment.tool
    profile = tool.profile
    friction = (friction_coefficient_or_stick_marker(experiment.friction),
                friction_coefficient_or_stick_marker(experiment.friction_wall))
    if tool.face_radius == 0:
        blunt = profile.rounding >= BLUNT * experiment.contact_radius and friction[0] != STICK
        return [ContactPair(profile, parts.top, friction, between_nodes=blunt)]
    if experiment.friction == "bonded":
        return [ContactPair(profile, parts.free, friction, first_line=1, closed=upright)]
    # The nodes under a sharp face without friction slide in its plane; its edge has no tangent. Tissue next to a sharp
    # edge cannot come under the face.
    tied, is_plane = friction[0] == STICK, tool.has_sharp_edge and friction[0] == 0.0
    first, between = 0 if tool.edge_radius else 1, not (tied or is_plane)
    return [ContactPair(Plate().profile if is_plane else profile, parts.face, friction, tied=tied,
                        between_nodes=between),
            ContactPair(profile, parts.free, friction, first_line=first, closed=upright, between_nodes=between)]
