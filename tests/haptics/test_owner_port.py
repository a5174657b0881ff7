"""`ReplyLimiter`: rate limit of the replies to clients that do not own the tissue."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.server.server import RATE_LIMIT, ReplyLimiter

A = ("127.0.0.1", 5001)
B = ("127.0.0.1", 5002)


def test_a_burst_then_a_constant_rate():
    limiter = ReplyLimiter()
    assert sum(limiter.take_token(A, 0.0) for _ in range(1000)) == RATE_LIMIT.burst
    assert limiter.take_token(B, 0.0), "each address has a separate bucket"
    taken = sum(limiter.take_token(A, 1e-4 * k) for k in range(10001))
    assert taken == pytest.approx(RATE_LIMIT.replies_per_second, abs=1)


def test_new_addresses_are_refused_until_an_old_one_is_silent():
    limiter = ReplyLimiter()
    assert all(limiter.take_token(("127.0.0.1", port), 0.0) for port in range(RATE_LIMIT.most_addresses))
    assert not limiter.take_token(A, 0.0) and limiter.take_token(("127.0.0.1", 3), 0.0)
    assert limiter.take_token(A, 1.0) and len(limiter._buckets) == 1


@given(st.lists(st.tuples(st.integers(0, 100), st.floats(0.0, 0.1)), max_size=200))
def test_the_rate_is_never_exceeded(packets):
    limiter, now, taken = ReplyLimiter(), 0.0, {}
    for port, passed in packets:
        now += passed
        taken[port] = taken.get(port, 0) + limiter.take_token(("127.0.0.1", port), now)
    assert all(count <= RATE_LIMIT.burst + RATE_LIMIT.replies_per_second * now + 1e-6 for count in taken.values())
