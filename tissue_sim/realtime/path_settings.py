"""Settings of the simulation of a tool path: lengths of its parts, linear solves, damping and inertia."""

from __future__ import annotations

from dataclasses import dataclass

from tissue_sim.settings import require_all_settings_positive


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
