"""Multi-rate: a solver too slow for the loop publishes force and stiffness; the loop evaluates them every tick."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, Tissue, ToolForce, depth_of


@dataclass(frozen=True, slots=True)
class LocalModel:
    """The force near one depth, F(d) = force + stiffness (d - depth).

    Attributes:
        force: N.
        stiffness: dF/dd, N/m.
        depth: m.
        time: when the tool was there, on the clock of the loop, s.
        error: how far the force may be off where the tool goes until the next model, N.
    """

    force: float
    stiffness: float
    depth: float
    time: float
    error: float = 0.0

    def evaluate(self, depth: float) -> float:
        """Force, N, at a depth, m."""
        return self.force + self.stiffness * (depth - self.depth)


#: Before the first model, and after one that is too old: no force.
_NONE = LocalModel(0.0, 0.0, 0.0, -math.inf, math.inf)
#: Part of an error estimate that outlives the next model.
_MEMORY = 0.8


class SlowSolver:
    """Makes local models of a tissue whose step takes longer than a tick; lives beside the loop, not in it.

    The error estimate is how far the last two models are off at the new depth, the larger of the two. While a model is
    being made, the loop goes on with the one before; so a model serves until the tool has moved on for up to two
    periods, and the last but one tells what that costs if the motion goes on like this. At a reversal both happen to
    be right, so a fifth of the estimate at most is forgotten with each model. It is an estimate, not a bound: a motion
    as fast as the solver deceives it.

    Args:
        tissue: steps at 2 to 60 Hz.
    """

    def __init__(self, tissue: Tissue):
        self._tissue = tissue
        self._last: LocalModel | None = None
        self._before: LocalModel | None = None

    def solve(self, depth: float | Pose, dt: float, time: float) -> LocalModel | None:
        """Step the tissue to where the tool was.

        Args:
            depth: depth, m, or pose of the tool.
            dt: time since the pose of the call before, s.
            time: when the tool was there: `LocalModelBlend.time` in the tick that asked, s.

        Returns:
            The model to publish, or None where the tissue refused the pose or answered with no finite number. A force
            without equilibrium keeps the time of the equilibrium that it comes from, and at least the error of then.
        """
        answer = self._tissue.step(depth, dt)
        if answer.status is ForceStatus.REFUSED or not math.isfinite(answer.force + answer.stiffness):
            return None
        where, made, last = depth_of(depth), time, self._last or _NONE
        error = max(abs(model.evaluate(where) - answer.force) for model in (last, self._before or last))
        if self._last is not None:
            # A force without equilibrium lies on the last model's own line and says nothing about its error.
            converged = answer.status is ForceStatus.CONVERGED
            error = max(error, _MEMORY * last.error if converged else last.error)
            made = time if converged else max(time - answer.age, last.time)
        self._before = self._last
        self._last = LocalModel(answer.force, answer.stiffness, where, made, error)
        return self._last


class LocalModelBlend:
    """The newest local model, evaluated every tick; itself a `Tissue`.

    When a model comes, the force goes on from where it is: the difference between the old and the new force at the
    depth of the last tick is kept as an offset, which shrinks by at most `jump` a tick. So a change of model alone
    never moves the force by more than `jump` in a tick, while motion is felt at once, with the new stiffness.

    Args:
        jump: largest change of force in a tick that a change of model may cause, N.
        oldest: a model older than this, s, is given up: the force goes to zero, by `jump` a tick. A slow solver that
            has ended would otherwise push for ever.

    Attributes:
        time: sum of all dt since the last reset, s: the clock on which models are stamped.
        offset: what is left of the last change of model, N.
        refused: how many models were refused.

    Raises:
        InputError: `jump` or `oldest` that is not above zero.
    """

    def __init__(self, jump: float = 0.02, oldest: float = 2.0):
        if not 0 < jump < math.inf:
            raise InputError(f"{jump:g} N is no jump to blend with; give one above zero, such as 0.02", field="jump")
        if not oldest > 0:
            raise InputError(f"{oldest:g} s is no age; give one above the solver's period, such as 2", field="oldest")
        self.jump, self.oldest = jump, oldest
        self.reset()

    def reset(self):
        """Forget all models and start the clock again."""
        self.time, self.offset, self.refused = 0.0, 0.0, 0
        self._model, self._published = _NONE, -math.inf
        self._depth: float | None = None
        self._force = 0.0

    @property
    def age(self) -> float:
        """Time since the tool was where the newest model was made, s; infinite before the first."""
        return self.time - self._published

    @property
    def error(self) -> float:
        """Estimate of how far the force may be off, N: the model's, and what is left of the change to it."""
        return self._model.error + abs(self.offset)

    def publish(self, model: LocalModel) -> bool:
        """Take a new model; returns whether it was taken.

        Refused, with the old one kept: a model with a number that is not finite, one made before the present one,
        one from after now (made before a reset).
        """
        depth = model.depth if self._depth is None else self._depth
        finite = math.isfinite(model.evaluate(depth)) and math.isfinite(model.time) and math.isfinite(model.error)
        if not (finite and self._published <= model.time <= self.time):
            self.refused += 1
            return False
        self._published = model.time
        self._change_to(model)
        return True

    def step(self, depth: float | Pose, dt: float) -> ToolForce:
        """Force at a depth, m, after dt, s.

        Returns:
            Status LATE: a local model's force; STOPPED before the first model and after one that is too old; REFUSED
            with the last force, and nothing changed, where depth or dt is not a finite number or dt is not above zero.
        """
        depth = depth_of(depth)
        if not (math.isfinite(depth) and 0 < dt < math.inf):
            return self._answer(ForceStatus.REFUSED)
        self.time += dt
        if self._depth is None:
            # No motion comes before the first tick: all of the first force is a change of model.
            self._depth = depth
            self._change_to(self._model)
        if self.age > self.oldest:
            self._change_to(_NONE)
        if self.offset > self.jump:
            self.offset -= self.jump
        elif self.offset < -self.jump:
            self.offset += self.jump
        else:
            self.offset = 0.0
        self._depth = depth
        self._force = self._model.evaluate(depth) + self.offset
        return self._answer(ForceStatus.LATE if math.isfinite(self._model.time) else ForceStatus.STOPPED)

    def _change_to(self, model: LocalModel):
        self._model = model
        if self._depth is not None:
            self.offset = self._force - model.evaluate(self._depth)

    def _answer(self, status: ForceStatus) -> ToolForce:
        return ToolForce.axial(self._force, self._model.stiffness, status, age=self.age, depth=self._model.depth)
