"""Coverage of prediction bands for recordings that are not fitted."""


import numpy as np
import pytest

from calibration.forward.motion import TimedMotion
from calibration.statistics.uncertainty import ScatterComponent, compute_prediction_band_half_widths


@pytest.fixture(scope="module")
def bands(benchmark_module):
    """The benchmark ``bands``."""
    return benchmark_module("inverse.bands")


@pytest.mark.slow
@pytest.mark.parametrize("words", ["contact and zero, 5", "the same stated, 1", "stiffness too, 5",
                                   "a law that cannot follow, 5"])
def test_bands_hold_new_recordings(bands, words):
    """Twelve campaigns tell coverage to 3 %; the study is in docs/coverage.md."""
    case = next(case for case in bands.CASES if case.name.startswith(words))
    samples, whole, _ = bands.coverage(case, 12, 1)
    assert 88 < samples < 99.5 and whole > 86


def test_a_band_without_bias_and_with_a_known_size_is_the_usual_one():
    half, whole = compute_prediction_band_half_widths(np.zeros(50), [ScatterComponent(np.full((50, 1), 0.3))],
                                                      np.full(50, 0.4))
    assert half == pytest.approx(1.959964 * 0.5, rel=1e-6)
    # One number shared by all samples and 50 white ones: wider than one sample, narrower than 51 independent ones.
    assert half[0] < whole[0] < 3.3 * 0.5


def test_few_recordings_count_with_students_t_and_a_bias_with_its_size():
    few, _ = compute_prediction_band_half_widths(np.zeros(3), [ScatterComponent(np.ones((3, 1)), 2.0)],
                                                 np.zeros(3) + 1e-9)
    assert few == pytest.approx(4.302653, rel=1e-3)
    biased, _ = compute_prediction_band_half_widths(np.full(3, -10.0), [ScatterComponent(np.ones((3, 1)))],
                                                    np.full(3, 1e-9))
    assert biased == pytest.approx(10.0 + 1.644854, rel=1e-4)


def test_noisy_hold_is_one_hold_and_no_loading_curve():
    """Creep during a hold is no loading curve: the derivative with the contact offset equals that of the ramp."""
    time = np.unique(np.append(np.linspace(0.0, 4.0, 41), np.linspace(4.0, 64.0, 99)))
    rng = np.random.default_rng(1)
    displacement = np.minimum(1e-3 * time, 4e-3)
    held = np.maximum(time - 4, 0.0)
    displacement += (time > 4) * 4e-6 * rng.standard_normal(time.size) + 2e-5 * (1 - np.exp(-held / 5))
    motion = TimedMotion.from_recording(time, displacement)
    assert len(motion.legs) == 2 and motion.legs[1][1] - motion.legs[1][0] > 5
    force = 500.0 * np.minimum(motion.displacement, 4e-3) * np.where(
        motion.time > 4, 0.6 + 0.4 * np.exp(-(motion.time - 4) / 3), 1.0)
    _, rate = motion.make_force_curve(force[:, None])(time, displacement, 0.0)
    assert rate[time > 1].max() < 0 and rate[time > 1].min() > -1.2 * 500.0
