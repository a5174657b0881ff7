"""Increments of a path that are halved after a failure and doubled after a success."""

from hypothesis import given
from hypothesis import strategies as st

from tissue_sim.fem.stepping import ROUNDING, AdaptiveIncrements


@given(st.lists(st.booleans(), max_size=200), st.floats(0.01, 1.0))
def test_a_path_ends_exactly_at_one_with_allowed_increments(successes, largest):
    increments, ends, smallest = AdaptiveIncrements(largest * 2.0**-6, largest), [0.0], largest * 2.0**-6
    for success in successes:
        end = increments.end
        assert end == 1.0 or smallest * (1.0 - ROUNDING) <= end - increments.done <= largest * (1.0 + ROUNDING)
        if success:
            increments.advance()
            ends.append(increments.done)
        elif not increments.halve_and_check_size():
            assert increments.length < smallest
            return
        if increments.is_complete:
            break
    assert ends == sorted(set(ends)) and increments.done == ends[-1] <= 1.0
    while not increments.is_complete:
        increments.advance()
    assert increments.done == 1.0


def test_increments_follow_successes_and_failures():
    increments = AdaptiveIncrements(2.0**-3)
    assert increments.end == 1.0
    assert increments.halve_and_check_size() and increments.halve_and_check_size()
    assert increments.end == 0.25
    increments.advance()
    assert (increments.done, increments.end) == (0.25, 0.75)
    increments.advance()
    assert (increments.done, increments.end, increments.length) == (0.75, 1.0, 1.0)
    assert [increments.halve_and_check_size() for _ in range(4)] == [True, True, True, False]


def test_the_last_increment_has_no_remainder_of_rounding():
    """Three times a third, and a remainder of rounding errors, end at exactly 1."""
    increments, count = AdaptiveIncrements(1e-3, 1.0 / 3.0), 0
    while not increments.is_complete:
        increments.advance()
        count += 1
    assert count == 3
