"""Settings of a tool path, and limits of steps in which the mass of the tissue acts.

The limits are unresolved waves, and light tools in an explicit coupling.

**Unresolved waves.** The force has an error by waves that the time steps do not resolve.
The tissue that moves with the tool has the mass m = (k_step - k) dt2, with the stiffness k_step within a step and the
stiffness k without mass. The inertial force of a step is f = d(m v)/dt. Backward differences of second order resolve f
if f changes evenly from step to step. Otherwise a wave begins within the step: an impact, a stop, or nodes that come
into contact. The history of its force within the step is unknown, so that the size of the force is the error there:
the difference between f and its extrapolation of order zero or one, whichever is smaller.

The impulse J = f dt of the wave is known. The wave leaves the contact within a time T and therefore has a force of
about J / T. Under a tool that is small in comparison with the specimen this is a shear wave, T = a / c_s, with the
radius a of the contact and c_s = sqrt(G / rho); between plates it is a pressure wave, T = H / c_p, with the height H
and c_p = sqrt((K + 4/3 G) / rho). T cannot be shorter than a step. The boundaries of the specimen reflect the wave back
to the contact. Waves of different origin add up in energy, not in amplitude. Their energy decays while the mass of the
tissue counts; this decay stands for the damping, which the model does not have.

A tool that is faster than the shear waves (v >= c_s) runs ahead of the deformation. The front before the tool has a
strain of the order v / c_s >= 1, which no mesh of finite elements resolves, so that finer steps do not converge.

Sources: Achenbach, Wave Propagation in Elastic Solids (1973), sections 1.3 and 2.10, for the impulse of a front and
the speeds of waves; Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, sections II.4 and III.7, for
error estimates from differences between steps and from the order with the smallest one.

**Stability of an explicit coupling** between a rigid tool and the tissue: pose in, force out, once per step.
A coupling by hand holds the force of one step during the next one. Tissue that moves with the tool then acts as an
added mass m_a whose force comes one step late. With the backward differences of `tissue_sim.fem.inertia` and steps of
dt, a tool of mass m with semi-implicit Euler steps on a tissue of stiffness k obeys

    m (x[n+1] - 2 x[n] + x[n-1]) = - k dt2 x[n] - m_a (9/4 x[n] - 6 x[n-1] + 11/2 x[n-2] - 2 x[n-3] + 1/4 x[n-4]).

The solution that alternates from step to step, x[n] = (-1)^n, is the first one that grows. Inserting it gives
4 m = k dt2 + 16 m_a. A step answers the stiffness k + (9/4) m_a / dt2, so that

    m > k dt2 / 4 + (16/9) (k_step - k) dt2,

with the largest value of the three translations. Source of the added-mass instability of explicit couplings: Causin,
Gerbeau and Nobile, Comput. Methods Appl. Mech. Eng. 194 (2005) 4506.

`PathSettings` contains the lengths of the parts of a path, linear solves, damping and inertia.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import ClassVar

from tissue_sim.model import Model
from tissue_sim.pose import Screw, Vector, scale_screw
from tissue_sim.settings import require_all_settings_positive
from tissue_sim.tool_force import ERROR_SHARE, Matrix


@dataclass(frozen=True)
class PathSettings:
    """Settings of the division of a path into parts, and of the repetition of failed parts.

    `tissue_sim.realtime.path_following.PathFollowingTissue` uses them.

    Attributes:
        largest_part: largest motion of the tool in one part, as a fraction of the contact radius, 1; a larger motion is
            divided. Smaller parts converge more reliably and take more solves.
        rounding: parts shorter than this fraction of a part are rounding errors and are not computed, 1.
        smallest_cut: fraction of the largest part below which a failed part is not cut again, 1. A smaller value tries
            shorter parts before the tool is stopped.
        straightness: late ticks are merged if their poses are on one line up to this fraction of the largest part, 1. A
            larger value merges more ticks and shortens curved paths.
        most_solves: largest number of linear solves of a part without extrapolation. More solves let difficult parts
            converge; fewer cut them sooner.
        most_extrapolated_solves: largest number of linear solves of a part with extrapolation; a bad extrapolation is
            abandoned sooner than an ordinary start.
        near_residual: relative residual at or below which an extrapolation is near the equilibrium, 1.
        most_near_solves: largest number of linear solves of a part whose extrapolation is near the equilibrium.
        damped_fraction: fraction of the largest part below which a failed part is repeated with artificial damping
            (`Solver.iterate_steps_with_damping`), 1. A larger value starts the damping after fewer cuts.
        most_damped_solves: largest number of linear solves of a damped step.
        free_force: force over the largest force so far at or below which the tool may have lifted off, 1.
        reserved_after: number of times that a static stiffness is postponed before a linear solve is reserved for it. A
            larger number leaves more solves to the equilibrium and makes stiffnesses older.
        inertial_speed: tool speed from which on the mass of the tissue acts, m/s. A lower speed computes the waves of
            slower motions and costs more.
        inertial_time: time after the last fast motion for which the mass of the tissue acts, s. A longer time computes
            waves for longer and costs more.

    Raises:
        InputError: a number is not positive.
    """

    largest_part: float = 0.0625
    rounding: float = 1e-9
    smallest_cut: float = 2.0**-8
    straightness: float = 2.0**-8
    most_solves: int = 30
    most_extrapolated_solves: int = 6
    near_residual: float = 1e-2
    most_near_solves: int = 12
    damped_fraction: float = 0.5
    most_damped_solves: int = 12
    free_force: float = 1e-6
    reserved_after: int = 2
    inertial_speed: float = 0.005
    inertial_time: float = 0.1

    def __post_init__(self) -> None:
        require_all_settings_positive(self)


#: Settings of every simulator.
PATH = PathSettings()


#: Time constant of the decay of reflected waves, s. In elastic tissue, which has no damping, steps of 1 ms and of
#: 0.1 ms still differ by the force of the wave 0.25 s after an impact.
REVERBERATION = 0.3
_AT_REST: Vector = (0.0, 0.0, 0.0)
_STANDS: Screw = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StabilityFactors:
    """Factors of the smallest tool mass of a stable explicit coupling; the derivation is above.

    Attributes:
        added_mass: tool mass over the added mass (k_step - k) dt2 of the tissue, 1.
        stiffness: tool mass over the stiffness of the tissue times dt2, 1.
    """

    added_mass: float = 16.0 / 9.0
    stiffness: float = 0.25


_STABILITY = StabilityFactors()


@dataclass(frozen=True, slots=True)
class ContactWaveTimeAndShearSpeed:
    """Time and speed of the waves under a tool.

    Attributes:
        duration: time in which a wave leaves the contact, s.
        shear_speed: of shear waves, m/s.
        floor: estimated error by waves that never rules out CONVERGED, N: the fraction `ERROR_SHARE` of the force at a
            depth of an eighth of the radius. Waves let the force pass through zero, so that it is no scale of their
            error.
    """

    duration: float
    shear_speed: float
    floor: float

    @classmethod
    def from_model(cls, model: Model, density: float) -> ContactWaveTimeAndShearSpeed:
        """Compute time and speed of the waves in the tissue of a model that has a density, kg/m3."""
        experiment, material = model.experiment, model.material
        shear_modulus = material.mu0
        speed, radius = math.sqrt(shear_modulus / density), experiment.contact_radius
        floor = ERROR_SHARE * shear_modulus * radius * radius
        if not experiment.tool.is_plate:
            return cls(radius / speed, speed, floor)
        pressure_speed = math.sqrt((material.bulk_modulus + 4.0 / 3.0 * shear_modulus) / density)
        return cls(experiment.specimen.height / pressure_speed, speed, floor)


@dataclass(slots=True)
class UnresolvedWaveErrorEstimator:
    """Estimate of the error of the force that is due to waves which the steps do not resolve.

    Attributes:
        force: the estimate at the last equilibrium, N.
        is_supersonic: whether the tool was faster than the shear waves in the last step.
    """

    force: float = 0.0
    is_supersonic: bool = False
    _square: float = 0.0
    _dt: float = math.inf
    _moving_momentum: Vector | None = None
    _inertial: Vector = _AT_REST
    _slope: Vector = _AT_REST
    _velocity: Screw = _STANDS

    def reset_error_at_step_without_mass(self, way: Screw | None, dt: float) -> None:
        """Set the error to zero after a quasi-static step, in which the inertia of the tissue does not act.

        Args:
            way: motion of the tool, which tissue in contact follows, m and rad; None if there is no contact.
            dt: time of the step, s.
        """
        self.force, self._square, self._dt, self.is_supersonic = 0.0, 0.0, math.inf, False
        self._moving_momentum, self._inertial, self._slope = None, _AT_REST, _AT_REST
        self._velocity = scale_screw(1.0 / dt, way) if way is not None and dt > 0.0 else _STANDS

    def register_step_with_mass(self, stiffness: Matrix, step_stiffness: Matrix, way: Screw, dt: float,
                                scale: ContactWaveTimeAndShearSpeed) -> None:
        """Update the error estimate with a step in which the inertia of the tissue acts.

        Args:
            stiffness: stiffness of the tissue without its mass, as in a `ToolForce`.
            step_stiffness: stiffness within the step, with the mass of the tissue, as in a `ToolForce`.
            way: motion of the tool in the step, m and rad.
            dt: time of the step, s.
            scale: time and speed of the waves under the tool.
        """
        momentum = _compute_momentum_from_stiffnesses(stiffness, step_stiffness, way, dt)
        before = self._moving_momentum
        if before is None:
            before = _compute_momentum_from_stiffnesses(stiffness, step_stiffness, scale_screw(dt, self._velocity), dt)
        inertial = _compute_rate_of_change(momentum, before, dt)
        slope = _compute_rate_of_change(inertial, self._inertial, dt)
        # A force of a step that was shorter has lasted for the time of that step only.
        lasts = min(dt, self._dt)
        change = lasts * min(math.hypot(*slope), math.dist(slope, self._slope))
        self._moving_momentum, self._inertial, self._slope, self._dt = momentum, inertial, slope, dt
        impulse = change * lasts
        self._square = self._square * math.exp(-2.0 * dt / REVERBERATION) + impulse * impulse
        self.force = max(change, math.sqrt(self._square) / max(scale.duration, dt))
        self.is_supersonic = math.hypot(*way[:3]) >= scale.shear_speed * dt


def _compute_momentum_from_stiffnesses(stiffness: Matrix, step_stiffness: Matrix, way: Screw, dt: float) -> Vector:
    """Compute the momentum of the tissue that moves with the tool, N s, along the three axes, from the stiffnesses."""
    u, v, w, a, b, c = way
    momentum = [0.0, 0.0, 0.0]
    for axis in range(3):
        k, s = stiffness[axis], step_stiffness[axis]
        if k is not s:
            momentum[axis] = dt * ((s[0] - k[0]) * u + (s[1] - k[1]) * v + (s[2] - k[2]) * w
                                   + (s[3] - k[3]) * a + (s[4] - k[4]) * b + (s[5] - k[5]) * c)
    return momentum[0], momentum[1], momentum[2]


def _compute_rate_of_change(now: Vector, before: Vector, dt: float) -> Vector:
    """Return the change of a vector per time."""
    return (now[0] - before[0]) / dt, (now[1] - before[1]) / dt, (now[2] - before[2]) / dt


def minimum_stable_tool_mass(stiffness: Matrix, step_stiffness: Matrix | None, dt: float) -> float:
    """Smallest tool mass, kg, of a stable explicit coupling.

    The diagonal entries of the three translations are used, as for a tool that moves along an axis of the scene.

    Args:
        stiffness: of the tissue without its mass, N/m.
        step_stiffness: within the step, with the mass of the tissue; None if the mass takes no part.
        dt: step, s.
    """
    (kx, _, _, _, _, _), (_, ky, _, _, _, _), (_, _, kz, _, _, _), *_ = stiffness
    if step_stiffness is None:
        return _STABILITY.stiffness * dt * dt * max(kx, ky, kz, 0.0)
    (sx, _, _, _, _, _), (_, sy, _, _, _, _), (_, _, sz, _, _, _), *_ = step_stiffness
    added_mass = _STABILITY.added_mass
    own = _STABILITY.stiffness - added_mass
    return dt * dt * max(own * kx + added_mass * sx, own * ky + added_mass * sy, own * kz + added_mass * sz, 0.0)


class LightToolWarning(UserWarning):
    """A tool that is coupled explicitly is too light for the tissue that moves with it."""


def issue_light_tool_warning(least_mass: float, *, looks_ahead: bool) -> None:
    """Warn that the tool reverses its motion in every step (`LightToolWarning`), with the remedies.

    Args:
        least_mass: `ToolForce.least_tool_mass` of the last step, kg.
        looks_ahead: whether the simulator predicts the force of the next step, so that the coupling may be implicit.
    """
    remedies = ("Use a smaller step, check that the coupling has the mass of the tool" if looks_ahead
                else "Use looks_ahead=True with an implicit coupling")
    warnings.warn(LightToolWarning(
        f"the tool reverses its motion in every step, as a tool lighter than {1e3 * least_mass:.2g} g does if coupled "
        f"by pose and force. {remedies}, use inertia='off', or a heavier tool; see docs/realtime.md."), stacklevel=2)


@dataclass(slots=True)
class ToolReversalDetector:
    """Detector of motions of the tool that the time steps do not resolve.

    Backward differences resolve the acceleration of a motion only if it takes several steps to reverse. A tool that is
    coupled explicitly and too light reverses in every step (see above), which is an artefact of the coupling. With
    ``inertia="auto"`` the mass of the tissue is ignored for such a motion.

    Attributes:
        quiet: time since the last oscillation of the tool, s.
    """

    #: The tool oscillates if its motion reverses in this many successive steps.
    MOST_TURNS: ClassVar[int] = 3
    quiet: float = math.inf
    _turns: int = 0
    _x: float = 0.0
    _y: float = 0.0
    _z: float = 0.0

    def register_translation_and_detect_oscillation(self, x: float, y: float, z: float, dt: float,
                                                    is_fast: bool) -> None:
        """Register the motion of the tool in a step; set `quiet` to 0 after `MOST_TURNS` successive reversals.

        Args:
            x: translation of the tool in this step along x, m.
            y: translation of the tool in this step along y, m.
            z: translation of the tool in this step along z, m.
            dt: duration of the step, s.
            is_fast: whether the motion is fast enough to count as a reversal.
        """
        self.quiet += dt
        turns = is_fast and x * self._x + y * self._y + z * self._z < 0.0
        self._turns = self._turns + 1 if turns else 0
        self._x, self._y, self._z = x, y, z
        if self._turns >= self.MOST_TURNS:
            self.quiet = 0.0
