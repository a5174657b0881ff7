"""Noise, covariance and information criteria."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from calibration.statistics.statistics import (
    compute_aic_and_bic,
    compute_chi_square_and_effective_samples,
    compute_correlation_matrix,
    compute_r_squared,
    estimate_white_noise,
    find_quantisation_step,
    get_effective_samples_and_variance_ratio,
)
from calibration.statistics.uncertainty import compute_cluster_robust_uncertainty


def linear_problem(rng, replicates=5, points=40, jitter=0.0, noise=1.0):
    """Line a + b x, each replicate shifted by jitter; least-squares answer, residual, Jacobian."""
    x = np.tile(np.linspace(0.0, 1.0, points), replicates)
    index = np.repeat(np.arange(replicates), points)
    jacobian = np.column_stack([np.ones_like(x), x])
    data = jacobian @ [2.0, 3.0] + rng.normal(0.0, noise, x.size) + jitter * rng.normal(size=replicates)[index]
    answer = np.linalg.lstsq(jacobian, data, rcond=None)[0]
    return answer, jacobian @ answer - data, jacobian, index


def coverage(jitter, stated, trials=400, replicates=5):
    """Share of 95 % intervals that hold the true values."""
    rng = np.random.default_rng(1)
    hits = []
    for _ in range(trials):
        answer, residual, jacobian, index = linear_problem(rng, replicates, jitter=jitter)
        columns = np.full((residual.size, 1), jitter) if stated else None
        spread = compute_cluster_robust_uncertainty(jacobian, residual, index, 1.0, np.zeros(2), columns)
        hits.append(np.abs(answer - [2.0, 3.0]) <= spread.quantile * spread.standard_errors)
    return np.mean(hits, axis=0)


def test_intervals_cover_under_white_noise():
    assert (np.abs(coverage(0.0, stated=False, replicates=2) - 0.95) < 0.035).all()
    assert (coverage(0.0, stated=False) > 0.93).all()


@pytest.mark.parametrize("jitter", [0.3, 1.0])
@pytest.mark.parametrize("replicates", [3, 5])
def test_jitter_between_replicates_is_covered_stated_or_not(jitter, replicates):
    """Also where the residuals hardly exceed the noise, so that only the replicates' scatter shows it."""
    assert (coverage(jitter, stated=True, replicates=replicates) > 0.92).all()
    assert (coverage(jitter, stated=False, replicates=replicates) > 0.92).all()


def test_white_noise_alone_hardly_widens_the_scatter_of_replicates():
    rng = np.random.default_rng(6)
    answers, errors = [], []
    for _ in range(300):
        answer, residual, jacobian, index = linear_problem(rng, replicates=5)
        answers.append(answer)
        errors.append(compute_cluster_robust_uncertainty(jacobian, residual, index, 1.0, np.zeros(2)).standard_errors)
    ratio = np.mean(errors, axis=0) / np.std(answers, axis=0)
    assert (ratio > 0.93).all() and (ratio < 1.3).all()


def test_every_replicate_counts_with_its_own_noise():
    """One replicate a hundred times quieter than the other: pooled noise would be wrong for both parameters."""
    rng = np.random.default_rng(7)
    noise, index = np.array([1.0, 0.01]), np.repeat([0, 1], [30, 300])
    x = np.concatenate([np.linspace(0.0, 1.0, 30), np.linspace(0.0, 0.1, 300)])
    jacobian = np.column_stack([np.ones_like(x), x])
    answers, errors, squares = [], [], []
    for _ in range(400):
        data = jacobian @ [2.0, 3.0] + rng.normal(size=x.size) * noise[index]
        answer = np.linalg.lstsq(jacobian, data, rcond=None)[0]
        residual = jacobian @ answer - data
        answers.append(answer)
        errors.append(compute_cluster_robust_uncertainty(jacobian, residual, index, noise, np.zeros(2)).standard_errors)
        squares.append(compute_chi_square_and_effective_samples(data - jacobian @ [2.0, 3.0], index, noise)[0])
    # The median: a few of the trials take their residuals for the noise.
    assert np.median(errors, axis=0) == pytest.approx(np.std(answers, axis=0), rel=0.15)
    assert np.mean(squares) == pytest.approx(x.size, rel=0.03)


