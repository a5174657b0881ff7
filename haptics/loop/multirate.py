"""A tissue by two rates: contact solved in every tick, on a bulk that another process linearises as fast as it can."""

from __future__ import annotations

import math
import time as clock
from collections import deque
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from haptics.loop.bulk_link import BulkLink, BulkProcess
from haptics.loop.model_drift import ModelDrift
from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import LINEARISATIONS
from tissue_sim.fem.condensed.stepper import CondensedStepper, ContactStep
from tissue_sim.live_material import require_same_layers, require_tissue
from tissue_sim.material.effect import ReducedForce
from tissue_sim.material.material import BULK_RATIOS
from tissue_sim.model import Model
from tissue_sim.parameters import with_values
from tissue_sim.pose import Pose, Screw, added, motion, scaled
from tissue_sim.simulator import Simulator
from tissue_sim.snapshot import Snapshot
from tissue_sim.tool_force import ForceStatus, ToolForce, axial_stiffness, axial_wrench, pose_of, scaled_matrix

#: Largest changes of force and torque in a tick that a change of model may cause, N and N m.
JUMP, TORQUE_JUMP = 0.01, 0.001
#: A model older than this, s, is worth nothing more.
OLDEST = 1.0
#: An estimated error beyond this share of the force, and beyond this force, N, is no equilibrium any more.
ERROR_SHARE, ERROR_FLOOR = 0.25, 0.05
#: How much of the estimate outlives the next model; ways shorter than this share of the contact's radius say nothing.
_MEMORY, _SHORT = 0.8, 0.1
#: Ticks from one state that is sent to the next, and back to the pose from which the tool's speed is taken.
_SEND_EVERY, _LOOK_BACK = 4, 8
#: Depths of the touch before the first tick, over the contact's radius.
_TOUCHES = (0.02, 0.04, 0.05)
_AT_REST = ToolForce(axial_wrench(0.0), axial_stiffness(0.0), ForceStatus.STOPPED)


