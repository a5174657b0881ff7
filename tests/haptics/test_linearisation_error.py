"""Estimated error of a linearised bulk: the newest model's own error, its age, the distance, and the torque."""

import math

import pytest
from delayed_bulk import DelayedBulkLink

import tissue_sim as ts
from haptics.loop.multirate import MultiRateTissue
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose
from tissue_sim.realtime.model_transition import LinearisationErrorEstimator

#: m.
RADIUS = 8e-3
#: Pa.
MODULUS = 4000.0


def learned(missed=0.02, distance=2e-3, between=1e-3, interval=0.05):
    estimate = LinearisationErrorEstimator(RADIUS, MODULUS)
    estimate.update_estimate(missed, distance, between, 1.0, interval)
    return estimate


def test_nothing_is_known_before_two_models():
    assert math.isinf(LinearisationErrorEstimator(RADIUS, MODULUS).estimate_force_error(0.0))


def test_the_newest_model_errs_at_its_own_pose_and_with_its_age():
    estimate = learned()
    growth = 0.02 / 2e-3**2
    assert estimate.estimate_force_error(0.0) == pytest.approx(0.02)
    assert estimate.estimate_force_error(0.0, 0.1) == estimate.estimate_force_error(0.0)
    assert estimate.estimate_force_error(0.0, 0.3) == pytest.approx(3 * estimate.estimate_force_error(0.0))
    assert estimate.estimate_force_error(1e-3) == pytest.approx(estimate.estimate_force_error(0.0) + growth * 1e-3**2)
    assert math.isinf(estimate.estimate_force_error(3.1e-3)), "far beyond the two models"


def test_models_that_agree_by_chance_leave_the_curvature_of_a_contact():
    assert learned(missed=0.0).estimate_force_error(2e-3) == pytest.approx(MODULUS * 2e-3**2)


def test_the_curvature_of_a_contact_is_that_of_hertz_at_the_depth_of_the_tool():
    """Two models that agree by chance at 1 mm; a model 1 mm away from a tool that is 2 mm deep."""
    agreed, distance, depth = learned(missed=0.0), 1e-3, 2e-3
    growth = 2.0 * MODULUS * math.sqrt(RADIUS / depth)
    assert agreed.estimate_force_error(distance, depth=depth) == pytest.approx(growth * distance**2)
    at_the_distance = 2.0 * MODULUS * math.sqrt(RADIUS / distance)
    assert agreed.estimate_force_error(distance, depth=-depth) == pytest.approx(at_the_distance * distance**2)
    assert agreed.estimate_force_error(0.0, depth=0.0) == 0.0
    assert agreed.estimate_force_error(distance, depth=10.0 * RADIUS) == pytest.approx(2.0 * MODULUS * distance**2)


def test_the_curvature_is_that_of_the_tip_where_the_contact_is_smaller():
    estimate = LinearisationErrorEstimator(RADIUS, MODULUS, tip_radius=4.0 * RADIUS)
    estimate.update_estimate(0.0, 2e-3, 1e-3, 1.0, 0.05)
    growth = 2.0 * MODULUS * math.sqrt(4.0 * RADIUS / 2e-3)
    assert estimate.estimate_force_error(1e-3, depth=2e-3) == pytest.approx(growth * 1e-3**2)


def test_a_force_of_zero_is_wrong_by_at_most_a_flat_punch_on_undeformed_tissue():
    estimate, base, punch = learned(), 0.02, 8.0 * MODULUS * RADIUS
    assert estimate.estimate_error_of_zero_force(2e-3, 0.0, 1e-6, 0.0) == pytest.approx(base + punch * 1e-6)
    # Above the undeformed surface the force is zero; the error of the newest model remains.
    assert estimate.estimate_error_of_zero_force(2e-3, 0.0, -1e-3, 0.0) == pytest.approx(base)
    # Near the pose of the model the error by linearisation is smaller.
    near = estimate.estimate_error_of_zero_force(1e-4, 0.0, 5e-4, 0.0)
    assert near == pytest.approx(estimate.estimate_force_error(1e-4, depth=5e-4))
    # Before two models were compared, only the force on undeformed tissue is known, and in the air nothing.
    new = LinearisationErrorEstimator(RADIUS, MODULUS)
    assert new.estimate_error_of_zero_force(2e-3, 0.0, 1e-5, 0.0) == pytest.approx(punch * 1e-5)
    assert math.isinf(new.estimate_error_of_zero_force(2e-3, 0.0, -1e-5, 0.0))


def test_a_force_of_zero_under_a_ball_is_wrong_by_at_most_hertz_with_a_margin():
    """F = 4/3 E' sqrt(R) depth^(3/2) with E' = 4 mu of an incompressible half space."""
    ball, depth = ts.Tool("sphere", radius=2.0 * RADIUS), 0.05 * RADIUS
    hertz = 4.0 / 3.0 * 4.0 * MODULUS * math.sqrt(ball.radius) * depth**1.5
    new = LinearisationErrorEstimator(RADIUS, MODULUS, ball.radius, ball.contact_radius)
    assert new.estimate_error_of_zero_force(2e-3, 0.0, depth, 0.0) == pytest.approx(1.5 * hertz)
    flat = ts.Tool("flat", radius=RADIUS)
    new = LinearisationErrorEstimator(RADIUS, MODULUS, flat.radius, flat.contact_radius)
    assert new.estimate_error_of_zero_force(2e-3, 0.0, depth, 0.0) == pytest.approx(8.0 * MODULUS * RADIUS * depth)


