"""Level and colour of a sensor's noise, from recordings whose noise is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.statistics.sensor_noise import SensorNoise, estimate_pooled_sensor_noise, whiten_columns
from tissue_sim.errors import InputError
from tissue_sim.rig.rig import generate_sensor_noise

TIME = np.linspace(0.0, 40.0, 401)
WAY = TIME / 40.0
CURVES = {"none": 0.0 * WAY, "cubic": 8 * (0.4 * WAY + 0.3 * WAY**2 + 0.3 * WAY**3), "sphere": 8 * WAY**1.5,
          "cone": 8 * WAY**2}


def estimate_sensor_noise(force, time, segment=None, **stated):
    """The case of one recording."""
    return estimate_pooled_sensor_noise([(force, time, segment)], **stated)


def estimates(force, level, tau, trials, time=TIME, segment=None, replicates=1):
    """Deviation in units of the true one, and correlation time, of each trial, shape (trials, 2)."""
    found = []
    for trial in range(trials):
        signals = [(force + generate_sensor_noise(force.size, level, 100 * trial + r, time=time, correlation_time=tau),
                    time,
                    segment) for r in range(replicates)]
        one = estimate_pooled_sensor_noise(signals)
        assert one.source == "estimated"
        found.append((one.deviation / level, one.correlation_time))
    return np.array(found)


def ramp_hold_unload(rate=10.0):
    """A ramp of 40 s, a hold of 60 s with relaxations of 2 and 20 s, an unloading of 40 s; time, force, segment."""
    ramp, hold, unload = np.split(np.arange(0.0, 140.0, 1 / rate), [round(40 * rate), round(100 * rate)])
    up = 7 * ramp / 40 + (ramp / 40)**2
    held = 8 - 2 * (1 - np.exp(-(hold - 40) / 2)) - 0.5 * (1 - np.exp(-(hold - 40) / 20))
    down = (held[-1] + 1) * ((140 - unload) / 40)**1.5 - np.exp(-(unload - 100) / 2)
    return (np.concatenate([ramp, hold, unload]), np.concatenate([up, held, down]),
            np.repeat(["ramp", "hold", "unload"], [ramp.size, hold.size, unload.size]))


@pytest.mark.parametrize("level", [0.02, 0.002])
@pytest.mark.parametrize("curve", CURVES)
def test_white_noise_on_a_smooth_curve(curve, level):
    """0.02 N and 0.002 N on 8 N: the curve is not noise, and 400 samples give the level to 3.5 %."""
    found = estimates(CURVES[curve], level, 0.0, 60)
    assert found[:, 0].mean() == pytest.approx(1.0, abs=4 / np.sqrt(2 * 400 * 60) + 0.01)
    assert found[:, 0].std() == pytest.approx(1 / np.sqrt(800), rel=0.35)
    assert np.mean(found[:, 1] == 0) >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("curve", ["none", "sphere"])
@pytest.mark.parametrize(("tau", "factor", "spread"), [(0.05, 1.15, 1.4), (0.2, 1.1, 1.4), (1.0, 1.15, 2.2)])
def test_correlation_times_of_three_replicates(curve, tau, factor, spread):
    """The median of the estimates is right within a factor, nine in ten are within the spread."""
    found = estimates(CURVES[curve], 0.02, tau, 40, replicates=3)
    coloured = found[found[:, 1] > 0]
    assert len(coloured) >= (30 if tau == 0.05 else 40), "half a step of the samples is hardly a colour"
    ratios = coloured[:, 1] / tau
    assert 1 / factor < np.median(ratios) < factor
    assert np.mean((ratios > 1 / spread) & (ratios < spread)) >= 0.85
    assert found[:, 0].mean() == pytest.approx(1.0, abs=0.05)


def test_one_recording_tells_colour_too():
    found = estimates(CURVES["cubic"], 0.02, 0.2, 40)
    assert np.mean(found[:, 1] > 0) >= 0.9
    assert np.median(found[:, 1]) == pytest.approx(0.2, rel=0.15)


@pytest.mark.slow
def test_the_trend_does_not_eat_noise_of_a_twentieth_of_the_segment():
    """Nor, beyond a factor of two of its variance, of a tenth."""
    found = estimates(CURVES["sphere"], 0.02, 2.0, 40, replicates=3)
    assert found[:, 0].mean() == pytest.approx(1.0, abs=0.12)
    assert 1.2 < np.median(found[:, 1]) < 3.0
    found = estimates(CURVES["sphere"], 0.02, 4.0, 40, replicates=3)
    assert np.mean(found[:, 0]) > np.sqrt(0.5)
    assert 1.8 < np.median(found[:, 1]) < 6.0


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.02, 0.002])
@pytest.mark.parametrize("tau", [0.0, 0.2, 1.0])
def test_ramp_hold_and_unload(level, tau):
    time, force, segment = ramp_hold_unload()
    found = estimates(force, level, tau, 20, time, segment)
    assert found[:, 0].mean() == pytest.approx(1.0, abs=0.06)
    if tau:
        assert np.median(found[:, 1]) == pytest.approx(tau, rel=0.15)
    else:
        assert np.mean(found[:, 1] == 0) >= 0.9


def test_a_relaxation_a_hundred_times_shorter_than_the_hold():
    time = np.arange(0.0, 60.0, 0.1)
    found = estimates(6 + 2 * np.exp(-time / 0.6), 0.02, 0.0, 20, time)
    assert found[:, 0].mean() == pytest.approx(1.0, abs=0.04)
    assert np.mean(found[:, 1] == 0) >= 0.9


@pytest.mark.parametrize("tau", [0.0, 0.2, 1.0])
def test_uneven_times(tau):
    time = np.cumsum(np.random.default_rng(5).exponential(0.1, 401))
    found = estimates(8 * (time / time[-1])**1.5, 0.02, tau, 30, time, replicates=2)
    assert found[:, 0].mean() == pytest.approx(1.0, abs=0.07)
    if tau:
        assert np.median(found[:, 1]) == pytest.approx(tau, rel=0.2)
    else:
        assert np.mean(found[:, 1] == 0) >= 0.9


def test_time_stamps_that_repeat():
    """A clock of half a second under samples at 10 Hz."""
    stamps = np.floor(TIME / 0.5) * 0.5
    found = [estimate_sensor_noise(CURVES["sphere"] + generate_sensor_noise(401, 0.02, seed, time=TIME,
                                                                            correlation_time=0.2),
                                   stamps) for seed in range(40)]
    assert np.mean([one.deviation for one in found]) == pytest.approx(0.02, rel=0.05)
    assert np.median([one.correlation_time for one in found]) == pytest.approx(0.2, rel=0.15)


def test_twenty_samples():
    time = np.linspace(0.0, 40.0, 20)
    found = estimates(8 * (time / 40)**1.5, 0.02, 0.0, 200, time)
    assert np.sqrt(np.mean(found[:, 0]**2)) == pytest.approx(1.0, abs=0.06)
    assert np.mean(found[:, 1] == 0) >= 0.9
    shared = estimates(8 * (time / 40)**1.5, 0.02, 0.0, 60, time, replicates=3)
    assert shared[:, 0].std() < 0.75 * found[:, 0].std(), "three replicates know their sensor better than one"


@pytest.mark.parametrize("level", [0.0, 0.005, 0.02, 0.05])
@pytest.mark.parametrize("curve", ["sphere", "cubic"])
def test_quantised_signals(curve, level):
    """The rounding error of a step q is q/sqrt(12), in addition to noise or alone."""
    rng, step = np.random.default_rng(7), 0.02
    found = [estimate_sensor_noise(step * np.round((CURVES[curve] + level * rng.standard_normal(401)) / step), TIME)
             for _ in range(20)]
    expected = np.hypot(level, step / np.sqrt(12))
    assert np.mean([one.deviation for one in found]) == pytest.approx(expected, rel=0.06)
    assert min(one.deviation for one in found) >= step / np.sqrt(12) * (1 - 1e-9)
    assert np.mean([one.correlation_time == 0 for one in found]) >= 0.9


def test_a_hold_inside_one_step_of_the_sensor_has_its_rounding_error():
    force = np.concatenate([np.linspace(0.0, 2.0, 200), np.full(400, 2.0), np.full(400, 1.98)])
    one = estimate_sensor_noise(0.02 * np.round(force / 0.02), None, np.repeat(["ramp", "hold"], [200, 800]))
    assert one.deviation >= 0.02 / np.sqrt(12) * (1 - 1e-9)
    ramp = estimate_sensor_noise(np.repeat(0.02 * np.arange(80.0), 5), None)
    assert ramp.source == "resolution" or ramp.deviation >= 0.02 / np.sqrt(12)


def test_what_is_stated_is_kept():
    force = CURVES["sphere"] + generate_sensor_noise(401, 0.02, 3, time=TIME, correlation_time=0.5)
    assert estimate_sensor_noise(force, TIME, deviation=0.03, correlation_time=0.0) == SensorNoise(0.03)
    level = estimate_sensor_noise(force, TIME, correlation_time=0.5)
    assert (level.correlation_time, level.source) == (0.5, "estimated")
    assert level.deviation == pytest.approx(0.02, rel=0.25)
    white = estimate_sensor_noise(force, TIME, correlation_time=0.0)
    assert (white.correlation_time, white.source) == (0.0, "estimated")
    colour = estimate_sensor_noise(force, TIME, deviation=0.02)
    assert (colour.deviation, colour.source) == (0.02, "stated")
    assert colour.correlation_time == pytest.approx(0.5, rel=0.4)


@pytest.mark.parametrize("stated", [0.005, 0.02, 0.1])
def test_a_wrong_level_makes_no_colour_and_hides_none(stated):
    for tau in (0.0, 0.5):
        found = [estimate_sensor_noise(CURVES["sphere"] + generate_sensor_noise(401, 0.02, seed, time=TIME,
                                                                                correlation_time=tau), TIME,
                                       deviation=stated)
                 for seed in range(20)]
        assert {one.deviation for one in found} == {stated}
        assert np.median([one.correlation_time for one in found]) == pytest.approx(tau, rel=0.25)
        assert np.mean([(one.correlation_time > 0) == (tau > 0) for one in found]) >= 0.9


def test_the_restricted_likelihood_counts_what_trends_absorb():
    """Thirty segments of eight samples: two or three of them go into each trend, and the variance is still right."""
    segment = np.repeat(np.arange(30), 8)
    found = [estimate_sensor_noise(np.random.default_rng(seed).normal(0.0, 0.02, 240), np.arange(240.0), segment,
                                   correlation_time=0.0).deviation for seed in range(60)]
    assert np.mean(np.square(found)) == pytest.approx(4e-4, rel=0.05)


def test_force_without_noise_has_a_level_above_zero():
    assert 0 < estimate_sensor_noise(CURVES["cubic"], TIME).deviation < 1e-7
    assert estimate_sensor_noise(CURVES["none"], TIME).deviation > 0
    constant = estimate_sensor_noise(np.full(50, 3.0), None)
    assert constant.deviation == pytest.approx(3e-9)
    assert constant.correlation_time == 0


@pytest.mark.parametrize("arguments", [dict.fromkeys(["deviation"], 0.0), {"deviation": np.nan},
                                       {"deviation": 1.0, "correlation_time": -1.0}])
def test_values_that_are_no_noise(arguments):
    with pytest.raises(InputError):
        SensorNoise(**arguments)


def test_too_few_samples():
    with pytest.raises(InputError, match="no segment has the 4 samples"):
        estimate_sensor_noise(np.arange(6.0), None, ["a", "a", "b", "b", "c", "c"])
    assert np.isfinite(estimate_sensor_noise(np.array([0.0, 1.1, 1.9, 3.0]), None).deviation)


@settings(max_examples=60, deadline=None)
@given(steps=st.lists(st.floats(1e-3, 10.0), min_size=2, max_size=30), tau=st.floats(1e-2, 100.0),
       deviation=st.floats(1e-3, 10.0))
def test_whitening_is_the_dense_cholesky_factor(steps, tau, deviation):
    time = np.cumsum(steps)
    covariance = deviation**2 * np.exp(-np.abs(time[:, None] - time) / tau)
    columns = np.random.default_rng(0).normal(size=(time.size, 3))
    expected = np.linalg.solve(np.linalg.cholesky(covariance), columns)
    noise = SensorNoise(deviation, tau)
    assert whiten_columns(columns, time, noise) == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(expected).max())
    assert whiten_columns(columns[:, 0], time, noise) == pytest.approx(whiten_columns(columns, time, noise)[:, 0])


def test_whitened_noise_is_white():
    time = np.cumsum(np.random.default_rng(1).exponential(0.1, 5000))
    noise = SensorNoise(0.02, 0.5)
    white = whiten_columns(generate_sensor_noise(5000, 0.02, 1, time=time, correlation_time=0.5), time, noise)
    assert white.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * 5000))
    assert abs(np.mean(white[1:] * white[:-1])) < 4 / np.sqrt(5000)


def test_whitening_with_equal_or_no_times():
    values = np.arange(6.0)
    assert whiten_columns(values, None, SensorNoise(0.5)) == pytest.approx(2 * values)
    numbered = whiten_columns(values, np.arange(6.0), SensorNoise(0.5, 2.0))
    assert whiten_columns(values, None, SensorNoise(0.5, 2.0)) == pytest.approx(numbered)
    # Stamps 0, 0, 2, 2, 4, 4 are 0, 1, 2, 3, 4, 5 read from a coarse clock.
    assert whiten_columns(values, np.array([0.0, 0, 2, 2, 4, 4]), SensorNoise(0.5, 2.0)) == pytest.approx(numbered)
    assert np.isfinite(whiten_columns(values, np.full(6, 3.0), SensorNoise(0.5, 2.0))).all()