class MultiRateTissue:
    """A `Tissue` of a solid: `warm_up`, `step`, `reset`, `set_parameters`, `snapshot` as of a `Simulator`.

    Each tick solves lift-off, touch and friction on the newest linearisation of the bulk; the process of the bulk gets
    the contact's forces and answers with the next one. When a model comes, the wrench goes on from where it is, and the
    difference is let go by `JUMP` a tick. An answer is `CONVERGED` where the contact is, on a model that is not too
    old, within the distance that its error estimate and its nodes allow; `LATE` otherwise, and let go by
    `ForceRelease`.

    The estimate: the change of the wrench with the last models was so much at such a way from the pose of the model
    before, and an error of a linearisation grows with the square of the way.

    Args:
        model: experiment, material.
        solver, resolution, mesh: whose bulk; see `tissue_sim.fem.condensed.model.LINEARISATIONS`.
        link: to a bulk, instead of that of a process which is made by `warm_up`.
        oldest: see `OLDEST`.

    Attributes:
        error: estimate of how far the force may be off, N. models: how many have come.
        resolution, force_error, budget, mesh: as of a `Simulator`.

    Raises:
        InputError: what a `Simulator` refuses, and what the linearisation does (in `warm_up`).
    """

    force_error: float | None = None
    budget: float | None = None
    mesh: Any = None

    def __init__(self, model: Model, *, solver: str = "solid", resolution: str = "realtime", mesh: Any = None,
                 link: BulkLink | None = None, oldest: float = OLDEST):
        if not oldest > 0.0:
            raise InputError(f"{oldest:g} s is no age; give one above the period of the bulk, such as 1",
                             field="oldest")
        require_tissue(model.material)
        self.model, self.resolution, self.oldest = model, resolution if mesh is None else "own mesh", oldest
        self._link = link or BulkProcess(model, solver=solver, resolution=resolution, mesh=mesh)
        self._stepper: CondensedStepper | None = None
        self._drift: ModelDrift | None = None
        self._epoch, self.models = 0, 0
        self._reduced = ReducedForce(model.material.reduced_effects(plate=model.experiment.tool.is_plate))
        self._untouched = self._reduced.history
        self._begin()

    def _begin(self) -> None:
        self._time, self._ticks, self.error, self._growth, self._left = 0.0, 0, 0.0, 0.0, 1.0
        self._offset, self._answer = axial_wrench(0.0), _AT_REST
        self._step: ContactStep | None = None
        self._poses: deque[tuple[float, Pose]] = deque(maxlen=_LOOK_BACK)
        self._made, self._models_before = 0.0, self.models
        self._prepared = False
        #: Of the model before the one that has come since the last step.
        self._known: Pose | None = None

    def warm_up(self) -> None:
        """Start the process of the bulk and compile what a tick needs.

        Raises:
            InputError: what the bulk's solver refuses.
            RuntimeError: its process has ended.
        """
        if self._stepper is not None:
            return
        self._first = self._link.start()
        self._stepper = CondensedStepper(self._link.surface)
        self._stepper.adopt(self._first)
        self._drift = ModelDrift(self._link.surface.radius)
        surface = self._link.surface
        x, y, z = surface.start.position
        # Touch, so that all that a tick needs is there, and go back.
        for depth in _TOUCHES:
            self._stepper.step(replace(surface.start, position=(x, y, z - depth * surface.radius)))
        self._stepper.reset()

    def close(self) -> None:
        """End the process of the bulk."""
        self._link.close()

    def __del__(self) -> None:
        link = getattr(self, "_link", None)
        if link is not None:
            link.close()

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """The force where the tool is now; see `Simulator.step`."""
        began = clock.perf_counter()
        self.warm_up()
        stepper = self._stepper
        assert stepper is not None
        pose = pose_of(pose)
        if not (pose.is_finite and math.isfinite(dt) and dt >= 0.0):
            return replace(self._answer, status=ForceStatus.REFUSED, iterations=0,
                           compute_time=clock.perf_counter() - began)
        self._time += dt
        self._ticks += 1
        if not self._prepared:
            self.prepare()
        before, step = self._step, stepper.step(pose)
        known, self._known, self._step, self._prepared = self._known, None, step, False
        if known is not None and before is not None:
            self._take_over(before, known, pose, step)
        self._poses.append((self._time, pose))
        if known is not None or self._ticks % _SEND_EVERY == 0:
            earlier, there = self._poses[0]
            self._link.send(stepper.state(self._time, pose, earlier, there, self._epoch))
        if any(self._offset):
            self._offset = _shorter(self._offset[:3], JUMP) + _shorter(self._offset[3:], TORQUE_JUMP)
        self._answer = self._found(step, pose, dt, began)
        return self._answer

    def prepare(self) -> None:
        """Take the newest model, where one has come: between two ticks, or `step` does it."""
        self._prepared, stepper = True, self._stepper
        if stepper is None or stepper.model is None:
            return
        model = self._link.receive(self._time)
        if model is not None and model.epoch == self._epoch:
            self.models, self._made, self._known = self.models + 1, model.time, stepper.model.pose
            stepper.adopt(model)

    def _take_over(self, before: ContactStep, of: Pose, pose: Pose, after: ContactStep) -> None:
        """What a new model changes becomes an offset: the wrench goes on as it would have without it.

        Args:
            before: the last step, on the model of a pose `of`.
            pose: of the tool. after: the step there on the new model.
        """
        assert self._stepper is not None and self._stepper.model is not None and self._drift is not None
        new, (_, here), drift = self._stepper.model.pose, self._poses[-1], self._drift
        slope = np.array(before.stiffness_matrix) @ np.array(motion(here, pose))
        went_on = cast("Screw", tuple((np.array(before.wrench) - slope).tolist()))
        missed, expected = added(after.wrench, scaled(-1.0, went_on)), drift.beyond(of, pose)
        if any(after.wrench):
            drift.learn(missed, of, new)
        else:
            drift.forget()
        for part in (expected, scaled(-1.0, missed), scaled(-1.0, drift.beyond(new, pose))):
            self._offset = added(self._offset, part)
        way = max(before.way, _SHORT * self._stepper.surface.radius)
        self._growth = max(_MEMORY * self._growth, math.dist(expected[:3], missed[:3]) / way**2)

    def _found(self, step: ContactStep, pose: Pose, dt: float, began: float) -> ToolForce:
        stepper = self._stepper
        assert stepper is not None and stepper.model is not None and self._drift is not None
        wrench, stiffness, drift = step.wrench, step.stiffness_matrix, self._drift
        if any(wrench):
            wrench, stiffness = added(wrench, drift.beyond(stepper.model.pose, pose)), drift.stiffness(stiffness)
        wrench = added(wrench, self._offset)
        force, age = math.hypot(*wrench[:3]), self._time - self._made
        self.error = self._growth * step.way**2 * bool(force) + math.hypot(*self._offset[:3])
        # Before a second model of this specimen nobody knows how fast the first one goes wrong.
        known = self.models > self._models_before or step.way <= _SHORT * stepper.surface.radius
        good = (step.converged and known and self._link.alive and age <= self.oldest and not stepper.leaves(pose)
                and self.error <= max(ERROR_FLOOR, ERROR_SHARE * force))
        self._left = self._reduced.go(pose.depth, dt)
        if self._left != 1.0:
            wrench, stiffness = scaled(self._left, wrench), scaled_matrix(self._left, stiffness)
        return ToolForce(wrench, stiffness, ForceStatus.CONVERGED if good else ForceStatus.LATE, step.iterations,
                         step.residual, clock.perf_counter() - began, age=max(0.0, age), pose=stepper.model.pose)

    def reset(self) -> None:
        """Back to the specimen that nobody has touched."""
        self._epoch += 1
        self._begin()
        self._reduced.history = self._untouched
        if self._stepper is not None and self._drift is not None:
            self._stepper.reset()
            self._drift.forget()
            self._stepper.adopt(self._first)
            surface = self._stepper.surface
            self._link.send(self._stepper.state(0.0, surface.start, 0.0, surface.start, self._epoch))

    def set_parameters(self, **values: float) -> None:
        """Change parameters of the material; the bulk follows with its next models. See `Simulator.set_parameters`.

        Raises:
            InputError: no such parameter, a value that the material refuses, or a modulus that is none of tissue.
        """
        material = with_values(self.model.material, values)
        require_same_layers(self.model.material, material)
        require_tissue(material)
        low, high = BULK_RATIOS
        if not low <= min(material.bulk_modulus, high * material.mu0) / material.mu0:
            raise InputError(f"K/mu0 is {material.bulk_modulus / material.mu0:g}; the finite elements are checked from "
                             f"{low:g} to {high:g}", field="bulk")
        self.warm_up()
        try:
            self._link.set_material(material)
        except OSError as error:
            raise InputError(f"the process of the bulk has ended ({error}); begin anew", field="material") from None
        self.model = replace(self.model, material=material)
        history = self._reduced.history
        self._reduced = ReducedForce(material.reduced_effects(plate=self.model.experiment.tool.is_plate))
        self._reduced.history = history

    def snapshot(self) -> Snapshot:
        """The surface of the tissue at one of the last models."""
        self.warm_up()
        return self._link.snapshot() or Snapshot(self._link.surface.start, self._link.surface.datum, None)


