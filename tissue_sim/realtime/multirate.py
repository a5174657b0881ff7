"""Multirate simulation: contact in each tick of the loop, on a bulk that is linearised at a lower rate.

`BulkLink` is the link to the slower solver of the bulk, which may run in another process.
"""

from __future__ import annotations

import math
import time as clock
from collections import deque
from dataclasses import dataclass, replace
from typing import Any, NoReturn, Protocol

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import CondensedBulk, ContactState, ContactSurface
from tissue_sim.fem.condensed.stepper import CondensedStepper, ContactStepResult
from tissue_sim.fem.taichi.launch import CopyError, make_single_thread_method
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.pose import (
    Pose,
    add_screws,
    compute_pose_distance,
    compute_rigid_motion,
    interpolate_pose,
    rotate_pose_about_its_position,
    scale_screw,
)
from tissue_sim.realtime.model_transition import ModelTransition
from tissue_sim.realtime.tissue import FORCE_BEFORE_FIRST_STEP, MotionLimits, RealTimeTissue, require_moduli_in_range
from tissue_sim.snapshot import Snapshot
from tissue_sim.tool_force import (
    ForceStatus,
    ToolForce,
    TouchState,
    is_force_error_acceptable_or_unknown,
    scale_matrix,
)


class BulkLink(Protocol):
    """Source of linearised models of the bulk. Call `close` at the end."""

    @property
    def contact_surface(self) -> ContactSurface:
        """Contact nodes and tool of the bulk; available after `start`."""

    @property
    def is_alive(self) -> bool:
        """Whether the bulk, or its process, still runs and can send models."""

    def start(self) -> CondensedBulk:
        """Start the bulk, wait until it is ready, and return its model of the undeformed tissue.

        Raises:
            InputError: the solver does not support the model.
            RuntimeError: the process of the bulk ended.
        """

    def send_state(self, state: ContactState) -> None:
        """Send the state of the contact, at which the bulk is linearised next, without waiting for the model."""

    def receive_model(self, now: float) -> CondensedBulk | None:
        """Return a model that has arrived since the last call, or None; does not wait. `now` is the loop's time, s."""

    def send_state_and_wait_for_model(self, state: ContactState) -> CondensedBulk | None:
        """Send a state and block until the next model arrives, which may belong to an earlier state.

        Returns:
            The model; None if none arrives within `BulkCommunicationSettings.longest_exchange` or the bulk has ended.
        """

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk; models of the new material have this `number` in their field `material`."""

    def snapshot(self) -> Snapshot | None:
        """Return a snapshot of the deformed tissue at a recent model; None for a link without snapshots."""

    def close(self) -> None:
        """End the bulk and free its resources."""


def make_untouched_state(surface: ContactSurface) -> ContactState:
    """Return the contact state of undeformed tissue with the tool at its start pose, without contact forces."""
    zeros, count = np.zeros((len(surface.places), 3)), len(surface.places)
    return ContactState(0, 0, 0.0, surface.start, 0.0, surface.start, zeros, zeros, np.zeros((3, count)), False)


@dataclass(frozen=True)
class MultirateSettings:
    """Exchange of states and models between a `MultiRateTissue` and its bulk.

    The last five fields apply to steps that wait for the bulk. All defaults are choices of this project.

    Attributes:
        oldest: largest age of the model of a CONVERGED force, s. A larger age accepts forces of a slower bulk.
        ticks_between_states: ticks between two states sent to the bulk. A larger number costs less time in the ticks;
            models then belong to older states.
        speed_ticks: ticks over which the speed of the tool is measured. A larger number reduces noise and delays the
            speed.
        touch_depths: depths of the touches in `MultiRateTissue.warm_up`, as fractions of the contact radius.
        recent: largest age of a model in a step that waits, s. A larger age saves exchanges and increases the error.
        near: largest distance of a model in a step that waits, as a fraction of `LinearisationErrorEstimator.short`. A
            larger distance saves exchanges and increases the error.
        max_exchanges: maximum number of exchanges of state and model in a step that waits. A step without convergence
            takes more time with a larger number.
        force_tolerance: tolerance on the change of the force in the last exchange, as a fraction of the force. A
            smaller tolerance requires more exchanges.
        force_floor: absolute tolerance on this change, N. A smaller tolerance requires more exchanges.
    """

    oldest: float = 1.0
    ticks_between_states: int = 4
    speed_ticks: int = 8
    touch_depths: tuple[float, ...] = (0.02, 0.04, 0.05)
    recent: float = 0.01
    near: float = 0.25
    max_exchanges: int = 16
    force_tolerance: float = 0.01
    force_floor: float = 1e-4


#: Defaults of every multirate tissue.
MULTIRATE = MultirateSettings()
#: Largest age of the model of a CONVERGED force, s.
OLDEST = MULTIRATE.oldest


class TouchFrame:
    """Map poses in the scene to poses of a bulk whose mesh was made for one pose of first touch.

    A bonded tool adheres to the tissue at the pose of its first touch. The bulk is the same for all positions of the
    touch, because the tissue is assumed to be wide. The motion since the touch is therefore applied to the pose for
    which the bulk was made, and a touch at another position or inclination causes no shear.

    Args:
        start: pose of first touch for which the bulk was made.
        touch: actual pose of first touch.
    """

    def __init__(self, start: Pose, touch: Pose):
        self._start, self._touch = start, touch
        self._is_identity = start == touch

    def pose_in_bulk(self, pose: Pose) -> Pose:
        """Convert a pose in the scene to the frame of the bulk."""
        return pose if self._is_identity else _apply_motion_between_poses(self._touch, pose, self._start)

    def pose_in_scene(self, pose: Pose) -> Pose:
        """Convert a pose in the frame of the bulk to the scene."""
        return pose if self._is_identity else _apply_motion_between_poses(self._start, pose, self._touch)


class MultiRateTissue(RealTimeTissue):
    """`Tissue` of a solid with contact in each tick and a bulk that is linearised at a lower rate.

    The methods `warm_up`, `step`, `reset`, `set_parameters` and `snapshot` are those of a `Simulator`. Each tick solves
    lift-off, touch and friction on the newest linearisation of the bulk. The process of the bulk receives the contact
    forces and returns the next linearisation, a "model". When a model arrives, the wrench continues from its value, and
    the difference is reduced tick by tick (`ModelTransition`).

    The status of a force is `CONVERGED` if all of these conditions hold, otherwise `LATE`:

    - the contact conditions are satisfied, and the model contains all nodes that the tool can touch;
    - the model has the present material and is not older than `oldest`, and the process of the bulk runs;
    - the estimated error (`tissue_sim.realtime.model_transition`) is at most `ERROR_SHARE` of the force, or
      `ERROR_FLOOR`. While the error is unknown, the tool must be within a tenth of the contact radius of the pose of
      the model, or of the pose of the touch if the model describes the undeformed tissue.

    Before the first touch the force is zero. A bonded tool adheres to the tissue from the pose of its first touch.

    Args:
        model: experiment and material.
        link: link to a bulk of the same model; `haptics.loop.multirate.MultiRateTissue` makes one to a process.
        resolution: name of the resolution of the bulk's mesh, for displays.
        oldest: largest age of the model of a CONVERGED force, s.
        waits: whether a step blocks until the bulk has sent a model for the pose of the step. Use it with simulated
            clocks, which run faster than the bulk; a haptic loop refuses such a tissue.
        limits: limits of poses and time steps; see `MotionLimits`.

    Attributes:
        error: estimated error of the force, N; infinite while it is unknown.
        models: number of models received.
        resolution: as in `Simulator`.
        force_error: as in `Simulator`.
        budget: as in `Simulator`.
        mesh: as in `Simulator`.

    Raises:
        InputError: a `Simulator` refuses the model; `warm_up` also raises the errors of the linearisation.
    """

    copy_remedy = "Its bulk runs in another process. Make another MultiRateTissue of the same model."
    force_error: float | None = None
    budget: float | None = None
    mesh: Any = None

    def __init__(self, model: Model, link: BulkLink, *, resolution: str = "realtime", oldest: float = MULTIRATE.oldest,
                 waits: bool = False, limits: MotionLimits | None = None):
        self.require_valid_arguments(model, oldest)
        super().__init__(model, limits)
        self._link, self.resolution, self.oldest, self.waits = link, resolution, oldest, waits
        self._is_warm, self._epoch, self._material, self.models = False, 0, 0, 0
        # Made by `warm_up`: the contact solver, its transition between models, and the model of undeformed tissue.
        self._stepper: CondensedStepper
        self._transition: ModelTransition
        self._first: CondensedBulk
        self._holds = model.experiment.friction == "bonded"
        self._untouched = self._reduced.history
        self._reset_state()

    @staticmethod
    def require_valid_arguments(model: Model, oldest: float) -> None:
        """Check these arguments of the constructor; raises its errors."""
        if not oldest > 0.0:
            raise InputError(f"oldest must be positive; got {oldest:g} s. Use more than the period of the bulk, such "
                             "as 1.", field="oldest")
        require_moduli_in_range(model.material)

    def _reset_state(self) -> None:
        """Set time, error, contact and model times to their values before the first step."""
        self._time, self._ticks, self.error, self._left = 0.0, 0, math.inf, 1.0
        self._answer = FORCE_BEFORE_FIRST_STEP
        self._step: ContactStepResult | None = None
        self._poses: deque[tuple[float, Pose]] = deque(maxlen=MULTIRATE.speed_ticks)
        self._touch = TouchState()
        self._tool_pose: Pose | None = None
        #: Times of the states to which the model and its tangent belong, s.
        self._made = self._tangent_made = 0.0
        self._prepared = False
        #: The previous model, if a new model has arrived since the last step.
        self._known: CondensedBulk | None = None
        #: Whether the force converged in the last exchange of a step that waits.
        self._settled = True

    @make_single_thread_method
    def warm_up(self) -> None:
        """Start the process of the bulk and compile all functions of a tick.

        Raises:
            InputError: the solver of the bulk refuses the model.
            RuntimeError: the process of the bulk has ended.
        """
        if self._is_warm:
            return
        self._first = self._link.start()
        surface = self._link.contact_surface
        self._stepper = CondensedStepper(surface)
        self._stepper.set_linearisation(self._first)
        tool = self.model.experiment.tool
        self._transition = ModelTransition(self._stepper, self.model.material.mu0, tool.radius, tool.contact_radius)
        x, y, z = surface.start.position
        # Touch the tissue once so that all functions of a tick are compiled, then return to the start.
        for depth in MULTIRATE.touch_depths:
            self._stepper.step(replace(surface.start, position=(x, y, z - depth * surface.radius)))
        self._reset_tool_to_start_in_air()
        self._is_warm = True

    def _reset_tool_to_start_in_air(self) -> None:
        """Place the tool at its start pose without contact; reset the touch frame and the transition."""
        self._stepper.reset_contact_in_air()
        start = self._link.contact_surface.start
        self._frame = TouchFrame(start, start)
        self._transition.reset(start)

    def close(self) -> None:
        """End the process of the bulk; the tissue cannot be stepped afterwards."""
        self._link.close()

    def __del__(self) -> None:
        link = getattr(self, "_link", None)
        if link is not None:
            link.close()

    def clone(self) -> NoReturn:
        """Raise a `CopyError`: a multirate tissue has no copy."""
        raise CopyError(f"{type(self).__name__} cannot be cloned. {self.copy_remedy}")

    @property
    def has_touched(self) -> bool:
        """Whether the tool has touched the tissue since the last reset."""
        return self._touch.has_touched

    @property
    def domain(self) -> str:
        """Poses for which the tissue has a force, as a sentence."""
        return ("Multirate simulation has forces for any pose at which the tool touches the top of the specimen. Each "
                "force has an estimated error.")

    @property
    def _last_pose(self) -> Pose | None:
        """Pose of the tool in the last step; None before the first step."""
        return self._tool_pose

    def _compute_step(self, pose: Pose, dt: float, began: float) -> ToolForce:
        self.warm_up()
        self._time += dt
        self._ticks += 1
        if not self._prepared:
            self.prepare()
        inside = self._register_pose_and_get_time_in_contact(pose, dt)
        if inside is None and self._holds:
            self._answer = self._step_before_bonded_touch(pose, began)
        else:
            self._answer = self._solve_contact_step(pose, dt if inside is None else inside, began)
        self._prepared = False
        return self._answer

    def _register_pose_and_get_time_in_contact(self, pose: Pose, dt: float) -> float | None:
        """Store the pose, begin contact at the first touch, and return the step's time in contact, s; None before."""
        start, touched = self._link.contact_surface.start, self._touch.has_touched
        height = start.position[2]
        inside = self._touch.register_height_and_get_contact_duration(pose.position[2] - height, dt)
        if inside is not None and not touched:
            touch = interpolate_pose_at_surface(self._tool_pose, pose, height)
            if self._holds:
                self._frame = TouchFrame(start, touch)
                touch = start
                self._poses.clear()
            self._stepper.place_at_first_touch(touch)
            self._transition.free, self._step = touch, None
        self._tool_pose = pose
        return inside

    def _step_before_bonded_touch(self, pose: Pose, began: float) -> ToolForce:
        """Send the undeformed state regularly; return the zero force of a bonded tool before its first touch."""
        self._known, start = None, self._link.contact_surface.start
        if self._ticks % MULTIRATE.ticks_between_states == 0:
            self._link.send_state(self._stepper.export_state(self._time, start, self._time, start, self._epoch,
                                                             touched=False))
        status = ForceStatus.CONVERGED if self._link.is_alive else ForceStatus.LATE
        return self._make_zero_force(status, pose, began)

    def _solve_contact_step(self, pose: Pose, dt: float, began: float) -> ToolForce:
        """Solve the contact at a pose, in contact or not, on the newest model; send the state, and return the force."""
        stepper, here = self._stepper, self._frame.pose_in_bulk(pose)
        before, step = self._step, stepper.step(here)
        known, self._known, self._step, transition = self._known, None, step, self._transition
        if known is not None and before is not None:
            transition.update_for_new_model(before, known, self._poses[-1][1] if self._poses else here, here,
                                            step)
        if self._poses and compute_pose_distance(self._poses[-1][1], here, stepper.surface.radius) \
                > transition.estimate.short:
            self._poses.clear()  # the tool jumped: its speed is unknown
        self._poses.append((self._time, here))
        if any(step.wrench):
            self._touch.has_touched = True
        elif transition.is_above_or_just_below_surface(here):
            transition.free = here
        if self.waits:
            if transition.free is not here and self._needs_newer_model(step, here):
                self._step = step = self._exchange_until_force_converges(step, here)
        elif known is not None or self._ticks % MULTIRATE.ticks_between_states == 0:
            earlier, there = self._poses[0]
            self._link.send_state(stepper.export_state(self._time, here, earlier, there, self._epoch, self.has_touched))
        transition.reduce_offset()
        return self._make_tool_force_and_store_error(step, here, pose, dt, began)

    @make_single_thread_method
    def prepare(self) -> None:
        """Use the newest model from the bulk if one has arrived; called between two ticks, otherwise by `step`."""
        self._prepared = True
        model = self._link.receive_model(self._time) if self._is_warm else None
        if model is not None and model.epoch == self._epoch:
            self._known = self._stepper.model
            self._use_model_and_store_its_times(model)

    def _use_model_and_store_its_times(self, model: CondensedBulk) -> None:
        """Use this model for the contact; store the times of its state and tangent, and count it."""
        self.models, self._made = self.models + 1, model.time
        self._tangent_made = model.tangent_time
        self._stepper.set_linearisation(model)

    def _needs_newer_model(self, step: ContactStepResult, pose: Pose) -> bool:
        """Return whether a step that waits needs another model: too old, too far from a pose, or not converged."""
        model, transition = self._stepper.model, self._transition
        assert model is not None
        return (not (step.converged and self._settled) or model.material != self._material
                or self._time - self._made > MULTIRATE.recent
                or transition.compute_distance_from_model(model, pose) > MULTIRATE.near * transition.estimate.short)

    def _exchange_until_force_converges(self, step: ContactStepResult, pose: Pose) -> ContactStepResult:
        """Wait for new models until the force at a pose converges, and return the step on the last model."""
        stepper = self._stepper
        assert stepper.model is not None
        self._settled = False
        for _ in range(MULTIRATE.max_exchanges):
            old = stepper.model
            # The clock is simulated: the pose must not be extrapolated by the wall time of a model.
            model = self._link.send_state_and_wait_for_model(
                stepper.export_state(self._time, pose, self._time, pose, self._epoch, self.has_touched))
            if model is None:
                break
            if model.epoch != self._epoch:
                continue
            self._use_model_and_store_its_times(model)
            before, step = step, stepper.step(pose)
            missed = math.dist(before.wrench[:3], step.wrench[:3])
            self._transition.update_error_estimate(add_screws(step.wrench, scale_screw(-1.0, before.wrench)), old, pose)
            if (model.time >= self._time and model.material == self._material and step.converged
                    and missed <= max(MULTIRATE.force_floor, MULTIRATE.force_tolerance * math.hypot(*step.wrench[:3]))):
                self._settled = True
                break
        self._transition.clear_offset_and_correction()
        return step

    def _make_tool_force_and_store_error(self, step: ContactStepResult, here: Pose, pose: Pose, dt: float,
                                         began: float) -> ToolForce:
        """Return the force of a step with its status and estimated error; store the error in `error`.

        Args:
            step: solved step of the contact.
            here: pose of the tool in the frame of the bulk.
            pose: pose of the tool in the scene.
            dt: time since the touch or the last step, s.
            began: clock at the beginning of the step, s.
        """
        stepper, transition = self._stepper, self._transition
        assert stepper.model is not None
        model = stepper.model
        wrench, stiffness = transition.compute_wrench_and_stiffness(step, here)
        age = self._time - self._made
        self.error, judged = transition.estimate_error_and_status_error(step, here, age)
        if model.material != self._material and self.has_touched:
            self.error = judged = math.inf
        good = (step.converged and self._settled and self._link.is_alive and age <= self.oldest
                and not stepper.may_touch_missing_nodes(here) and is_force_error_acceptable_or_unknown(wrench, judged))
        self._left = self._reduced.record_depth_and_get_force_factor(pose.depth, dt)
        if self._left != 1.0:
            wrench, stiffness = scale_screw(self._left, wrench), scale_matrix(self._left, stiffness)
        is_known, learned_at = math.isfinite(self.error), transition.estimate.time
        return ToolForce(
            wrench, stiffness, ForceStatus.CONVERGED if good else ForceStatus.LATE, step.iterations, step.residual,
            clock.perf_counter() - began, age=max(0.0, age), pose=self._frame.pose_in_scene(model.pose),
            stiffness_age=max(0.0, self._time - self._tangent_made),
            force_error=self._left * self.error if is_known else None,
            error_age=max(0.0, self._time - learned_at) if is_known and math.isfinite(learned_at) else 0.0)

    @make_single_thread_method
    def reset(self) -> None:
        """Restore the undeformed tissue, in the state before the first touch of the tool."""
        self._epoch += 1
        self._reset_state()
        self._reduced.history = self._untouched
        if self._is_warm:
            self._reset_tool_to_start_in_air()
            self._stepper.set_linearisation(self._first)
            start = self._link.contact_surface.start
            self._link.send_state(self._stepper.export_state(0.0, start, 0.0, start, self._epoch, touched=False))

    def _send_material_to_solver(self, material: Material) -> None:
        """Send the material to the bulk; the status is LATE until a model of the new material arrives.

        A loop reduces the force if this takes more than 50 ms.

        Raises:
            InputError: the ratio of bulk and shear modulus is not in the validated range, or the bulk has ended.
        """
        material.require_verified_bulk_ratio()
        self.warm_up()
        try:
            self._link.set_material(material, self._material + 1)
        except OSError as error:
            raise InputError(f"the process of the bulk has ended ({error}). Create another MultiRateTissue",
                             field="material") from None
        self._material += 1
        self._transition.estimate.set_shear_modulus(material.mu0)

    def snapshot(self) -> Snapshot:
        """Return a snapshot of the deformed tissue at one of the last models, in the frame of the bulk."""
        self.warm_up()
        surface = self._link.contact_surface
        return self._link.snapshot() or Snapshot(surface.start, surface.datum, None)


def interpolate_pose_at_surface(before: Pose | None, pose: Pose, height: float) -> Pose:
    """Interpolate the pose, between two steps, at which a tool reaches the height of a tissue's surface.

    Args:
        before: last pose in the air; None if the first step is in the tissue, which counts as a vertical approach.
        pose: pose at or below the surface.
        height: height of the surface, m.
    """
    touch = pose
    if before is not None and before.position[2] > height:
        above = before.position[2] - height
        touch = interpolate_pose(before, pose, above / (before.position[2] - pose.position[2]))
    return replace(touch, position=(*touch.position[:2], height))


def _apply_motion_between_poses(start: Pose, end: Pose, other: Pose) -> Pose:
    """Return the pose `other`, moved by the translation and rotated by the rotation from `start` to `end`."""
    x, y, z, *rotation = compute_rigid_motion(start, end)
    a, b, c = other.position
    moved = Pose((a + x, b + y, c + z), other.orientation)
    u, v, w = rotation
    return rotate_pose_about_its_position(moved, (u, v, w))
