"""Late and missed ticks of a loop, counted from its ring, for `worker` and `processes`."""

from contextlib import suppress
from pathlib import Path

import numpy as np

import tissue_sim as ts
from haptics.loop.ring import RingReader

#: The whole test, m and m/s, and what is played again and again meanwhile.
SPEED = 20e-3
TEST = ts.Protocol.ramp(depth=8e-3, points=81)
MOTION = "ramp 8mm @20mm/s; unload @20mm/s"
#: Depth of a tool at rest, m.
STANDING = 4e-3
#: Time before a run, s.
SETTLING = 1.2


class TickCount:
    """Counter of ticks, started at its construction."""

    def __init__(self, ring: RingReader):
        self._ring, self._number, self._before = ring, ring.written_count, ring.latest()

    def records(self) -> np.ndarray:
        """Return the ticks that the ring still holds, dtype `haptics.loop.ring.TICK`."""
        return self._ring.read_ticks_after(self._number).records

    def counted(self) -> dict:
        """Return fractions of missed deadlines and late ticks, and quantiles in us."""
        now, before, records = self._ring.latest(), self._before, self.records()
        deadlines, missed, late = (int(now[name]) - int(before[name]) for name in ("tick", "missed", "late"))
        lateness, taken = 1e6 * records["lateness"], 1e6 * records["compute_time"]
        return {"deadlines": deadlines, "missed_percent": 100 * missed / deadlines,
                "late_percent": 100 * late / (deadlines - missed), "lateness_us_p50": float(np.median(lateness)),
                "lateness_us_p99": float(np.quantile(lateness, 0.99)), "compute_us_p50": float(np.median(taken)),
                "compute_us_p99": float(np.quantile(taken, 0.99))}


def peak_memory(pid: int) -> float | None:
    """Return the peak memory of a process, MB; None if the system does not report it."""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    return None
