"""What a real-time step answers: the force on the tool, and how far it can be believed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from tissue_sim.errors import InputError

_NONE = (0.0,) * 6
#: How far the length of a quaternion may be from 1.
_UNIT = 1e-6


class ForceStatus(IntEnum):
    """How the force of a step came about; every number but that of a refused pose is the best that is known."""

    CONVERGED = 0
    LATE = 1
    STOPPED = 2
    REFUSED = 3

    @property
    def message(self) -> str:
        """What it means, and what to do."""
        return {
            ForceStatus.CONVERGED: "in equilibrium at this pose",
            ForceStatus.LATE: "the time budget ended before equilibrium: the last equilibrium's force and stiffness, "
                              "carried on to this pose; the next step goes on from there",
            ForceStatus.STOPPED: "no equilibrium was found on the way to this pose: the last one's force and "
                                 "stiffness, carried on to this pose; move the tool back, or reset",
            ForceStatus.REFUSED: "the pose or the time step is not a number: the last force; nothing was changed",
        }[self]


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the tool is, in the frame of the scene: origin at the centre of the undeformed top, z out of the tissue.

    Attributes:
        position: x, y, z, m.
        orientation: unit quaternion (w, x, y, z).

    Raises:
        InputError: a quaternion that has no length of 1.
    """

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self):
        # A NaN passes here: it is the simulator that refuses a pose and keeps its state.
        length = math.sqrt(sum(part * part for part in self.orientation))
        if abs(length - 1.0) > _UNIT:
            raise InputError(f"the quaternion (w, x, y, z) has length {length:.6g}; give a unit quaternion",
                             field="orientation")

    @property
    def depth(self) -> float:
        """How far the tool is pushed in, m."""
        return -self.position[2]


@dataclass(frozen=True, slots=True)
class ToolForce:
    """The answer to one step.

    Attributes:
        force: on the tool along z, N, positive when the tissue pushes back.
        stiffness: dF/dd, N/m: how the force grows with depth at once, within this step.
        status: how far to believe them.
        iterations: linear solves of this step.
        residual: unbalanced over balanced forces of the last equilibrium that was looked for.
        compute_time: wall time of the step, s.
        inertial: whether the mass of the tissue was taken into account.
        age: time since the last equilibrium, s; 0 where this one is.
        depth: tool displacement of that last equilibrium, m.
    """

    force: float
    stiffness: float
    status: ForceStatus
    iterations: int = 0
    residual: float = 0.0
    compute_time: float = 0.0
    inertial: bool = False
    age: float = 0.0
    depth: float = 0.0

    @property
    def force_vector(self) -> tuple[float, float, float]:
        """Force on the tool, N."""
        return (0.0, 0.0, self.force)

    @property
    def torque_vector(self) -> tuple[float, float, float]:
        """Torque on the tool about its tip, N m; none in an axisymmetric scene."""
        return (0.0, 0.0, 0.0)

    @property
    def stiffness_matrix(self) -> tuple[tuple[float, ...], ...]:
        """Minus the derivative of (force, torque) with (position, rotation vector), 6 x 6, N/m, N, N m.

        A tissue that resists has positive entries on the diagonal; an axisymmetric scene only that of z.
        """
        return (_NONE, _NONE, (0.0, 0.0, self.stiffness, 0.0, 0.0, 0.0), _NONE, _NONE, _NONE)


class Tissue(Protocol):
    """What answers a tool's motion with a force: a `Simulator`, or what stands in for one."""

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """The force where the tool is now, a depth, m, or a pose, dt s after the last step."""


def depth_of(pose: float | Pose) -> float:
    """Depth of a pose, or the depth that was given, m."""
    return pose.depth if isinstance(pose, Pose) else float(pose)
