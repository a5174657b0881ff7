"""Couple a rigid body of a physics engine with a tissue: motion of the body in, wrench on the body out.

The adapters in `tissue_sim.realtime.engines` read the motion from an engine and write the wrench to it. Everything that
does not depend on the engine is here: frames, first touch, time steps, implicit coupling of light tools, statuses,
limits, saved states.
"""

from __future__ import annotations

import contextlib
import copy
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Vector, interpolate_pose, invert_pose, multiply_poses
from tissue_sim.realtime.force_fading import ForceFader
from tissue_sim.realtime.tissue import FORCE_BEFORE_FIRST_STEP
from tissue_sim.tool_force import ForceStatus, Tissue, ToolForce, limit_force_of_wrench

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class CouplingLimits:
    """Limits of a coupling.

    Attributes:
        largest_force: largest force on the body, N; force and torque are scaled together.
        longest_step: longest step of the tissue, s. A longer step of the engine is divided, with interpolated poses.
        most_parts: largest number of parts of a step of the engine. A step longer than `most_parts` times
            `longest_step` is divided into `most_parts` parts, each longer than `longest_step`.
        largest_tilt: largest angle, rad, between the axis of the tool and the outward normal of the tissue in the first
            step, at most pi. A larger angle raises an error, because the z axis of the tool frame then has the wrong
            direction.

    Raises:
        InputError: a limit that is not positive, a tilt above pi, or a number of parts that is not an integer.
    """

    largest_force: float = 100.0
    longest_step: float = 2e-3
    most_parts: int = 50
    largest_tilt: float = 0.5 * math.pi

    def __post_init__(self):
        for name in ("largest_force", "longest_step", "most_parts", "largest_tilt"):
            if not getattr(self, name) > 0:
                raise InputError(f"must be positive; got {getattr(self, name):g}.", field=name)
        if self.largest_tilt > math.pi:
            raise InputError(f"must be at most pi; got {self.largest_tilt:g}.", field="largest_tilt")
        if not isinstance(self.most_parts, int):
            raise InputError(f"must be an integer; got {self.most_parts!r}.", field="most_parts")


class TissueFailureWarning(UserWarning):
    """A step of a tissue raised an error; the coupling applies no force until it is reset."""


class OutsideDomainWarning(UserWarning):
    """The tissue has no force at the pose of the tool; the force fades to zero."""


@dataclass(frozen=True, slots=True)
class RigidBodyState:
    """Motion of the rigid body that carries the tool, in the world frame of the engine.

    Attributes:
        position: origin of the frame of the body, m.
        orientation: quaternion (w, x, y, z) of the frame of the body; any length except zero.
        center_of_mass: position of the centre of mass, m.
        velocity: velocity of the centre of mass, m/s.
        angular_velocity: rad/s, components along the axes of the world.
        next_velocity: velocity of the centre of mass, m/s, at the end of the next step of the engine if the wrench of
            the last step acts again; None: it is extrapolated from the last steps.
        next_angular_velocity: angular velocity at that time, rad/s; given together with `next_velocity`.
        mobility: derivative of these two velocities with respect to the impulse of a force at the centre of mass and of
            a torque, components along the axes of the world, shape (6, 6); None: that of the free body.
    """

    position: Sequence[float]
    orientation: Sequence[float]
    center_of_mass: Sequence[float]
    velocity: Sequence[float]
    angular_velocity: Sequence[float]
    next_velocity: Sequence[float] | None = None
    next_angular_velocity: Sequence[float] | None = None
    mobility: Any = None


