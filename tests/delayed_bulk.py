"""Bulk of a multirate simulation with a simulated delay; the same run gives the same forces on any computer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from tissue_sim.fem.condensed.model import BulkLineariser, CondensedBulk, ContactState
from tissue_sim.fem.condensed.predictive_linearisation import PREDICTION, PredictiveLineariser
from tissue_sim.material.material import Material
from tissue_sim.realtime.multirate import make_untouched_state
from tissue_sim.snapshot import Snapshot


class DelayedBulkLink:
    """Bulk in this process whose models arrive after a fixed simulated delay, so that forces are reproducible.

    Args:
        linearisation: linearisation of the bulk.
        delay: time from the state of a model to the tick that receives the model, s.
        tangent: time from the state of a tangent to the first model with this tangent, s; None: each model has a new
            tangent.

    Attributes:
        linearising: CPU time spent on models, s.
    """

    is_alive = True

    def __init__(self, linearisation: BulkLineariser, delay: float, tangent: float | None = None):
        self._bulk, self.contact_surface, self._delay, self._epoch = linearisation, linearisation.surface, delay, 0
        self._predictive, self._now = PredictiveLineariser(linearisation), 0.0
        self._tangent = tangent
        if tangent is not None:
            linearisation.executor = self._compute_tangent_and_get_finish_check
        self.linearising = 0.0
        self._coming: tuple[float, CondensedBulk | None] | None = None

    def _compute_tangent_and_get_finish_check(self, compute: Callable[[], None]) -> Callable[[], bool]:
        """Compute a tangent now, and return a function that returns True once the tangent's delay is over.

        After a reset the tangent belongs to a discarded specimen and is reported as finished at once.
        """
        assert self._tangent is not None
        compute()
        due, epoch = self._now + self._tangent, self._epoch
        return lambda: self._epoch != epoch or self._now >= due - 1e-9

    def start(self) -> CondensedBulk:
        """Compute and return the model of the undeformed tissue.

        Raises:
            RuntimeError: the undeformed tissue has no linearisation.
        """
        model = self._predictive.linearise_at_predicted_pose_or_none(make_untouched_state(self.contact_surface), 0.0,
                                                                     0.0)
        if model is None:
            raise RuntimeError("the bulk must have a linearisation of the undeformed tissue; the solver returned none")
        return model

    def send_state(self, state: ContactState) -> None:
        """Linearise the bulk at a state, unless a model is in transit; the model arrives after the delay."""
        if state.epoch != self._epoch:
            # A model in transit belongs to the specimen before the reset.
            self._epoch, self._coming = state.epoch, None
        if self._coming is None:
            began, self._now = time.process_time(), state.time
            serves = 2.0 * (self._delay if self._tangent is None else self._tangent)
            model = self._predictive.linearise_at_predicted_pose_or_none(state, PREDICTION.lead_factor * self._delay,
                                                                         serves)
            self._coming = state.time + self._delay, model
            self.linearising += time.process_time() - began

    def receive_model(self, now: float) -> CondensedBulk | None:
        """Return the model in transit if it has arrived at the time `now`, s, otherwise None."""
        if self._coming is None or now < self._coming[0] - 1e-9:
            return None
        model, self._coming = self._coming[1], None
        return model

    def send_state_and_wait_for_model(self, state: ContactState) -> CondensedBulk | None:
        """Return a model at once: of an earlier state whose model was not yet received, otherwise of this state."""
        self.send_state(state)
        return self.receive_model(math.inf)

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk; later models have this `number` in their field `material`."""
        self._predictive.set_material(material, number)

    def snapshot(self) -> Snapshot | None:
        """Return None: this link has no snapshots."""
        return None

    def close(self) -> None:
        """Do nothing: the bulk is part of this process."""
        return
