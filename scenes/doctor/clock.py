"""How well this computer keeps a 1 kHz clock."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack

import numpy as np

from haptics.loop.real_time import PRIORITY, claim_fifo
from scenes.doctor.check import Check

PERIOD = 1e-3  # s
#: Sleep up to this long before the tick and spin the rest: sleeping alone wakes up late.
SPIN = 0.2e-3  # s
LATE, VERY_LATE = 0.1e-3, 1e-3  # s
#: Largest share of very late ticks that a haptic loop can hide.
TOLERATED = 1e-3


def ticks(seconds: float) -> Check:
    """Lateness of the ticks of a 1 kHz clock in this process, under real-time priority where that is allowed."""
    with ExitStack() as undo:
        scheduler = "ordinary priority" if claim_fifo(undo, PRIORITY) else "SCHED_FIFO"
        lateness = measure_lateness(seconds)
    late, very_late = float((lateness > LATE).mean()), float((lateness > VERY_LATE).mean())
    p50, p99, longest = (float(x) for x in np.quantile(lateness, (0.5, 0.99, 1.0)) * 1e6)
    finding = (f"{lateness.size} ticks ({scheduler}): {late:.2%} later than 0.1 ms, {very_late:.2%} later than 1 ms; "
               f"p50 {p50:.2g} us, p99 {p99:.3g} us, max {longest:.3g} us")
    values = {"ticks": lateness.size, "scheduler": scheduler, "later_than_0.1_ms": late, "later_than_1_ms": very_late,
              "p50_us": p50, "p99_us": p99, "max_us": longest}
    if p50 > VERY_LATE * 1e6:
        return Check("1 kHz clock", "fail", finding, "half of the ticks miss their period: close other programs, or "
                     "use a computer with a free core", values)
    if very_late > TOLERATED:
        return Check("1 kHz clock", "warn", finding, "haptic rates will stutter: close other programs, use real-time "
                     "priority and mains power; simulation and calibration are not touched by this", values)
    return Check("1 kHz clock", "ok", finding, values=values)


def measure_lateness(seconds: float) -> np.ndarray:
    """Lateness of each tick in s, shape (number of ticks,).

    The deadlines stand: a tick that is several periods late makes the following ones late too, as in a real loop.
    """
    count = max(1, round(seconds / PERIOD))
    lateness = np.empty(count)
    start = time.perf_counter() + PERIOD
    for tick in range(count):
        deadline = start + tick * PERIOD
        slack = deadline - time.perf_counter()
        if slack > SPIN:
            time.sleep(slack - SPIN)
        now = time.perf_counter()
        while now < deadline:
            now = time.perf_counter()
        lateness[tick] = now - deadline
    return lateness


def real_time_priority() -> Check:
    """Whether this user may ask for SCHED_FIFO."""
    with ExitStack() as undo:
        allowed = not claim_fifo(undo, PRIORITY)
    values = {"allowed": allowed}
    if allowed:
        return Check("real-time priority", "ok", "SCHED_FIFO is allowed", values=values)
    if not hasattr(os, "sched_setscheduler"):
        return Check("real-time priority", "warn", "this platform has no SCHED_FIFO",
                     "nothing to do: the 1 kHz loop runs with ordinary priority and ticks may be late", values)
    return Check("real-time priority", "warn", "SCHED_FIFO is not allowed for this user",
                 "for haptics add 'USER - rtprio 20' to /etc/security/limits.d/rtprio.conf and log in again "
                 "(in a container: --cap-add=SYS_NICE)", values)
