"""Scores of many directions: probabilities corrected for the number of directions."""

import numpy as np
import pytest
from scipy import stats

from calibration.statistics.adequacy import (
    DIRECTIONS,
    EffectDirection,
    compute_familywise_p_values,
    compute_largest_principal_cosine,
)

N = 60


def direction(column, fitted=None, positive=False):
    fitted = np.zeros((N, 0)) if fitted is None else np.linalg.qr(fitted)[0]
    return EffectDirection.from_whitened_change(np.asarray(column, float).reshape(N, -1), fitted, positive=positive)


def axis(number, length=1.0):
    column = np.zeros(N)
    column[number] = length
    return column


def test_a_score_is_in_deviations_and_has_the_sign_of_the_effect():
    rng = np.random.default_rng(1)
    column, fitted = rng.normal(size=N), rng.normal(size=(N, 3))
    one = direction(column, fitted)
    # Data that have four trial sizes of it: model minus data is -4 times the change, plus what the fit takes up.
    residual = -4.0 * column + fitted @ [1.0, -2.0, 0.5]
    assert one.compute_score_components(residual)[0] / one.reach == pytest.approx(4.0)
    many = np.array([one.compute_score_components(noise)[0] for noise in rng.normal(size=(4000, N))])
    assert many.mean() == pytest.approx(0.0, abs=0.06) and many.std() == pytest.approx(1.0, abs=0.05)


def test_what_the_fit_takes_up_cannot_be_tested():
    fitted = np.random.default_rng(2).normal(size=(N, 3))
    assert direction(fitted @ [1.0, 2.0, 3.0], fitted).degrees_of_freedom == 0
    assert direction(np.zeros(N)).degrees_of_freedom == 0


def test_one_direction_has_its_own_probability():
    two_sided, one_sided = direction(axis(0)), direction(axis(0), positive=True)
    assert two_sided.compute_p_value(np.array([2.0])) == pytest.approx(2 * stats.norm.sf(2.0))
    assert one_sided.compute_p_value(np.array([2.0])) == pytest.approx(stats.norm.sf(2.0))
    assert one_sided.compute_p_value(np.array([-2.0])) == pytest.approx(stats.norm.cdf(2.0))
    for one in (two_sided, one_sided):
        expected = float(one.compute_p_value(np.array([2.0])))
        found = compute_familywise_p_values([one], [np.array([2.0])])[0]
        assert found == pytest.approx(expected, abs=4 * np.sqrt(expected / DIRECTIONS.draws))


@pytest.mark.parametrize("count", [5, 30])
def test_independent_directions_cost_what_sidak_says(count):
    several = [direction(axis(k)) for k in range(count)]
    scores = [np.array([3.0]), *(np.array([0.1]) for _ in range(count - 1))]
    expected = 1 - (1 - 2 * stats.norm.sf(3.0)) ** count
    found = compute_familywise_p_values(several, scores)[0]
    assert found == pytest.approx(expected, abs=4 * np.sqrt(expected / DIRECTIONS.draws))


def test_the_same_direction_many_times_costs_nothing():
    several = [direction(axis(0, length)) for length in (1.0, 2.0, 5.0)]
    found = compute_familywise_p_values(several, [np.array([2.5])] * 3)
    assert found == pytest.approx(2 * stats.norm.sf(2.5), abs=4 * np.sqrt(0.0125 / DIRECTIONS.draws))


def test_several_numbers_at_once_are_a_chi_square():
    both = direction(np.column_stack([axis(0), axis(1)]))
    assert both.degrees_of_freedom == 2
    assert both.compute_p_value(np.array([2.0, 1.0])) == pytest.approx(stats.chi2.sf(5.0, 2))


def test_twins_and_strangers():
    assert compute_largest_principal_cosine(direction(axis(0)), direction(axis(0, -3.0))) == pytest.approx(1.0)
    assert compute_largest_principal_cosine(direction(axis(0)), direction(axis(1))) == pytest.approx(0.0)
    assert compute_largest_principal_cosine(direction(axis(0) + axis(1)),
                                            direction(axis(0))) == pytest.approx(np.sqrt(0.5))


def test_nothing_to_look_at():
    assert compute_familywise_p_values([], []).size == 0
