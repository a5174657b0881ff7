"""Error factors of a reduced solid: the stated error covers the errors of the test states."""

import numpy as np
import pytest

from tissue_sim.fem.reduced.reduction import find_covering_factor
from tissue_sim.fem.reduced.settings import VERIFICATION

#: Errors above this value are substantial, over the rms force.
SUBSTANTIAL = 0.02


def find_factor(estimates, errors):
    estimates = np.array(estimates)
    return find_covering_factor(estimates, np.array(errors), np.full(len(estimates), SUBSTANTIAL))


def test_a_single_substantial_error_among_many_small_ones_is_covered():
    # The quantile alone would leave out one state of 1000.
    estimates, errors = [0.01] * 1000, [0.005] * 999 + [0.05]
    factor = find_factor(estimates, errors)
    assert factor * 0.01 + VERIFICATION.negligible_error == pytest.approx(0.05)


def test_a_rare_error_that_is_not_substantial_is_left_to_the_quantile():
    estimates, errors = [0.01] * 1000, [0.012] * 999 + [0.019]
    factor = find_factor(estimates, errors)
    assert factor * 0.01 + VERIFICATION.negligible_error == pytest.approx(0.012)


def test_the_fraction_of_the_settings_is_covered():
    generator = np.random.default_rng(3)
    estimates, errors = generator.uniform(1e-3, 1e-2, 2000), generator.uniform(0.0, SUBSTANTIAL, 2000)
    covered = errors <= find_factor(estimates, errors) * estimates + VERIFICATION.negligible_error
    assert covered.mean() == pytest.approx(VERIFICATION.coverage, abs=1e-3)


def test_states_without_an_estimate_give_no_factor():
    assert find_factor([0.0, 0.0], [0.5, 0.5]) == 0.0


def test_negligible_errors_give_no_factor():
    assert find_factor([0.01, 0.01], [0.0, 0.5 * VERIFICATION.negligible_error]) == 0.0