def test_interpolated_points_are_worth_their_samples():
    samples = 40
    grid = np.linspace(0.0, samples - 1.0, 400)
    left = np.minimum(grid.astype(int), samples - 2)
    share = grid - left
    rows = np.arange(grid.size)
    places = np.tile(rows, 2), np.concatenate([left, left + 1])
    interpolation = csr_array((np.concatenate([1 - share, share]), places), shape=(grid.size, samples))
    count, kept = get_effective_samples_and_variance_ratio(interpolation, grid.size)
    assert 0.7 * samples < count < samples and kept == pytest.approx(2 / 3, rel=0.01)
    assert get_effective_samples_and_variance_ratio(None, 7) == (7.0, 1.0)
    jacobian = np.column_stack([np.ones_like(grid), grid / samples])
    index = np.zeros(grid.size, int)
    rng, answers, errors, squares = np.random.default_rng(8), [], [], []
    for _ in range(400):
        error = interpolation @ rng.normal(size=samples)
        answer = np.linalg.lstsq(jacobian, error, rcond=None)[0]
        answers.append(answer)
        spread = compute_cluster_robust_uncertainty(jacobian, jacobian @ answer - error, index, 1.0, np.zeros(2), None,
                                                    [interpolation])
        errors.append(spread.standard_errors)
        squares.append(compute_chi_square_and_effective_samples(error, index, np.ones(1), [interpolation]))
    assert np.median(errors, axis=0) == pytest.approx(np.std(answers, axis=0), rel=0.12)
    total, number = np.mean(squares, axis=0)
    assert total == pytest.approx(number, rel=0.05)


def test_a_prior_that_holds_a_parameter_keeps_its_error_small():
    """The scatter of the replicates says nothing about what the prior says."""
    rng = np.random.default_rng(9)
    x = np.tile(np.linspace(0.0, 1.0, 40), 4)
    index = np.repeat(np.arange(4), 40)
    jacobian = np.column_stack([np.ones_like(x), x])
    data = jacobian @ [2.0, 3.0] + rng.normal(size=x.size) + 5.0 * rng.normal(size=4)[index]
    precision = np.array([1e6, 0.0])
    # Prior mean 0, two thousand standard deviations from the truth.
    answer = np.linalg.solve(jacobian.T @ jacobian + np.diag(precision), jacobian.T @ data)
    spread = compute_cluster_robust_uncertainty(jacobian, jacobian @ answer - data, index, 1.0, precision)
    assert spread.basis == "replicates"
    assert spread.standard_errors[0] == pytest.approx(1e-3, rel=0.1)


def test_scatter_of_replicates_is_seen_when_the_model_error_dominates():
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(300):
        answer, residual, jacobian, index = linear_problem(rng, replicates=8, jitter=10.0)
        spread = compute_cluster_robust_uncertainty(jacobian, residual, index, 1.0, np.zeros(2))
        assert spread.basis == "replicates"
        hits.append(abs(answer[0] - 2.0) <= spread.quantile * spread.standard_errors[0])
    assert np.mean(hits) > 0.9


def test_residuals_above_the_noise_widen_the_errors():
    answer, residual, jacobian, index = linear_problem(np.random.default_rng(3), replicates=1)
    believed = compute_cluster_robust_uncertainty(jacobian, residual, index, 1.0, np.zeros(2))
    doubted = compute_cluster_robust_uncertainty(jacobian, residual, index, 0.1, np.zeros(2))
    assert doubted.basis == "residuals"
    assert doubted.standard_errors == pytest.approx(believed.standard_errors, rel=0.3)
    assert answer.shape == (2,)