def test_the_first_model_with_contact_has_twice_the_error():
    """The Newton step from the undeformed tissue is long and may reduce the error by a third only."""
    later, first = LinearisationErrorEstimator(RADIUS, MODULUS), LinearisationErrorEstimator(RADIUS, MODULUS)
    later.update_estimate(0.02, 2e-3, 1e-3, 1.0, 0.1)
    first.update_estimate(0.02, 2e-3, 1e-3, 1.0, 0.1, from_rest=True)
    assert first.estimate_force_error(0.0) == pytest.approx(2.0 * later.estimate_force_error(0.0))


def test_a_tangent_of_an_earlier_pose_adds_an_error_that_is_linear_in_the_distance():
    """The force is growth z**2; a model at 2 mm with the stiffness of 1.5 mm, used at 1.8 mm."""
    growth, made, tangent, used = 5e3, 2e-3, 1.5e-3, 1.8e-3
    estimate = LinearisationErrorEstimator(RADIUS)
    estimate.update_estimate(growth * (4e-6 - 1e-6), 2e-3, 1e-3, 0.1, 0.1, newer=1e-3)
    estimate.base = 0.0
    error = growth * used**2 - (growth * made**2 + 2.0 * growth * tangent * (used - made))
    assert error == pytest.approx(growth * (made - used) ** 2 - 2.0 * growth * (made - tangent) * (made - used))
    assert estimate.estimate_force_error(made - used, tangent=made - tangent) >= abs(error)
    assert estimate.estimate_force_error(made - used, tangent=made - tangent) == pytest.approx(growth * (4e-8 + 2e-7))


def test_a_stiffer_material_raises_what_was_learned():
    estimate, before = learned(), learned().estimate_force_error(1e-3)
    estimate.set_shear_modulus(2 * MODULUS)
    assert estimate.estimate_force_error(1e-3) == pytest.approx(2 * before)
    estimate.set_shear_modulus(MODULUS)
    assert estimate.estimate_force_error(1e-3) == pytest.approx(2 * before), "a softer one does not lower it"


def bonded():
    """A bonded needle on a coarse solid whose models come 6 ms after they were asked for, tangents 30 ms."""
    material = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3))
    experiment = ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(2e-3, 2), friction="bonded",
                               tool=ts.Tool("flat", radius=RADIUS))
    model = ts.Model(experiment, material)
    mesh = create_cylinder_mesh_under_needle(0.030, 0.020, RADIUS, HEX8P0, smallest=0.45 * RADIUS, growth=2.4,
                                             largest=3.0 * RADIUS,
                                             around=2)
    bulk = SolidLineariser(make_solver(model, mesh=mesh))
    return MultiRateTissue(model, link=DelayedBulkLink(bulk, 6e-3, 30e-3))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_first_converged_force_of_another_material_is_right(factor):
    """All moduli times a factor: the elastic force, too, in the tick in which the first model of it comes."""
    tissue = bonded()
    for tick in range(101):
        tissue.step(Pose((0.0, 0.0, -1e-5 * tick)), 1e-3)
    before = [tissue.step(Pose((0.0, 0.0, -1e-3)), 1e-3) for _ in range(60)][-1]
    tissue.set_parameters(C10=2000.0 * factor)
    answers = [tissue.step(Pose((0.0, 0.0, -1e-3)), 1e-3) for _ in range(30)]
    assert answers[0].status is ts.ForceStatus.LATE and answers[0].force_error is None
    converged = [answer for answer in answers if answer.status is ts.ForceStatus.CONVERGED]
    assert len(converged) > 10
    assert [answer.force for answer in converged] == pytest.approx([factor * before.force] * len(converged), rel=0.01)


def test_growth_is_that_of_the_difference_of_both_errors():
    """Models at 2 mm and 1 mm from the tool differ by three quarters of the error of the first one."""
    estimate = LinearisationErrorEstimator(8e-3)
    growth = 5e3
    estimate.update_estimate(growth * (4e-6 - 1e-6), 2e-3, 1e-3, 0.1, 0.1, newer=1e-3)
    assert estimate.growth == pytest.approx(growth)
    # A tool that turned round, with both models at one distance, gives no infinite growth.
    estimate.update_estimate(1e-3, 2e-3, 1e-3, 0.2, 0.1, newer=2e-3)
    assert estimate.growth <= max(growth, 1e-3 / estimate.short**2)


def test_the_first_model_of_a_new_material_has_its_own_error():
    """What was learned of the old material says nothing about the Newton step to the new one."""
    estimate = learned()
    estimate.set_error_of_first_model_of_material(0.1, 2.0)
    assert estimate.estimate_force_error(0.0) == pytest.approx(0.2)
    unknown = LinearisationErrorEstimator(RADIUS, MODULUS)
    unknown.set_error_of_first_model_of_material(0.1, 2.0)
    assert unknown.estimate_force_error(0.0) == pytest.approx(0.2)
