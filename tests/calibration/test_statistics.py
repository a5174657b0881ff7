"""Noise, covariance and information criteria."""

import numpy as np
import pytest

from calibration.statistics import correlation, estimate_noise, information_criteria, r_squared, uncertainty


def linear_problem(rng, replicates=5, points=40, jitter=0.0, noise=1.0):
    """Line a + b x, each replicate shifted by jitter; least-squares answer, residual, Jacobian."""
    x = np.tile(np.linspace(0.0, 1.0, points), replicates)
    index = np.repeat(np.arange(replicates), points)
    jacobian = np.column_stack([np.ones_like(x), x])
    data = jacobian @ [2.0, 3.0] + rng.normal(0.0, noise, x.size) + jitter * rng.normal(size=replicates)[index]
    answer = np.linalg.lstsq(jacobian, data, rcond=None)[0]
    return answer, jacobian @ answer - data, jacobian, index


def coverage(jitter, stated, trials=400):
    """Share of 95 % intervals that hold the true values."""
    rng = np.random.default_rng(1)
    hits = []
    for _ in range(trials):
        answer, residual, jacobian, index = linear_problem(rng, jitter=jitter)
        columns = np.full((residual.size, 1), jitter) if stated else None
        spread = uncertainty(jacobian, residual, index, 1.0, np.zeros(2), columns)
        hits.append(np.abs(answer - [2.0, 3.0]) <= spread.quantile * spread.standard_errors)
    return np.mean(hits, axis=0)


def test_intervals_cover_under_white_noise():
    assert (np.abs(coverage(0.0, stated=False) - 0.95) < 0.035).all()


def test_stated_jitter_keeps_the_coverage_that_white_noise_loses():
    assert (coverage(1.0, stated=True) > 0.92).all()
    assert coverage(1.0, stated=False)[0] < 0.7


def test_scatter_of_replicates_is_seen_when_the_model_error_dominates():
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(300):
        answer, residual, jacobian, index = linear_problem(rng, replicates=8, jitter=10.0)
        spread = uncertainty(jacobian, residual, index, 1.0, np.zeros(2))
        assert spread.basis == "replicates"
        hits.append(abs(answer[0] - 2.0) <= spread.quantile * spread.standard_errors[0])
    assert np.mean(hits) > 0.9


def test_residuals_above_the_noise_widen_the_errors():
    answer, residual, jacobian, index = linear_problem(np.random.default_rng(3), replicates=1)
    believed = uncertainty(jacobian, residual, index, 1.0, np.zeros(2))
    doubted = uncertainty(jacobian, residual, index, 0.1, np.zeros(2))
    assert doubted.basis == "residuals"
    assert doubted.standard_errors == pytest.approx(believed.standard_errors, rel=0.3)
    assert answer.shape == (2,)


def test_prior_and_singular_direction():
    x = np.linspace(0.0, 1.0, 30)
    jacobian = np.column_stack([x, x, np.ones_like(x)])
    residual = np.random.default_rng(4).normal(0.0, 0.1, x.size)
    index = np.zeros(x.size, int)
    spread = uncertainty(jacobian, residual, index, 0.1, np.zeros(3))
    assert spread.singular.tolist() == [True, True, False]
    assert np.isinf(spread.standard_errors[:2]).all()
    held = uncertainty(jacobian, residual, index, 0.1, np.array([1.0, 0.0, 0.0]))
    assert not held.singular.any()
    assert held.standard_errors[0] == pytest.approx(1.0, rel=0.05)


def test_noise_from_second_differences():
    x = np.linspace(0.0, 1.0, 4000)
    curve = 50 * x + 30 * x**3
    noisy = curve + np.random.default_rng(5).normal(0.0, 0.3, x.size)
    assert estimate_noise(noisy) == pytest.approx(0.3, rel=0.06)
    noisy[::500] += 40.0
    assert estimate_noise(noisy) == pytest.approx(0.3, rel=0.08)
    assert 0 < estimate_noise(np.zeros(10)) < 1e-300
    assert estimate_noise(50 * x) < 1e-6


def test_criteria_and_correlation():
    residual = np.array([1.0, -1.0, 2.0, 0.0])
    aic, bic = information_criteria(residual, 2.0, 3)
    assert aic == pytest.approx(6.0 / 4.0 + 6.0)
    assert bic == pytest.approx(6.0 / 4.0 + 3.0 * np.log(4.0))
    assert r_squared(np.array([0.0, 1.0, 2.0, 3.0]), residual) == pytest.approx(1.0 - 6.0 / 5.0)
    covariance = np.array([[4.0, -2.0, 0.0], [-2.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    assert correlation(covariance) == pytest.approx(np.array([[1, -1 / 3, 0], [-1 / 3, 1, 0], [0, 0, 1]]))
