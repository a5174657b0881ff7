"""Stability of an explicit coupling between a rigid tool and the tissue: pose in, force out, once per step.

A coupling by hand holds the force of one step during the next one. Tissue that moves with the tool then acts as an
added mass m_a whose force comes one step late. With the backward differences of `tissue_sim.fem.inertia` and steps of
dt, a tool of mass m with semi-implicit Euler steps on a tissue of stiffness k obeys

    m (x[n+1] - 2 x[n] + x[n-1]) = - k dt2 x[n] - m_a (9/4 x[n] - 6 x[n-1] + 11/2 x[n-2] - 2 x[n-3] + 1/4 x[n-4]).

The solution that alternates from step to step, x[n] = (-1)^n, is the first one that grows. Inserting it gives
4 m = k dt2 + 16 m_a. A step answers the stiffness k + (9/4) m_a / dt2, so that

    m > k dt2 / 4 + (16/9) (k_step - k) dt2,

with the largest value of the three translations. Source of the added-mass instability of explicit couplings: Causin,
Gerbeau and Nobile, Comput. Methods Appl. Mech. Eng. 194 (2005) 4506.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from tissue_sim.tool_force import Matrix


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


def issue_light_tool_warning(least_mass: float) -> None:
    """Warn that the tool reverses its motion in every step (`LightToolWarning`).

    The remedies in the warning are an implicit coupling with looks_ahead=True, inertia='off', or a heavier tool.

    Args:
        least_mass: `ToolForce.least_tool_mass` of the last step, kg.
    """
    warnings.warn(LightToolWarning(
        f"the tool reverses its motion in every step, as a tool lighter than {1e3 * least_mass:.2g} g does if coupled "
        "by pose and force. Use looks_ahead=True with an implicit coupling, inertia='off', or a heavier tool; see "
        "docs/realtime.md."), stacklevel=2)


class ToolReversalDetector:
    """Detector of motions of the tool that the time steps do not resolve.

    Backward differences resolve the acceleration of a motion only if it takes several steps to reverse. A tool that is
    coupled explicitly and too light reverses in every step (see above), which is an artefact of the coupling. With
    ``inertia="auto"`` the mass of the tissue is ignored for such a motion.
    """

    #: The tool oscillates if its motion reverses in this many successive steps.
    MOST_TURNS = 3
    __slots__ = ("_turns", "_x", "_y", "_z", "quiet")

    def __init__(self) -> None:
        #: Time since the last oscillation of the tool, s.
        self.quiet = float("inf")
        self._turns, self._x, self._y, self._z = 0, 0.0, 0.0, 0.0

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

    def copy(self) -> ToolReversalDetector:
        """Return an independent copy, for saved states."""
        other = ToolReversalDetector()
        other.quiet, other._turns = self.quiet, self._turns
        other._x, other._y, other._z = self._x, self._y, self._z
        return other
