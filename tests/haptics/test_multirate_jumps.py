"""Multirate tissue whose tool jumps, and the age of the tangent on which a tissue in motion is solved."""

import pytest
from delayed_bulk import DelayedBulkLink

import tissue_sim as ts
from haptics.loop.multirate import MultiRateTissue
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose

#: Length of a step, s.
DT = 1e-3
#: Radius of the ball, m.
RADIUS = 8e-3
#: Simulated time from a state to its model, s.
DELAY = 0.01
#: Simulated time for the factorisation of a tangent, s.
TANGENT = 0.05


def make_ball(friction, delay):
    """Return a multirate simulator of a ball on a coarse solid, with a simulated time from a state to its model, s."""
    material = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3))
    experiment = ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(2e-3, 2), friction=friction,
                               tool=ts.Tool("round", radius=RADIUS))
    model = ts.Model(experiment, material)
    mesh = create_cylinder_mesh_under_needle(0.030, 0.020, RADIUS, HEX8P0, smallest=0.45 * RADIUS, growth=2.4,
                                             largest=3.0 * RADIUS, around=2)
    bulk = SolidLineariser(make_solver(model, mesh=mesh))
    tissue = MultiRateTissue(model, link=DelayedBulkLink(bulk, delay, TANGENT))
    tissue.warm_up()
    return tissue


@pytest.fixture(scope="module")
def ball():
    """A ball on a coarse solid without friction."""
    return make_ball("frictionless", DELAY)


@pytest.mark.parametrize("before", [52, 55, 58])
def test_a_jump_in_the_air_is_no_speed(ball, before):
    """A tool that jumps down to a place in the air and waits there does not press the tissue of the next models.

    The models come every 10 ticks, so that some state is sent soon after one of the jumps.
    """
    ball.reset()
    answers = [ball.step(Pose((0.0, 0.0, 3e-3)), DT) for _ in range(before)]
    answers += [ball.step(Pose((2e-4, 0.0, 3e-4)), DT) for _ in range(30)]
    assert {answer.status for answer in answers} == {ts.ForceStatus.CONVERGED}
    assert not any(any(answer.wrench) for answer in answers)


def test_the_stiffness_is_as_old_as_the_iterate_at_which_its_tangent_was_assembled(ball):
    ball.reset()
    answers = [ball.step(Pose((0.0, 0.0, -1e-5 * min(tick, 150))), DT) for tick in range(300)]
    assert min(answer.stiffness_age for answer in answers[150:]) >= TANGENT
    assert all(answer.age < answer.stiffness_age for answer in answers[150:])


@pytest.mark.parametrize("friction", [0.3, "frictionless"])
def test_friction_keeps_the_error_of_an_excursion_until_the_next_model(friction):
    """The tool moves sideways by 0.4 mm and back while no model arrives."""
    ball = make_ball(friction, 0.1)
    answers = [ball.step(Pose((0.0, 0.0, -2.5e-6 * min(tick, 400))), DT) for tick in range(800)]
    # The excursion begins when a model has just come, so that its age is the smallest of all.
    youngest = min(answer.age for answer in answers[600:])
    for _ in range(200):
        answers.append(ball.step(Pose((0.0, 0.0, -1e-3)), DT))
        if answers[-1].age <= youngest + 0.5 * DT:
            break
    aside = [4e-4 * (1.0 - abs(tick - 20) / 20.0) for tick in range(1, 41)]
    excursion = [ball.step(Pose((x, 0.0, -1e-3)), DT) for x in aside]
    assert all(answer.pose == excursion[0].pose for answer in excursion), "one model"
    largest = max(answer.force_error for answer in excursion)
    assert largest > 2.0 * answers[-1].force_error
    if friction == "frictionless":
        assert excursion[-1].force_error < 0.5 * largest
    else:
        assert excursion[-1].force_error == pytest.approx(largest)
