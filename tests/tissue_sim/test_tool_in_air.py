"""A tool in the air touches where it is, in the orientation that it has, and without an invented past."""

import math

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.pose import add_twist, find_axis_twist_quaternion_or_none, remove_twist
from tissue_sim.tool_force import TouchState, has_touched

SOFT = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3))
RELAXING = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3),
                       viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.05),)))
SPUN = (0.0, 0.0, 0.0, 1.0)


def needle(material=SOFT, **options):
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(6e-3, 2), tool=ts.Tool("flat", radius=8e-3),
                               friction="bonded")
    return ts.Simulator(ts.Model(experiment, material), **{"resolution": "realtime_20", **options})


def ball(friction=0.5, material=SOFT, **options):
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(4e-3, 2), tool=ts.Tool("sphere", 0.008),
                               friction=friction)
    return ts.Simulator(ts.Model(experiment, material), **{"resolution": "realtime_20", "inertia": "off", **options})


def solid(tool, friction, **options):
    experiment = ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(2e-3, 2), tool=tool, friction=friction)
    return ts.Simulator(ts.Model(experiment, SOFT), **{"solver": "solid", "inertia": "off", **options})


@pytest.mark.parametrize("inertia", ["auto", "on"])
def test_a_tool_that_begins_inside_is_at_rest_there(inertia):
    at_rest = needle(inertia="off").step(3e-3, 1e-3).force
    sim = needle(inertia=inertia)
    for _ in range(2):
        answers = [sim.step(3e-3, 1e-3) for _ in range(4)]
        assert [answer.force for answer in answers] == pytest.approx([at_rest] * 4, rel=1e-4)
        assert not answers[0].inertial
        sim.reset()
    sim.step(-1e-3, 1e-3)
    assert sim.step(3e-3, 1e-3).force > 1.2 * at_rest, "a tool that comes out of the air at 4 m/s is a blow"


def test_touch_state():
    touch = TouchState()
    assert touch.height is None and touch.register_height_and_get_contact_duration(3e-3, 1.0) is None \
        and not touch.has_touched
    assert touch.register_height_and_get_contact_duration(-1e-3, 1.0) == pytest.approx(0.25) and touch.has_touched
    copy = touch.copy()
    assert copy.register_height_and_get_contact_duration(5e-3,
                                                         0.5) == 0.5 and copy.has_touched and touch.height == -1e-3
    assert TouchState().register_height_and_get_contact_duration(-1e-3, 0.5) \
        == 0.5, "all of the first step: what went before is not known"


def test_a_tissue_says_whether_it_was_touched():
    sim = needle(inertia="off")
    assert not has_touched(sim)
    assert sim.step(-1e-3, 1e-3).wrench == (0.0,) * 6 and not has_touched(sim)
    sim.step(1e-4, 1e-3)
    saved = sim.save()
    assert has_touched(sim)
    sim.reset()
    assert not has_touched(sim)
    sim.restore(saved)
    assert has_touched(sim) and has_touched(object())


def test_the_twist_is_what_an_orientation_turns_about_the_axis_of_the_tool():
    lean = (math.cos(0.2), 0.6 * math.sin(0.2), 0.8 * math.sin(0.2), 0.0)
    spin = (math.cos(1.1), 0.0, 0.0, math.sin(1.1))
    pose = add_twist(ts.Pose((1.0, 2.0, 3.0), lean), spin)
    assert find_axis_twist_quaternion_or_none(pose.orientation) == pytest.approx(spin)
    np.testing.assert_allclose(remove_twist(pose, spin).orientation, lean, atol=1e-15)
    assert find_axis_twist_quaternion_or_none(lean) is None


