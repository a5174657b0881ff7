"""How often strangers are answered."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.server.owner_port import ANSWERS_PER_SECOND, BURST, MOST_STRANGERS, Allowance

A, B = ("127.0.0.1", 5001), ("127.0.0.1", 5002)


def test_a_burst_then_an_even_rate():
    allowance = Allowance()
    assert sum(allowance.takes(A, 0.0) for _ in range(1000)) == BURST
    assert allowance.takes(B, 0.0), "each has its own"
    assert sum(allowance.takes(A, 1e-4 * k) for k in range(10001)) == pytest.approx(ANSWERS_PER_SECOND, abs=1)


def test_no_more_strangers_are_remembered_than_fit_until_some_are_quiet():
    allowance = Allowance()
    assert all(allowance.takes(("127.0.0.1", port), 0.0) for port in range(MOST_STRANGERS))
    assert not allowance.takes(A, 0.0) and allowance.takes(("127.0.0.1", 3), 0.0)
    assert allowance.takes(A, 1.0) and len(allowance._left) == 1


@given(st.lists(st.tuples(st.integers(0, 100), st.floats(0.0, 0.1)), max_size=200))
def test_never_more_than_the_rate(packets):
    allowance, now, taken = Allowance(), 0.0, {}
    for port, passed in packets:
        now += passed
        taken[port] = taken.get(port, 0) + allowance.takes(("127.0.0.1", port), now)
    assert all(count <= BURST + ANSWERS_PER_SECOND * now + 1e-6 for count in taken.values())
