"""What successive linearisations of a force leave out, learned from how they go apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.loop.model_drift import ModelDrift
from tissue_sim.pose import Pose

RADIUS = 5e-3


def truth(z):
    """A force that stiffens with depth."""
    return 50.0 * z + 4e3 * z * abs(z)


def model(at, z):
    """One that is right where it was made, and half as stiff as it should be."""
    return truth(at) + 0.5 * (50.0 + 8e3 * abs(at)) * (z - at)


def test_on_a_straight_way_what_models_miss_shrinks_to_a_third():
    drift, poses = ModelDrift(RADIUS), np.linspace(0.0, -4e-3, 21)
    plain, learned = [], []
    for last, here, there in zip(poses, poses[1:], poses[2:], strict=False):
        missed = model(here, here) - model(last, here)
        drift.learn((0.0, 0.0, missed, 0.0, 0.0, 0.0), Pose((0.0, 0.0, last)), Pose((0.0, 0.0, here)))
        beyond = drift.beyond(Pose((0.0, 0.0, here)), Pose((0.0, 0.0, there)))
        plain.append(abs(truth(there) - model(here, there)))
        learned.append(abs(truth(there) - model(here, there) - beyond[2]))
        assert beyond[:2] == (0.0, 0.0)
    assert np.mean(learned[5:]) < np.mean(plain[5:]) / 3.0


@given(st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6), st.lists(st.floats(-1e-3, 1e-3), min_size=3,
                                                                              max_size=3))
def test_half_of_what_was_missed_is_expected_along_the_same_way(missed, way):
    drift, last, here = ModelDrift(RADIUS), Pose((0.0, 0.0, 0.0)), Pose(tuple(way))
    drift.learn(tuple(missed), last, here)
    expected = 0.5 * np.array(missed) if np.linalg.norm(way) > 0.01 * RADIUS * (1 + 1e-9) else None
    found = drift.beyond(last, here)
    if expected is not None:
        np.testing.assert_allclose(found, expected, atol=1e-9)
    across = np.cross(way, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(drift.beyond(last, Pose(tuple(across.tolist()))), 0.0, atol=1e-9 * 100)
    drift.forget()
    assert not any(drift.beyond(last, here))


def test_the_stiffness_is_that_of_the_whole_answer():
    drift, last, here = ModelDrift(RADIUS), Pose((0.0, 0.0, 0.0)), Pose((1e-3, 0.0, -1e-3))
    drift.learn((0.1, 0.0, 0.2, 0.0, 1e-3, 0.0), last, here)
    stiffness = np.array(drift.stiffness(((0.0,) * 6,) * 6))
    h = 1e-6
    for axis in range(3):
        place = [0.0, 0.0, 0.0]
        place[axis] = h
        slope = -np.array(drift.beyond(last, Pose(tuple(place)))) / h
        assert stiffness[:, axis] == pytest.approx(slope, rel=1e-9)