@dataclass(frozen=True, slots=True)
class BodyWrench:
    """Wrench of the tissue on the body, and the answer of the tissue.

    Attributes:
        force: N, components along the axes of the world.
        torque: torque about the centre of mass of the body, N m, components along the axes of the world.
        torque_about_tip: torque about the deepest point of the tool, N m, components along the axes of the world.
        status: status of the force after fading.
        answer: answer of the tissue at the pose of the tool, in the frame of the scene.
        pose: pose of the tool in the frame of the scene; None if the pose of the body is not finite.
        is_limited: whether the force was reduced to `CouplingLimits.largest_force`.
    """

    force: Vector
    torque: Vector
    torque_about_tip: Vector
    status: ForceStatus
    answer: ToolForce
    pose: Pose | None
    is_limited: bool

    @property
    def force_error(self) -> float | None:
        """Estimated error of the force of the tissue, N; None if the error is unknown."""
        return self.answer.force_error


@dataclass(frozen=True)
class CouplingState:
    """State of a `ToolCoupling` between two steps; see `ToolCoupling.save`.

    Attributes:
        tissue: state of the tissue.
        time: simulated time of the last step, s; None before the first step.
        pose: last pose of the tool that was finite, in the scene; None before it.
        lever: vector from the centre of mass to the tip at this pose, m, shape (3,).
        twist: velocity of the tip, m/s, and angular velocity, rad/s, in the scene, shape (6,); None if unknown.
        wrench: wrench at the tip in the last step, N and N m, in the scene, shape (6,).
        acceleration: acceleration of the tip by all other forces, m/s2 and rad/s2, shape (6,); None if unknown.
        answer: last answer of the tissue, before fading; None before the first step.
        wrench_on_body: result of the last step.
        fader: state of the fading.
        failure: error of the tissue.
        has_warned: whether an `OutsideDomainWarning` was issued.
    """

    tissue: Any
    time: float | None
    pose: Pose | None
    lever: _Array
    twist: _Array | None
    wrench: _Array
    acceleration: _Array | None
    answer: ToolForce | None
    wrench_on_body: BodyWrench | None
    fader: ForceFader
    failure: Exception | None
    has_warned: bool


