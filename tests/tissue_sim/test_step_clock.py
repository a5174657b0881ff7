"""Conversion of a budget in wall time to linear solves."""

from time import perf_counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tissue_sim.realtime.path_following import StepBudget, StepTimeEstimator, count_solves_in_budget_or_none


def followed(fixed, solve, noise=0.0, steps=600, seed=1):
    """A clock that has seen steps of 0 to 4 solves."""
    rng, clock = np.random.default_rng(seed), StepTimeEstimator()
    clock.restart_estimate_from_solve_time(0.2e-3)
    for solves in rng.choice(5, steps, p=[0.2, 0.4, 0.2, 0.1, 0.1]):
        clock.update_estimate((fixed + solves * solve) * (1.0 + noise * rng.random()), int(solves))
    return clock


@pytest.mark.parametrize(("fixed", "solve"), [(0.4e-3, 0.06e-3), (0.1e-3, 0.1e-3), (1e-3, 0.2e-3)])
def test_fixed_time_and_time_per_solve_are_separated(fixed, solve):
    clock = followed(fixed, solve, noise=0.1)
    assert clock.solve == pytest.approx(solve, rel=0.5)
    for solves in (0, 2, 4):
        assert clock.fixed + solves * clock.solve == pytest.approx(1.05 * (fixed + solves * solve), rel=0.2)
    assert clock.count_fitting_solves(fixed + 3.5 * solve + 0.15 * fixed) in (2, 3, 4)


def test_no_solve_fits_into_less_than_the_fixed_time():
    clock = followed(0.4e-3, 0.05e-3)
    assert clock.count_fitting_solves(0.3e-3) == -1 and clock.count_fitting_solves(0.0) == -1
    assert clock.count_fitting_solves(0.43e-3) == 0 and clock.count_fitting_solves(0.43e-3, first=True) == 1
    clock.halve_fixed_time()
    assert clock.count_fitting_solves(0.3e-3) > 0


def test_one_slow_step_changes_the_estimate_only_briefly():
    """A step that was interrupted for 20 ms must not stop the next ones from being tried."""
    clock = followed(0.3e-3, 0.05e-3)
    clock.update_estimate(20e-3, 1)
    assert clock.count_fitting_solves(0.8e-3) > 0


def test_equal_steps_do_not_change_the_time_per_solve():
    clock = StepTimeEstimator()
    clock.restart_estimate_from_solve_time(0.1e-3)
    for _ in range(1000):
        clock.update_estimate(0.5e-3, 1)
    assert clock.solve == 0.1e-3 and clock.fixed == pytest.approx(0.4e-3)


@given(st.lists(st.tuples(st.floats(0.0, 10.0), st.integers(0, 50)), max_size=100))
def test_estimates_stay_positive_and_finite_for_any_steps(steps):
    clock = StepTimeEstimator()
    clock.restart_estimate_from_solve_time(1e-4)
    for time, solves in steps:
        clock.update_estimate(time, solves)
        assert 0.0 < clock.fixed < 1e3 and 0.0 < clock.solve < 1e3
        assert clock.count_fitting_solves(1e9) >= 0


def test_stiffnesses_count_against_the_number_of_solves():
    allowance = StepBudget(StepTimeEstimator(), 6, None)
    assert allowance.count_fitting_solves() == 5 and allowance.count_fitting_solves(answers=2) == 4
    allowance.subtract_solves(2)
    assert allowance.count_fitting_solves() == 2
    allowance.subtract_solves(0, answers=2)
    assert allowance.count_fitting_solves() == 0
    assert StepBudget(StepTimeEstimator(), None, None).count_fitting_solves() > 10**8


def test_the_shorter_of_number_and_time_counts():
    clock = StepTimeEstimator()
    clock.restart_estimate_from_solve_time(1.0)
    now = perf_counter()
    assert StepBudget(clock, 3, now + 100.0).count_fitting_solves() == 2
    assert StepBudget(clock, 300, now + 10.5).count_fitting_solves() == 9
    assert StepBudget(clock, 300, now - 1.0).count_fitting_solves() < 1


@pytest.mark.parametrize(("left", "fixed"), [(10, 0.5), (1, 1.0)], ids=["by time", "by number"])
def test_estimate_is_lowered_only_if_time_was_the_limit(left, fixed):
    clock = StepTimeEstimator()
    clock.restart_estimate_from_solve_time(1.0)
    StepBudget(clock, left, perf_counter() - 1.0).lower_time_estimate_if_nothing_begun()
    assert clock.fixed == fixed


def test_number_of_solves_in_a_budget():
    assert count_solves_in_budget_or_none(0.8e-3, 0.1001e-3) == 7 and count_solves_in_budget_or_none(1e-9, 1.0) == 3
    assert count_solves_in_budget_or_none(None, 1.0) is None and count_solves_in_budget_or_none(1.0, None) is None
