"""The simulator of the loop that a page looks at. Imports little: the process of the loop imports it."""

from __future__ import annotations

from tissue_sim.simulator import Simulator

#: Times of a linear solve that a tick of a slow solver gets: for one and what belongs to it, so that the loop listens
#: between two of them.
_SLOW_SOLVES = 2.0


class ViewedSimulator(Simulator):
    """A simulator that somebody looks at: where a linear solve takes longer than its budget, it gets `_SLOW_SOLVES`
    times as long, since it would do nothing in most ticks."""

    def warm_up(self) -> None:
        super().warm_up()
        if self.budget is not None and self.solve_time > self.budget:
            self.budget = _SLOW_SOLVES * self.solve_time