class ToolCoupling:
    """Force of a tissue on a tool that is fixed to a rigid body of a physics engine.

    **Frames.** The scene has its origin at the centre of the undeformed top of the tissue, with z out of the tissue.
    `scene` is its pose in the world. `tip` is the pose of the tool in the frame of the body: its position is the
    deepest point of the tool, and its z axis points from the tip to the handle.

    **Scheme.** Let `F(x)` be the wrench of the tissue at the tool, `k` its stiffness, `dt` the step of the engine, `V`
    the twist of the tool, and `A` the mobility of the body at the tip: twist = A times impulse. The engine applies one
    wrench `f` during a step. `f` is the mean of the wrenches at the start and at the end of
    the step, linearised at the start, so that the work on the tool along a closed path in an elastic tissue vanishes
    to second order in the step:

        f = F - C dt V_next,    C = k / 2
        V_next = V* + dt A f,   which gives   (1 + dt^2 C A) f = F - dt C V*

    `V*` is the twist at the end of the step without the tissue. If the engine computes the twist `V_again` with the
    last wrench (`RigidBodyState.next_velocity`), `V* = V_again - dt A f_before`. Otherwise it is extrapolated from the
    acceleration by all other forces in the last two steps, `a = (V - V_before) / dt - A f_before`:

        V* = V + dt (a + beta (a - a_before)),    beta = min(1, 1 / q),    q = trace(dt^2 C A)

    In equilibrium `f = F` for any `A`. With `beta = 1` the force has no lag. For light tools, large `q`, linear
    extrapolation is unstable, and the force lags by up to `q` steps.

    The mass of the tissue acts implicitly: `F` is the predicted wrench of the next step (`ToolForce.ahead`), and
    `C = S - k / 2` with its stiffness `S`. In a step in which the tool touches, the force of the moving tissue acts for
    the fraction `r` of the step after the touch; then `F` is `r` times the wrench of this step, so that the impulse is
    that of the tissue, and `C = k / 2 + r^2 (S - k)`. The explicit coupling `f = F` is unstable if the moving tissue
    has more than a quarter of the mass of the tool (`ToolForce.least_tool_mass`).

    A body in a mechanism or on a servo is less mobile than the free body (Gauss's principle of least constraint), so
    that `A` is an upper bound if the engine does not compute it (`RigidBodyState.mobility`).

    **First step.** In the first step, and in the first after `reset`, no earlier pose is known: the tissue is stepped
    with dt = 0. A tool that starts inside the tissue is at rest there.

    **Statuses.** Forces without equilibrium are extrapolated for 50 ms, then fade to zero (`ForceFader`). A pose that
    is not finite or outside of the limits, and a tool outside the domain of the tissue, gives REFUSED or STOPPED and
    fades in the same way. An error inside the tissue gives FAILED, one `TissueFailureWarning`, and zero force until
    `reset`.

    Args:
        tissue: a `Simulator`, a `MultiRateTissue` or any `Tissue`. Its attribute ``looks_ahead`` is set, if it has one.
        scene: pose of the scene in the world.
        tip: pose of the tool in the frame of the body.
        mass: mass of the body, kg; None: the motion of the body is prescribed, and the wrench is that at the present
            pose.
        inertia: moments of inertia about the centre of mass, shape (3, 3), frame of the body, kg m2.
        limits: see `CouplingLimits`.
        real_time: whether the engine keeps up with the wall clock. If it does not, the tissue must not have a budget
            of wall time, and a multirate tissue must wait for its bulk.

    Attributes:
        last: wrench of the last step; None before the first step.
        failure: error of the tissue since the last reset; None: no error.

    Raises:
        InputError: a tissue that depends on the wall clock without `real_time`, a mass or inertia that is not positive.
    """

    def __init__(self, tissue: Tissue, *, scene: Pose | None = None, tip: Pose | None = None,
                 mass: float | None = None, inertia: Any = None, limits: CouplingLimits | None = None,
                 real_time: bool = False):
        _require_independence_of_wall_clock(tissue, real_time)
        self.tissue, self.limits, self.real_time = tissue, limits or CouplingLimits(), real_time
        self.scene, self.tip = scene or Pose((0.0, 0.0, 0.0)), tip or Pose((0.0, 0.0, 0.0))
        self.mass, self.inertia = _convert_mass_and_inertia(mass, inertia)
        self._inverse_inertia = np.zeros((3, 3)) if self.inertia is None else np.linalg.inv(self.inertia)
        with contextlib.suppress(AttributeError):  # a plug-in may have a read-only attribute
            if hasattr(tissue, "looks_ahead"):
                tissue.looks_ahead = True
        self._rotation = np.array(self.scene.rotation_matrix)
        self._clear()

    def _clear(self) -> None:
        """Forget the motion of the tool."""
        self.last: BodyWrench | None = None
        self.failure: Exception | None = None
        self._time: float | None = None
        self._pose: Pose | None = None
        self._answer: ToolForce | None = None
        self._lever, self._wrench = np.zeros(3), np.zeros(6)
        self._twist: _Array | None = None
        self._acceleration: _Array | None = None
        self._fader = ForceFader(largest_first_force=math.inf)
        self._has_warned = False

    @property
    def domain(self) -> str:
        """Poses for which the tissue has a force, and its stated error, as one sentence each."""
        return getattr(self.tissue, "domain", "The tissue does not state its domain.")

    def warm_up(self) -> None:
        """Compile the kernels of the tissue, or start its process; this takes seconds, before the first step."""
        warm_up = getattr(self.tissue, "warm_up", None)
        if warm_up is not None:
            warm_up()

    def compute_wrench(self, body: RigidBodyState, time: float) -> BodyWrench:
        """Compute the wrench that the engine applies in its next step.

        Args:
            body: motion of the body now.
            time: simulated time, s. A time before that of the last call restarts as `reset` does. At the same time the
                last wrench is returned.

        Raises:
            InputError: the tool frame has the wrong direction in the first step, the time is not finite, or the time
                goes back and the tissue has no method ``reset``.
        """
        if not math.isfinite(time):
            raise InputError(f"must be finite; got {time} s.", field="time")
        if self._time is not None and self.last is not None:
            if time == self._time:
                return self.last
            if time < self._time:
                self.reset()
        dt = 0.0 if self._time is None else time - self._time
        pose = self._convert_to_scene(body)
        if self._time is None and pose is not None:
            self._require_outward_tool_axis(pose)
        answer, parts = self._step_tissue(pose, dt)
        self._answer = answer
        answer = self._fader.step(answer, time)
        lever, twist = self._compute_lever_and_twist(body, pose)
        wrench = self._compute_implicit_wrench(answer, twist, body, lever, dt, parts)
        requested = tuple(wrench.tolist())
        limited = limit_force_of_wrench(requested, self.limits.largest_force)
        is_limited, wrench = limited is not requested, np.array(limited)
        self._time, self._pose, self._lever = time, pose or self._pose, lever
        self._twist, self._wrench = twist, wrench
        about_center = wrench[3:] + _make_cross_matrix(lever) @ wrench[:3]
        force, torque, about_tip = (np.array([wrench[:3], about_center, wrench[3:]]) @ self._rotation.T).tolist()
        self.last = BodyWrench(tuple(force), tuple(torque), tuple(about_tip), answer.status, answer, pose, is_limited)
        return self.last

    def _convert_to_scene(self, body: RigidBodyState) -> Pose | None:
        """Return the pose of the tool in the scene; None if a number is not finite or the quaternion is zero."""
        size = math.hypot(*body.orientation)
        if not (math.isfinite(size) and size > 0.0
                and all(map(math.isfinite, (*body.position, *body.center_of_mass)))):
            return None
        return multiply_poses(invert_pose(self.scene), multiply_poses(_make_body_pose(body), self.tip))

    def _require_outward_tool_axis(self, pose: Pose) -> None:
        """Check the direction of the tool frame in the first step.

        Raises:
            InputError: the z axis of the tool points into the tissue.
        """
        cosine, most = pose.rotation_matrix[2][2], self.limits.largest_tilt
        if cosine < math.cos(most):
            angle = math.degrees(math.acos(max(-1.0, cosine)))
            raise InputError("must have its z axis from the tip to the handle, within "
                             f"{math.degrees(most):.0f} degrees of the outward normal of the tissue; got {angle:.0f} "
                             "degrees. Rotate the tip frame, or the frame of the scene, whose z axis points out of the "
                             "tissue.", field="tip")

    def _step_tissue(self, pose: Pose | None, dt: float) -> tuple[ToolForce, int]:
        """Step the tissue to a pose; return its answer and the number of parts of the step."""
        last = FORCE_BEFORE_FIRST_STEP if self._answer is None else self._answer
        if self.failure is not None:
            return replace(FORCE_BEFORE_FIRST_STEP, status=ForceStatus.FAILED), 1
        if pose is None:
            return replace(last, status=ForceStatus.REFUSED), 1
        limits = self.limits
        parts = min(max(1, math.ceil(dt / limits.longest_step - 1e-9)), limits.most_parts)
        before = self._pose or pose
        try:
            for part in range(1, parts + 1):
                target = pose if part == parts else interpolate_pose(before, pose, part / parts)
                answer = self.tissue.step(target, dt / parts)
            if not answer.is_finite:
                raise ArithmeticError("wrench or stiffness is not finite")
        except Exception as error:  # an error of any plug-in must not stop the engine
            self.failure = error
            warnings.warn(TissueFailureWarning(f"The tissue raised {type(error).__name__}: {error}. The coupling "
                                               "applies no force; call reset()."), stacklevel=3)
            return replace(FORCE_BEFORE_FIRST_STEP, status=ForceStatus.FAILED), 1
        if not answer.is_on_axis and any(answer.wrench):
            answer = replace(answer, status=ForceStatus.REFUSED)
        if answer.status in (ForceStatus.REFUSED, ForceStatus.STOPPED) and not self._has_warned:
            self._has_warned = True
            reason = (answer.status.message if answer.is_on_axis else
                      'the tool is off the axis of an axisymmetric tissue. Use Simulator(..., solver="solid"), a '
                      "reduced solid or a multirate tissue")
            x, y, z = (1e3 * part for part in pose.position)
            warnings.warn(OutsideDomainWarning(
                f"The tissue has no force at ({x:.4g}, {y:.4g}, {z:.4g}) mm: {reason}. The force fades to zero. "
                f"{self.domain}"), stacklevel=3)
        return answer, parts

    def _compute_lever_and_twist(self, body: RigidBodyState, pose: Pose | None) -> tuple[_Array, _Array | None]:
        """Return the vector from centre of mass to tip, m, and the twist of the tip, m/s and rad/s, in the scene.

        Without a pose the lever is that of the last pose. The twist is None if it is not finite.
        """
        to_scene = self._rotation.T
        if pose is None:
            return self._lever, None
        center = to_scene @ (np.array(body.center_of_mass, float) - np.array(self.scene.position))
        lever = np.array(pose.position) - center
        return lever, self._compute_twist_or_none(body.velocity, body.angular_velocity, lever)

    def _compute_twist_or_none(self, velocity: Sequence[float] | None, angular_velocity: Sequence[float] | None,
                               lever: _Array) -> _Array | None:
        """Return the twist of the tip in the scene from velocities in the world; None if unknown or not finite.

        Args:
            velocity: of the centre of mass, m/s; None: unknown.
            angular_velocity: rad/s; None: unknown.
            lever: vector from the centre of mass to the tip, m.
        """
        if velocity is None or angular_velocity is None:
            return None
        to_scene = self._rotation.T
        spin = to_scene @ np.array(angular_velocity, float)
        twist = np.concatenate([to_scene @ np.array(velocity, float) - _make_cross_matrix(lever) @ spin, spin])
        return twist if np.isfinite(twist).all() else None

    def _compute_implicit_wrench(self, answer: ToolForce, twist: _Array | None, body: RigidBodyState, lever: _Array,
                                 dt: float, parts: int) -> _Array:
        """Return the wrench at the tip during the next step, in the scene; see the class for the scheme.

        Args:
            answer: answer of the tissue after fading.
            twist: velocity of the tip and angular velocity; None if unknown.
            body: motion of the body.
            lever: vector from the centre of mass to the tip, m.
            dt: length of the step, s.
            parts: number of parts into which the step of the tissue was divided.
        """
        wrench, static = np.array(answer.wrench), np.array(answer.stiffness_matrix)
        reacts = dt > 0.0 and self.mass is not None
        if twist is None or not reacts or answer.status in (ForceStatus.REFUSED, ForceStatus.FAILED):
            self._acceleration = None
            return wrench
        fraction, step_stiffness = 1.0 / parts, answer.stiffness_matrix_within_step
        if answer.time_since_touch is not None and answer.inertial:
            fraction = answer.time_since_touch / dt
            wrench = wrench * fraction
        elif answer.ahead is not None and parts == 1:
            wrench, step_stiffness = np.array(answer.ahead.wrench), answer.ahead.stiffness_matrix
        implicit_stiffness = 0.5 * static
        if answer.step_stiffness_matrix is not None:
            # (S - k) times the square of its step is proportional to the moving mass, whatever the step.
            implicit_stiffness = implicit_stiffness + fraction**2 * (np.array(step_stiffness) - static)
        implicit_stiffness = _project_to_positive_semidefinite(implicit_stiffness)
        mobility = self._compute_mobility(body, lever)
        product = dt * dt * implicit_stiffness @ mobility
        again = self._compute_twist_or_none(body.next_velocity, body.next_angular_velocity, lever)
        free_twist = (self._extrapolate_free_twist(twist, mobility, float(np.trace(product)), dt) if again is None else
                      again - dt * mobility @ self._wrench)
        return np.asarray(np.linalg.solve(np.eye(6) + product, wrench - dt * implicit_stiffness @ free_twist),
                          np.float64)

    def _extrapolate_free_twist(self, twist: _Array, mobility: _Array, added_mass: float, dt: float) -> _Array:
        """Return the twist at the end of the next step without the tissue, extrapolated from the last two steps.

        Args:
            twist: present twist.
            mobility: of the body at the tip.
            added_mass: `q` of the class.
            dt: length of the step, s.
        """
        # If the last twist is unknown, the body is assumed to keep its velocity.
        acceleration = (0.0 if self._twist is None else (twist - self._twist) / dt) - mobility @ self._wrench
        change = acceleration - (acceleration if self._acceleration is None else self._acceleration)
        self._acceleration = acceleration
        return np.asarray(twist + dt * (acceleration + min(1.0, 1.0 / max(added_mass, 1e-12)) * change), np.float64)

    def _compute_mobility(self, body: RigidBodyState, lever: _Array) -> _Array:
        """Return the mobility of the body at the tip, shape (6, 6): twist over impulse, in the scene.

        It is that of the free body if the engine states none, or one that is not finite.

        Raises:
            InputError: the mobility of the engine has another shape.
        """
        assert self.mass is not None
        if body.mobility is not None and np.shape(body.mobility) != (6, 6):
            raise InputError(f"must have the shape (6, 6); got {np.shape(body.mobility)}. State the derivative of "
                             "velocity and angular velocity with respect to the impulse of force and torque.",
                             field="mobility")
        mobility, to_tip = np.zeros((6, 6)), np.eye(6)
        to_tip[:3, 3:] = -_make_cross_matrix(lever)  # angular velocity x lever
        if body.mobility is not None and np.isfinite(body.mobility).all():
            turn = np.kron(np.eye(2), self._rotation)
            mobility[:] = turn.T @ np.asarray(body.mobility, float) @ turn
        else:
            mobility[:3, :3] = np.eye(3) / self.mass
            if self.inertia is not None:
                rotation = self._rotation.T @ np.array(_make_body_pose(body).rotation_matrix)
                mobility[3:, 3:] = rotation @ self._inverse_inertia @ rotation.T
        return to_tip @ mobility @ to_tip.T

    def reset(self) -> None:
        """Return to the untouched tissue; call it when the engine is reset. The next step is a first step."""
        self._get_tissue_method("reset")()
        self._clear()

    def _get_tissue_method(self, name: str) -> Callable[..., Any]:
        """Return a method of the tissue.

        Raises:
            InputError: the tissue does not have this method, as a multirate tissue has no `save`.
        """
        method: Callable[..., Any] | None = getattr(self.tissue, name, None)
        if method is None:
            raise InputError(f"must have the method {name}(); a {type(self.tissue).__name__} does not. Use a "
                             "Simulator.", field="tissue")
        return method

    def save(self) -> CouplingState:
        """Return the state of tissue and coupling, for planners.

        Raises:
            InputError: the tissue cannot save its state, as a multirate tissue.
        """
        return self._make_state(self._get_tissue_method("save")())

    def _make_state(self, tissue: Any) -> CouplingState:
        """Make the state of the coupling with a state of the tissue."""
        return CouplingState(tissue, self._time, self._pose, self._lever, self._twist, self._wrench, self._acceleration,
                             self._answer, self.last, copy.deepcopy(self._fader), self.failure, self._has_warned)

    def restore(self, state: CouplingState) -> None:
        """Restore a saved state.

        Raises:
            InputError: a state of another tissue; nothing is changed.
        """
        if not isinstance(state, CouplingState):
            raise InputError(f"must be a state that save() returned; got {type(state).__name__}.", field="state")
        self._get_tissue_method("restore")(state.tissue)
        self._restore_motion(state)

    def _restore_motion(self, state: CouplingState) -> None:
        """Restore the state of the coupling without that of the tissue."""
        self._time, self._pose, self._lever, self._twist = state.time, state.pose, state.lever, state.twist
        self._wrench, self._acceleration, self._answer = state.wrench, state.acceleration, state.answer
        self.last, self.failure, self._has_warned = state.wrench_on_body, state.failure, state.has_warned
        self._fader = copy.deepcopy(state.fader)

    def clone(self) -> ToolCoupling:
        """Return an independent coupling with a clone of the tissue at the same state.

        Raises:
            CopyError: a multirate tissue.
            InputError: the tissue has no method ``clone``.
        """
        other = ToolCoupling(self._get_tissue_method("clone")(), scene=self.scene, tip=self.tip, mass=self.mass,
                             inertia=self.inertia, limits=self.limits, real_time=self.real_time)
        other._restore_motion(self._make_state(None))
        return other


