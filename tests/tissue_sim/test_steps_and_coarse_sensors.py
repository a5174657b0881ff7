"""Signals with steps, holds and coarse sensors: outliers, loads at zero, failures and saturation."""

import numpy as np
import pytest

from tissue_sim.recording.failure import find_failure
from tissue_sim.recording.outliers import find_outliers_of_motion_and_load
from tissue_sim.recording.saturation import find_rounding_step_or_zero, find_saturated_runs
from tissue_sim.recording.screening import estimate_load_at_zero_displacement

TIME = np.arange(0.0, 80.0, 0.5)
STEP = np.floor(TIME / 20.0)
NOISE = np.random.default_rng(3).normal(0.0, 1e-3, TIME.size)
#: Four weights, under each of which the displacement creeps, m and N.
WEIGHTS = 0.2 * (STEP + 1) + NOISE
CREPT = 5e-3 * (STEP + 1 + 0.3 * (1 - np.exp(-(TIME % 20.0) / 4.0)))


@pytest.mark.parametrize("sample", [39, 40, 41, 80, 120])
@pytest.mark.parametrize("value", [0.0, -0.4, 9999.0])
def test_a_wrong_load_at_a_step_is_left_out(sample, value):
    load = WEIGHTS.copy()
    load[sample] = value
    assert [each[:2] for each in find_outliers_of_motion_and_load(CREPT, load)] == [("load", (sample,))]


@pytest.mark.parametrize("fraction", [0.3, 0.9])
def test_a_load_between_the_levels_of_a_step_is_kept(fraction):
    load, way = WEIGHTS.copy(), CREPT.copy()
    load[40] = load[39] + fraction * (load[41] - load[39])
    assert find_outliers_of_motion_and_load(way, load) == ()


def test_the_overshoot_of_a_relaxing_load_in_a_step_is_kept():
    way = 1e-3 * (STEP + 1)
    load = 0.2 * (STEP + 1) + 0.3 * np.exp(-(TIME % 20.0) / 1.0) + NOISE
    assert find_outliers_of_motion_and_load(way, load) == ()


@pytest.mark.parametrize("step", [0.05, 0.884])
@pytest.mark.parametrize("decimals", [3, 5])
def test_the_step_of_a_coarse_sensor_is_found_in_printed_numbers(step, decimals):
    load = np.round(np.round(np.linspace(0.0, 20 * step, 400) / step) * step, decimals)
    assert find_rounding_step_or_zero(load) == pytest.approx(step, rel=1e-3)
    assert find_rounding_step_or_zero(np.linspace(0.0, 1.0, 400)) == 0.0


@pytest.mark.parametrize("levels", [15, 22, 30])
def test_relaxation_in_steps_of_a_coarse_sensor_is_no_tear(levels):
    time = np.arange(0.0, 30.0, 0.05)
    way = np.minimum(5e-3 * time / 2.0, 5e-3)
    load = 20.0 * way / 5e-3 * np.where(time < 2.0, 1.0, 1.0 - 0.25 * (1 - np.exp(-(time - 2.0) / 1.5)))
    step = 20.0 / levels
    assert find_failure(way, np.round(np.round(load / step) * step, 3), time) is None


@pytest.mark.parametrize("preload", [0.0, 0.08])
def test_the_load_at_zero_is_judged_before_the_load_relaxes(preload):
    time = np.arange(0.0, 120.0, 0.5)
    number, within = np.divmod(time, 40.0)
    way = 4e-3 * (number + np.minimum(within / 8.0, 1.0))
    relaxed = 1.0 - 0.35 * (1 - np.exp(-np.maximum(time - 4.0, 0.0) / 6.0))
    load = (60.0 * way + preload) * relaxed + np.random.default_rng(1).normal(0.0, 1e-3, time.size)
    found = estimate_load_at_zero_displacement(way, load)
    assert (found is not None) == (preload > 0)
    assert found is None or found.load == pytest.approx(preload, rel=0.1)


@pytest.mark.parametrize(("noise", "saturated"), [(4e-4, True), (0.0, False)])
def test_equal_values_after_a_noisy_loading_are_saturated(noise, saturated):
    way = np.append(np.linspace(0.0, 5e-3, 40), 5e-3 * (1 + 0.3 * (1 - np.exp(-np.arange(100) / 30.0))))
    load = np.append(np.linspace(0.0, 2.0, 40), np.full(100, 2.0))
    load[:40] += np.random.default_rng(2).normal(0.0, 1.0, 40) * noise
    load = np.minimum(np.round(load, 5), 2.0)
    assert bool(find_saturated_runs(load, way)) is saturated
