"""Multirate rendering with local models: a slow solver publishes wrench and stiffness, the loop evaluates them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Screw, add_screws, compute_rigid_motion, scale_screw, shorten_screw
from tissue_sim.public_names import OldName
from tissue_sim.realtime.model_transition import ERROR_ESTIMATE
from tissue_sim.tool_force import (
    ForceStatus,
    Matrix,
    Tissue,
    ToolForce,
    convert_depth_or_pose_to_pose,
    extrapolate_wrench,
)

_NO_WRENCH: Screw = (0.0,) * 6
_NO_STIFFNESS: Matrix = (_NO_WRENCH,) * 6


@dataclass(frozen=True, slots=True)
class LocalModel:
    """Linear model of the wrench near one pose: W(p) = wrench - stiffness_matrix (motion from `pose` to p).

    Attributes:
        wrench: force and torque about the deepest point of the tool, N and N m.
        stiffness_matrix: stiffness as in `ToolForce`, shape (6, 6), N/m, N, N m.
        pose: pose of the tool.
        time: time at which the tool had this pose, on the clock of the loop, s.
        error: estimated error of the force until the next model, N, without the error of the torque; None if unknown.
        stiffness_time: time at which the stiffness was evaluated, s; None: at `time`.
    """

    wrench: Screw
    stiffness_matrix: Matrix
    pose: Pose
    time: float
    error: float | None = 0.0
    stiffness_time: float | None = None

    @classmethod
    def from_axial_force(cls, force: float, stiffness: float, depth: float, time: float,
                         error: float | None = 0.0) -> LocalModel:
        """Return a model for motion along z only, from a scalar force and stiffness.

        Args:
            force: force along z, N.
            stiffness: stiffness along z, N/m.
            depth: depth of the tool, m.
            time: time at which the tool had this depth, s.
            error: estimated error of the force, N; None if unknown.
        """
        answer = ToolForce.from_axial_force(force, stiffness, ForceStatus.CONVERGED)
        return cls(answer.wrench, answer.stiffness_matrix, Pose.at_depth(depth), time, error)

    axial = OldName("from_axial_force")

    def evaluate_wrench(self, pose: Pose) -> Screw:
        """Return the wrench at a pose, N and N m."""
        return extrapolate_wrench(self.wrench, self.stiffness_matrix, compute_rigid_motion(self.pose, pose))

    evaluate = OldName("evaluate_wrench")


#: Model with zero wrench, used before the first model and after a model that is too old.
_NONE = LocalModel(_NO_WRENCH, _NO_STIFFNESS, Pose.at_depth(0.0), -math.inf, None)


class SlowSolver:
    """Create local models of a tissue whose step takes longer than a tick; runs outside of the loop.

    The error estimate is the larger difference between the new force and the forces of the last two models at the new
    pose. The loop uses a model while the next one is computed, that is up to two periods, so the last but one model
    shows the error of this time for a steady motion. At a reversal of the motion both models agree by chance; therefore
    at least 80 % of the estimate is kept with each model. All models of a tool in the air are equal and do not change
    the estimate; before the first force the error is unknown. An error estimated by the tissue itself is a lower limit.
    The estimate is not a bound: it is too small for motions as fast as the solver.

    Args:
        tissue: tissue that is stepped at 2 to 60 Hz.
    """

    def __init__(self, tissue: Tissue):
        self._tissue = tissue
        self._last: LocalModel | None = None
        self._before: LocalModel | None = None

    def solve(self, pose: float | Pose, dt: float, time: float) -> LocalModel | None:
        """Step the tissue to a pose of the tool and create a local model there.

        Args:
            pose: pose of the tool, or its depth, m.
            dt: time since the pose of the previous call, s.
            time: time at which the tool had this pose, on the clock `LocalModelBlend.time`, s.

        Returns:
            The model to publish; None if the tissue refused the pose or returned a force that is not finite. A force
            without equilibrium keeps the time of the last equilibrium, and at least its error.
        """
        tool_pose = convert_depth_or_pose_to_pose(pose)
        answer = self._tissue.step(tool_pose, dt)
        if answer.status is ForceStatus.REFUSED or not answer.is_finite:
            return None
        made, last = time, self._last or _NONE
        # A force without equilibrium is extrapolated from the last model and contains no information on its error.
        converged = answer.status is ForceStatus.CONVERGED
        if self._last is not None and not converged:
            made = max(time - answer.age, last.time)
        error = self._estimate_error_from_last_models(tool_pose, answer, last,
                                                      ERROR_ESTIMATE.memory if converged else 1.0)
        evaluated = max(made - max(0.0, answer.stiffness_age - (time - made)), last.stiffness_time or -math.inf)
        self._before = self._last
        self._last = LocalModel(answer.wrench, answer.stiffness_matrix, tool_pose, made, error, min(made, evaluated))
        return self._last

    def _estimate_error_from_last_models(self, pose: Pose, answer: ToolForce, last: LocalModel,
                                         memory: float) -> float | None:
        """Return the error of a new model's force, N, from the last two models; None while it is unknown."""
        known = last.error
        if any(answer.wrench) or any(last.wrench):
            models = (last, self._before or last)
            error = max(math.dist(model.evaluate_wrench(pose)[:3], answer.wrench[:3]) for model in models)
            known = error if known is None or self._last is None else max(error, memory * known)
        if known is None or answer.force_error is None:
            return known
        return max(known, answer.force_error)


