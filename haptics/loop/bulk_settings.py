"""Settings of the process that linearises the bulk of a multirate simulation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BulkCommunicationSettings:
    """Communication with the process of a bulk.

    Attributes:
        piece: bytes of a model that are read in one tick. A larger piece delivers the model earlier and takes more of
            the tick.
        end_timeout: time that the process has to end before it is killed, s.
        longest_exchange: longest wall time that `BulkLink.send_state_and_wait_for_model` blocks, s.
        polling_interval: polling interval of `BulkLink.send_state_and_wait_for_model`, s. A longer interval uses less
            CPU time and delays the model.
        resend_interval: time after which `BulkLink.send_state_and_wait_for_model` sends the state again, s, so that a
            bulk without a linearisation tries again.
        idle_sleep: sleep of the process when no new state is available, s. A longer sleep uses less CPU time and
            delays the model.
        surface_interval: time between two publications of the surface, s. A longer interval uses less CPU time.
        niceness: increment of the niceness of the process, so that the loop has priority on computers with few cores.
    """

    piece: int = 1 << 16
    end_timeout: float = 5.0
    longest_exchange: float = 60.0
    polling_interval: float = 0.2e-3
    resend_interval: float = 0.05
    idle_sleep: float = 0.5e-3
    surface_interval: float = 0.05
    niceness: int = 5


#: Settings of every process of a bulk.
BULK_PROCESS = BulkCommunicationSettings()
