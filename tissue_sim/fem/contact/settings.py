"""Definitions that the contact algorithms of all solvers share: bonds, tolerances, penalty stiffness, active sets."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

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
