"""Specimens as a population: against closed forms, a published analysis by another program, and simulated ones."""

import numpy as np
import pytest
from scipy import stats

from calibration.statistics.population import estimate_population
from tissue_sim.errors import InputError


def alone(values, variances):
    """The population of one parameter."""
    values = np.asarray(values, dtype=float)
    return estimate_population(["a"], [str(i) for i in range(values.size)], values[:, None],
                               np.reshape(variances, (-1, 1, 1)))


@pytest.mark.parametrize("n", [2, 3, 5, 10])
def test_specimens_measured_without_error_are_an_ordinary_sample(n):
    x = np.random.default_rng(n).normal(1500.0, 200.0, n)
    found, deviation, t = alone(x, np.full(n, 1e-6)), x.std(ddof=1), stats.t.ppf(0.975, n - 1)
    assert found.mean[0] == pytest.approx(x.mean()) and found.spread[0] == pytest.approx(deviation, rel=1e-5)
    # The distribution of the spread is taken at 400 shares: the far tail of two specimens is cut a little short.
    rel = 0.03 if n == 2 else 0.005
    half = t * deviation * np.array([1 / np.sqrt(n), np.sqrt(1 + 1 / n)])
    ends = np.stack([found.mean_intervals[0], found.next_specimen[0]])
    np.testing.assert_allclose(ends - x.mean(), half[:, None] * [-1.0, 1.0], rtol=rel)
    squares = (n - 1) * deviation**2
    np.testing.assert_allclose(found.spread_intervals[0],
                               np.sqrt(squares / stats.chi2.ppf([0.975, 0.025], n - 1)), rtol=1e-5)
    np.testing.assert_allclose(found.shrunken[:, 0], x, rtol=1e-6)


def test_trials_of_a_vaccine():
    """13 trials of the BCG vaccine, log relative risks (Colditz et al., JAMA 271 (1994) 698): metafor prints
    for restricted likelihood a mean of -0.7145 with standard error 0.1798, tau^2 0.3132 and its Q-profile interval
    0.1197 to 1.1115 (Viechtbauer, J. Statistical Software 36 (2010) 3)."""
    treated = np.array([4, 6, 3, 62, 33, 180, 8, 505, 29, 17, 186, 5, 27])
    treated_well = np.array([119, 300, 228, 13536, 5036, 1361, 2537, 87886, 7470, 1699, 50448, 2493, 16886])
    control = np.array([11, 29, 11, 248, 47, 372, 10, 499, 45, 65, 141, 3, 29])
    control_well = np.array([128, 274, 209, 12619, 5761, 1079, 619, 87892, 7232, 1600, 27197, 2338, 17825])
    risks = treated / (treated + treated_well), control / (control + control_well)
    variances = (1 / treated - 1 / (treated + treated_well) + 1 / control - 1 / (control + control_well))
    found = alone(np.log(risks[0] / risks[1]), variances)
    assert found.mean[0] == pytest.approx(-0.7145, abs=5e-5) and found.mean_errors[0] == pytest.approx(0.1798, abs=5e-5)
    assert found.between[0, 0] == pytest.approx(0.3132, abs=1e-4)
    np.testing.assert_allclose(found.spread_intervals[0]**2, [0.1197, 1.1115], atol=1e-4)


def test_equal_specimens_have_no_scatter():
    """Estimates that differ by less than their errors: spread 0, each specimen shrunken to the mean."""
    found = alone([1000.0, 1010.0, 990.0, 1004.0], np.full(4, 50.0**2))
    assert found.spread[0] < 1.0 and found.spread_intervals[0, 0] == 0.0
    np.testing.assert_allclose(found.shrunken, 1001.0, atol=0.5)
    assert (found.shrunken_errors < 26.0).all() and found.mean_errors[0] == pytest.approx(25.0, rel=1e-3)


def test_scatter_of_two_parameters_and_its_correlation():
    """Many specimens: the covariance between them comes out of estimates whose own errors are correlated the other
    way."""
    rng = np.random.default_rng(3)
    between = np.array([[200.0**2, 0.8 * 200 * 90], [0.8 * 200 * 90, 90.0**2]])
    errors = np.array([[100.0**2, -0.9 * 100 * 60], [-0.9 * 100 * 60, 60.0**2]])
    truth = rng.multivariate_normal([1400.0, 700.0], between, 3000)
    estimates = truth + rng.multivariate_normal([0.0, 0.0], errors, 3000)
    found = estimate_population(["C10", "C20"], list(map(str, range(3000))), estimates, np.tile(errors, (3000, 1, 1)))
    np.testing.assert_allclose(found.mean, [1400.0, 700.0], atol=2.5 * found.mean_errors.max())
    np.testing.assert_allclose(found.spread, [200.0, 90.0], rtol=0.05)
    assert found.between[0, 1] / found.spread.prod() == pytest.approx(0.8, abs=0.05)
    # The shrunken ones are nearer to the truth than each alone, by as much as they say.
    left, alone_left = found.shrunken - truth, estimates - truth
    assert (np.std(left, axis=0) < 0.95 * np.std(alone_left, axis=0)).all()
    np.testing.assert_allclose(np.std(left, axis=0), found.shrunken_errors.mean(axis=0), rtol=0.12)


def test_intervals_hold_the_truth():
    """60 populations of five specimens, whose own errors are as large as the scatter; benchmarks/population.py has
    thousands. Fewer than 51 of 60 have a probability of 0.1 % for an interval of 95 %."""
    rng, held = np.random.default_rng(8), np.zeros(3)
    for _ in range(60):
        variances = rng.uniform(50.0, 200.0, 5)**2
        truth = rng.normal(1500.0, 120.0, 6)
        found = alone(truth[:5] + rng.normal(0.0, np.sqrt(variances)), variances)
        held += [low <= value <= high for (low, high), value in (
            (found.mean_intervals[0], 1500.0), (found.spread_intervals[0], 120.0), (found.next_specimen[0], truth[5]))]
    assert held.min() >= 51


def test_what_tells_nothing_is_refused():
    with pytest.raises(InputError, match="1 specimen says nothing about the scatter"):
        alone([1.0], [1.0])
    with pytest.raises(InputError, match="the fit of 1 does not determine a"):
        alone([1.0, 2.0], [1.0, np.inf])
    with pytest.raises(InputError, match="expected"):
        estimate_population(["a"], ["x", "y"], np.zeros((2, 2)), np.zeros((2, 2, 2)))