def test_prior_and_singular_direction():
    x = np.linspace(0.0, 1.0, 30)
    jacobian = np.column_stack([x, x, np.ones_like(x)])
    residual = np.random.default_rng(4).normal(0.0, 0.1, x.size)
    index = np.zeros(x.size, int)
    spread = compute_cluster_robust_uncertainty(jacobian, residual, index, 0.1, np.zeros(3))
    assert np.isinf(spread.standard_errors).tolist() == [True, True, False]
    assert np.isinf(spread.standard_errors[:2]).all()
    held = compute_cluster_robust_uncertainty(jacobian, residual, index, 0.1, np.array([1.0, 0.0, 0.0]))
    assert not np.isinf(held.standard_errors).any()
    assert held.standard_errors[0] == pytest.approx(1.0, rel=0.05)


def test_noise_from_second_differences():
    x = np.linspace(0.0, 1.0, 4000)
    curve = 50 * x + 30 * x**3
    noisy = curve + np.random.default_rng(5).normal(0.0, 0.3, x.size)
    assert estimate_white_noise(noisy) == pytest.approx(0.3, rel=0.06)
    noisy[::500] += 40.0
    assert estimate_white_noise(noisy) == pytest.approx(0.3, rel=0.08)
    assert 0 < estimate_white_noise(np.zeros(10)) < 1e-300
    assert estimate_white_noise(50 * x) < 1e-6


def test_noise_of_uneven_samples_is_not_their_slope():
    rng = np.random.default_rng(11)
    x = np.sort(rng.uniform(0.0, 1.0, 3000))
    noisy = 3000 * x + 30 * x**3 + rng.normal(0.0, 0.1, x.size)
    assert estimate_white_noise(noisy) > 0.3, "even steps would be assumed"
    assert estimate_white_noise(noisy, x) == pytest.approx(0.1, rel=0.06)
    # A coarse encoder below a smooth force: the order of the samples knows better than the abscissa.
    even = np.linspace(0.0, 1.0, 3000)
    staircase = np.round(even * 200) / 200
    noisy = 3000 * even + rng.normal(0.0, 0.1, even.size)
    assert estimate_white_noise(noisy, staircase) == pytest.approx(0.1, rel=0.06)


def test_resolution_of_a_quantised_signal():
    rng = np.random.default_rng(10)
    ramp = np.linspace(0.0, 8.0, 5000)**1.2
    for step in (0.02, 1.0 / 300.0, 7.0):
        rounded = step * np.round(ramp / step)
        assert find_quantisation_step(rounded) == pytest.approx(step, rel=1e-6)
        assert find_quantisation_step(-3e4 * rounded) == pytest.approx(3e4 * step, rel=1e-6)
    noisy = 0.02 * np.round((ramp + rng.normal(0.0, 0.03, ramp.size)) / 0.02)
    assert find_quantisation_step(noisy) == pytest.approx(0.02, rel=1e-6)
    # Second differences alone see nothing in the staircase, and enough in the noisy one.
    assert estimate_white_noise(0.02 * np.round(ramp / 0.02)) < 1e-6
    assert estimate_white_noise(noisy) == pytest.approx(np.hypot(0.03, 0.02 / np.sqrt(12)), rel=0.25)
    for smooth in (ramp, ramp + rng.normal(0.0, 0.01, ramp.size), np.zeros(10), 50 * ramp, np.arange(20.0)):
        assert find_quantisation_step(smooth) == 0.0


def test_criteria_and_correlation():
    residual = np.array([1.0, -1.0, 2.0, 0.0])
    squares, samples = compute_chi_square_and_effective_samples(residual, np.zeros(4, int), np.array([2.0]))
    assert (squares, samples) == (6.0 / 4.0, 4.0)
    aic, bic = compute_aic_and_bic(squares, samples, 3)
    assert aic == pytest.approx(6.0 / 4.0 + 6.0)
    assert bic == pytest.approx(6.0 / 4.0 + 3.0 * np.log(4.0))
    assert compute_r_squared(np.array([0.0, 1.0, 2.0, 3.0]), residual) == pytest.approx(1.0 - 6.0 / 5.0)
    covariance = np.array([[4.0, -2.0, 0.0], [-2.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    assert compute_correlation_matrix(covariance) == pytest.approx(np.array([[1, -1 / 3, 0], [-1 / 3, 1, 0],
                                                                             [0, 0, 1]]))
