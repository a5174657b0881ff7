"""Settings of the Newton solver of a solid, of its settlement under self-weight, and of its linearisation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SolidNewtonSettings:
    """Settings of Newton's method in `SolidSolver`.

    Attributes:
        max_halvings: largest number of bisections of an increment that turns an element inside out.
        all_points_iterations: number of linear solves after which only a subset of the nodes may change their contact
            state at once, so that the active set does not cycle.
        min_reference_force: smallest reference force of the relative residual, over the largest load so far, 1. A
            larger value tolerates larger residuals at small forces.
        rest_motion: motion of the tool over the size of the mesh below which the tool is at rest, 1.
        friction_floor: friction over the smallest reference force below which friction is ignored, 1.
    """

    max_halvings: int = 4
    all_points_iterations: int = 8
    min_reference_force: float = 0.1
    rest_motion: float = 1e-14
    friction_floor: float = 1e-6


@dataclass(frozen=True)
class SettlingSettings:
    """Settings of the load steps by which a specimen comes into equilibrium under its weight.

    Attributes:
        smallest_part: smallest part of the weight that is applied in one step, 1. A smaller value tries smaller steps
            before the specimen counts as unstable.
        height_width: distance of the neighbours of the logarithm of the height, 1; the half width of the difference is
            ten times this distance.
    """

    smallest_part: float = 2.0**-6
    height_width: float = 1e-6


@dataclass(frozen=True)
class LinearisationSettings:
    """Settings of the linearisation of a solid for multirate simulation.

    Attributes:
        more: number of condensed nodes over the number of published nodes with Pardiso, whose cost hardly depends on
            this ratio.
        needed: fraction of the nearest nodes that must be condensed; otherwise other nodes are chosen, which requires
            a new symbolic analysis.
        fractions: fractions of a step that are tried in turn if it turns elements inside out, 1.
        old_fractions: the same with an earlier tangent, which would overshoot where the tissue has become more than
            twice as stiff, 1.
        rounding: length of a step over that of the displacement below which the step is zero, 1.
    """

    more: int = 3
    needed: float = 0.6
    fractions: tuple[float, ...] = (1.0, 0.5, 0.25)
    old_fractions: tuple[float, ...] = (0.8, 0.4, 0.2)
    rounding: float = 1e-5


#: Settings of every solid.
NEWTON = SolidNewtonSettings()
#: Settings of every specimen with self-weight.
SETTLING = SettlingSettings()
