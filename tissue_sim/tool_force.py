"""Result of a real-time step: wrench and stiffness on the tool, and their status."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Protocol

from tissue_sim.pose import Pose, Screw, Vector, scale_screw
from tissue_sim.public_names import OldName, with_old_names

#: 6 x 6 matrix, row by row.
Matrix = tuple[Screw, Screw, Screw, Screw, Screw, Screw]
_NONE: Screw = (0.0,) * 6
_AT_THE_TOUCH = Pose((0.0, 0.0, 0.0))


def make_axial_wrench(force: float) -> Screw:
    """Make the wrench of a force along z, N."""
    return (0.0, 0.0, force, 0.0, 0.0, 0.0)


def make_axial_stiffness_matrix(stiffness: float) -> Matrix:
    """Make the stiffness matrix of a body that resists along z only, N/m."""
    return (_NONE, _NONE, (0.0, 0.0, stiffness, 0.0, 0.0, 0.0), _NONE, _NONE, _NONE)


def extrapolate_wrench(wrench: Screw, stiffness: Matrix, way: Screw) -> Screw:
    """Extrapolate a wrench linearly: wrench - stiffness times a motion, m and rad, of the tool."""
    x, y, z, u, v, w = way
    a, b, c, d, e, f = [part - (row[0] * x + row[1] * y + row[2] * z + row[3] * u + row[4] * v + row[5] * w)
                        for part, row in zip(wrench, stiffness, strict=True)]
    return (a, b, c, d, e, f)


#: Fraction of the force beyond which an estimated error of the force rules out `ForceStatus.CONVERGED`.
ERROR_SHARE = 0.25
#: An estimated error below this force, N, never rules it out in a scene with large forces.
ERROR_FLOOR = 0.05
#: In a scene with small forces, neither does one below this fraction of the shear modulus times the contact radius
#: squared, which is about the force at a depth of an eighth of that radius.
ERROR_FLOOR_SHARE = 0.05


def compute_negligible_force_error(shear_modulus: float, contact_radius: float) -> float:
    """Return the error of the force, N, up to which a force has the status CONVERGED however small the force is.

    Args:
        shear_modulus: initial shear modulus, Pa.
        contact_radius: contact radius of the tool, m.
    """
    return min(ERROR_FLOOR, ERROR_FLOOR_SHARE * shear_modulus * contact_radius**2)


def is_force_error_acceptable_or_unknown(wrench: Screw, error: float | None, floor: float = ERROR_FLOOR) -> bool:
    """Return whether the estimated error of the force, N, allows the status CONVERGED; True for an unknown error.

    Args:
        wrench: force and torque on the tool.
        error: N.
        floor: see `compute_negligible_force_error`, N.
    """
    if error is None or error <= floor:
        return True
    x, y, z, *_ = wrench
    return error <= ERROR_SHARE * math.sqrt(x * x + y * y + z * z)


def limit_force_of_wrench(wrench: Screw, largest: float) -> Screw:
    """Return a wrench whose force is at most `largest`, N; force and torque are scaled by the same factor."""
    force = math.hypot(*wrench[:3])
    return wrench if force <= largest else scale_screw(largest / force, wrench)


def compute_largest_force_change_for_motion(stiffness: Matrix, length: float) -> float:
    """Return the largest change of a force component, N, for a displacement increment of the tool.

    Args:
        stiffness: see `ToolForce`.
        length: length of the increment, m.
    """
    return length * max(abs(stiffness[axis][axis]) for axis in (0, 1, 2))


def scale_matrix(share: float, matrix: Matrix) -> Matrix:
    """Multiply a matrix by a number."""
    a, b, c, d, e, f = (scale_screw(share, row) for row in matrix)
    return (a, b, c, d, e, f)


class ForceStatus(IntEnum):
    """Status of the force of a step.

    CONVERGED means that the answer is right, at this pose, at this time, for this tissue:

    - the tissue is in equilibrium with the tool at the pose of this step, within the tolerance, with the material that
      is set now;
    - the equilibrium is one of this time: no time and no part of the path is left to later steps;
    - the estimated error of the force, where one is known, is at most `ERROR_SHARE` of the force, or
      `compute_negligible_force_error`;
    - where the tissue has mass, the part of the error that unresolved waves have is at most `ERROR_SHARE` of the force,
      or `tissue_sim.realtime.inertia_limits.ContactWaveTimeAndShearSpeed.floor`, the tool is slower than shear waves,
      and no wave was lost.

    The status does not depend on the age of the stiffness (`ToolForce.stiffness_age`). An unknown error is None, not 0.
    A tissue returns the first four statuses; the others are set between tissue and hand
    (`tissue_sim.realtime.force_fading`, `haptics.server`).
    """

    CONVERGED = 0
    LATE = 1
    STOPPED = 2
    REFUSED = 3
    FADING = 4
    RETURNING = 5
    FAILED = 6

    @property
    def message(self) -> str:
        """Meaning of the status, and remedy."""
        return {
            ForceStatus.CONVERGED: "in equilibrium at this pose",
            ForceStatus.LATE: "the time or the linear solutions of the step ended before equilibrium: force and "
                              "stiffness of the last equilibrium, extrapolated to this pose; the next step continues "
                              "from there; or the force is in equilibrium and its estimated error is too large",
            ForceStatus.STOPPED: "no equilibrium was found on the path to this pose: force and stiffness of the last "
                                 "equilibrium, extrapolated to this pose; move the tool back, or reset",
            ForceStatus.REFUSED: "the pose or the time step is not finite, or outside of the limits of the scene: the "
                                 "last force; nothing was changed",
            ForceStatus.FADING: "no equilibrium for too long: force and stiffness decrease to zero; move the tool "
                                "back, or reset",
            ForceStatus.RETURNING: "in equilibrium at this pose: force and stiffness increase along a ramp",
            ForceStatus.FAILED: "the step failed, and the tissue was made again: no force; see the log of the server",
        }[self]


@dataclass(frozen=True, slots=True)
class PredictedForceOfNextStep:
    """Predicted force of the next step of a tissue with mass: wrench - stiffness m after a motion m of the tool.

    The next step is assumed to be as long as this one.

    Attributes:
        wrench: for a tool at rest, N and N m; it contains the impact of the moving tissue.
        stiffness_matrix: minus its derivative with respect to a motion of the tool in that step; see `ToolForce`.
    """

    wrench: Screw
    stiffness_matrix: Matrix

    def multiply_wrench_and_stiffness(self, share: float) -> PredictedForceOfNextStep:
        """Return the prediction with wrench and stiffness multiplied by a number."""
        return PredictedForceOfNextStep(scale_screw(share, self.wrench), scale_matrix(share, self.stiffness_matrix))


@with_old_names(axial="from_axial_force")
@dataclass(frozen=True, slots=True)
class ToolForce:
    """Force on the tool after a step, with its status, stiffness and error estimate.

    Attributes:
        wrench: force, then torque about the tool's deepest point, on the tool, in the frame of the scene, N and N m.
        stiffness_matrix: static stiffness of the tissue: minus the derivative of the wrench with respect to (position,
            rotation vector), 6 x 6, N/m, N, N m, without the mass of the tissue. The diagonal is positive for a tissue
            that resists. In inertial steps it may belong to an earlier step, if no time was left for it.
        status: reliability of force and stiffness.
        iterations: number of linear solves of this step.
        residual: relative residual of the last Newton iteration, 1.
        compute_time: wall time of the step, s.
        inertial: whether the mass of the tissue acted.
        age: time since the last equilibrium, s; 0 if this is one.
        pose: pose of the tool at the last equilibrium.
        ahead: prediction for the next step, for programs that choose the next pose by the force, such as a virtual
            coupling; None: use this wrench with the stiffness within the step.
        step_stiffness_matrix: the same derivative for a motion within this step; it contains the inertia m/dt2 of
            tissue that moves with the tool. None: no other than `stiffness_matrix`.
        stiffness_age: time since `stiffness_matrix` was evaluated, s; 0 if it belongs to this equilibrium.
        force_error: estimated error of the force, N; None if the error is unknown.
        error_age: time since `force_error` was estimated, s.
        is_on_axis: whether the tool is on the axis of an axisymmetric scene and parallel to it, as the force assumes;
            True in three-dimensional scenes.
        least_tool_mass: smallest mass, kg, of a tool that an explicit coupling (pose in, force out) keeps stable at
            this step length; 0 if any mass is stable.
        time_since_touch: time between a touch in this step and the end of the step, s; `ahead` and the stiffness
            within the step belong to this time. None if the tool did not touch in this step, or if the tissue does not
            state it.
    """

    wrench: Screw
    stiffness_matrix: Matrix
    status: ForceStatus
    iterations: int = 0
    residual: float = 0.0
    compute_time: float = 0.0
    inertial: bool = False
    age: float = 0.0
    pose: Pose = _AT_THE_TOUCH
    ahead: PredictedForceOfNextStep | None = None
    step_stiffness_matrix: Matrix | None = None
    stiffness_age: float = 0.0
    force_error: float | None = None
    error_age: float = 0.0
    is_on_axis: bool = True
    least_tool_mass: float = 0.0
    time_since_touch: float | None = None

    @classmethod
    def from_axial_force(cls, force: float, stiffness: float, status: ForceStatus, iterations: int = 0,
                         residual: float = 0.0,
                         compute_time: float = 0.0, inertial: bool = False, age: float = 0.0,
                         depth: float = 0.0) -> ToolForce:
        """Make the result of a scene of axial motion only.

        Args:
            force: axial force, N.
            stiffness: axial stiffness, N/m.
            status: see `ToolForce`.
            iterations: see `ToolForce`.
            residual: see `ToolForce`.
            compute_time: s.
            inertial: whether the mass of the tissue acts.
            age: time since the last equilibrium, s.
            depth: depth of the tool at the last equilibrium, m.
        """
        return cls(make_axial_wrench(force), make_axial_stiffness_matrix(stiffness), status, iterations, residual,
                   compute_time,
                   inertial, age, Pose.at_depth(depth))

    @property
    def force(self) -> float:
        """Force on the tool along z, N, positive if the tissue pushes the tool out."""
        return self.wrench[2]

    @property
    def stiffness(self) -> float:
        """Derivative of the static force along z with respect to depth, N/m."""
        return self.stiffness_matrix[2][2]

    within_step = OldName("stiffness_matrix_within_step")
    scaled = OldName("multiply_force_and_set_status")

    @property
    def stiffness_matrix_within_step(self) -> Matrix:
        """Stiffness for a motion within this step, with the mass of the tissue if it acted."""
        return self.stiffness_matrix if self.step_stiffness_matrix is None else self.step_stiffness_matrix

    @property
    def step_stiffness(self) -> float:
        """Derivative of the force along z with respect to depth within this step, N/m."""
        return self.stiffness_matrix_within_step[2][2]

    @property
    def depth(self) -> float:
        """Tool displacement of the last equilibrium, m."""
        return self.pose.depth

    @property
    def force_vector(self) -> Vector:
        """Force on the tool, N."""
        return self.wrench[:3]

    @property
    def torque_vector(self) -> Vector:
        """Torque on the tool about its deepest point, N m."""
        return self.wrench[3:]

    def multiply_force_and_set_status(self, share: float, status: ForceStatus) -> ToolForce:
        """Return the result with force, torque and all stiffnesses multiplied by a number, and with another status."""
        ahead, within = self.ahead, self.step_stiffness_matrix
        return replace(
            self, wrench=scale_screw(share, self.wrench), stiffness_matrix=scale_matrix(share, self.stiffness_matrix),
            status=status, ahead=None if ahead is None else ahead.multiply_wrench_and_stiffness(share),
            step_stiffness_matrix=None if within is None else scale_matrix(share, within))

    @property
    def is_finite(self) -> bool:
        """Whether wrench and stiffness are finite."""
        total = sum(self.wrench)
        rows: tuple[Screw, ...] = self.stiffness_matrix
        if self.step_stiffness_matrix is not None:
            rows += self.step_stiffness_matrix
        if self.ahead is not None:
            total += sum(self.ahead.wrench)
            rows += self.ahead.stiffness_matrix
        for row in rows:
            if row is not _NONE:
                total += sum(row)
        return math.isfinite(total)


class TouchState:
    """Whether the tool has touched the tissue since the last reset.

    The tool touches in the first step in which its height is zero or negative. Until then the tissue is at rest, no
    step solves anything, and every force is zero, also that of a bonded tool. A tool that has touched counts as
    having touched until the next reset, even after lift-off.

    Attributes:
        has_touched: whether the tool has touched.
        height: height of the tool in the last step, m; None before the first step. The first step has no past: the
            motion up to its pose is not known, so that it must not count as a speed.
    """

    __slots__ = ("has_touched", "height")

    def __init__(self, has_touched: bool = False, height: float | None = None):
        self.has_touched, self.height = has_touched, height

    def register_height_and_get_contact_duration(self, height: float, dt: float) -> float | None:
        """Register the height of the tool in a step, and update whether the tool has touched the tissue.

        Args:
            height: distance that the tool must go down until it touches the undeformed tissue, m; negative if the tool
                is inside. Over a flat top this is z of an upright tool's pose.
            dt: length of the step, s.

        Returns:
            Time of the step after the first touch, s, at constant speed; None if the tool has not touched yet.
        """
        before, self.height = self.height, height
        if self.has_touched:
            return dt
        if height > 0.0:
            return None
        self.has_touched = True
        return dt if before is None or before <= 0.0 else dt * height / (height - before)

    def copy(self) -> TouchState:
        """Return an independent copy, for saved states."""
        return TouchState(self.has_touched, self.height)


class Tissue(Protocol):
    """Contract of the tissue that a loop or a server steps: a `Simulator`, a `MultiRateTissue`, or one of a plug-in.

    Before the first touch after a reset, every force must be zero, and poses in the air must have no influence on later
    forces (`TouchState`). Other members are optional:

    - ``has_touched``: bool, whether the tool has touched since the last reset; read it with `has_touched`.
    - ``reset()``: return to the undeformed tissue that has not been touched.
    - ``prepare()``: a loop calls it between two ticks, after the force has been sent.
    - ``warm_up()``: compile kernels, or start processes.
    - ``save()``, ``restore(state)``, ``clone()``: for planners.
    - ``domain``: str, poses for which the tissue has a force.
    - ``looks_ahead``: bool, whether answers contain `ToolForce.ahead`; `ToolCoupling` sets it.
    - ``budget``, ``waits``: wall time of a step, and whether a step waits for its bulk; see `ToolCoupling`.
    """

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """Force on the tool at a pose, or at a depth in m, dt s after the last step."""


def has_touched(tissue: Tissue) -> bool:
    """Whether the tool has touched the tissue since the last reset; True for a tissue that does not state it."""
    return bool(getattr(tissue, "has_touched", True))


def get_depth_of_pose_or_number(pose: float | Pose) -> float:
    """Return the depth of a pose, m; a number is a depth and is returned unchanged."""
    return pose.depth if isinstance(pose, Pose) else float(pose)


def convert_depth_or_pose_to_pose(pose: float | Pose) -> Pose:
    """Return a pose unchanged, or the pose of an upright tool at a depth, m."""
    return pose if isinstance(pose, Pose) else Pose.at_depth(float(pose))