def real_time_tissue(model: Model, *, solver: str, resolution: str, budget: float | None, inertia: str = "auto",
                     looks_ahead: bool = False, simulator: type[Simulator] = Simulator,
                     mesh: Any = None) -> partial[Any]:
    """What makes a tissue that is stepped 1000 times a second: a `Simulator`, or a `MultiRateTissue` of a solver whose
    bulk can be linearised. Arguments as of `Simulator`, which may be one of its kind; can be sent to another process.

    Raises:
        InputError: inertia that is to be on where there is none.
    """
    if solver not in LINEARISATIONS:
        given = {} if mesh is None else {"mesh": mesh}
        return partial(simulator, model, resolution=resolution, inertia=inertia, looks_ahead=looks_ahead, budget=budget,
                       solver=solver, **given)
    if inertia == "on":
        raise InputError(f"a solid by two rates has no mass ({solver!r}); use 'auto' or 'off'", field="inertia")
    return partial(MultiRateTissue, model, solver=solver, resolution=resolution, mesh=mesh)


def _shorter(vector: tuple[float, float, float], step: float) -> tuple[float, float, float]:
    size = math.hypot(*vector)
    left = max(0.0, 1.0 - step / size) if size else 0.0
    x, y, z = vector
    return (left * x, left * y, left * z)

