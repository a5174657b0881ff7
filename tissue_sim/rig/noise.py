"""White or coloured noise of a sensor."""

from __future__ import annotations

import numpy as np

from tissue_sim.errors import InputError


def generate_sensor_noise(samples: int, standard_deviation: float, seed: int, *, time: np.ndarray | None = None,
                          correlation_time: float = 0.0) -> np.ndarray:
    """Generate Gaussian noise with autocorrelation exp(-lag / correlation_time), white if that time is 0.

    Coloured noise is the Ornstein-Uhlenbeck process, exact for any spacing of the samples (Gillespie, Phys. Rev. E 54
    (1996) 2084); on a uniform grid it is the autoregressive process AR(1).

    Args:
        samples: number of samples n.
        standard_deviation: of every sample, in the unit of the result.
        seed: the same seed gives the same noise.
        time: s, shape (n,); required with a correlation time.
        correlation_time: s.

    Returns:
        Shape (n,).

    Raises:
        InputError: a correlation time without `time`.
    """
    noise = np.random.default_rng(seed).normal(0.0, standard_deviation, samples)
    if correlation_time:
        if time is None:
            raise InputError("time must be given if correlation_time is above 0; got None.", field="time")
        kept = np.exp(-np.diff(time) / correlation_time)
        fresh = np.sqrt(1.0 - kept**2) * noise[1:]
        for sample, (share, part) in enumerate(zip(kept.tolist(), fresh.tolist(), strict=True), start=1):
            noise[sample] = share * noise[sample - 1] + part
    return noise