def _require_independence_of_wall_clock(tissue: Any, real_time: bool) -> None:
    """Check that the forces of a tissue do not depend on the speed of the computer, unless the engine is in real time.

    Raises:
        InputError: a budget of wall time, or a multirate tissue that does not wait for its bulk.
    """
    if real_time:
        return
    if getattr(tissue, "budget", None) is not None:
        raise InputError("must have budget=None unless real_time=True, because a budget makes forces depend on the "
                         "speed of the computer.", field="tissue")
    if getattr(tissue, "waits", True) is False:
        raise InputError("must have waits=True unless real_time=True, because forces without waiting depend on the "
                         "speed of the computer. Make MultiRateTissue(..., waits=True).", field="tissue")


def _convert_mass_and_inertia(mass: float | None, inertia: Any) -> tuple[float | None, _Array | None]:
    """Check mass and inertia; the inertia becomes a matrix.

    Raises:
        InputError: not positive, not finite, or inertia without mass.
    """
    if mass is None:
        if inertia is not None:
            raise InputError("must be given with the inertia; got None.", field="mass")
        return None, None
    if not 0.0 < mass < math.inf:
        raise InputError(f"must be positive and finite, or None for a body with prescribed motion; got {mass:g} kg.",
                         field="mass")
    if inertia is None:
        return float(mass), None
    matrix = np.array(inertia, float)
    if matrix.shape == (3,):
        matrix = np.diag(matrix)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.linalg.eigvalsh(matrix).min() > 0.0:
        raise InputError(f"must be a positive definite matrix of shape (3, 3), or three moments; got {inertia!r}.",
                         field="inertia")
    return float(mass), matrix


