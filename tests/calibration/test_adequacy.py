"""Score tests for what a model lacks."""

import numpy as np
import pytest
from scipy import stats

from calibration.statistics.adequacy import adjust_p_values_by_holm, compute_rao_score_test, make_cosine_modes
from calibration.statistics.sensor_noise import SensorNoise, whiten_columns
from tissue_sim.rig.rig import generate_sensor_noise

DEPTH = np.linspace(0.0, 1.0, 200)
PARAMETERS = np.column_stack([DEPTH, DEPTH**3])
#: A contact offset and a zero, in units of their prior deviations.
NUISANCES = np.column_stack([0.3 * (1 + 3 * DEPTH**2), np.full_like(DEPTH, 0.1)])


def fit(noise, misfit_force=0.0, seed=0, replicates=2):
    """Augmented residual (model minus data) and design at the optimum, and the modes, of a linear model."""
    rng = np.random.default_rng(seed)
    time = 40 * DEPTH
    rows, data, modes = [], [], []
    for r in range(replicates):
        own = np.zeros((DEPTH.size, 2 * replicates))
        own[:, 2 * r:2 * r + 2] = NUISANCES
        error = generate_sensor_noise(DEPTH.size, noise.deviation, 1000 * seed + r, time=time,
                                      correlation_time=noise.correlation_time)
        force = PARAMETERS @ [6.0, 2.0] + NUISANCES @ rng.normal(size=2) + misfit_force + error
        rows.append(whiten_columns(np.column_stack([PARAMETERS, own]), time, noise))
        data.append(whiten_columns(force, time, noise))
        modes.append(whiten_columns(make_cosine_modes(DEPTH, 5), time, noise))
    prior = np.column_stack([np.zeros((2 * replicates, 2)), np.eye(2 * replicates)])
    design = np.vstack([*rows, prior])
    data = np.concatenate([*data, np.zeros(2 * replicates)])
    modes = np.vstack([*modes, np.zeros((2 * replicates, 5))])
    optimum = np.linalg.lstsq(design, data, rcond=None)[0]
    return design @ optimum - data, design, modes


@pytest.mark.parametrize("noise", [SensorNoise(0.02), SensorNoise(0.02, 2.0)], ids=["white", "coloured"])
def test_p_is_uniform_where_the_model_is_right(noise):
    found = [compute_rao_score_test(*fit(noise, seed=seed)) for seed in range(400)]
    freedom = {one.freedom for one in found}
    assert freedom == {4}, "one combination of the five cosines is what the fit adjusts"
    assert stats.kstest([one.p for one in found], "uniform").pvalue > 0.05
    assert np.mean([one.statistic for one in found]) == pytest.approx(4.0, abs=4 * np.sqrt(2 * 4 / 400))


def test_coloured_noise_taken_as_white_raises_false_alarms():
    """The whitening is what keeps the test honest."""
    coloured = SensorNoise(0.02, 2.0)
    alarms = 0
    for seed in range(100):
        residual, design, modes = fit(coloured, seed=seed)
        alarms += compute_rao_score_test(residual, design, modes).p < 0.05
    assert alarms < 12
    alarms = 0
    for seed in range(100):
        rng_error = generate_sensor_noise(DEPTH.size, 0.02, seed, time=40 * DEPTH, correlation_time=2.0) / 0.02
        answer = np.linalg.lstsq(PARAMETERS, rng_error, rcond=None)[0]
        alarms += compute_rao_score_test(PARAMETERS @ answer - rng_error, PARAMETERS,
                                         make_cosine_modes(DEPTH, 5)).p < 0.05
    assert alarms > 50


def test_a_smooth_misfit_below_the_noise_is_found():
    """0.015 N, with 0.02 N of noise on a sample and 8 N of force: R-squared above 0.9999 would hide it."""
    lacking = 0.015 * np.cos(3 * np.pi * DEPTH)
    found = [compute_rao_score_test(*fit(SensorNoise(0.02), lacking, seed)).p < 0.01 for seed in range(50)]
    assert np.mean(found) > 0.9


