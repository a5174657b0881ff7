"""Change of the model of a bulk: continuous wrench, learned correction of the stiffness, and estimated error.

The force error of a linearised bulk is learned from the differences of successive models.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from tissue_sim.fem.condensed.model import CondensedBulk
from tissue_sim.fem.condensed.stepper import CondensedStepper, ContactStepResult
from tissue_sim.pose import (
    Pose,
    Screw,
    add_screws,
    compute_pose_distance,
    compute_rigid_motion,
    scale_screw,
    shorten_screw,
)
from tissue_sim.tool_force import Matrix


@dataclass(frozen=True)
class LinearisationErrorSettings:
    """Settings of the error estimate, chosen by this project.

    Attributes:
        short: distance from the pose of a model, as a fraction of the contact radius, within which a model is trusted
            before an error estimate exists. A larger distance gives more forces the status CONVERGED without an
            estimate.
        memory: fraction of the estimate that is kept when the next model comes. A larger fraction keeps large
            estimates for more models.
        validity: the estimate is valid up to this many times the distance between the two models from which it was
            learned. A larger factor trusts a longer extrapolation.
        first_step: factor on the difference of two models if the second is the first one with contact or of a new
            material, which covers a Newton step that reduces the error by a third instead of a half.
    """

    short: float = 0.1
    memory: float = 0.8
    validity: float = 3.0
    first_step: float = 2.0


#: Settings of every error estimate.
ERROR_ESTIMATE = LinearisationErrorSettings()


class LinearisationErrorEstimator:
    """Estimator of the force error on a linearised bulk: ``base * max(1, age / (2 interval)) + growth * distance**2``.

    The first term is the error of the newest model at its own pose. Models follow each other by single Newton steps, so
    that the newest one is not yet in equilibrium. If each step reduces the error at least by half, the error that is
    left is at most the difference `base` of the last two models at the pose of the tool. Tissue that relaxes changes by
    this difference in the time `interval` between the two models. Models are used until they are one to two intervals
    old, so the term grows in proportion to the age of a model that is older.

    The second term is the error by linearisation. Two models at the distances d1 and d2 from the pose of the tool have
    the errors growth d1**2 and growth d2**2, of the same sign while the tool moves on. Their difference divided by
    d1**2 - d2**2 gives `growth` (Richardson's extrapolation). It describes the tissue between the poses of
    the two models, so the estimate is valid up to `LinearisationErrorSettings.validity` times the distance between
    these poses. Beyond, and before two models of the deformed tissue have come, the error is unknown, except that of a
    force of zero below the undeformed surface. Two models of the undeformed tissue are equal; their difference contains
    no information and must not be passed to `update_estimate`.

    The tangent of a model may have been assembled at an earlier pose, at a distance D from that of the model. The
    stiffness of the model is then wrong by 2 growth D, and its force by 2 growth D distance more.

    Two models can agree at one pose by chance. `growth` is therefore never below the curvature of a contact: under a
    ball of radius R at depth d it is 2 mu sqrt(R / d) (second derivative of Hertz's force, halved). The depth is that
    of the tool, and at least its distance from the pose of the model. Where the depth is unknown, the limit is mu.

    A tool that a model leaves without a force may still touch tissue that rises faster than the model knows. The force
    of this contact is at most that on undeformed tissue. It is estimated by that of a flat punch with the radius a of
    the contact at the depth of the tool on a half space, 8 mu a depth. Under a ball it is 1.5 times Hertz's force; this
    leaves a margin for a thin specimen.

    Args:
        radius: radius of the contact, m.
        shear_modulus: shear modulus of the tissue, Pa.
        tip_radius: radius of curvature of the tool, m; None, or below `radius`: `radius`.
        contact_radius_at_depth: radius of the contact, m, as a function of the depth of the tool, m; None: `radius`.

    Attributes:
        radius: radius of the contact, m.
        base: error of the newest model at its own pose, N.
        interval: time between the last two models, s.
        growth: learned error divided by the square of the distance, N/m2.
        shear_modulus: shear modulus of the tissue, Pa.
        reach: distance between the models from which `growth` was learned, m.
        time: time of the newest model from which the estimate was learned, s; minus infinity if there is none.
        short: `LinearisationErrorSettings.short` times the radius, m.
        tip_radius: radius of curvature of the tool, m.
    """

    def __init__(self, radius: float, shear_modulus: float = 0.0, tip_radius: float | None = None,
                 contact_radius_at_depth: Callable[[float], float] | None = None):
        self.tip_radius, self._contact_radius_at_depth = max(radius, tip_radius or 0.0), contact_radius_at_depth
        self.radius, self.short, self.shear_modulus = radius, ERROR_ESTIMATE.short * radius, shear_modulus
        self.discard_estimate()

    def discard_estimate(self) -> None:
        """Discard the estimate: the error is unknown until the next call of `update_estimate`."""
        self.growth, self.reach, self.time = 0.0, 0.0, -math.inf
        self.base, self.interval = 0.0, 0.0

    def set_shear_modulus(self, shear_modulus: float) -> None:
        """Set the shear modulus, Pa; multiply the estimate by new / old modulus if the tissue becomes stiffer."""
        factor = max(1.0, shear_modulus / self.shear_modulus) if self.shear_modulus > 0.0 else 1.0
        self.base, self.growth, self.shear_modulus = factor * self.base, factor * self.growth, shear_modulus

    def update_estimate(self, missed: float, distance: float, between: float, time: float, interval: float = 0.0,
                        newer: float = 0.0, *, from_rest: bool = False) -> None:
        """Update the estimate with the difference of two successive models.

        Args:
            missed: difference of the forces of the two models at the pose of the tool, N.
            distance: distance of the tool from the pose of the first model, m.
            between: distance between the poses of the two models, m.
            time: time of the second model, s.
            interval: time between the two models, s.
            newer: distance of the tool from the pose of the second model, m.
            from_rest: whether the first model is of the undeformed tissue. The Newton step from there is long, and does
                not always halve the error; see `LinearisationErrorSettings.first_step`.
        """
        # Models of nearly the same pose contain no information on larger distances: they may only raise the estimate.
        memory = ERROR_ESTIMATE.memory if between >= self.short else 1.0
        squares = max(distance**2 - newer**2, self.short**2)
        self.growth = max(memory * self.growth, missed / squares)
        self.reach, self.time = max(memory * self.reach, between), time
        self.base, self.interval = (ERROR_ESTIMATE.first_step if from_rest else 1.0) * missed, interval

    def set_error_of_first_model_of_material(self, missed: float, time: float) -> None:
        """Set the error of the first model of a new material, which is one Newton step from the state of the old one.

        Args:
            missed: difference of its force from that of the model of the old material, N.
            time: time of the model, s.
        """
        self.base, self.time = ERROR_ESTIMATE.first_step * missed, time

    def _compute_growth_coefficient(self, distance: float, depth: float | None) -> float:
        """Return `growth`, N/m2, raised at least to a contact's curvature; arguments as `estimate_force_error`."""
        if depth is None:
            return max(self.growth, self.shear_modulus)
        reached = min(max(depth, distance), self.radius)
        if reached <= 0.0:
            return self.growth
        return max(self.growth, 2.0 * self.shear_modulus * math.sqrt(self.tip_radius / reached))

    def is_error_known_at_distance(self, distance: float) -> bool:
        """Return whether an estimate exists and is valid at this distance, m, from the pose of a model."""
        return math.isfinite(self.time) and distance <= max(self.short, ERROR_ESTIMATE.validity * self.reach)

    def estimate_force_error(self, distance: float, age: float = 0.0, depth: float | None = None,
                             tangent: float = 0.0) -> float:
        """Return the estimated error of the force, N; infinite if it is unknown.

        Args:
            distance: distance of the tool from the pose of the model, m.
            age: age of the model, s.
            depth: depth of the tool below the undeformed surface, m; None: unknown.
            tangent: distance of the pose of the model from the pose at which its tangent was assembled, m.
        """
        if not self.is_error_known_at_distance(distance):
            return math.inf
        age_factor = max(1.0, age / (2.0 * self.interval)) if self.interval > 0.0 else 1.0
        growth = self._compute_growth_coefficient(distance, depth)
        return self.base * age_factor + growth * distance * (distance + 2.0 * tangent)

    def estimate_error_of_zero_force(self, distance: float, age: float, depth: float, tangent: float) -> float:
        """Return the estimated force error, N, where the model gives zero force; infinite if it is unknown.

        The error by linearisation is at most the force on undeformed tissue, and zero above the undeformed surface.
        Below this surface the error is that force also before models were compared, when `time` is minus infinity.
        Arguments as in `estimate_force_error`.
        """
        of_model = self.estimate_force_error(0.0, age)
        if depth <= 0.0:
            return of_model
        reached = self.radius if self._contact_radius_at_depth is None else self._contact_radius_at_depth(depth)
        largest = 8.0 * self.shear_modulus * min(reached, self.radius) * depth
        return min(largest + (of_model if math.isfinite(of_model) else 0.0),
                   self.estimate_force_error(distance, age, depth, tangent))


@dataclass(frozen=True)
class OffsetStepLimits:
    """Largest reduction of the offset per tick after a change of the model; smaller values take more ticks.

    Attributes:
        force_step: largest change of the force, N.
        torque_step: largest change of the torque, N m.
    """

    force_step: float = 0.01
    torque_step: float = 0.001


@dataclass(frozen=True)
class BroydenSettings:
    """Settings of the secant update, chosen by this project.

    Attributes:
        relaxation: relaxation factor of the update. About half of a difference belongs to motions that are not
            repeated; a larger factor learns faster and follows these motions more.
        min_motion: shortest motion from which the correction is learned, as a fraction of the contact radius. A smaller
            motion amplifies the errors of the models.
    """

    relaxation: float = 0.5
    min_motion: float = 0.01


#: Settings of every transition.
TRANSITION = OffsetStepLimits()
#: Settings of every correction.
BROYDEN = BroydenSettings()
_NO_WRENCH: Screw = (0.0,) * 6


class BroydenCorrection:
    """Correction of the stiffness that linearised models omit, by relaxed secant updates.

    The update for a motion s with the difference of wrenches y is R += c (y - R s) s^T W^2 / (s^T W^2 s) with the
    relaxation factor c and the weights W of `radius` (Broyden, Math. Comp. 19 (1965) 577).

    Args:
        radius: radius of the contact, m, which converts rotations to displacements.

    Attributes:
        rates: derivative R of the omitted wrench with respect to the motion of the tool, N/m, N, N m, shape (6, 6).
    """

    def __init__(self, radius: float):
        self._scale = np.array([1.0, 1.0, 1.0, radius, radius, radius])
        self._min_square = (BROYDEN.min_motion * radius) ** 2
        self.rates = np.zeros((6, 6))

    def reset(self) -> None:
        """Set all rates to zero, so that the correction no longer changes wrench and stiffness."""
        self.rates[:] = 0.0

    def apply_secant_update(self, missed: Screw, last: Pose, pose: Pose) -> None:
        """Update the rates with the difference of two models, unless the motion between them is too short.

        Args:
            missed: wrench of the new model minus that of the last model, N and N m.
            last: pose of the last model.
            pose: pose of the new model.
        """
        step = np.array(compute_rigid_motion(last, pose))
        scaled = self._scale * step
        square = float(scaled @ scaled)
        if square > self._min_square:
            residual = np.array(missed) - self.rates @ step
            self.rates += BROYDEN.relaxation / square * np.outer(residual, self._scale * scaled)

    def reduce_for_new_tangent(self, before: float, after: float, between: float) -> None:
        """Reduce the rates when a model has a new tangent, which includes a part of the stiffness that they describe.

        The stiffness that a tangent omits grows in proportion to the distance from its pose. The rates were learned at
        the distance of a model from its tangent plus half of the motion between two models.

        Args:
            before: distance between the poses of the old model and of its tangent, m.
            after: distance between the poses of the new model and of its tangent, m.
            between: distance between the poses of the two models, m.
        """
        if after < before:
            self.rates *= (after + 0.5 * between) / (before + 0.5 * between)

    def compute_omitted_wrench(self, model: Pose, pose: Pose) -> Screw:
        """Return the wrench to add to that of a model at another pose, N and N m: the rates times the motion.

        Args:
            model: pose of the model.
            pose: pose of the tool.
        """
        return cast("Screw", tuple((self.rates @ np.array(compute_rigid_motion(model, pose))).tolist()))

    def subtract_correction_from_stiffness(self, of_model: Matrix) -> Matrix:
        """Return the stiffness `of_model` of a model minus the learned rates: N/m, N, N m, shape (6, 6)."""
        return cast("Matrix", tuple(map(tuple, (np.array(of_model) - self.rates).tolist())))


class ModelTransition:
    """Keep the wrench continuous when a model of the bulk arrives, and learn from the difference of the models.

    A model of another material is used at once, as in a `Simulator`, because the parameters also change in one step.
    Friction stores the path of the tool, so that an error at a distance from the pose of a model remains while the tool
    returns: the estimated error of a model does not decrease until the tool lifts off or the next model arrives.

    Args:
        stepper: solver of the contact with the newest model.
        shear_modulus: shear modulus of the tissue, Pa.
        tip_radius: radius of curvature of the tool, m; None: the radius of the contact.
        contact_radius_at_depth: radius of the contact, m, as a function of the depth of the tool, m; None: the radius
            of the contact of the surface.

    Attributes:
        offset: remaining difference of the models so far, N and N m, which is added to the wrench.
        estimate: estimated error of the force on a model.
        free: last pose of the tool without contact force, near the surface or above it.
    """

    def __init__(self, stepper: CondensedStepper, shear_modulus: float, tip_radius: float | None = None,
                 contact_radius_at_depth: Callable[[float], float] | None = None):
        self._stepper, self._radius = stepper, stepper.surface.radius
        self._correction = BroydenCorrection(self._radius)
        self.estimate = LinearisationErrorEstimator(self._radius, shear_modulus, tip_radius, contact_radius_at_depth)
        self._has_friction = bool(np.any(stepper.surface.friction > 0.0))
        self.reset(stepper.surface.start)

    def reset(self, pose: Pose) -> None:
        """Set offset and correction to zero and discard the error estimate; `pose` is the last pose without contact."""
        self.offset: Screw = _NO_WRENCH
        self.free = pose
        self._correction.reset()
        self._largest_error = 0.0
        self.estimate.discard_estimate()

    def compute_distance_from_model(self, model: CondensedBulk, pose: Pose) -> float:
        """Return the distance, m, that the tool's surface moves at most from the pose of a model to a pose.

        A model without contact describes the undeformed tissue and is valid at each pose in the air. Its distance is
        measured from the last pose in the air, or from its own pose if this is in the air and nearer. A pose without a
        force below the undeformed surface, in a dent, is moved up to the surface.
        """
        distance = compute_pose_distance(model.pose, pose, self._radius)
        if model.has_contact:
            return distance
        from_air = compute_pose_distance(self._raise_to_surface(self.free), pose, self._radius)
        return min(distance, from_air) if self.is_above_or_just_below_surface(model.pose) else from_air

    def _raise_to_surface(self, pose: Pose) -> Pose:
        """Return a pose, moved up to the undeformed surface if it is below."""
        (x, y, z), height = pose.position, self._stepper.surface.start.position[2]
        return pose if z >= height else Pose((x, y, height), pose.orientation)

    def is_above_or_just_below_surface(self, pose: Pose) -> bool:
        """Return whether a pose is at any height above the undeformed surface, or at most `short` below.

        The tolerance is necessary because a round tool between surface nodes touches them slightly below the surface.
        """
        return pose.position[2] >= self._stepper.surface.start.position[2] - self.estimate.short

    def update_for_new_model(self, before: ContactStepResult, old: CondensedBulk, last: Pose, pose: Pose,
                             after: ContactStepResult) -> None:
        """Add the jump of the wrench at the change of the model to the offset; update correction and error estimate.

        If one of the two steps did not converge, offset and correction are zero afterwards, and the error is unknown.

        Args:
            before: last step on the old model.
            old: the old model.
            last: pose of the last step.
            pose: present pose of the tool.
            after: step at this pose on the new model.
        """
        new, correction = self._newest_model, self._correction
        self._largest_error = 0.0
        if not (before.converged and after.converged):
            # The wrench of a step that did not converge says nothing about the difference of the models.
            self.clear_offset_and_correction()
            self.estimate.discard_estimate()
            return
        slope = np.array(before.stiffness_matrix) @ np.array(compute_rigid_motion(last, pose))
        extrapolated = cast("Screw", tuple((np.array(before.wrench) - slope).tolist()))
        missed = add_screws(after.wrench, scale_screw(-1.0, extrapolated))
        if new.material != old.material:
            self.clear_offset_and_correction()
            if any(after.wrench):
                self.estimate.set_error_of_first_model_of_material(self._compute_max_equivalent_force(missed), new.time)
            return
        expected = correction.compute_omitted_wrench(old.pose, pose)
        if any(after.wrench) and new.has_contact:
            correction.apply_secant_update(missed, old.pose, new.pose)
            if new.tangent_pose != old.tangent_pose:
                correction.reduce_for_new_tangent(self._compute_distance_from_tangent_pose(old),
                                                  self._compute_distance_from_tangent_pose(new),
                                                  compute_pose_distance(old.pose, new.pose, self._radius))
            self.update_error_estimate(add_screws(expected, scale_screw(-1.0, missed)), old, last)
        else:
            correction.reset()
        omitted = correction.compute_omitted_wrench(new.pose, pose)
        for part in (expected, scale_screw(-1.0, missed), scale_screw(-1.0, omitted)):
            self.offset = add_screws(self.offset, part)

    def update_error_estimate(self, missed: Screw, old: CondensedBulk, pose: Pose) -> None:
        """Update the error estimate with the difference of the newest model and the model before.

        Models of undeformed tissue and models of different materials do not change the estimate.

        Args:
            missed: difference of the wrenches at `pose`, N and N m.
            old: the model before.
            pose: pose of the tool.
        """
        new = self._newest_model
        if new.has_contact and new.material == old.material:
            self.estimate.update_estimate(
                self._compute_max_equivalent_force(missed), self.compute_distance_from_model(old, pose),
                self.compute_distance_from_model(old, new.pose), new.time, new.time - old.time,
                self.compute_distance_from_model(new, pose), from_rest=not old.has_contact)

    def _compute_max_equivalent_force(self, wrench: Screw) -> float:
        """Return the larger of two magnitudes of a wrench, N: its force, and its torque / contact radius."""
        return max(math.hypot(*wrench[:3]), math.hypot(*wrench[3:]) / self._radius)

    def clear_offset_and_correction(self) -> None:
        """Set offset, correction and stored error to zero, so that the wrench of the newest model is used unchanged."""
        self.offset, self._largest_error = _NO_WRENCH, 0.0
        self._correction.reset()

    def reduce_offset(self) -> None:
        """Reduce the offset by one tick: its force and its torque by at most the steps of `OffsetStepLimits`."""
        self.offset = shorten_screw(self.offset, TRANSITION.force_step, TRANSITION.torque_step)

    def compute_wrench_and_stiffness(self, step: ContactStepResult, pose: Pose) -> tuple[Screw, Matrix]:
        """Return wrench, N and N m, plus correction and offset, and corrected stiffness, shape (6, 6), of a step."""
        wrench, stiffness = step.wrench, step.stiffness_matrix
        if any(wrench):
            wrench = add_screws(wrench, self._correction.compute_omitted_wrench(self._newest_model.pose, pose))
            stiffness = self._correction.subtract_correction_from_stiffness(stiffness)
        return add_screws(wrench, self.offset), stiffness

    def estimate_error_and_status_error(self, step: ContactStepResult, pose: Pose, age: float) -> tuple[float, float]:
        """Return two errors, N: the estimated error of a step's wrench, and the error that decides its status.

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
        if not (is_loaded or self.is_above_or_just_below_surface(pose)):
            return math.inf, math.inf
        newest, estimate = self._newest_model, self.estimate
        distance = self.compute_distance_from_model(newest, pose) if is_loaded or newest.has_contact else 0.0
        offset = self._compute_max_equivalent_force(self.offset)
        depth = self._stepper.surface.start.position[2] - pose.position[2]
        evaluate = estimate.estimate_force_error if is_loaded else estimate.estimate_error_of_zero_force
        error = evaluate(distance, age, depth, self._compute_distance_from_tangent_pose(newest))
        if self._has_friction:
            error = self._largest_error = max(error, self._largest_error if is_loaded else 0.0)
        error += offset
        is_trusted = not is_loaded or distance <= estimate.short
        return error, offset if math.isinf(error) and is_trusted else error

    def _compute_distance_from_tangent_pose(self, model: CondensedBulk) -> float:
        """Return the distance, m, of the pose of a model from that of its tangent; 0 without contact.

        A tangent that was assembled in the air is that of the pose of the touch.
        """
        if not model.has_contact:
            return 0.0
        distance = compute_pose_distance(model.tangent_pose, model.pose, self._radius)
        if self.is_above_or_just_below_surface(model.tangent_pose):
            from_air = compute_pose_distance(self._raise_to_surface(self.free), model.pose, self._radius)
            distance = min(distance, from_air)
        return distance

    @property
    def _newest_model(self) -> CondensedBulk:
        """Model that the contact solver uses now."""
        assert self._stepper.model is not None
        return self._stepper.model
