"""Link between a multirate simulation and the slower solver of its bulk."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tissue_sim.fem.condensed.model import CondensedBulk, ContactState, ContactSurface
from tissue_sim.material.material import Material
from tissue_sim.snapshot import Snapshot


class BulkLink(Protocol):
    """Source of linearised models of the bulk. Call `close` at the end."""

    @property
    def contact_surface(self) -> ContactSurface:
        """Contact nodes and tool of the bulk; available after `start`."""

    @property
    def is_alive(self) -> bool:
        """Whether the bulk, or its process, still runs and can send models."""

    def start(self) -> CondensedBulk:
        """Start the bulk, wait until it is ready, and return its model of the undeformed tissue.

        Raises:
            InputError: the solver does not support the model.
            RuntimeError: the process of the bulk ended.
        """

    def send_state(self, state: ContactState) -> None:
        """Send the state of the contact, at which the bulk is linearised next, without waiting for the model."""

    def receive_model(self, now: float) -> CondensedBulk | None:
        """Return a model that has arrived since the last call, or None; does not wait. `now` is the loop's time, s."""

    def send_state_and_wait_for_model(self, state: ContactState) -> CondensedBulk | None:
        """Send a state and block until the next model arrives, which may belong to an earlier state.

        Returns:
            The model; None if none arrives within `BulkCommunicationSettings.longest_exchange` or the bulk has ended.
        """

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk; models of the new material have this `number` in their field `material`."""

    def snapshot(self) -> Snapshot | None:
        """Return a snapshot of the deformed tissue at a recent model; None for a link without snapshots."""

    def close(self) -> None:
        """End the bulk and free its resources."""


def make_untouched_state(surface: ContactSurface) -> ContactState:
    """Return the contact state of undeformed tissue with the tool at its start pose, without contact forces."""
    zeros, count = np.zeros((len(surface.places), 3)), len(surface.places)
    return ContactState(0, 0, 0.0, surface.start, 0.0, surface.start, zeros, zeros, np.zeros((3, count)), False)
