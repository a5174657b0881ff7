"""Results of functions of arrays are stored by the content of the arrays."""

import numpy as np
import pytest

from tissue_sim.recording.contact import cache_by_array_content


@pytest.fixture
def calls():
    return []


@pytest.fixture
def total(calls):
    @cache_by_array_content(most=2)
    def total(values, weights=None, *, power=1):
        calls.append(len(values))
        if not len(values):
            raise ValueError("empty")
        return float(np.sum(values**power * (1 if weights is None else weights)))

    return total


def test_equal_content_is_computed_once(total, calls):
    assert total(np.arange(3.0)) == total(np.arange(3.0)) == 3.0
    assert len(calls) == 1


@pytest.mark.parametrize(("first", "second"), [
    ((np.arange(3.0),), (np.array([0.0, 1.0, 2.5]),)),
    ((np.arange(3.0),), (np.arange(3),)),
    ((np.ones(4),), (np.ones((2, 2)),)),
    ((np.arange(3.0),), (np.arange(3.0), np.ones(3))),
], ids=["value", "type", "shape", "further argument"])
def test_other_arguments_are_computed(total, calls, first, second):
    total(*first)
    total(*second)
    assert len(calls) == 2


def test_keywords_belong_to_the_key(total, calls):
    assert (total(np.arange(3.0), power=2), total(np.arange(3.0), power=3), total(np.arange(3.0))) == (5.0, 9.0, 3.0)
    assert len(calls) == 3


def test_a_view_with_strides_is_its_content(total, calls):
    values = np.arange(6.0)
    assert total(values[::2]) == total(np.array([0.0, 2.0, 4.0]))
    assert len(calls) == 1


def test_the_oldest_result_is_discarded(total, calls):
    for length in (1, 2, 3, 3, 2, 1):
        total(np.arange(float(length)))
    assert calls == [1, 2, 3, 1]


def test_errors_are_not_stored(total, calls):
    for _ in range(2):
        with pytest.raises(ValueError, match="empty"):
            total(np.zeros(0))
    assert calls == [0, 0]


def test_a_changed_array_is_computed_again(total, calls):
    values = np.arange(3.0)
    total(values)
    values[0] = 5.0
    assert total(values) == 8.0
    assert len(calls) == 2
