"""Periodic clock with fixed deadlines, statistics of its delays, and real-time features of the operating system.

A message states each feature that the operating system refuses.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import IntFlag
from itertools import accumulate

from tissue_sim.errors import InputError

#: SCHED_FIFO priority (1 to 99): above all ordinary processes, below the threads of the kernel.
PRIORITY = 10
#: Set the timer slack of a thread (Linux, prctl.h).
_PR_SET_TIMERSLACK = 29


class MemoryLockFlags(IntFlag):
    """Flags of the system call ``mlockall``, which keeps pages of this process in memory (Linux, mman.h)."""

    #: Lock present pages in memory.
    CURRENT = 1
    #: Lock future pages in memory.
    FUTURE = 2
    #: Lock pages at their first use, because Taichi reserves much more memory than it uses.
    ON_FAULT = 4


@dataclass(frozen=True)
class RealTimeFeature:
    """Feature of the operating system or of Python that reduces delays of a loop.

    Attributes:
        name: ``SCHED_FIFO``, ``locked memory``, ``timer slack`` or ``no garbage collection``.
        obtained: whether the feature is active.
        message: reason and remedy if it is not active.
    """

    name: str
    obtained: bool
    message: str = ""


@contextmanager
def request_real_time_features(wanted: bool = True) -> Iterator[tuple[RealTimeFeature, ...]]:
    """Request real-time features for this thread and process inside a ``with`` block; release them at its end.

    Call it after memory is allocated and kernels are compiled. A refused feature raises no exception; the yielded
    features state it.

    Args:
        wanted: whether features are requested; if not, no features are yielded.

    Yields:
        The features, obtained or refused.
    """
    if not wanted:
        yield ()
        return
    with ExitStack() as undo:
        features = []
        for name, claim in _FEATURES.items():
            reason = claim(undo)
            features.append(RealTimeFeature(name, not reason, f"{name}: {reason}" if reason else ""))
        yield tuple(features)


def request_fifo_scheduling_and_get_refusal(undo: ExitStack) -> str:
    """Request SCHED_FIFO scheduling until `undo` is closed; return the reason of a refusal, or an empty string."""
    if not hasattr(os, "sched_setscheduler"):
        return f"not available on {sys.platform}; other processes may delay ticks"
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        return (f"{error.strerror}; 'ulimit -r' shows the highest allowed priority: add 'USER - rtprio 20' to "
                "/etc/security/limits.d/rtprio.conf and log in again (in a container: --cap-add=SYS_NICE)")
    undo.callback(os.sched_setscheduler, 0, *before)
    return ""


def _lock_memory_and_get_refusal(undo: ExitStack) -> str:
    """Lock used pages in memory until `undo` is closed; return the reason of a refusal, or an empty string."""
    if not sys.platform.startswith("linux"):
        return f"not available on {sys.platform}; swapping of memory may delay the loop"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MemoryLockFlags.CURRENT | MemoryLockFlags.FUTURE | MemoryLockFlags.ON_FAULT) != 0:
        return (f"{os.strerror(ctypes.get_errno())}; 'ulimit -l' shows how many kB may be locked: add 'USER - memlock "
                "unlimited' to /etc/security/limits.d/memlock.conf and log in again (in a container: --ulimit "
                "memlock=-1)")
    undo.callback(libc.munlockall)
    return ""


def _reduce_timer_slack_and_get_refusal(undo: ExitStack) -> str:
    """Reduce this thread's timer slack to 1 ns until `undo` is closed; return the reason of a refusal, or ``""``."""
    if not sys.platform.startswith("linux"):
        return f"not available on {sys.platform}; sleeps may end late"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0) != 0:
        return os.strerror(ctypes.get_errno())
    undo.callback(libc.prctl, _PR_SET_TIMERSLACK, ctypes.c_ulong(0), 0, 0, 0)  # 0 restores the default of the thread
    return ""


