"""The rig: what stands between the tissue and the numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording import Recording


@dataclass(frozen=True)
class Rig:
    """Effects of the load frame and the sensor on a recording. `Rig()` is ideal.

    Attributes:
        contact_offset: reported displacement at which the tool truly touches, m; the protocol of a model is the true
            motion, and this is added to what is reported of it.
        zero_offset: reading of the sensor without load, N.
        force_noise: standard deviation of white noise on every force sample, N.
        seed: seed of that noise; the same seed gives the same recording.
    """

    contact_offset: float = 0.0
    zero_offset: float = 0.0
    force_noise: float = 0.0
    seed: int = 0

    def __post_init__(self):
        for name in ("contact_offset", "zero_offset", "force_noise"):
            if not np.isfinite(getattr(self, name)):
                raise InputError(f"{getattr(self, name)} is not a finite number", field=f"rig.{name}")
        if self.force_noise < 0:
            raise InputError(f"{self.force_noise:g} N is negative; give a standard deviation", field="rig.force_noise")

    @property
    def ideal(self) -> bool:
        return self == replace(Rig(), seed=self.seed)

    def measure(self, recording: Recording) -> Recording:
        """What this rig reports of a true recording; an ideal rig returns it unchanged."""
        if self.ideal:
            return recording
        noise = np.random.default_rng(self.seed).normal(0.0, self.force_noise, recording.force.shape)
        return recording.with_channels(displacement=recording.displacement + self.contact_offset,
                                       force=recording.force + self.zero_offset + noise)
