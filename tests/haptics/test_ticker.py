"""Deadlines that stand, on a clock that the test sets; quantiles against numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.loop.ticker import Ticker, TimeHistogram
from tissue_sim.errors import InputError

MS = 1_000_000


class FakeClock:
    """Nanoseconds that pass while sleeping, while reading the clock, and when the test says so."""

    def __init__(self, oversleep=0, reading=0):
        self.now, self.oversleep, self.reading, self.slept = 12345, oversleep, reading, []

    def __call__(self):
        self.now += self.reading
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += round(seconds * 1e9) + self.oversleep

    def ticker(self, period=1e-3, **options):
        ticker = Ticker(period, clock=self, sleep=self.sleep, **options)
        ticker.start_first_period()
        return ticker


def test_deadlines_do_not_drift():
    """A thousand ticks that oversleep and compute still begin at whole milliseconds."""
    clock = FakeClock(oversleep=60_000)
    ticker = clock.ticker()
    for n in range(1, 1001):
        assert ticker.wait_and_get_lateness_nanoseconds() == 60_000 and ticker.number == n
        assert clock.now == 12345 + n * MS + 60_000
        clock.now += 700_000  # the work of the tick
    assert (ticker.ticks, ticker.late, ticker.missed) == (1000, 0, 0)


def test_a_period_that_is_no_whole_number_of_seconds_does_not_drift_either():
    clock = FakeClock()
    ticker = clock.ticker(1 / 3)
    for _ in range(300):
        ticker.wait_and_get_lateness_nanoseconds()
    assert clock.now - 12345 == 300 * 333_333_333


def test_a_late_tick_is_late_and_the_next_one_is_not():
    clock = FakeClock()
    ticker = clock.ticker()
    ticker.wait_and_get_lateness_nanoseconds()
    clock.now += 1_400_000
    assert ticker.wait_and_get_lateness_nanoseconds() == 400_000 and ticker.number == 2
    assert ticker.wait_and_get_lateness_nanoseconds() == 0 and ticker.number == 3
    assert (ticker.ticks, ticker.late, ticker.missed) == (3, 1, 0)
    assert clock.slept[-1] == pytest.approx(0.6e-3)


def test_deadlines_that_passed_are_skipped_and_counted():
    """The loop stops for 5.3 ms in tick 1: deadlines 2 to 5 pass, the next tick is that of deadline 6."""
    clock = FakeClock()
    ticker = clock.ticker()
    ticker.wait_and_get_lateness_nanoseconds()
    clock.now += 5_300_000
    assert ticker.wait_and_get_lateness_nanoseconds() == 4_300_000, "behind the first deadline without a tick"
    assert (ticker.number, ticker.ticks, ticker.late, ticker.missed) == (6, 2, 1, 4)
    assert ticker.wait_and_get_lateness_nanoseconds() == 0 and ticker.number == 7
    assert clock.now == 12345 + 7 * MS
    assert ticker.lateness.maximum == pytest.approx(4.3e-3)


@given(st.lists(st.integers(0, 6_000_000), max_size=60))
def test_every_deadline_is_a_tick_or_missed(works):
    clock = FakeClock(oversleep=20_000)
    ticker = clock.ticker()
    for work in works:
        ticker.wait_and_get_lateness_nanoseconds()
        clock.now += work
    assert ticker.ticks == len(works) and ticker.ticks + ticker.missed == ticker.number
    if works:
        ticker.wait_and_get_lateness_nanoseconds()
        assert 0 <= clock.now - 12345 - ticker.number * MS < MS, "a tick belongs to the last deadline that has passed"


def test_the_last_part_is_spun():
    """Sleep ends 0.2 ms before the deadline at most; from there the clock is watched to the nanosecond of its steps."""
    clock = FakeClock(oversleep=150_000, reading=50)
    ticker = clock.ticker(spin=0.2e-3)
    for _ in range(20):
        assert 0 <= ticker.wait_and_get_lateness_nanoseconds() <= 50
    assert max(clock.slept) < 0.8e-3


@pytest.mark.parametrize("work", [0.0, 0.5, 0.88])
def test_one_that_watches_the_clock_sleeps_all_the_same(work):
    """Or else Linux stops it for 50 ms in each second."""
    clock = FakeClock(reading=1000)
    ticker = clock.ticker(spin=0.95e-3)
    for _ in range(1000):
        clock.now += round(work * MS)
        assert ticker.wait_and_get_lateness_nanoseconds() <= 1000
    assert sum(clock.slept) == pytest.approx(max(0.1, 1.0 - 0.95 - work), rel=0.35)


def test_sleep_is_made_up_for():
    """Ticks that leave no time are not made late by it; those that follow sleep longer."""
    clock = FakeClock(reading=1000)
    ticker = clock.ticker(spin=0.95e-3)
    for tick in range(1000):
        clock.now += round((0.99 if tick % 50 < 40 else 0.4) * MS)
        assert ticker.wait_and_get_lateness_nanoseconds() <= 1000
    assert sum(clock.slept) == pytest.approx(0.1, rel=0.1)
    assert max(clock.slept) < 0.56e-3


def test_little_is_made_up_for():
    """After a long time without sleep, the ticker makes up for a small part of the lost sleep only."""
    clock = FakeClock(reading=1000)
    ticker = clock.ticker(spin=0.95e-3)
    for _ in range(3000):
        clock.now += round(0.99 * MS)
        ticker.wait_and_get_lateness_nanoseconds()
    clock.slept.clear()
    for _ in range(500):
        clock.now += round(0.4 * MS)
        ticker.wait_and_get_lateness_nanoseconds()
    assert sum(clock.slept) == pytest.approx(0.05 + 500 * 0.1e-3, rel=0.1)


def test_a_sleep_that_ends_early_is_continued():
    clock = FakeClock()
    clock.sleep = lambda seconds: setattr(clock, "now", clock.now + max(round(seconds * 0.6e9), 1))
    ticker = clock.ticker()
    begun = clock.now
    assert ticker.wait_and_get_lateness_nanoseconds() >= 0 and clock.now >= begun + MS


@pytest.mark.parametrize(("period", "spin", "field"), [
    (0.0, 0.0, "period"), (-1e-3, 0.0, "period"), (float("nan"), 0.0, "period"), (float("inf"), 0.0, "period"),
    (1e-3, -1e-6, "spin"), (1e-3, 1e-3, "spin"), (1e-3, float("nan"), "spin"),
])
def test_periods_that_cannot_be_kept_are_refused(period, spin, field):
    with pytest.raises(InputError) as caught:
        Ticker(period, spin=spin)
    assert caught.value.field == field


@pytest.mark.parametrize("draw", [
    lambda rng: rng.lognormal(11, 2, 20_000), lambda rng: rng.uniform(0, 100, 5000),
    lambda rng: np.repeat([3.0, 1e6, 1e9], [980, 15, 5]), lambda rng: rng.exponential(3e5, 3),
], ids=["lognormal", "small", "steps", "few"])
def test_quantiles_are_those_of_numpy(draw):
    """Within 2 % of the exact order statistic, and the maximum exactly."""
    times = draw(np.random.default_rng(1)).astype(np.int64)
    histogram = TimeHistogram()
    for nanoseconds in times.tolist():
        histogram.add_nanoseconds(nanoseconds)
    quantiles = histogram.quantiles
    for share, value in ((0.5, quantiles.p50), (0.99, quantiles.p99), (0.999, quantiles.p999)):
        exact = np.quantile(times, share, method="inverted_cdf") * 1e-9
        assert value == pytest.approx(exact, rel=0.02)
    assert quantiles.maximum == pytest.approx(times.max() * 1e-9, rel=1e-15)
    assert histogram.count == times.size


def test_times_beyond_all_bins_are_kept():
    histogram = TimeHistogram()
    assert histogram.quantiles.p50 == histogram.maximum == 0.0
    histogram.add_nanoseconds(-5)
    assert histogram.quantile(1.0) == 0.0
    histogram.add_nanoseconds(10**15)
    assert histogram.maximum == 1e6 and histogram.count == 2


def test_a_histogram_does_not_grow():
    histogram = TimeHistogram()
    size = len(histogram._bins)
    for exponent in range(60):
        histogram.add_nanoseconds(1 << exponent)
    assert len(histogram._bins) == size and sum(histogram._bins) == 60
