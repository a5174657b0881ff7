"""Continuous wrench at a change of the model, and estimated error of the force on the newest model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from haptics.loop.broyden_correction import BroydenCorrection
from haptics.loop.linearisation_error import LinearisationError
from tissue_sim.fem.condensed.model import CondensedContact
from tissue_sim.fem.condensed.stepper import CondensedStepper, ContactStep
from tissue_sim.pose import Pose, Screw, add_screws, motion, scale_screw
from tissue_sim.tool_force import Matrix


@dataclass(frozen=True)
class TransitionSettings:
    """Largest changes of the wrench in a tick that a change of model may cause; smaller values take more ticks.

    Attributes:
        force_step: largest change of the force, N.
        torque_step: largest change of the torque, N m.
    """

    force_step: float = 0.01
    torque_step: float = 0.001


#: Settings of every transition.
TRANSITION = TransitionSettings()
_NO_WRENCH: Screw = (0.0,) * 6


class ModelTransition:
    """Keep the wrench continuous when a model of the bulk arrives, and learn from the difference of the models.

    A model of another material is used at once, as in a `Simulator`, because the parameters also change in one step.

    Args:
        stepper: solver of the contact with the newest model.
        shear_modulus: shear modulus of the tissue, Pa.

    Attributes:
        offset: remaining difference of the models so far, N and N m, which is added to the wrench.
        estimate: estimated error of the force on a model.
        free: last pose of the tool without contact force, near the surface or above it.
    """

    def __init__(self, stepper: CondensedStepper, shear_modulus: float):
        self._stepper, radius = stepper, stepper.surface.radius
        self._correction, self.estimate = BroydenCorrection(radius), LinearisationError(radius, shear_modulus)
        self.reset(stepper.surface.start)

    def reset(self, pose: Pose) -> None:
        """Restart with undeformed tissue and zero offset; `pose` is the pose of the next touch."""
        self.offset: Screw = _NO_WRENCH
        self.free = pose
        self._correction.reset()
        self.estimate.forget()

    def distance(self, model: CondensedContact, pose: Pose) -> float:
        """Return the distance of a pose from the pose of a model, m.

        A model without contact describes the undeformed tissue and is valid at each pose in the air. Its distance is
        measured from the last pose in the air, or from its own pose if this is in the air and nearer.
        """
        distance = self._stepper.distance(motion(model.pose, pose))
        if model.has_contact:
            return distance
        from_air = self._stepper.distance(motion(self.free, pose))
        return min(distance, from_air) if self.is_near_surface(model.pose) else from_air

    def is_near_surface(self, pose: Pose) -> bool:
        """Return whether a pose is above the undeformed surface, or at most `LinearisationError.short` below.

        The tolerance is necessary because a round tool between surface nodes touches them slightly below the surface.
        """
        return pose.position[2] >= self._stepper.surface.start.position[2] - self.estimate.short

    def take_over(self, before: ContactStep, old: CondensedContact, last: Pose, pose: Pose, after: ContactStep) -> None:
        """Continue the wrench of the old model; the difference to the new model becomes an offset.

        Args:
            before: last step on the old model.
            old: the old model.
            last: pose of the last step.
            pose: present pose of the tool.
            after: step at this pose on the new model.
        """
        new, correction = self._newest, self._correction
        if new.material != old.material:
            self.settle()
            return
        slope = np.array(before.stiffness_matrix) @ np.array(motion(last, pose))
        extrapolated = cast("Screw", tuple((np.array(before.wrench) - slope).tolist()))
        missed, expected = add_screws(after.wrench, scale_screw(-1.0, extrapolated)), correction.wrench(old.pose, pose)
        if any(after.wrench):
            correction.learn(missed, old.pose, new.pose)
            self.learn(add_screws(expected, scale_screw(-1.0, missed)), old, last)
        else:
            correction.reset()
        for part in (expected, scale_screw(-1.0, missed), scale_screw(-1.0, correction.wrench(new.pose, pose))):
            self.offset = add_screws(self.offset, part)

    def learn(self, missed: Screw, old: CondensedContact, pose: Pose) -> None:
        """Update the error estimate with the difference of the newest model and the model before.

        Models of undeformed tissue and models of different materials do not change the estimate.

        Args:
            missed: difference of the wrenches at `pose`, N and N m.
            old: the model before.
            pose: pose of the tool.
        """
        new = self._newest
        if new.has_contact and new.material == old.material:
            self.estimate.learn(self._size(missed), self.distance(old, pose), self.distance(old, new.pose), new.time,
                                new.time - old.time, self.distance(new, pose))

    def _size(self, wrench: Screw) -> float:
        """Return the force of a wrench, or its torque divided by the contact radius if larger, N."""
        return max(math.hypot(*wrench[:3]), math.hypot(*wrench[3:]) / self._stepper.surface.radius)

    def settle(self) -> None:
        """Use the wrench of the newest model without offset and correction."""
        self.offset = _NO_WRENCH
        self._correction.reset()

    def reduce_offset(self) -> None:
        """Reduce the offset by at most one step of `TransitionSettings`."""
        if any(self.offset):
            force, torque = self.offset[:3], self.offset[3:]
            self.offset = _shorten(force, TRANSITION.force_step) + _shorten(torque, TRANSITION.torque_step)

    def answer(self, step: ContactStep, pose: Pose) -> tuple[Screw, Matrix]:
        """Return wrench and stiffness of a step on the newest model with offset and Broyden correction."""
        wrench, stiffness = step.wrench, step.stiffness_matrix
        if any(wrench):
            wrench = add_screws(wrench, self._correction.wrench(self._newest.pose, pose))
            stiffness = self._correction.corrected_stiffness(stiffness)
        return add_screws(wrench, self.offset), stiffness

    def error(self, step: ContactStep, pose: Pose, age: float) -> tuple[float, float]:
        """Return the estimated error of the wrench of a step, and the error that decides its status, N.

        Both are errors of the force, or of the torque divided by the contact radius if larger. The first is infinite
        while the error is unknown. The second then consists of the offset only, if the tool is within the short
        distance in which a model is trusted without an estimate. If the tool is deep in the tissue without a force,
        both are infinite, because the newest model then describes a more deformed tissue.

        Args:
            step: step on the newest model.
            pose: pose of the tool.
            age: age of the model, s.
        """
        is_loaded = any(step.wrench)
        if not (is_loaded or self.is_near_surface(pose)):
            return math.inf, math.inf
        distance = self.distance(self._newest, pose) if is_loaded else 0.0
        offset = self._size(self.offset)
        depth = self._stepper.surface.start.position[2] - pose.position[2]
        error = self.estimate.at(distance, age, depth, self._tangent_distance) + offset
        return error, offset if math.isinf(error) and distance <= self.estimate.short else error

    @property
    def _tangent_distance(self) -> float:
        """Distance of the newest model from the pose at which its tangent was assembled, m; 0 without contact.

        A tangent that was assembled in the air is that of the pose of the touch.
        """
        model = self._newest
        if not model.has_contact:
            return 0.0
        distance = self._stepper.distance(motion(model.tangent_pose, model.pose))
        if self.is_near_surface(model.tangent_pose):
            distance = min(distance, self._stepper.distance(motion(self.free, model.pose)))
        return distance

    @property
    def _newest(self) -> CondensedContact:
        assert self._stepper.model is not None
        return self._stepper.model


def _shorten(vector: tuple[float, float, float], step: float) -> tuple[float, float, float]:
    """Shorten a vector by this length, at most to zero."""
    size = math.hypot(*vector)
    factor = max(0.0, 1.0 - step / size) if size else 0.0
    x, y, z = vector
    return (factor * x, factor * y, factor * z)