def test_amplitudes_have_the_sign_and_size_of_what_the_data_have_more():
    lacking = 0.3 * make_cosine_modes(DEPTH, 5)[:, 3] - 0.1 * make_cosine_modes(DEPTH, 5)[:, 4]
    found = np.mean([compute_rao_score_test(*fit(SensorNoise(0.02), lacking, seed)).amplitudes for seed in range(20)],
                    axis=0)
    residual, design, modes = fit(SensorNoise(0.02), lacking)
    # Only what the fit does not absorb can be compared: project truth and estimate.
    free = modes - design @ np.linalg.lstsq(design, modes, rcond=None)[0]
    truth = free @ [0, 0, 0, 0.3, -0.1]
    assert np.linalg.norm(free @ found - truth) < 0.15 * np.linalg.norm(truth)
    assert found[3] > 0.1
    assert free[:, 3] @ residual < 0, "the residual is model minus data"


def test_the_statistic_is_the_gain_of_a_fit_with_the_modes():
    """For a linear model the score test is the likelihood-ratio test."""
    residual, design, modes = fit(SensorNoise(0.02), 0.02 * np.cos(3 * np.pi * DEPTH))
    modes = modes[:, 3:]
    both = np.column_stack([design, modes])
    more = residual - both @ np.linalg.lstsq(both, residual, rcond=None)[0]
    found = compute_rao_score_test(residual, design, modes)
    assert found.statistic == pytest.approx(residual @ residual - more @ more, rel=1e-9)
    assert found.freedom == 2
    assert found.p == pytest.approx(stats.chi2.sf(found.statistic, 2))


def test_a_misfit_that_the_fit_absorbs_is_not_seen():
    residual, design, modes = fit(SensorNoise(0.02), 0.5 * DEPTH)
    whole = compute_rao_score_test(residual, design, modes)
    assert whole.p > 0.01
    widened = np.column_stack([design, modes[:, 2]])
    assert compute_rao_score_test(residual, widened, modes).freedom == whole.freedom - 1
    nothing = compute_rao_score_test(residual, design, design[:, :2])
    assert (nothing.freedom, nothing.statistic, nothing.p) == (0, 0.0, 1.0)
    assert not nothing.amplitudes.any()


def test_scale_and_dependence_of_columns_do_not_matter():
    residual, design, modes = fit(SensorNoise(0.02), 0.02 * np.cos(3 * np.pi * DEPTH))
    plain = compute_rao_score_test(residual, design, modes)
    scaled = compute_rao_score_test(residual, np.column_stack([design * 10.0**np.arange(-6, 6, 2), design[:, 0],
                                                               0 * design[:, 0]]),
                    np.column_stack([modes, modes[:, 0]]))
    assert scaled.freedom == plain.freedom
    assert scaled.statistic == pytest.approx(plain.statistic, rel=1e-6)


def test_a_region_without_samples_has_no_misfit():
    residual, design, modes = fit(SensorNoise(0.02))
    assert compute_rao_score_test(residual, design, 0 * modes).p == 1.0
    assert compute_rao_score_test(residual, design, modes[:, :0]).freedom == 0


def test_cosine_modes():
    modes = make_cosine_modes(np.array([0.0, 0.25, 1.0]), 3)
    assert modes == pytest.approx(np.array([[1, 1, 1], [1, np.sqrt(0.5), 0], [1, -1, 1]]))
    assert make_cosine_modes(np.zeros(4), 5).shape == (4, 5)


def test_holm():
    """The smallest of four times 4, the next times 3, and so on; never falling, at most 1."""
    assert adjust_p_values_by_holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert adjust_p_values_by_holm([0.9, 0.6]) == pytest.approx([1.0, 1.0])
    assert adjust_p_values_by_holm([]).size == 0


def test_holm_keeps_false_alarms_of_a_family_at_their_level():
    p = np.random.default_rng(3).uniform(size=(4000, 7))
    alarms = np.mean([adjust_p_values_by_holm(row).min() < 0.05 for row in p])
    assert alarms == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 4000))
