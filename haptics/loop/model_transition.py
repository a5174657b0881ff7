"""The wrench across a change of model, and the estimated error of the force on the newest model."""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from haptics.loop.linearisation_error import LinearisationError
from haptics.loop.model_drift import ModelDrift
from tissue_sim.fem.condensed.model import CondensedContact
from tissue_sim.fem.condensed.stepper import CondensedStepper, ContactStep
from tissue_sim.pose import Pose, Screw, added, motion, scaled
from tissue_sim.tool_force import Matrix

#: Largest change of force in a tick that a change of model may cause, N.
JUMP = 0.01
#: Largest change of torque in a tick that a change of model may cause, N m.
TORQUE_JUMP = 0.001
_NO_WRENCH: Screw = (0.0,) * 6


class ModelTransition:
    """Keeps the wrench continuous when a model of the bulk comes, and learns from the difference.

    A model of another material is used at once, as in a `Simulator`: the parameters were changed in one step, so the
    force is, too.

    Args:
        stepper: of the contact; its model is the newest one.
        shear_modulus: of the tissue, Pa.

    Attributes:
        offset: rest of the differences of the models so far, N and N m; it is part of the wrench that is answered.
        estimate: of the error of the force on a model.
        free: last pose of the tool without a contact force, near the surface or above.
    """

    def __init__(self, stepper: CondensedStepper, shear_modulus: float):
        self._stepper, radius = stepper, stepper.surface.radius
        self._drift, self.estimate = ModelDrift(radius), LinearisationError(radius, shear_modulus)
        self.reset(stepper.surface.start)

    def reset(self, pose: Pose) -> None:
        """Begin with an undeformed tissue and a tool in the air, which touches at a pose."""
        self.offset: Screw = _NO_WRENCH
        self.free = pose
        self._drift.forget()
        self.estimate.forget()

    def distance(self, model: CondensedContact, pose: Pose) -> float:
        """Distance of a pose from that of a model, m.

        A model without contact is of the undeformed tissue, which each pose in the air has in common: its distance is
        that from the last of them, or from its own pose if that is in the air and nearer.
        """
        distance = self._stepper.distance(motion(model.pose, pose))
        if model.has_contact:
            return distance
        from_air = self._stepper.distance(motion(self.free, pose))
        return min(distance, from_air) if self.is_near_surface(model.pose) else from_air

    def is_near_surface(self, pose: Pose) -> bool:
        """Whether a pose is above the surface of the undeformed tissue, or at most the short distance below.

        A round tool between the nodes of the surface meets them only a little below.
        """
        return pose.position[2] >= self._stepper.surface.start.position[2] - self.estimate.short

    def take_over(self, before: ContactStep, old: CondensedContact, last: Pose, pose: Pose, after: ContactStep) -> None:
        """Continue the wrench as it would have been on the model before; the difference becomes an offset.

        Args:
            before: the last step, on the old model, at the pose `last`.
            pose: of the tool. after: the step there on the new model.
        """
        new, drift = self._newest, self._drift
        if new.material != old.material:
            self.settle()
            return
        slope = np.array(before.stiffness_matrix) @ np.array(motion(last, pose))
        went_on = cast("Screw", tuple((np.array(before.wrench) - slope).tolist()))
        missed, expected = added(after.wrench, scaled(-1.0, went_on)), drift.beyond(old.pose, pose)
        if any(after.wrench):
            drift.learn(missed, old.pose, new.pose)
            self.learn(added(expected, scaled(-1.0, missed)), old, last)
        else:
            drift.forget()
        for part in (expected, scaled(-1.0, missed), scaled(-1.0, drift.beyond(new.pose, pose))):
            self.offset = added(self.offset, part)

    def learn(self, missed: Screw, old: CondensedContact, pose: Pose) -> None:
        """Update the error estimate with the wrench by which the newest model differs from the one before at a pose.

        Models of the undeformed tissue and models of different materials teach nothing.
        """
        new = self._newest
        if new.has_contact and new.material == old.material:
            self.estimate.learn(self._size(missed), self.distance(old, pose), self.distance(old, new.pose), new.time,
                                new.time - old.time, self.distance(new, pose))

    def _size(self, wrench: Screw) -> float:
        """Force of a wrench, or its torque over the contact radius if that is larger, N."""
        return max(math.hypot(*wrench[:3]), math.hypot(*wrench[3:]) / self._stepper.surface.radius)

    def settle(self) -> None:
        """Let the wrench be that of the newest model at once."""
        self.offset = _NO_WRENCH
        self._drift.forget()

    def reduce_offset(self) -> None:
        """Bring the offset nearer to zero, by at most `JUMP` and `TORQUE_JUMP`."""
        if any(self.offset):
            self.offset = _shorter(self.offset[:3], JUMP) + _shorter(self.offset[3:], TORQUE_JUMP)

    def answer(self, step: ContactStep, pose: Pose) -> tuple[Screw, Matrix]:
        """Wrench and stiffness of a step on the newest model with the offset and the correction of the drift."""
        wrench, stiffness = step.wrench, step.stiffness_matrix
        if any(wrench):
            wrench, stiffness = added(wrench, self._drift.beyond(self._newest.pose, pose)), self._drift.stiffness(
                stiffness)
        return added(wrench, self.offset), stiffness

    def error(self, step: ContactStep, pose: Pose, age: float) -> tuple[float, float]:
        """Estimated error of the wrench of a step at a pose, and the error by which its status is judged, N.

        Both are errors of the force, or of the torque over the contact radius where that is larger. The first is
        infinite while it is unknown. The second is then only that of the offset, if the tool is within the short
        distance at which a model is trusted without an estimate. Without a force deep in the tissue both are infinite:
        the newest model is then one of a tissue that is deformed more.

        Args:
            step: on the newest model.
            pose: of the tool.
            age: of the model, s.
        """
        is_loaded = any(step.wrench)
        if not (is_loaded or self.is_near_surface(pose)):
            return math.inf, math.inf
        distance = self.distance(self._newest, pose) if is_loaded else 0.0
        offset = self._size(self.offset)
        error = self.estimate.at(distance, age) + offset
        return error, offset if math.isinf(error) and distance <= self.estimate.short else error

    @property
    def _newest(self) -> CondensedContact:
        assert self._stepper.model is not None
        return self._stepper.model


def _shorter(vector: tuple[float, float, float], step: float) -> tuple[float, float, float]:
    size = math.hypot(*vector)
    left = max(0.0, 1.0 - step / size) if size else 0.0
    x, y, z = vector
    return (left * x, left * y, left * z)
