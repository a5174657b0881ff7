"""A clock that ticks at deadlines which stand, and what it takes to say how well they were kept."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate

from tissue_sim.errors import InputError

#: A tick that begins later than this behind its deadline is counted as late, s.
LATE = 0.1e-3
#: Bins per doubling are 2**_FINENESS: no value is further than 1.6 % from the middle of its bin.
_FINENESS = 5
_LINEAR = 1 << _FINENESS
#: Longest time that has a bin of its own: 2**_LARGEST ns, 18 minutes.
_LARGEST = 40


@dataclass(frozen=True)
class Quantiles:
    """How a time is distributed, s. The maximum is exact, the others to 2 %."""

    p50: float = 0.0
    p99: float = 0.0
    p999: float = 0.0
    maximum: float = 0.0


class TimeHistogram:
    """Counts times in bins that widen with the time; adding one costs a fixed, short time and no memory."""

    def __init__(self):
        self.count, self._maximum = 0, 0
        self._bins = array("Q", bytes(8 * (_bin(1 << _LARGEST) + 1)))

    def add(self, nanoseconds: int) -> None:
        """Count one; below zero it counts as zero."""
        nanoseconds = max(nanoseconds, 0)
        self.count += 1
        if nanoseconds > self._maximum:
            self._maximum = nanoseconds
        self._bins[_bin(min(nanoseconds, 1 << _LARGEST))] += 1

    def quantile(self, share: float) -> float:
        """The time, s, that this share (0 to 1) of all does not exceed; 0 of none."""
        if self.count == 0:
            return 0.0
        wanted = max(math.ceil(share * self.count), 1)
        index = next(index for index, below in enumerate(accumulate(self._bins)) if below >= wanted)
        return min(_middle(index), self._maximum) / 1e9

    @property
    def maximum(self) -> float:
        """The longest, s, exact."""
        return self._maximum / 1e9

    @property
    def quantiles(self) -> Quantiles:
        return Quantiles(self.quantile(0.5), self.quantile(0.99), self.quantile(0.999), self.maximum)


def _bin(nanoseconds: int) -> int:
    """Whole nanoseconds up to 2**_FINENESS, then 2**_FINENESS bins per doubling."""
    doublings = max(nanoseconds.bit_length() - _FINENESS - 1, 0)
    return doublings * _LINEAR + (nanoseconds >> doublings)


def _middle(index: int) -> float:
    doublings = max(index // _LINEAR - 1, 0)
    return (index - doublings * _LINEAR + 0.5 * (doublings > 0)) * (1 << doublings)


#: Share of the time that a watching ticker sleeps all the same, and of the period that it keeps for waking up: Linux
#: stops a process of a real-time priority that takes more than 0.95 s of a second (sched_rt_runtime_us) for the rest.
_REST, _WAKING = 0.1, 0.05
#: Most of it that ticks without time leave to later ones, ns: what Linux lets nobody take in a second.
_MOST_OWED = 50_000_000


class Ticker:
    """Deadlines at whole multiples of a period from the start: they never drift, whatever a tick takes.

    A deadline that passes while another tick is worked on is skipped and counted as missed as soon as the next one has
    passed, too; the tick after it belongs to the last deadline that has passed. Its lateness is that behind the first
    deadline which no tick has kept, so that the longest stop of the loop is the largest lateness.

    Args:
        period: s.
        spin: how long before a deadline to stop sleeping and watch the clock, s: a sleep ends late. A tenth of the
            time is slept through in any case, by ticks that leave some for it.
        late: lateness from which a tick counts as late, s.
        clock: nanoseconds that only increase.
        sleep: waits for a number of seconds, or a bit longer.

    Attributes:
        number: of the deadline that the current tick belongs to, from 1.
        ticks, late, missed: how many ticks there were, those that began late, and deadlines without a tick.
        lateness: of all ticks.

    Raises:
        InputError: a period that is not positive, a spin that is negative or not shorter than the period.
    """

    def __init__(self, period: float, *, spin: float = 0.0, late: float = LATE,
                 clock: Callable[[], int] = time.monotonic_ns, sleep: Callable[[float], None] = time.sleep):
        if not (math.isfinite(period) and period >= 1e-6):
            raise InputError(f"{period:g} s is not a period; give at least a microsecond", field="period")
        if not 0 <= spin < period:
            raise InputError(f"{spin:g} s; give 0 or more, but less than the period of {period:g} s", field="spin")
        self._period, self._spin, self._late = round(period * 1e9), round(spin * 1e9), round(late * 1e9)
        self._waking = round(_WAKING * self._period)
        #: Sleep that earlier ticks left no time for, ns, as it was counted last.
        self._owed = self._counted = 0
        self._clock, self._sleep = clock, sleep
        self._start = 0
        self.number = self.ticks = self.late = self.missed = 0
        self.lateness = TimeHistogram()

    def start(self) -> None:
        """Set the first deadline one period from now."""
        self._start = self._counted = self._clock()
        self._owed = 0

    def wait(self) -> int:
        """Wait for the next deadline; returns how late it is, ns."""
        clock = self._clock
        deadline = self._start + (self.number + 1) * self._period
        now = clock()
        self._owed = min(self._owed + round(_REST * (now - self._counted)), _MOST_OWED)
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
        self.lateness.add(lateness)
        return lateness

    @property
    def elapsed(self) -> int:
        """Time since the start, ns."""
        return self._clock() - self._start
