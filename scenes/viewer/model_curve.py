"""Curves of whole tests, computed in another process: the newest request counts."""

from __future__ import annotations

from concurrent.futures import Future

import tissue_sim as ts
from calibration.tasks.errors import WorkerError
from calibration.tasks.process_pool import ProcessPool
from tissue_sim.errors import ConvergenceError, InputError, MissingBackendError


class ModelCurve:
    """Computes `simulate(model)` again and again as the model changes. Close it.

    Args:
        resolution, solver: as in `simulate`. reduced: what the solver ``"reduced"`` steps.

    Attributes:
        recording: of the last model that was computed; None before.
        problem: why the newest model has no curve; empty where it has, or will have.
        number: grows with each answer.
    """

    def __init__(self, resolution: str = "fast", solver: str = "axisymmetric",
                 reduced: ts.ReducedModel | None = None):
        self._resolution, self._solver, self._reduced = resolution, solver, reduced
        self._pool = ProcessPool(1)
        self._wanted: ts.Model | None = None
        self._computed: Future | None = None
        self._stale = False
        self.recording: ts.Recording | None = None
        self.problem, self.number = "", 0

    @property
    def busy(self) -> bool:
        """Whether the newest request is still to be computed."""
        return self._computed is not None or self._wanted is not None

    def ask(self, model: ts.Model) -> None:
        """Ask for the curve of a model, in place of an earlier request that has not begun."""
        self._wanted = model

    def forget(self) -> None:
        """Drop the curve: what was computed belongs to another test."""
        self.recording, self.problem, self._wanted, self.number = None, "", None, self.number + 1
        self._stale = self._computed is not None

    def poll(self) -> None:
        """Take an answer, and begin with the next request."""
        if self._computed is not None and self._computed.done():
            computed, stale = self._computed, self._stale
            self._computed, self._stale = None, False
            if not stale:
                self._take(computed)
        if self._computed is None and self._wanted is not None:
            wanted, self._wanted = self._wanted, None
            try:
                self._computed = self._pool.submit(simulate_test, (wanted, self._resolution, self._solver,
                                                                      self._reduced))
            except WorkerError as error:
                self.problem, self.number = str(error), self.number + 1

    def _take(self, computed: Future) -> None:
        self.number += 1
        try:
            self.recording, self.problem = computed.result(), ""
        except (ConvergenceError, InputError, MissingBackendError) as error:
            self.recording, self.problem = getattr(error, "recording", None), str(error)
        except self._pool.death:
            self.problem = "the process that computes the curve has died; it begins anew with the next change"

    def close(self) -> None:
        """End the process, whatever it does."""
        self._pool.stop()


def simulate_test(model: ts.Model, resolution: str, solver: str,
                  reduced: ts.ReducedModel | None = None) -> ts.Recording:
    """The whole test, in the worker."""
    return ts.simulate(model, resolution=resolution, solver=solver, mesh=reduced, estimate_error=False)