def _disable_gc_and_get_empty_refusal(undo: ExitStack) -> str:
    """Collect garbage, then disable the collector until `undo` is closed; return ``""``: never refused."""
    gc.collect()
    gc.freeze()
    undo.callback(gc.unfreeze)
    if gc.isenabled():
        gc.disable()
        undo.callback(gc.enable)
    return ""


#: Features in the order of their requests; memory is locked after the garbage collection has freed it.
_FEATURES: dict[str, Callable[[ExitStack], str]] = {
    "no garbage collection": _disable_gc_and_get_empty_refusal,
    "locked memory": _lock_memory_and_get_refusal,
    "timer slack": _reduce_timer_slack_and_get_refusal,
    "SCHED_FIFO": request_fifo_scheduling_and_get_refusal,
}


@dataclass(frozen=True)
class HistogramBins:
    """Bins of a `TimeHistogram`.

    Attributes:
        fineness: binary logarithm of the number of bins per doubling. With 5, times differ from the middle of their bin
            by at most 1.6 %; a larger number reduces this error and uses more memory.
        largest: binary logarithm of the longest time with a separate bin, ns; 2**40 ns are 18 minutes.
    """

    fineness: int = 5
    largest: int = 40


@dataclass(frozen=True)
class TickerSettings:
    """Settings of a `Ticker`.

    Attributes:
        late: lateness from which a tick counts as late, s.
        rest: fraction of the time that a spinning ticker sleeps. Linux suspends a process of real-time priority that
            uses more than 0.95 s per second (sched_rt_runtime_us).
        waking: fraction of the period that is reserved for waking up. A larger fraction polls longer.
        max_owed: largest postponed sleep, ns: the 5 % of a second that Linux reserves for other processes.
    """

    late: float = 0.1e-3
    rest: float = 0.1
    waking: float = 0.05
    max_owed: int = 50_000_000


#: Bins of all histograms.
BINS = HistogramBins()
#: Settings of all tickers.
TICKER = TickerSettings()
#: Number of bins per doubling, and number of linear bins of 1 ns.
_LINEAR = 1 << BINS.fineness


@dataclass(frozen=True)
class TimeQuantiles:
    """Quantiles of a time, s. The maximum is exact, the others have an error of at most 2 %.

    Attributes:
        p50: median.
        p99: 99 % quantile.
        p999: 99.9 % quantile.
        maximum: maximum.
    """

    p50: float = 0.0
    p99: float = 0.0
    p999: float = 0.0
    maximum: float = 0.0


class TimeHistogram:
    """Histogram of times with logarithmic bins; adding a time takes constant time and no memory."""

    def __init__(self):
        self.count, self._maximum = 0, 0
        self._bins = array("Q", bytes(8 * (_compute_bin_index_of_nanoseconds(1 << BINS.largest) + 1)))

    def add_nanoseconds(self, nanoseconds: int) -> None:
        """Add one time, ns, to its bin; a negative time counts as zero."""
        nanoseconds = max(nanoseconds, 0)
        self.count += 1
        if nanoseconds > self._maximum:
            self._maximum = nanoseconds
        self._bins[_compute_bin_index_of_nanoseconds(min(nanoseconds, 1 << BINS.largest))] += 1

    def quantile(self, share: float) -> float:
        """Return the time, s, that a fraction `share` (0 to 1) of all times does not exceed; 0 without times."""
        if self.count == 0:
            return 0.0
        rank = max(math.ceil(share * self.count), 1)
        index = next(index for index, below in enumerate(accumulate(self._bins)) if below >= rank)
        return min(_compute_bin_midpoint_nanoseconds(index), self._maximum) / 1e9

    @property
    def maximum(self) -> float:
        """Longest added time, s, without the rounding of the bins."""
        return self._maximum / 1e9

    @property
    def quantiles(self) -> TimeQuantiles:
        """Median, 99 % quantile, 99.9 % quantile and maximum of the added times, s."""
        return TimeQuantiles(self.quantile(0.5), self.quantile(0.99), self.quantile(0.999), self.maximum)


