"""Settings of `MultiRateTissue`."""

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
        near: largest distance of a model in a step that waits, as a fraction of `LinearisationErrorEstimator.short`. A
            larger distance saves exchanges and increases the error.
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


#: Defaults of every multirate tissue.
MULTIRATE = MultirateSettings()
