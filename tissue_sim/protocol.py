"""The motion of the tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError, require_length


@dataclass(frozen=True, eq=False)
class Protocol:
    """True tool displacement against time: straight lines between its points.

    The motion of a measured recording is what the rig reported: take its contact offset off first,
    ``Protocol(recording.time, recording.displacement - offset)``.

    Attributes:
        time: s, strictly increasing, shape (n,).
        displacement: m, positive into the tissue, shape (n,). Below zero a bonded plate pulls.
    """

    time: np.ndarray
    displacement: np.ndarray

    def __post_init__(self):
        for name in ("time", "displacement"):
            array = np.array(getattr(self, name), dtype=float)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.time.ndim != 1 or self.time.shape != self.displacement.shape or self.time.size == 0:
            raise InputError(f"time {self.time.shape} and displacement {self.displacement.shape} must be two lists of "
                             "the same length", field="protocol")
        if not (np.isfinite(self.time).all() and np.isfinite(self.displacement).all()):
            raise InputError("time and displacement must be finite", field="protocol")
        if (np.diff(self.time) <= 0).any():
            raise InputError("time must increase from point to point", field="protocol.time")

    @classmethod
    def ramp(cls, depth: float, points: int = 21, speed: float = 0.248e-3) -> Protocol:
        """A ramp to `depth` (m) at `speed` (m/s), `points` samples with rest included; the study's speed by default."""
        require_length(depth, "protocol.depth")
        require_length(speed, "protocol.speed")
        if points < 2:
            raise InputError(f"{points} points cannot make a ramp; give at least 2", field="protocol.points")
        displacement = np.linspace(0.0, depth, points)
        return cls(displacement / speed, displacement)

    @property
    def depth(self) -> float:
        """Largest displacement, m."""
        return float(self.displacement.max())
