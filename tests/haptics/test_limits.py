"""Force and rate limits hold for every input."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.safety.limits import ForceLimits
from tissue_sim import InputError

anything = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(anything | st.floats(-20, 20), max_size=80), st.floats(0.1, 50.0), st.floats(1e-3, 5.0))
def test_no_input_passes_the_limits(forces, largest, rate):
    limits, last = ForceLimits(largest, rate), 0.0
    for force in forces:
        given_ = limits.step(force)
        assert abs(given_) <= largest
        assert abs(given_ - last) <= rate * (1 + 1e-12) + 1e-12
        assert limits.invalid == (not math.isfinite(force))
        assert limits.limited == (abs(force) > largest and math.isfinite(force))
        if not (limits.limited or limits.rate_limited or limits.invalid):
            assert given_ == force
            assert limits.message == "as asked"
        last = given_


@given(st.floats(0.5, 10.0), st.floats(0.01, 1.0), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_what_is_no_number_leads_to_zero(force, rate, bad):
    limits = ForceLimits(10.0, rate)
    for _ in range(math.ceil(force / rate) + 1):
        limits.step(force)
    assert limits.last == force
    last = force
    for _ in range(math.ceil(force / rate) + 1):
        given_ = limits.step(bad)
        assert 0 <= given_ <= last
        last = given_
    assert last == 0.0
    assert "not a number" in limits.message


def test_it_says_which_limit_held():
    limits = ForceLimits(force=3.0, rate=2.0)
    assert (limits.step(5.0), limits.limited, limits.rate_limited) == (2.0, True, True)
    assert limits.message == "cut to 3 N, changed by 2 N only"
    assert (limits.step(5.0), limits.limited, limits.rate_limited) == (3.0, True, False)
    assert limits.message == "cut to 3 N"
    assert (limits.step(0.0), limits.limited, limits.rate_limited) == (1.0, False, True)
    assert limits.message == "changed by 2 N only"
    limits.reset()
    assert (limits.last, limits.limited, limits.rate_limited) == (0.0, False, False)


@pytest.mark.parametrize("settings", [{"force": 0.0, "rate": 1.0}, {"force": math.inf, "rate": 1.0},
                                      {"force": 5.0, "rate": -1.0}, {"force": 5.0, "rate": math.nan}])
def test_limits_that_limit_nothing_are_refused(settings):
    with pytest.raises(InputError, match="is no limit"):
        ForceLimits(**settings)
