"""Measure how late the ticks of a 1 kHz clock are on this computer."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from haptics.loop.real_time import request_fifo_scheduling_and_get_refusal
from scenes.doctor.check import CheckResult


@dataclass(frozen=True)
class ClockCheckSettings:
    """Settings of the clock measurement.

    Attributes:
        period: time between two ticks, s.
        spin: time before a tick from which the process polls the clock instead of sleeping, s. A sleeping process wakes
            up late by less than this time.
        late: lateness from which a tick counts as late, s.
        very_late: lateness from which a tick counts as very late, s: a whole period is missed.
        tolerated: largest fraction of very late ticks that is not noticeable in a haptic loop, 1.
    """

    period: float = 1e-3
    spin: float = 0.2e-3
    late: float = 0.1e-3
    very_late: float = 1e-3
    tolerated: float = 1e-3


#: Settings of every measurement.
_SETTINGS = ClockCheckSettings()


def check_clock_lateness(seconds: float) -> CheckResult:
    """Measure the lateness of the ticks of a 1 kHz clock in this process, with real-time priority if allowed.

    Args:
        seconds: duration of the measurement, s.
    """
    with ExitStack() as undo:
        scheduler = "ordinary priority" if request_fifo_scheduling_and_get_refusal(undo) else "SCHED_FIFO"
        lateness = measure_lateness_of_each_tick(seconds)
    late, very_late = (
        float((lateness > limit).mean()) for limit in (_SETTINGS.late, _SETTINGS.very_late))
    p50, p99, longest = (float(x) for x in np.quantile(lateness, (0.5, 0.99, 1.0)) * 1e6)
    finding = (f"{lateness.size} ticks ({scheduler}): {late:.2%} later than 0.1 ms, {very_late:.2%} later than 1 ms; "
               f"p50 {p50:.2g} us, p99 {p99:.3g} us, max {longest:.3g} us")
    values = {"ticks": lateness.size, "scheduler": scheduler, "later_than_0.1_ms": late, "later_than_1_ms": very_late,
              "p50_us": p50, "p99_us": p99, "max_us": longest}
    if p50 > _SETTINGS.very_late * 1e6:
        return CheckResult("1 kHz clock", "fail", finding, "more than half of the ticks miss their period: close other "
                           "programs, or use a computer with a free core", values)
    if very_late > _SETTINGS.tolerated:
        return CheckResult("1 kHz clock", "warn", finding, "haptic loops will miss ticks: close other programs, use "
                           "real-time priority and mains power; simulation and calibration are not affected", values)
    return CheckResult("1 kHz clock", "ok", finding, values=values)


def measure_lateness_of_each_tick(seconds: float) -> np.ndarray:
    """Measure the lateness of each tick.

    The deadlines are fixed in advance: a tick that is several periods late also delays the following ticks, as in a
    real loop.

    Args:
        seconds: duration of the measurement, s.

    Returns:
        Lateness, s, shape (number of ticks,).
    """
    period, spin = _SETTINGS.period, _SETTINGS.spin
    count = max(1, round(seconds / period))
    lateness = np.empty(count)
    start = time.perf_counter() + period
    for tick in range(count):
        deadline = start + tick * period
        slack = deadline - time.perf_counter()
        if slack > spin:
            time.sleep(slack - spin)
        now = time.perf_counter()
        while now < deadline:
            now = time.perf_counter()
        lateness[tick] = now - deadline
    return lateness


def check_real_time_priority() -> CheckResult:
    """Check whether this user may use the real-time scheduler SCHED_FIFO."""
    with ExitStack() as undo:
        allowed = not request_fifo_scheduling_and_get_refusal(undo)
    values = {"allowed": allowed}
    if allowed:
        return CheckResult("real-time priority", "ok", "SCHED_FIFO is allowed", values=values)
    if not hasattr(os, "sched_setscheduler"):
        return CheckResult("real-time priority", "warn", "this platform has no SCHED_FIFO",
                           "no action is possible: the 1 kHz loop runs with ordinary priority, and ticks may be late",
                           values)
    return CheckResult("real-time priority", "warn", "SCHED_FIFO is not allowed for this user",
                       "for haptics add 'USER - rtprio 20' to /etc/security/limits.d/rtprio.conf and log in again "
                       "(in a container: --cap-add=SYS_NICE)", values)
