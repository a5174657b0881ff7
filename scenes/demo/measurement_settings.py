"""Settings of the virtual measurements of the demonstrations."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VirtualReplicateAndErrorSettings:
    """Number of recordings of a virtual test, and the errors of the virtual rig.

    Attributes:
        replicates: recordings of each test.
        samples: samples of each recording.
        force_noise: standard deviation of the force sensor, N.
        contact_jitter: standard deviation of the contact point between recordings, m.
        zero_jitter: standard deviation of the zero of the sensor between recordings, N.
    """

    replicates: int
    samples: int
    force_noise: float
    contact_jitter: float = 0.0
    zero_jitter: float = 0.0
