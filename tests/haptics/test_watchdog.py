"""`Watchdog`: the gain of the force fades when the pose is lost, and returns with the pose."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tissue_sim import InputError
from tissue_sim.realtime.force_fading import Watchdog, WatchdogState

DT = 1e-3


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 200)), max_size=20), st.floats(0.002, 0.1),
       st.floats(0.005, 0.3))
def test_gain_is_continuous_and_reaches_zero_and_one(intervals, timeout, ramp):
    """Any sequence of intervals with and without a pose."""
    watchdog, last = Watchdog(timeout, ramp), 1.0
    for seen, ticks in intervals:
        for _ in range(ticks):
            gain = watchdog.step(seen, DT)
            assert 0.0 <= gain <= 1.0
            assert abs(gain - last) <= 1.5 * DT / ramp + 1e-12
            if seen:
                assert gain >= last - 1e-12
                assert watchdog.state in (WatchdogState.TRACKING, WatchdogState.RETURNING)
                assert (watchdog.state is WatchdogState.TRACKING) == (gain == 1.0)
            else:
                assert gain <= last + 1e-12
                if watchdog.state is WatchdogState.MISSING:
                    assert gain == last
            last = gain
        if seen and ticks * DT > ramp + DT:
            assert last == 1.0
        if not seen and ticks * DT > timeout + ramp + DT:
            assert (last, watchdog.state) == (0.0, WatchdogState.LOST)


def test_fifty_milliseconds():
    watchdog = Watchdog(timeout=0.050, ramp=0.020)
    gains = [watchdog.step(False, DT) for _ in range(100)]
    assert gains[48] == 1.0  # 49 ms
    assert gains[49] < 1.0   # 50 ms
    assert gains[59] == pytest.approx(1 - 3 * 0.55**2 + 2 * 0.55**3)
    assert gains[67] > 0.0 and gains[69] == 0.0


def test_states_follow_the_poses():
    watchdog, states = Watchdog(timeout=0.050, ramp=0.020), []
    for seen, ticks in ((True, 10), (False, 40), (True, 10), (False, 40), (True, 1), (False, 100), (True, 50)):
        for _ in range(ticks):
            watchdog.step(seen, DT)
            if not states or states[-1] is not watchdog.state:
                states.append(watchdog.state)
    state = WatchdogState
    assert states == [*[state.TRACKING, state.MISSING] * 3, state.FADING, state.LOST, state.RETURNING, state.TRACKING]
    assert state.LOST.value == "the pose is lost: no force"
    watchdog.step(False, DT)
    watchdog.reset()
    assert (watchdog.gain, watchdog.missing, watchdog.state) == (1.0, 0.0, state.TRACKING)


@pytest.mark.parametrize("settings", [{"timeout": 0.0}, {"ramp": -1.0}, {"timeout": math.nan}, {"ramp": math.inf}])
def test_invalid_times_are_refused(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        Watchdog(**settings)
