"""Distance of the tool from a model of the bulk, on a surface without nodes."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from tissue_sim.pose import Pose
from tissue_sim.realtime.model_transition import ModelTransition

RADIUS = 4e-3
AIR = SimpleNamespace(has_contact=False, pose=Pose((0.0, 0.0, 4e-3)))


@pytest.fixture
def transition():
    surface = SimpleNamespace(radius=RADIUS, start=Pose((0.0, 0.0, 0.0)), friction=np.zeros(3))
    return ModelTransition(SimpleNamespace(surface=surface, model=AIR), 4000.0)


def down(depth):
    return Pose((0.0, 0.0, -depth))


def test_a_model_of_undeformed_tissue_is_as_far_as_the_surface(transition):
    transition.free = down(0.0)
    assert transition.compute_distance_from_model(AIR, down(6e-4)) == pytest.approx(6e-4)


def test_a_pose_in_a_dent_is_no_place_in_the_air(transition):
    """The tool had no force at 0.37 mm because the tissue was pressed in; on undeformed tissue it has one there."""
    transition.free = down(3.7e-4)
    assert transition.compute_distance_from_model(AIR, down(6e-4)) == pytest.approx(6e-4)
    assert transition.compute_distance_from_model(AIR, down(6e-4)) > transition.estimate.short


def test_a_place_in_the_air_stays_where_it_is(transition):
    transition.free = Pose((1e-3, 0.0, 2e-4))
    assert transition.compute_distance_from_model(AIR, Pose((1e-3, 0.0, -2e-4))) == pytest.approx(4e-4)


@pytest.mark.parametrize(("before", "after"), [(True, False), (False, True)])
def test_a_step_that_did_not_converge_teaches_nothing(transition, before, after):
    """Its wrench is that of an earlier step: two models seemed to agree, and a force of 2.7 N had an error of 0.3 N."""
    pressed = SimpleNamespace(has_contact=True, pose=down(5e-3), tangent_pose=down(5e-3), material=0, time=0.4)
    steps = [SimpleNamespace(wrench=(0.0, 0.0, 0.4, 0.0, 0.0, 0.0), stiffness_matrix=((0.0,) * 6,) * 6, converged=each)
             for each in (before, after)]
    transition._stepper.model = pressed
    transition.estimate.update_estimate(0.01, 1e-3, 1e-3, 0.2, 0.2)
    transition.update_for_new_model(steps[0], SimpleNamespace(material=0, pose=down(0.0), has_contact=False,
                                                              time=0.2), down(1e-3), down(1e-3), steps[1])
    assert math.isinf(transition.estimate.estimate_force_error(0.0)) and not any(transition.offset)
