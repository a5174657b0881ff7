"""`SampleClock`: sampling times from sequence numbers and late arrivals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.recorder.motion_record import SampleClock


@given(st.integers(0, 2**32), st.floats(2e-3, 0.05), st.floats(0.999, 1.001))
def test_late_arrivals_do_not_move_the_line(seed, period, drift):
    random = np.random.default_rng(seed)
    numbers = np.arange(2000)
    sampled = 5.0 + drift * period * numbers
    late = random.exponential(3e-3, numbers.size) * (random.uniform(size=numbers.size) < 0.9)
    clock = SampleClock.fit_to_arrivals(numbers, np.maximum.accumulate(sampled + late), period)
    assert np.abs(clock.compute_times(numbers) - sampled).max() < 3e-3
    assert clock.period == pytest.approx(drift * period, rel=3e-3 / (1000 * period))


def test_bursts_are_distributed_evenly():
    """A device that sends forty samples at a time."""
    numbers = np.arange(4000)
    sampled = numbers / 7000.0
    received = sampled[np.minimum((numbers // 40) * 40 + 39, 3999)]
    clock = SampleClock.fit_to_arrivals(numbers, received, 1 / 7000.0)
    np.testing.assert_allclose(clock.compute_times(numbers), sampled, atol=1e-9)
    assert clock.jitter == pytest.approx(20 / 7000.0, rel=0.1)


def test_lost_samples_leave_gaps():
    numbers = np.array([0, 1, 2, 50, 51, 99])
    clock = SampleClock.fit_to_arrivals(numbers, 1.0 + 0.01 * numbers, 0.01)
    np.testing.assert_allclose(clock.compute_times(numbers), 1.0 + 0.01 * numbers, atol=1e-12)


@pytest.mark.parametrize("numbers", [[], [7]])
def test_a_single_sample_uses_the_stated_period(numbers):
    clock = SampleClock.fit_to_arrivals(numbers, [3.0 for _ in numbers], 0.01)
    assert clock.period == 0.01
    np.testing.assert_allclose(clock.compute_times(numbers), [3.0 for _ in numbers])


def test_a_wrong_stated_rate_is_replaced_by_the_measured_rate():
    """The device states 21.3 Hz and samples at 19.05 Hz."""
    numbers = np.arange(300)
    late = np.random.default_rng(2).exponential(3e-3, numbers.size)
    clock = SampleClock.fit_to_arrivals(numbers, 7.0 + numbers / 19.05 + late, 1 / 21.3)
    assert not clock.fits and clock.period == pytest.approx(1 / 19.05, rel=1e-3)
    np.testing.assert_allclose(clock.compute_times(numbers), 7.0 + numbers / 19.05, atol=3e-3)
    assert SampleClock.fit_to_arrivals(numbers, 7.0 + numbers / 21.3 + late, 1 / 21.3).fits


def test_a_long_run_uses_the_earliest_sample_of_each_stretch():
    """One minute at 7 kHz: the fit stays accurate to 50 us."""
    numbers = np.arange(420_000)
    sampled = numbers * (1.0003 / 7000.0)
    received = np.maximum.accumulate(sampled + np.random.default_rng(1).exponential(2e-4, numbers.size))
    clock = SampleClock.fit_to_arrivals(numbers, received, 1 / 7000.0)
    assert clock.fits and np.abs(clock.compute_times(numbers) - sampled).max() < 5e-5
