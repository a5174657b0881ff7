"""Estimated force error of a linearised bulk, learned from the differences of successive models."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


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