class LocalModelBlend:
    """Tissue that evaluates the newest local model in each tick, with a continuous wrench at changes of the model.

    At a change of the model the difference of both wrenches at the last pose is stored as an offset. The offset
    decreases by at most `jump` (force) and `torque_jump` (torque) per tick. A change of the model therefore changes the
    force by at most `jump` per tick, whereas motion changes the force at once with the new stiffness.

    Args:
        jump: largest change of force per tick due to a change of the model, N.
        oldest: age above which a model is discarded, s; the wrench then decreases to zero in steps of `jump`. The limit
            prevents a permanent force after the slow solver has ended.
        torque_jump: largest change of torque per tick due to a change of the model, N m.

    Attributes:
        time: sum of all dt since the last reset, s; the clock for the times of models.
        offset: remaining offset of the last change of the model, N and N m.
        refused: number of refused models.

    Raises:
        InputError: `jump`, `torque_jump` or `oldest` is not positive.
    """

    def __init__(self, jump: float = 0.02, oldest: float = 2.0, torque_jump: float = 0.002):
        for value, unit, field in ((jump, "N", "jump"), (torque_jump, "N m", "torque_jump")):
            if not 0 < value < math.inf:
                raise InputError(f"{field} must be positive and finite; got {value:g} {unit}. Use for example 0.02",
                                 field=field)
        if not oldest > 0:
            raise InputError(f"oldest must be positive; got {oldest:g} s. Use more than the period of the solver, such "
                             "as 2", field="oldest")
        self.jump, self.torque_jump, self.oldest = jump, torque_jump, oldest
        self.reset()

    def reset(self):
        """Discard all models, set the wrench to zero and restart the clock at zero."""
        self.time, self.offset, self.refused = 0.0, _NO_WRENCH, 0
        self._model, self._published = _NONE, -math.inf
        self._pose: Pose | None = None
        self._wrench = _NO_WRENCH

    @property
    def age(self) -> float:
        """Time since the tool had the pose of the newest model, s; infinite before the first model."""
        return self.time - self._published

    @property
    def error(self) -> float:
        """Estimated error of the force, N: error of the model plus remaining offset; infinite if unknown."""
        error = self._model.error
        return math.inf if error is None else error + math.hypot(*self.offset[:3])

    def publish(self, model: LocalModel) -> bool:
        """Replace the model by a newer one, if it is valid; the wrench stays continuous.

        Returns:
            Whether the new model is used. A model is refused, and the old one kept, if it contains a number that is not
            finite, if it is older than the present model, or if its time is in the future (it was made before a reset).
        """
        wrench = model.evaluate_wrench(model.pose if self._pose is None else self._pose)
        finite = math.isfinite(sum(wrench)) and math.isfinite(model.time) and math.isfinite(model.error or 0.0)
        if not (finite and self._published <= model.time <= self.time):
            self.refused += 1
            return False
        self._published = model.time
        self._switch_to_model(model)
        return True

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """Advance the clock by one tick, and return the wrench at a pose.

        Args:
            pose: pose of the tool, or its depth, m.
            dt: time since the last step, s.

        Returns:
            The wrench with the status LATE for a local model, STOPPED before the first model and after one that is too
            old, or REFUSED with the last wrench if pose or dt is not finite or dt is not positive.
        """
        pose = convert_depth_or_pose_to_pose(pose)
        if not (pose.is_finite and 0 < dt < math.inf):
            return self._make_tool_force(ForceStatus.REFUSED)
        self.time += dt
        if self._pose is None:
            # At the first tick the whole wrench counts as a change of the model.
            self._pose = pose
            self._switch_to_model(self._model)
        if self.age > self.oldest:
            self._switch_to_model(_NONE)
        self.offset = shorten_screw(self.offset, self.jump, self.torque_jump)
        self._pose = pose
        self._wrench = add_screws(self._model.evaluate_wrench(pose), self.offset)
        return self._make_tool_force(ForceStatus.LATE if math.isfinite(self._model.time) else ForceStatus.STOPPED)

    def _switch_to_model(self, model: LocalModel):
        """Use this linear model of the wrench, and store the jump of the wrench at the last pose as the offset."""
        self._model = model
        if self._pose is not None:
            self.offset = add_screws(self._wrench, scale_screw(-1.0, model.evaluate_wrench(self._pose)))

    def _make_tool_force(self, status: ForceStatus) -> ToolForce:
        """Return the present wrench with this status, the stiffness of the model, and age and error."""
        model, age, error = self._model, self.age, self.error
        is_known = math.isfinite(error)
        stiffness_age = age if model.stiffness_time is None else self.time - model.stiffness_time
        return ToolForce(self._wrench, model.stiffness_matrix, status, age=age, pose=model.pose,
                         stiffness_age=stiffness_age if any(map(any, model.stiffness_matrix)) else 0.0,
                         force_error=error if is_known else None, error_age=age if is_known else 0.0)