def _project_to_positive_semidefinite(matrix: _Array) -> _Array:
    """Return the symmetric part of a stiffness without its negative eigenvalues, which would destabilise the step.

    Rotations are scaled to lengths by the ratio of the largest entries, so that units have no influence.

    Args:
        matrix: shape (6, 6), translations, then rotations.
    """
    symmetric = 0.5 * (matrix + matrix.T)
    linear, angular = symmetric[:3, :3].diagonal().max(), symmetric[3:, 3:].diagonal().max()
    length = math.sqrt(angular / linear) if linear > 0.0 and angular > 0.0 else 1.0
    scale = np.array([1.0] * 3 + [1.0 / length] * 3)
    values, vectors = np.linalg.eigh(symmetric * np.outer(scale, scale))
    projected: _Array = (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(scale, scale)
    return projected


def _make_cross_matrix(vector: _Array) -> _Array:
    """Return the matrix of a cross product: ``_make_cross_matrix(a) @ b`` is a x b."""
    a, b, c = vector.tolist()
    return np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])


def _make_body_pose(body: RigidBodyState) -> Pose:
    """Return the pose of the frame of a body in the world, with a quaternion of length 1."""
    x, y, z = map(float, body.position)
    size = math.hypot(*body.orientation)
    w, a, b, c = (float(part) / size for part in body.orientation)
    return Pose((x, y, z), (w, a, b, c))