class TestAfterLiftOff:
    def test_nothing_is_solved_because_the_tool_moves(self):
        sim = ball()
        for depth in (1e-3, 2e-3, 1e-3, -1e-3):
            sim.step(depth, 1e-3)
        answers = [sim.step(depth, 1e-3) for depth in (-3e-3, -0.5, -2e-3, -1e-6)]
        assert [answer.iterations for answer in answers] == [0] * 4
        assert all(answer.wrench == (0.0,) * 6 and answer.status is ts.ForceStatus.CONVERGED for answer in answers)
        again, fresh = sim.step(1e-3, 1e-3), ball().step(1e-3, 1e-3)
        assert again.force == pytest.approx(fresh.force, rel=2e-3) and again.iterations < 2 * fresh.iterations + 4

    def test_time_in_the_air_lets_the_tissue_relax(self):
        forces = []
        for air in (1, 400):
            sim = ball("frictionless", RELAXING)
            sim.step(3e-3, 0.5)
            sim.step(-5e-3, 1e-3)
            for _ in range(air):
                assert sim.step(-5e-3, 1e-3).force == pytest.approx(0.0, abs=1e-12)
            forces.append(sim.step(1e-3, 1e-3).force)
        fresh = ball("frictionless", RELAXING)
        fresh.step(-5e-3, 1e-3)
        right = fresh.step(1e-3, 1e-3).force
        assert forces[1] == pytest.approx(right, rel=1e-2) and forces[0] < 0.98 * right, "soon after, a dent is left"


class TestSolid:
    @pytest.mark.slow
    def test_a_ball_touches_where_it_went_in_the_air(self):
        tool = ts.Tool("round", radius=5e-3)
        middle, aside, spun = (solid(tool, 0.5) for _ in range(3))
        there = middle.step(ts.Pose((0.0, 0.0, -0.4e-3)), 1e-3)
        aside.step(ts.Pose((0.0, 0.0, 1e-3)), 1e-3)
        assert aside.step(ts.Pose((5e-3, 3e-3, 0.5e-3)), 1e-3).iterations == 0
        moved = aside.step(ts.Pose((5e-3, 3e-3, -0.4e-3)), 1e-3)
        assert moved.status is ts.ForceStatus.CONVERGED and moved.iterations <= 2 * there.iterations
        assert moved.force == pytest.approx(there.force, rel=0.02), "the mesh is as fine there"
        assert math.hypot(*moved.force_vector[:2]) < 0.02 * moved.force
        spun.step(ts.Pose((0.0, 0.0, 1e-3), SPUN), 1e-3)
        answer = spun.step(ts.Pose((0.0, 0.0, -0.4e-3), SPUN), 1e-3)
        np.testing.assert_allclose(answer.wrench, there.wrench, atol=1e-6)
        assert answer.pose.orientation == pytest.approx(SPUN)
        # Back to the first place with its own mesh.
        saved = aside.save()
        aside.reset()
        assert aside.step(ts.Pose((0.0, 0.0, -0.4e-3)), 1e-3).force == pytest.approx(there.force, rel=1e-6)
        aside.restore(saved)
        assert aside.step(ts.Pose((5e-3, 3e-3, -0.4e-3)), 1e-3).force == pytest.approx(moved.force, rel=1e-6)

    def test_a_bonded_tool_holds_the_tissue_where_it_comes_down(self):
        sim = solid(ts.Tool("flat", radius=8e-3), "bonded")
        for z in (1e-3, 1e-5):
            assert sim.step(ts.Pose((0.0, 0.8e-3, z), SPUN), 1e-3).wrench == (0.0,) * 6
        answer = sim.step(ts.Pose((0.0, 0.8e-3, -1e-4), SPUN), 1e-3)
        assert answer.status is ts.ForceStatus.CONVERGED and answer.force > 0.03
        assert np.abs(np.array(answer.wrench)[[0, 1, 5]]).max() < 0.01 * answer.force
        dragged = sim.step(ts.Pose((1e-4, 0.8e-3, -1e-4), SPUN), 1e-3)
        assert dragged.force_vector[0] < -0.01, "from there on it is dragged"

    def test_a_tool_beside_the_specimen_touches_nothing(self):
        sim = solid(ts.Tool("round", radius=5e-3), 0.5)
        answer = sim.step(ts.Pose((0.05, 0.0, -5e-3)), 1e-3)
        assert answer.wrench == (0.0,) * 6 and not sim.has_touched
