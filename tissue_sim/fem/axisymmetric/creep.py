"""Pseudo-transient continuation with artificial viscous damping, for snap-through and abrupt changes of contact.

Each step solves R(u) + c V (u - u_0) = 0, where R is the residual of the equilibrium, V the nodal volumes, u_0 the
state of the last step and c the damping. A large c keeps u close to u_0, so that Newton's iteration converges. The
damping is reduced from step to step, and the last step has none. Friction follows the path of the damped motion.

Source: Kelley and Keyes, SIAM J. Numer. Anal. 35 (1998) 508.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from tissue_sim.fem.axisymmetric.equations import EquilibriumEquations
from tissue_sim.fem.axisymmetric.predictor import compute_extrapolation_weights
from tissue_sim.fem.axisymmetric.state import SavedState, SolverState
from tissue_sim.fem.solver import Step, StepStatus


@dataclass(frozen=True)
class PseudoTransientSettings:
    """Settings of the pseudo-transient continuation.

    Damping is given in shear moduli over the squared height of the specimen.

    Attributes:
        first_damping: damping of the first step.
        last_damping: damping below which the next step has none.
        repeated_damping: smallest damping to which the continuation returns after a failure.
        max_reduction: largest ratio of the dampings of two successive steps.
        min_reduction: smallest ratio.
        reduction_growth: factor of the ratio after a step that converges quickly; a failed step halves the ratio.
        quick_solves: number of linear solves up to which a step counts as quick.
        first_increase: factor of the damping after a failure of the first step.
        increase: factor of the damping after a failure of a step whose damping has already converged once.
        max_pause: maximum number of steps with constant damping after a failure. The pause doubles at each failure,
            because tissue that snaps moves a long way during which no smaller damping converges.
        near_residual: relative residual below which a step may use more linear solves; then only points that change
            between stick and slip remain.
        near_factor: factor of the maximum number of linear solves of such a step.
        max_failures: number of successive failures after which the continuation stops.
        max_solves: total number of linear solves after which the continuation stops.
    """

    first_damping: float = 1e4
    last_damping: float = 1.0
    repeated_damping: float = 0.01
    max_reduction: float = 10.0
    min_reduction: float = 1.5
    reduction_growth: float = 1.5
    quick_solves: int = 12
    first_increase: float = 100.0
    increase: float = 10.0
    max_pause: int = 8
    near_residual: float = 1e-2
    near_factor: int = 4
    max_failures: int = 8
    max_solves: int = 1000


#: Settings of every continuation.
_SETTINGS = PseudoTransientSettings()


class DampableSolverProtocol(Protocol):
    """Attributes and methods of a solver that the continuation uses."""

    equations: EquilibriumEquations
    committed: SolverState

    def try_depth_step(self, depth: float, dt: float, tolerance: float, max_iterations: int, predictor_order: int,
                       rate: float, *, resumes: bool = False) -> Step:
        """Try a step with a damping force, `rate` (N/m4) times nodal volume times displacement from rest."""

    def save(self) -> SavedState:
        """Return the committed state."""

    def restore(self, saved: SavedState) -> None:
        """Return to a saved state."""


def iterate_damped_steps(solver: DampableSolverProtocol, depth: float, dt: float, tolerance: float, max_iterations: int,
                         allowed: Callable[[], int] | None = None) -> Generator[Step]:
    """Yield the steps of the continuation to a depth; the last one has converged without damping.

    The first step is damped towards the extrapolated motion of the tissue, the others towards the last state. If the
    continuation fails or is closed early, the solver returns to the state in which it began.

    Args:
        solver: solver with its last committed state.
        depth: depth of the tool, m.
        dt: duration of the first step, s; the others take no time.
        tolerance: relative residual of a converged step.
        max_iterations: maximum number of linear solves in a step.
        allowed: function that returns the number of linear solves until the next yield; None: no limit.

    Yields:
        Steps; `Step.dissipated` is the energy that the damping dissipates, J.
    """
    equations, state = solver.equations, solver.committed
    saved, volumes = solver.save(), equations.compute_dof_volumes()
    masses, rest, density = equations.replace_masses_by_damping_volumes()
    # Unit of the damping: shear modulus over the squared height of the specimen.
    unit = equations.material.mu0 / float(np.ptp(equations.mesh.nodes[:, 1])) ** 2
    working_damping = damping = _SETTINGS.first_damping * unit
    ratio, failures, has_begun, has_arrived = _SETTINGS.max_reduction, 0, False, False
    total_solves, remaining_pause, pause = 0, 0, 1
    try:
        while failures <= _SETTINGS.max_failures and total_solves < _SETTINGS.max_solves:
            if has_begun:
                rest[:] = state.last_committed_solution[: rest.size]
            else:
                weights = compute_extrapolation_weights(state.depths, depth, 1)
                rest[:] = sum(weight * state.history[slot, : rest.size]
                              for weight, slot in zip(weights, state.slots, strict=True))
            origin = rest.copy()
            step_solves, limit, resumes = 0, max_iterations, False
            while True:
                left = limit - step_solves
                most = left if allowed is None else min(left, allowed())
                step = solver.try_depth_step(depth, 0.0 if has_begun else dt, tolerance, most, 0 if has_begun else 1,
                                             damping, resumes=resumes)
                step_solves += max(1, step.iterations)
                if step.status is StepStatus.SLOW and most == left and limit == max_iterations and (
                        step.residual <= _SETTINGS.near_residual):
                    limit = _SETTINGS.near_factor * max_iterations
                elif step.status is not StepStatus.SLOW or most == left:
                    break
                resumes = True
                yield step
            total_solves += step_solves
            if step.status is StepStatus.CONVERGED:
                displacement = state.last_committed_solution[: rest.size] - origin
                has_arrived, has_begun, failures = damping == 0.0, True, 0
                working_damping = max(damping, _SETTINGS.repeated_damping * unit)
                yield replace(step, dissipated=damping * float(volumes @ displacement**2))
                if has_arrived:
                    break
                if step_solves <= _SETTINGS.quick_solves:
                    ratio = min(_SETTINGS.max_reduction, _SETTINGS.reduction_growth * ratio)
                if remaining_pause > 0:
                    remaining_pause -= 1
                else:
                    damping = damping / ratio if damping > _SETTINGS.last_damping * unit else 0.0
            else:
                yield step
                failures += 1
                # A damping that has converged once nearly always converges again from the present state.
                if not has_begun or damping >= working_damping:
                    working_damping = damping * (_SETTINGS.increase if has_begun else _SETTINGS.first_increase)
                else:
                    remaining_pause, pause = pause, min(2 * pause, _SETTINGS.max_pause)
                damping, ratio = working_damping, max(_SETTINGS.min_reduction, 0.5 * ratio)
    finally:
        equations.restore_masses_and_density(masses, density)
        if not has_arrived:
            solver.restore(saved)
    if not has_arrived:
        yield replace(step, status=StepStatus.SLOW if step.status is StepStatus.CONVERGED else step.status,
                      iterations=0)
