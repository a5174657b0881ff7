"""Multi-rate: a solver too slow for the loop publishes wrench and stiffness; the loop evaluates them every tick."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Screw, Vector, added, motion, scaled
from tissue_sim.tool_force import ForceStatus, Matrix, Tissue, ToolForce, carried_on, pose_of

_NO_WRENCH: Screw = (0.0,) * 6
_NO_STIFFNESS: Matrix = (_NO_WRENCH,) * 6


@dataclass(frozen=True, slots=True)
class LocalModel:
    """The wrench near one pose, W(p) = wrench - stiffness_matrix (motion from there to p).

    Attributes:
        wrench: force, then torque about the tool's deepest point, N and N m.
        stiffness_matrix: as of a `ToolForce`, 6 x 6, N/m, N, N m.
        pose: of the tool.
        time: when the tool was there, on the clock of the loop, s.
        error: estimated error of the force on the way of the tool until the next model, N; None if it is unknown. It
            says nothing of the torque.
        stiffness_time: when the stiffness was evaluated, s; None: at `time`.
    """

    wrench: Screw
    stiffness_matrix: Matrix
    pose: Pose
    time: float
    error: float | None = 0.0
    stiffness_time: float | None = None

    @classmethod
    def axial(cls, force: float, stiffness: float, depth: float, time: float,
              error: float | None = 0.0) -> LocalModel:
        """Of a scene that knows the motion along z only: N, N/m, m."""
        answer = ToolForce.axial(force, stiffness, ForceStatus.CONVERGED)
        return cls(answer.wrench, answer.stiffness_matrix, Pose.at_depth(depth), time, error)

    def evaluate(self, pose: Pose) -> Screw:
        """Wrench at a pose, N and N m."""
        return carried_on(self.wrench, self.stiffness_matrix, motion(self.pose, pose))


#: Before the first model, and after one that is too old: no wrench.
_NONE = LocalModel(_NO_WRENCH, _NO_STIFFNESS, Pose.at_depth(0.0), -math.inf, None)
#: Part of an error estimate that outlives the next model.
_MEMORY = 0.8


class SlowSolver:
    """Makes local models of a tissue whose step takes longer than a tick; lives beside the loop, not in it.

    The error estimate is how far the forces of the last two models are off at the new pose, the larger of the two.
    While a model is being made, the loop goes on with the one before; so a model serves until the tool has moved on for
    up to two periods, and the last but one tells what that costs if the motion goes on like this. At a reversal both
    happen to be right, so a fifth of the estimate at most is forgotten with each model. Models of a tool in the air are
    all equal: they change no estimate, and before the first force the error is unknown. An error that the tissue itself
    estimates is a lower limit. The estimate is not a bound: it is too small for a motion as fast as the solver.

    Args:
        tissue: steps at 2 to 60 Hz.
    """

    def __init__(self, tissue: Tissue):
        self._tissue = tissue
        self._last: LocalModel | None = None
        self._before: LocalModel | None = None

    def solve(self, pose: float | Pose, dt: float, time: float) -> LocalModel | None:
        """Step the tissue to where the tool was.

        Args:
            pose: of the tool, or its depth, m.
            dt: time since the pose of the call before, s.
            time: when the tool was there: `LocalModelBlend.time` in the tick that asked, s.

        Returns:
            The model to publish, or None where the tissue refused the pose or answered with no finite number. A force
            without equilibrium keeps the time of the equilibrium that it comes from, and at least the error of then.
        """
        where = pose_of(pose)
        answer = self._tissue.step(where, dt)
        if answer.status is ForceStatus.REFUSED or not answer.is_finite:
            return None
        made, last = time, self._last or _NONE
        # A force without equilibrium lies on the last model's own line and says nothing about its error.
        converged = answer.status is ForceStatus.CONVERGED
        if self._last is not None and not converged:
            made = max(time - answer.age, last.time)
        error = self._error(where, answer, last, _MEMORY if converged else 1.0)
        evaluated = max(made - max(0.0, answer.stiffness_age - (time - made)), last.stiffness_time or -math.inf)
        self._before = self._last
        self._last = LocalModel(answer.wrench, answer.stiffness_matrix, where, made, error, min(made, evaluated))
        return self._last

    def _error(self, pose: Pose, answer: ToolForce, last: LocalModel, memory: float) -> float | None:
        """Estimated error of the model that an answer makes, N; None while it is unknown."""
        known = last.error
        if any(answer.wrench) or any(last.wrench):
            models = (last, self._before or last)
            error = max(math.dist(model.evaluate(pose)[:3], answer.wrench[:3]) for model in models)
            known = error if known is None or self._last is None else max(error, memory * known)
        if known is None or answer.force_error is None:
            return known
        return max(known, answer.force_error)


class LocalModelBlend:
    """The newest local model, evaluated every tick; itself a `Tissue`.

    When a model comes, the wrench goes on from where it is: the difference between the old and the new one at the pose
    of the last tick is kept as an offset, whose force shrinks by at most `jump` a tick, and its torque by at most
    `torque_jump`. So a change of model alone never moves the force by more than `jump` in a tick, while motion is felt
    at once, with the new stiffness.

    Args:
        jump: largest change of force in a tick that a change of model may cause, N.
        oldest: a model older than this, s, is given up: the wrench goes to zero, by the jumps. A slow solver that has
            ended would otherwise push for ever.
        torque_jump: the same of the torque, N m.

    Attributes:
        time: sum of all dt since the last reset, s: the clock on which models are stamped.
        offset: what is left of the last change of model, N and N m.
        refused: how many models were refused.

    Raises:
        InputError: `jump`, `torque_jump` or `oldest` that is not above zero.
    """

    def __init__(self, jump: float = 0.02, oldest: float = 2.0, torque_jump: float = 0.002):
        for value, unit, field in ((jump, "N", "jump"), (torque_jump, "N m", "torque_jump")):
            if not 0 < value < math.inf:
                raise InputError(f"{value:g} {unit} is no jump to blend with; give one above zero, such as 0.02",
                                 field=field)
        if not oldest > 0:
            raise InputError(f"{oldest:g} s is no age; give one above the solver's period, such as 2", field="oldest")
        self.jump, self.torque_jump, self.oldest = jump, torque_jump, oldest
        self.reset()

    def reset(self):
        """Forget all models and start the clock again."""
        self.time, self.offset, self.refused = 0.0, _NO_WRENCH, 0
        self._model, self._published = _NONE, -math.inf
        self._pose: Pose | None = None
        self._wrench = _NO_WRENCH

    @property
    def age(self) -> float:
        """Time since the tool was where the newest model was made, s; infinite before the first."""
        return self.time - self._published

    @property
    def error(self) -> float:
        """Estimated error of the force, N: of the model, and the rest of the change to it; infinite if unknown."""
        error = self._model.error
        return math.inf if error is None else error + _size(self.offset[:3])

    def publish(self, model: LocalModel) -> bool:
        """Take a new model; returns whether it was taken.

        Refused, with the old one kept: a model with a number that is not finite, one made before the present one,
        one from after now (made before a reset).
        """
        wrench = model.evaluate(model.pose if self._pose is None else self._pose)
        finite = math.isfinite(sum(wrench)) and math.isfinite(model.time) and math.isfinite(model.error or 0.0)
        if not (finite and self._published <= model.time <= self.time):
            self.refused += 1
            return False
        self._published = model.time
        self._change_to(model)
        return True

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """Wrench at a pose, or at a depth, m, after dt, s.

        Returns:
            Status LATE: a local model's wrench; STOPPED before the first model and after one that is too old; REFUSED
            with the last wrench, and nothing changed, where pose or dt is not finite or dt is not above zero.
        """
        pose = pose_of(pose)
        if not (pose.is_finite and 0 < dt < math.inf):
            return self._answer(ForceStatus.REFUSED)
        self.time += dt
        if self._pose is None:
            # No motion comes before the first tick: all of the first wrench is a change of model.
            self._pose = pose
            self._change_to(self._model)
        if self.age > self.oldest:
            self._change_to(_NONE)
        if any(self.offset):
            self.offset = _shrunk(self.offset[:3], self.jump) + _shrunk(self.offset[3:], self.torque_jump)
        self._pose = pose
        self._wrench = added(self._model.evaluate(pose), self.offset)
        return self._answer(ForceStatus.LATE if math.isfinite(self._model.time) else ForceStatus.STOPPED)

    def _change_to(self, model: LocalModel):
        self._model = model
        if self._pose is not None:
            self.offset = added(self._wrench, scaled(-1.0, model.evaluate(self._pose)))

    def _answer(self, status: ForceStatus) -> ToolForce:
        model, age, error = self._model, self.age, self.error
        is_known = math.isfinite(error)
        stiffness_age = age if model.stiffness_time is None else self.time - model.stiffness_time
        return ToolForce(self._wrench, model.stiffness_matrix, status, age=age, pose=model.pose,
                         stiffness_age=stiffness_age if any(map(any, model.stiffness_matrix)) else 0.0,
                         force_error=error if is_known else None, error_age=age if is_known else 0.0)


def _size(vector: Vector) -> float:
    return math.hypot(*vector)


def _shrunk(vector: Vector, step: float) -> Vector:
    """A vector made shorter by a step."""
    size = _size(vector)
    if size <= step:
        return (0.0, 0.0, 0.0)
    # The direction first: along an axis it is 1.
    x, y, z = vector
    return (x - x / size * step, y - y / size * step, z - z / size * step)
