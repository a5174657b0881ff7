"""Simulations of the viewer in other processes: the simulator of the loop, and the model curve.

The model curve is the simulation of the whole test, repeated for the newest model. This module imports little, because
the loop process loads it.
"""

from __future__ import annotations

from concurrent.futures import Future

import tissue_sim as ts
from calibration.tasks.process_pool import ProcessPool
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError, WorkerError
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


class ModelCurveWorker:
    """Computes ``simulate(model)`` for the newest requested model in another process; call `close` at the end.

    Args:
        resolution: Resolution, as in `tissue_sim.simulate`.
        solver: Solver, as in `tissue_sim.simulate`.
        reduced: Reduced model for the solver ``"reduced"``; otherwise None.

    Attributes:
        recording: Curve of the last model that was computed; None before.
        problem: Why the last computed model has no complete curve; empty otherwise.
        number: Number that increases with each result.
    """

    def __init__(self, resolution: str = "fast", solver: str = "axisymmetric",
                 reduced: ts.ReducedModel | None = None):
        self._resolution, self._solver, self._reduced = resolution, solver, reduced
        self._pool = ProcessPool(1)
        self._requested: ts.Model | None = None
        self._computed: Future | None = None
        self._stale = False
        self.recording: ts.Recording | None = None
        self.problem, self.number = "", 0

    @property
    def is_busy(self) -> bool:
        """Whether a requested curve has not been computed yet."""
        return self._computed is not None or self._requested is not None

    def store_curve_request(self, model: ts.Model) -> None:
        """Store a request for the curve of a model, instead of a request that has not started; start no computation."""
        self._requested = model

    def discard_curve_and_requests(self) -> None:
        """Delete the curve and all requests; for use when the kind of test has changed."""
        self.recording, self.problem, self._requested, self.number = None, "", None, self.number + 1
        self._stale = self._computed is not None

    def store_result_and_start_next(self) -> None:
        """Store a finished result, and start the computation of the next request."""
        if self._computed is not None and self._computed.done():
            computed, stale = self._computed, self._stale
            self._computed, self._stale = None, False
            if not stale:
                self._store_computed_curve(computed)
        if self._computed is None and self._requested is not None:
            model, self._requested = self._requested, None
            try:
                self._computed = self._pool.submit(simulate_whole_test,
                                                   (model, self._resolution, self._solver, self._reduced))
            except WorkerError as error:
                self.problem, self.number = str(error), self.number + 1

    def _store_computed_curve(self, computed: Future) -> None:
        """Store the curve of a finished computation, or the reason why it has no complete curve."""
        self.number += 1
        try:
            self.recording, self.problem = computed.result(), ""
        except (ConvergenceError, InputError, MissingBackendError) as error:
            self.recording, self.problem = getattr(error, "recording", None), str(error)
        except self._pool.death:
            self.problem = ("The process that computes the model curve has died. It restarts with the next change of "
                            "the material or the scene.")

    def close(self) -> None:
        """Stop the process, also during a computation."""
        self._pool.abandon_tasks()


def simulate_whole_test(model: ts.Model, resolution: str, solver: str,
                        reduced: ts.ReducedModel | None = None) -> ts.Recording:
    """Simulate the whole test of a model without an error estimate; runs in the worker process."""
    return ts.simulate(model, resolution=resolution, solver=solver, mesh=reduced, estimate_error=False)
