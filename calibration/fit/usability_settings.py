"""Limits of the usability rule, see `calibration.fit.usability`."""

from __future__ import annotations

from dataclasses import dataclass

from calibration.statistics.statistics import NOISE_RATIOS
from tissue_sim.errors import InputError
from tissue_sim.settings import require_all_settings_positive


@dataclass(frozen=True)
class UsabilitySettings:
    """Limits of the clauses of the usability rule; a fit is usable if all clauses hold.

    Attributes:
        largest_residual: largest root mean square residual of a test, relative to its largest force. A smaller value
            rejects laws whose error is below the scatter between specimens.
        smallest_R2: smallest fraction of the variance of the force (of the displacement if the force is controlled)
            that a law must explain in each test, over the samples in which the controlled quantity moves. A larger
            value rejects laws that describe measured tissue; docs/calibration.md compares the limit with measured data.
        noise_ratio: residuals below this many times the noise fail no clause on residuals. A larger value accepts a
            misfit in recordings with little noise.
        start_samples: number of samples whose mean is the force at the start of a recording.
        start_fraction: a force against the load at the start counts above this fraction of the range of the force ...
        start_noise: ... and above this many times the noise; the remedy of a misfit is then the zero of the load cell.
            A force that exceeds that at the start by more is a clear rise, before which the tool may be in the air.

    Raises:
        InputError: a limit is not positive, or `smallest_R2` is 1 or more.
    """

    largest_residual: float = 0.10
    smallest_R2: float = 0.95
    noise_ratio: float = NOISE_RATIOS.model_error
    start_samples: int = 3
    start_fraction: float = 0.02
    start_noise: float = 5.0

    def __post_init__(self) -> None:
        require_all_settings_positive(self)
        if not self.smallest_R2 < 1:
            raise InputError(f"smallest_R2 must be below 1; got {self.smallest_R2:g}", field="smallest_R2")


#: Default limits of the usability rule.
USABILITY = UsabilitySettings()
