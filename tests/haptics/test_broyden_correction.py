"""Broyden correction of the stiffness that linearised models omit."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tissue_sim.pose import Pose
from tissue_sim.realtime.model_transition import BroydenCorrection

RADIUS = 5e-3


def truth(z):
    """Force whose stiffness increases with depth."""
    return 50.0 * z + 4e3 * z * abs(z)


def model(at, z):
    """Model that is exact at its own depth and has half of the correct stiffness."""
    return truth(at) + 0.5 * (50.0 + 8e3 * abs(at)) * (z - at)


def test_on_a_straight_path_the_correction_reduces_the_error_to_a_third():
    correction, poses = BroydenCorrection(RADIUS), np.linspace(0.0, -4e-3, 21)
    plain, learned = [], []
    for last, here, there in zip(poses, poses[1:], poses[2:], strict=False):
        missed = model(here, here) - model(last, here)
        correction.apply_secant_update((0.0, 0.0, missed, 0.0, 0.0, 0.0), Pose((0.0, 0.0, last)),
                                       Pose((0.0, 0.0, here)))
        omitted = correction.compute_omitted_wrench(Pose((0.0, 0.0, here)), Pose((0.0, 0.0, there)))
        plain.append(abs(truth(there) - model(here, there)))
        learned.append(abs(truth(there) - model(here, there) - omitted[2]))
        assert omitted[:2] == (0.0, 0.0)
    assert np.mean(learned[5:]) < np.mean(plain[5:]) / 3.0


def test_a_new_tangent_includes_the_stiffness_that_was_learned_with_the_old_one():
    """Models with the tangent of 0.5 mm until 3 mm, then with that of 2.9 mm; the tool turns back by 0.3 mm."""
    def tangent_model(tangent, at, z):
        return truth(at) + (50.0 + 8e3 * abs(tangent)) * (z - at)

    correction, poses, stale, fresh = BroydenCorrection(RADIUS), np.linspace(-1e-3, -3e-3, 11), -0.5e-3, -2.9e-3
    for last, here in pairwise(poses):
        missed = tangent_model(stale, here, here) - tangent_model(stale, last, here)
        correction.apply_secant_update((0.0, 0.0, missed, 0.0, 0.0, 0.0), Pose((0.0, 0.0, last)),
                                       Pose((0.0, 0.0, here)))

    def compute_error(z):
        omitted = correction.compute_omitted_wrench(Pose((0.0, 0.0, poses[-1])), Pose((0.0, 0.0, z)))[2]
        return abs(truth(z) - tangent_model(fresh, poses[-1], z) - omitted)

    as_learned = compute_error(-2.7e-3)
    correction.reduce_for_new_tangent(abs(poses[-1] - stale), abs(poses[-1] - fresh), 0.2e-3)
    assert compute_error(-2.7e-3) < 0.1 * as_learned
    kept = correction.rates.copy()
    correction.reduce_for_new_tangent(1e-4, 2e-3, 0.2e-3)
    np.testing.assert_array_equal(correction.rates, kept)


@given(st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6), st.lists(st.floats(-1e-3, 1e-3), min_size=3,
                                                                            max_size=3))
def test_half_of_the_difference_is_expected_along_the_same_motion(missed, way):
    correction, last, here = BroydenCorrection(RADIUS), Pose((0.0, 0.0, 0.0)), Pose(tuple(way))
    correction.apply_secant_update(tuple(missed), last, here)
    expected = 0.5 * np.array(missed) if np.linalg.norm(way) > 0.01 * RADIUS * (1 + 1e-9) else None
    found = correction.compute_omitted_wrench(last, here)
    if expected is not None:
        np.testing.assert_allclose(found, expected, atol=1e-9)
    across = np.cross(way, [1.0, 2.0, 3.0])
    omitted = correction.compute_omitted_wrench(last, Pose(tuple(across.tolist())))
    np.testing.assert_allclose(omitted, 0.0, atol=1e-9 * 100)
    correction.reset()
    assert not any(correction.compute_omitted_wrench(last, here))


def test_the_corrected_stiffness_is_the_derivative_of_the_corrected_wrench():
    correction, last, here = BroydenCorrection(RADIUS), Pose((0.0, 0.0, 0.0)), Pose((1e-3, 0.0, -1e-3))
    correction.apply_secant_update((0.1, 0.0, 0.2, 0.0, 1e-3, 0.0), last, here)
    stiffness = np.array(correction.subtract_correction_from_stiffness(((0.0,) * 6,) * 6))
    h = 1e-6
    for axis in range(3):
        place = [0.0, 0.0, 0.0]
        place[axis] = h
        slope = -np.array(correction.compute_omitted_wrench(last, Pose(tuple(place)))) / h
        assert stiffness[:, axis] == pytest.approx(slope, rel=1e-9)
