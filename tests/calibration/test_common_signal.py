"""Common part of the residuals of replicates, compared with their differences."""

import numpy as np
import pytest

from calibration.statistics.adequacy import compute_f_ratio_and_freedoms, get_most_significant_common_signal

SEGMENTS = [slice(0, 160), slice(160, 400), slice(400, 560)]
TIME = np.arange(560) / 4.0


def drawn(random, memory=0.0):
    """Noise of three recordings of one size, with a correlation from sample to sample."""
    noise = random.standard_normal((3, TIME.size))
    for k in range(1, TIME.size):
        noise[:, k] = memory * noise[:, k - 1] + np.sqrt(1 - memory**2) * noise[:, k]
    return noise


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "scale"), [(0.0, 1.0), (0.0, 0.3), (0.4, 1.0)])
def test_noise_of_any_size_and_colour_has_nothing_in_common(memory, scale):
    """The probability is no smaller than it should be: at most 1 of 20 below 5 %, with 3 deviations of 400 draws."""
    random = np.random.default_rng(8)
    p = np.array([get_most_significant_common_signal(scale * drawn(random, memory), SEGMENTS).p for _ in range(400)])
    assert np.mean(p < 0.05) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 400)
    assert p.min() > 1e-5


def test_a_wave_is_found_with_its_period():
    """Half a deviation high, which neither its place nor all of it tells."""
    random = np.random.default_rng(3)
    left = drawn(random) + 0.5 * np.sin(2 * np.pi * TIME / 17.5)
    found = get_most_significant_common_signal(left, SEGMENTS)
    assert found.p < 1e-6 and (found.first, found.last) == (0, 559)
    assert (TIME[-1] - TIME[0]) / found.waves == pytest.approx(17.5, rel=0.05)
    ratio, *_ = compute_f_ratio_and_freedoms(left)
    assert ratio < 1.6


def test_a_bump_is_found_at_its_place():
    random = np.random.default_rng(3)
    left = drawn(random)
    left[:, 300:316] += 1.5
    found = get_most_significant_common_signal(left, SEGMENTS)
    assert found.p < 1e-6 and not found.waves
    assert found.first > 290 and found.last < 326


def test_one_recording_that_differs_is_nothing_in_common():
    random = np.random.default_rng(3)
    left = drawn(random)
    left[1] += 2.0 * np.sin(2 * np.pi * TIME / 17.5)
    left[2, 300:316] += 3.0
    assert get_most_significant_common_signal(left, SEGMENTS).p > 0.01