def _compute_bin_index_of_nanoseconds(nanoseconds: int) -> int:
    """Return the index of the bin of a time, ns: bins of 1 ns up to `_LINEAR` ns, then `_LINEAR` per doubling."""
    doublings = max(nanoseconds.bit_length() - BINS.fineness - 1, 0)
    return doublings * _LINEAR + (nanoseconds >> doublings)


def _compute_bin_midpoint_nanoseconds(index: int) -> float:
    """Return the time, ns, in the middle of the bin with this index."""
    doublings = max(index // _LINEAR - 1, 0)
    return (index - doublings * _LINEAR + 0.5 * (doublings > 0)) * (1 << doublings)


class Ticker:
    """Clock with deadlines at multiples of a period from the start, which do not drift with the duration of ticks.

    If two deadlines pass during a tick, the first is counted as missed, and the next tick belongs to the last deadline
    that has passed. The lateness of this tick is measured from the first deadline without a tick, so that the longest
    interruption of the loop is the largest lateness.

    Args:
        period: period, s.
        spin: time before a deadline in which the clock is polled instead of sleeping, s, because sleeps end late. A
            tenth of the time is used for sleep in any case, in ticks that have time left.
        late: lateness from which a tick counts as late, s.
        clock: monotonic clock, ns.
        sleep: sleeps for a time in s, or slightly longer.

    Attributes:
        number: number of the deadline of the current tick, from 1.
        ticks: number of ticks.
        late: number of ticks that began late.
        missed: number of deadlines without a tick.
        lateness: histogram of the lateness of all ticks.

    Raises:
        InputError: `period` is shorter than a microsecond, or `spin` is negative or not shorter than `period`.
    """

    def __init__(self, period: float, *, spin: float = 0.0, late: float = TICKER.late,
                 clock: Callable[[], int] = time.monotonic_ns, sleep: Callable[[float], None] = time.sleep):
        if not (math.isfinite(period) and period >= 1e-6):
            raise InputError(f"period must be at least 1e-06 s and finite; got {period:g} s", field="period")
        if not 0 <= spin < period:
            raise InputError(f"spin must be at least 0 and less than the period of {period:g} s; got {spin:g} s",
                             field="spin")
        self._period, self._spin, self._late = round(period * 1e9), round(spin * 1e9), round(late * 1e9)
        self._waking = round(TICKER.waking * self._period)
        #: Sleep postponed by earlier ticks, and time of its last update, ns.
        self._owed = self._counted = 0
        self._clock, self._sleep = clock, sleep
        self._start = 0
        self.number = self.ticks = self.late = self.missed = 0
        self.lateness = TimeHistogram()

    def start_first_period(self) -> None:
        """Start the periods now: the first deadline is one period later. Does not reset the statistics."""
        self._start = self._counted = self._clock()
        self._owed = 0

    def wait_and_get_lateness_nanoseconds(self) -> int:
        """Wait for the next deadline, count missed ones, and return the lateness of this tick, ns, 0 or more."""
        clock = self._clock
        deadline = self._start + (self.number + 1) * self._period
        now = clock()
        self._owed = min(self._owed + round(TICKER.rest * (now - self._counted)), TICKER.max_owed)
        self._counted = now
        wake = max(deadline - self._spin, min(now + self._owed, deadline - self._waking))
        began = now
        while now < wake:
            self._sleep((wake - now) * 1e-9)
            now = clock()
        self._owed = max(0, self._owed - (now - began))
        while now < deadline:
            now = clock()
        lateness = now - deadline
        passed = lateness // self._period
        self.missed += passed
        self.number += 1 + passed
        self.ticks += 1
        self.late += lateness > self._late
        self.lateness.add_nanoseconds(lateness)
        return lateness

    @property
    def nanoseconds_since_start(self) -> int:
        """Time from `start_first_period` to now, ns."""
        return self._clock() - self._start
