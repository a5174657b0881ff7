"""From one equilibrium to the next where the tissue snaps, or where contact finds no state: it creeps there.

Against a drag on every node, as in a viscous fluid, each step is as close to the one before as the drag is large, so
that there is a solution near by; the drag is let go from step to step, and the last one has none. Pseudo-transient
continuation (Kelley and Keyes, SIAM J. Numer. Anal. 35 (1998) 508), with the friction of the way that is gone.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace
from typing import Protocol

import numpy as np

from tissue_sim.fem.axisymmetric.equations import Equations
from tissue_sim.fem.axisymmetric.predictor import extrapolation
from tissue_sim.fem.axisymmetric.state import SavedState, State
from tissue_sim.fem.solver import Step, StepStatus

#: Drag per volume at first, below which it is let go, and which it has again after that, in shear moduli over the
#: squared height of the specimen.
_FIRST, _LAST, _AGAIN = 1e4, 1.0, 0.01
#: How much smaller each drag is than the one before, at most and at least.
_LARGEST_RATIO, _SMALLEST_RATIO = 10.0, 1.5
#: That ratio grows by this after a step of so few linear solves, and is halved after one that fails.
_BOLDER, _FEW = 1.5, 12
#: Where the first step fails its drag grows by this, and where one fails that has worked before by the other.
_HARDER, _STIFFER = 100.0, 10.0
#: After a failure it stays as it is for a step, and for twice as many each time that letting go fails again, up to so
#: many: what snaps moves a long way, and as long as it does no smaller drag holds it.
_LONGEST_STAY = 8
#: A step whose unbalanced forces, over balanced ones, are down to this goes on to so many times its linear solves: what
#: is left is points that stick or slip.
_NEAR, _LONGER = 1e-2, 4
#: Failures in a row, and linear solves in all, after which there is no way.
_MOST_FAILURES, _MOST_SOLVES = 8, 1000


class Dragged(Protocol):
    """What `creep` needs of a solver."""

    equations: Equations
    committed: State

    def try_step(self, depth: float, dt: float, tolerance: float, max_iterations: int, predictor_order: int,
                 rate: float, *, resumes: bool = False) -> Step:
        """A step in which `rate`, N/m4, times its volume draws each freedom to where it rests."""

    def save(self) -> SavedState:
        """All that a committed step leaves behind."""

    def restore(self, saved: SavedState) -> None:
        """Go back to where `save` was called."""


def creep(solver: Dragged, depth: float, dt: float, tolerance: float, max_iterations: int,
          allowed: Callable[[], int] | None = None) -> Generator[Step]:
    """Steps to a depth, m, in a time dt, s; the last one has converged without drag, or the state is as it was.

    The first one is dragged along with the extrapolated motion of the tissue, the others are dragged from where the
    one before ended. `Step.dissipated` is what the drag takes. Who closes this on the way is back where it began.
    """
    equations, state = solver.equations, solver.committed
    saved, volumes = solver.save(), equations.all_masses()
    masses, rest, density = equations.begin_drag()
    # What the whole specimen feels.
    unit = equations.material.mu0 / float(np.ptp(equations.mesh.nodes[:, 1])) ** 2
    works = drag = _FIRST * unit
    ratio, failures, begun, arrived = _LARGEST_RATIO, 0, False, False
    solved, stay, stays = 0, 0, 1
    try:
        while failures <= _MOST_FAILURES and solved < _MOST_SOLVES:
            if begun:
                rest[:] = state.latest[: rest.size]
            else:
                weights = extrapolation(state.depths, depth, 1)
                rest[:] = sum(weight * state.history[slot, : rest.size]
                              for weight, slot in zip(weights, state.slots, strict=True))
            origin = rest.copy()
            spent, limit, resumes = 0, max_iterations, False
            while True:
                left = limit - spent
                most = left if allowed is None else min(left, allowed())
                step = solver.try_step(depth, 0.0 if begun else dt, tolerance, most, 0 if begun else 1, drag,
                                       resumes=resumes)
                spent += max(1, step.iterations)
                if step.status is StepStatus.SLOW and most == left and limit == max_iterations and (
                        step.residual <= _NEAR):
                    limit = _LONGER * max_iterations
                elif step.status is not StepStatus.SLOW or most == left:
                    break
                resumes = True
                yield step
            solved += spent
            if step.status is StepStatus.CONVERGED:
                way = state.latest[: rest.size] - origin
                arrived, begun, works, failures = drag == 0.0, True, max(drag, _AGAIN * unit), 0
                yield replace(step, dissipated=drag * float(volumes @ way**2))
                if arrived:
                    break
                if spent <= _FEW:
                    ratio = min(_LARGEST_RATIO, _BOLDER * ratio)
                if stay > 0:
                    stay -= 1
                else:
                    drag = drag / ratio if drag > _LAST * unit else 0.0
            else:
                yield step
                failures += 1
                # What has worked does so again from where the tissue is now, nearly always.
                if not begun or drag >= works:
                    works = drag * (_STIFFER if begun else _HARDER)
                else:
                    stay, stays = stays, min(2 * stays, _LONGEST_STAY)
                drag, ratio = works, max(_SMALLEST_RATIO, 0.5 * ratio)
    finally:
        equations.end_drag(masses, density)
        if not arrived:
            solver.restore(saved)
    if not arrived:
        yield replace(step, status=StepStatus.SLOW if step.status is StepStatus.CONVERGED else step.status,
                      iterations=0)
