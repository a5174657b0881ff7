"""How often strangers are answered."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.server.owner_port import RATE_LIMIT, ReplyLimiter

A, B = ("127.0.0.1", 5001), ("127.0.0.1", 5002)


def test_a_burst_then_an_even_rate():
    limiter = ReplyLimiter()
    assert sum(limiter.allows(A, 0.0) for _ in range(1000)) == RATE_LIMIT.burst
    assert limiter.allows(B, 0.0), "each has its own"
    assert sum(limiter.allows(A, 1e-4 * k) for k in range(10001)) == pytest.approx(RATE_LIMIT.replies_per_second, abs=1)


def test_no_more_strangers_are_remembered_than_fit_until_some_are_quiet():
    limiter = ReplyLimiter()
    assert all(limiter.allows(("127.0.0.1", port), 0.0) for port in range(RATE_LIMIT.most_addresses))
    assert not limiter.allows(A, 0.0) and limiter.allows(("127.0.0.1", 3), 0.0)
    assert limiter.allows(A, 1.0) and len(limiter._buckets) == 1


@given(st.lists(st.tuples(st.integers(0, 100), st.floats(0.0, 0.1)), max_size=200))
def test_never_more_than_the_rate(packets):
    limiter, now, taken = ReplyLimiter(), 0.0, {}
    for port, passed in packets:
        now += passed
        taken[port] = taken.get(port, 0) + limiter.allows(("127.0.0.1", port), now)
    assert all(count <= RATE_LIMIT.burst + RATE_LIMIT.replies_per_second * now + 1e-6 for count in taken.values())
