"""`ForceLimiter`: magnitude and rate limits hold for every input."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.safety.limits import ForceLimiter
from tissue_sim import InputError

anything = st.floats(allow_nan=True, allow_infinity=True)
part = st.floats(-20.0, 20.0)


def along(force):
    """Return the wrench of a force along z, N."""
    return (0.0, 0.0, force, 0.0, 0.0, 0.0)


def step_along_z(limits, force):
    """Step with a force along z, N, check that the result is along z, and return its force, N."""
    result = limits.step(along(force))
    assert result == along(result[2]) and result is limits.last
    return result[2]


def limit_scalar(force, last, largest, rate):
    """Limit a scalar force in magnitude and rate, N."""
    limited = min(max(force, -largest), largest)
    return min(max(limited, last - rate), last + rate)


@given(st.lists(st.floats(-20, 20), max_size=50), st.floats(0.1, 50.0), st.floats(1e-3, 5.0))
def test_along_one_axis_the_limits_are_those_of_a_scalar(forces, largest, rate):
    limits, last = ForceLimiter(largest, rate), 0.0
    for force in forces:
        last = limit_scalar(force, last, largest, rate)
        assert step_along_z(limits, force) == pytest.approx(last, rel=1e-14, abs=1e-14)
        last = limits.last[2]


@given(st.lists(st.tuples(*[part] * 6), max_size=50), st.floats(0.1, 50.0), st.floats(1e-3, 5.0), st.floats(0.1, 5.0),
       st.floats(1e-3, 1.0))
def test_magnitudes_are_limited_and_directions_kept(wrenches, largest, rate, torque, torque_rate):
    limits, last = ForceLimiter(largest, rate, torque, torque_rate), (0.0,) * 6
    for wrench in wrenches:
        result = limits.step(wrench)
        for start, most, change in ((0, largest, rate), (3, torque, torque_rate)):
            now, before, requested = (np.array(each[start:start + 3]) for each in (result, last, wrench))
            assert np.linalg.norm(now) <= most * (1 + 1e-12)
            assert np.linalg.norm(now - before) <= change * (1 + 1e-12)
            # The change points towards the requested vector, limited in magnitude.
            aim = requested * min(1.0, most / max(np.linalg.norm(requested), 1e-300))
            np.testing.assert_allclose(np.cross(now - before, aim - before), 0.0, atol=1e-9)
            assert (now - before) @ (aim - before) >= 0.0
        last = result


def test_torque_has_separate_limits():
    limits = ForceLimiter(3.0, 10.0, torque=0.5, torque_rate=0.4)
    assert limits.step((0.0, 0.0, 1.0, 0.6, 0.0, 0.8)) == pytest.approx((0.0, 0.0, 1.0, 0.24, 0.0, 0.32))
    assert (limits.limited, limits.rate_limited) == (True, True)
    assert limits.active_limits_description == "torque limited to 0.5 N m, change of the torque limited to 0.4 N m"
    assert limits.step((0.0, 0.0, 1.0, 0.6, 0.0, 0.8)) == pytest.approx((0.0, 0.0, 1.0, 0.3, 0.0, 0.4))
    assert limits.active_limits_description == "torque limited to 0.5 N m"
    limits.step((0.0, 0.0, 1.0, math.nan, 0.0, 0.0))
    assert limits.invalid and limits.last[2] == 0.0


@given(st.lists(anything | st.floats(-20, 20), max_size=80), st.floats(0.1, 50.0), st.floats(1e-3, 5.0))
def test_no_input_exceeds_the_limits(forces, largest, rate):
    limits, last = ForceLimiter(largest, rate), 0.0
    for force in forces:
        result = step_along_z(limits, force)
        assert abs(result) <= largest
        assert abs(result - last) <= rate * (1 + 1e-12) + 1e-12
        assert limits.invalid == (not math.isfinite(force))
        assert limits.limited == (abs(force) > largest and math.isfinite(force))
        if not (limits.limited or limits.rate_limited or limits.invalid):
            assert result == force
            assert limits.active_limits_description == "not limited"
        last = result


@given(st.floats(0.5, 10.0), st.floats(0.01, 1.0), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_what_is_no_number_leads_to_zero(force, rate, bad):
    limits = ForceLimiter(10.0, rate)
    for _ in range(math.ceil(force / rate) + 1):
        step_along_z(limits, force)
    assert limits.last == along(force)
    last = force
    for _ in range(math.ceil(force / rate) + 1):
        result = step_along_z(limits, bad)
        assert 0 <= result <= last
        last = result
    assert last == 0.0
    assert "not a number" in limits.active_limits_description


def test_the_message_names_the_limit_that_acted():
    limits = ForceLimiter(force=3.0, rate=2.0)
    assert (step_along_z(limits, 5.0), limits.limited, limits.rate_limited) == (2.0, True, True)
    assert limits.active_limits_description == "force limited to 3 N, change of the force limited to 2 N"
    assert (step_along_z(limits, 5.0), limits.limited, limits.rate_limited) == (3.0, True, False)
    assert limits.active_limits_description == "force limited to 3 N"
    assert (step_along_z(limits, 0.0), limits.limited, limits.rate_limited) == (1.0, False, True)
    assert limits.active_limits_description == "change of the force limited to 2 N"
    limits.reset()
    assert (limits.last, limits.limited, limits.rate_limited) == (along(0.0), False, False)


@pytest.mark.parametrize("settings", [{"force": 0.0, "rate": 1.0}, {"force": math.inf, "rate": 1.0},
                                      {"force": 5.0, "rate": -1.0}, {"force": 5.0, "rate": math.nan}])
def test_invalid_limits_are_refused(settings):
    with pytest.raises(InputError, match="must be positive and finite"):
        ForceLimiter(**settings)
    with pytest.raises(InputError, match="torque_rate: a force limit must be positive and finite; got 0 N m per tick"):
        ForceLimiter(5.0, 1.0, 1.0, 0.0)
