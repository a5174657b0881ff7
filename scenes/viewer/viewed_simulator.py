"""Simulator of the viewer's loop. This module imports little, because the loop process loads it."""

from __future__ import annotations

from tissue_sim.realtime.simulator import Simulator

#: Budget of a step over the time of one linear solve, for slow solvers: enough for one solve with its assembly, so that
#: the loop can receive commands after each solve.
_BUDGET_PER_SOLVE = 2.0


class ExtendableBudgetSimulator(Simulator):
    """Simulator that extends its budget if one linear solve takes longer than the budget.

    With the original budget, such a simulator would make no progress in most ticks.
    """

    def warm_up(self) -> None:
        """Compile all functions of a step, and extend the budget to two linear solves if it is shorter than one."""
        super().warm_up()
        if self.budget is not None and self.linear_solve_time > self.budget:
            self.budget = _BUDGET_PER_SOLVE * self.linear_solve_time
