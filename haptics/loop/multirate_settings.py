"""Settings of `MultiRateTissue`, and of the process that linearises its bulk."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MultirateSettings:
    """Exchange of states and models between a `MultiRateTissue` and its bulk.

    The last five fields apply to steps that wait for the bulk. All defaults are choices of this project.

    Attributes:
        oldest: largest age of the model of a CONVERGED force, s. A larger age accepts forces of a slower bulk.
        ticks_between_states: ticks between two states sent to the bulk. A larger number costs less time in the ticks;
            models then belong to older states.
        speed_ticks: ticks over which the speed of the tool is measured. A larger number reduces noise and delays the
            speed.
        touch_depths: depths of the touches in `MultiRateTissue.warm_up`, as fractions of the contact radius.
        recent: largest age of a model in a step that waits, s. A larger age saves exchanges and increases the error.
        near: largest distance of a model in a step that waits, as a fraction of `LinearisationError.short`. A larger
            distance saves exchanges and increases the error.
        max_exchanges: maximum number of exchanges of state and model in a step that waits. A step without convergence
            takes more time with a larger number.
        force_tolerance: tolerance on the change of the force in the last exchange, as a fraction of the force. A
            smaller tolerance requires more exchanges.
        force_floor: absolute tolerance on this change, N. A smaller tolerance requires more exchanges.
    """

    oldest: float = 1.0
    ticks_between_states: int = 4
    speed_ticks: int = 8
    touch_depths: tuple[float, ...] = (0.02, 0.04, 0.05)
    recent: float = 0.01
    near: float = 0.25
    max_exchanges: int = 16
    force_tolerance: float = 0.01
    force_floor: float = 1e-4


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


#: Defaults of every multirate tissue.
MULTIRATE = MultirateSettings()
#: Settings of every process of a bulk.
BULK_PROCESS = BulkCommunicationSettings()
