"""A slow solver's local models, evaluated and blended at 1 kHz."""

import math
import pickle
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tissue_sim import InputError
from tissue_sim.pose import Pose
from tissue_sim.realtime.local_model import LocalModel, LocalModelBlend, SlowSolver
from tissue_sim.tool_force import ForceStatus, ToolForce

DT = 1e-3
JUMP = 0.02


class Stiffening:
    """F = a d + c d^3."""

    def __init__(self, status=ForceStatus.CONVERGED):
        self.status = status

    def force(self, depth):
        return 400.0 * depth + 6e6 * depth**3

    def step(self, depth, dt):
        depth = depth.depth if isinstance(depth, Pose) else depth
        return ToolForce.from_axial_force(self.force(depth), 400.0 + 18e6 * depth**2, self.status)


def force_of(model, depth):
    """Along z, N, at a depth, m."""
    return model.evaluate_wrench(Pose((0.0, 0.0, -depth)))[2]


depths = st.floats(-0.02, 0.02)
numbers = st.floats(-50.0, 50.0)
models = st.builds(lambda force, stiffness, depth, late: (force, stiffness, depth, late), numbers,
                   st.floats(-1e4, 1e4), depths, st.floats(0.0, 0.02))


@given(st.lists(st.tuples(depths, st.none() | models), min_size=1, max_size=60))
def test_change_of_model_moves_the_force_by_at_most_the_jump(ticks):
    """After the motion along the newest model, the remaining difference is the change of model."""
    blend, newest, last_depth, last_force = LocalModelBlend(jump=JUMP, oldest=math.inf), None, None, 0.0
    for depth, made in ticks:
        if made is not None:
            force, stiffness, where, late = made
            model = LocalModel.from_axial_force(force, stiffness, where,
                                                max(blend.time - late, newest.time if newest else 0.0))
            assert blend.publish(model)
            newest = model
        answer = blend.step(depth, DT)
        before = depth if last_depth is None else last_depth
        motion = newest.stiffness_matrix[2][2] * (depth - before) if newest else 0.0
        assert abs(answer.force - last_force - motion) <= JUMP + 1e-9
        last_depth, last_force = depth, answer.force


@given(models, st.lists(depths, min_size=1, max_size=20))
def test_force_arrives_at_the_newest_model(made, path):
    blend, jump = LocalModelBlend(jump=0.5, oldest=math.inf), 0.5
    for depth in path:
        blend.step(depth, DT)
    model = LocalModel.from_axial_force(*made[:3], time=blend.time, error=0.3)
    assert blend.publish(model)
    depth = path[-1]
    for _ in range(math.ceil(abs(force_of(model, depth)) / jump) + 1):
        assert blend.error == pytest.approx(0.3 + abs(blend.offset[2]))
        answer = blend.step(depth, DT)
    assert answer.force == pytest.approx(force_of(model, depth), abs=1e-9)
    assert blend.error == 0.3


@given(st.sampled_from(["force", "stiffness", "depth", "time", "error"]),
       st.sampled_from([math.nan, math.inf, -math.inf]))
def test_model_that_is_no_number_is_refused_and_the_old_one_kept(field, value):
    values = {"force": 1.0, "stiffness": 500.0, "depth": 2e-3, "time": 0.0, "error": 0.1}
    blend = LocalModelBlend()
    assert not blend.publish(LocalModel.from_axial_force(**{**values, field: value}))
    assert blend.publish(LocalModel.from_axial_force(**values))
    assert not blend.publish(LocalModel.from_axial_force(**{**values, field: value}))
    assert blend.refused == 2
    for _ in range(100):
        answer = blend.step(3e-3, DT)
    assert answer.force == pytest.approx(1.5)
    assert (answer.stiffness, answer.depth, answer.status) == (500.0, 2e-3, ForceStatus.LATE)


def test_models_from_before_the_present_one_or_from_after_now_are_refused():
    blend = LocalModelBlend()
    for _ in range(10):
        blend.step(0.0, DT)
    assert blend.publish(LocalModel.from_axial_force(1.0, 0.0, 0.0, time=5 * DT))
    assert not blend.publish(LocalModel.from_axial_force(2.0, 0.0, 0.0, time=4 * DT))
    assert not blend.publish(LocalModel.from_axial_force(2.0, 0.0, 0.0, time=11 * DT))
    assert blend.age == pytest.approx(5 * DT)


def test_age_counts_from_where_the_model_was_made():
    blend = LocalModelBlend()
    assert blend.age == math.inf
    blend.step(0.0, DT)
    blend.publish(LocalModel.from_axial_force(0.0, 0.0, 0.0, time=blend.time))
    ages = [blend.step(0.0, 2e-3).age for _ in range(3)]
    assert ages == pytest.approx([2e-3, 4e-3, 6e-3])


def test_without_a_model_or_with_one_too_old_the_force_is_let_go():
    blend = LocalModelBlend(jump=JUMP, oldest=0.5)
    assert blend.step(1e-3, DT).force == 0.0
    assert blend.step(1e-3, DT).status is ForceStatus.STOPPED
    blend.publish(LocalModel.from_axial_force(1.0, 0.0, 0.0, time=blend.time))
    answers = [blend.step(1e-3, DT) for _ in range(700)]
    forces = [answer.force for answer in answers]
    assert max(forces) == pytest.approx(1.0)
    assert forces[498] == pytest.approx(1.0)
    assert max(abs(b - a) for a, b in pairwise(forces)) <= JUMP + 1e-12
    assert (forces[-1], answers[-1].status) == (0.0, ForceStatus.STOPPED)
    assert answers[-1].age == pytest.approx(0.7)
    assert blend.publish(LocalModel.from_axial_force(1.0, 0.0, 0.0, time=blend.time))


@pytest.mark.parametrize(("depth", "dt"), [(math.nan, DT), (math.inf, DT), (1e-3, 0.0), (1e-3, math.nan)])
def test_pose_or_tick_that_is_no_number_changes_nothing(depth, dt):
    blend = LocalModelBlend()
    blend.publish(LocalModel.from_axial_force(0.01, 100.0, 1e-3, time=0.0))
    before = blend.step(1e-3, DT)
    refused = blend.step(depth, dt)
    assert (refused.status, refused.force) == (ForceStatus.REFUSED, before.force)
    assert blend.time == DT
    assert blend.step(1e-3, DT).force == before.force


def test_a_pose_counts_by_its_depth():
    blend = LocalModelBlend()
    blend.publish(LocalModel.from_axial_force(0.0, 10.0, 0.0, time=0.0))
    assert blend.step(Pose((0.0, 0.0, -1e-3)), DT).force == pytest.approx(0.01)
    assert SlowSolver(Stiffening()).solve(Pose((0.0, 0.0, -2e-3)), DT, 0.0).pose.depth == 2e-3


def test_reset_forgets_and_another_process_does_not():
    blend = LocalModelBlend()
    blend.step(1e-3, DT)
    blend.publish(LocalModel.from_axial_force(5.0, 10.0, 0.0, time=0.0))
    blend.step(1e-3, DT)
    sent = pickle.loads(pickle.dumps(blend))
    assert sent.step(1e-3, DT) == blend.step(1e-3, DT)
    blend.reset()
    assert (blend.time, blend.age, blend.step(1e-3, DT).force) == (0.0, math.inf, 0.0)


@pytest.mark.parametrize("settings", [{"jump": 0.0}, {"jump": math.nan}, {"oldest": 0.0}, {"oldest": math.nan}])
def test_settings_that_mean_nothing_are_refused(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        LocalModelBlend(**settings)


def multi_rate(period, latency, frequency, seconds=4):
    """Run a solver that needs `latency` ticks every `period` ticks, in parallel with the loop.

    Returns:
        Errors of the force, the errors that were stated, N, and the jumps beyond the motion on the newest model, N.
    """
    tissue, blend, pending = Stiffening(), LocalModelBlend(), None
    solver = SlowSolver(tissue)
    errors, stated, jumps, last, newest = [], [], [], None, None
    for tick in range(seconds * 1000):
        depth = 5e-3 + 4e-3 * math.sin(2 * math.pi * frequency * tick * DT)
        answer = blend.step(depth, DT)
        if last is not None and newest is not None:
            jumps.append(abs(answer.force - last[1] - newest.stiffness_matrix[2][2] * (depth - last[0])))
        last = (depth, answer.force)
        if tick % period == 0:
            pending = (tick + latency, solver.solve(depth, period * DT, blend.time))
        if pending is not None and tick >= pending[0]:
            newest, pending = pending[1], None
            assert blend.publish(newest)
        if tick >= 1000:
            errors.append(abs(answer.force - tissue.force(depth)))
            stated.append(blend.error)
    return errors, stated, jumps


@pytest.mark.parametrize(("period", "latency"), [(17, 1), (17, 16), (33, 1), (33, 32), (500, 100)])
def test_multi_rate_blends_without_jumps_and_states_its_error(period, latency):
    """60, 30 and 2 Hz, quick and as slow as the period, on a motion of 7.5 mm/s up to 9 mm."""
    errors, stated, jumps = multi_rate(period, latency, frequency=0.3)
    assert max(jumps) <= JUMP + 1e-9
    assert max(errors) <= max(stated)
    assert sum(error <= said for error, said in zip(errors, stated, strict=True)) >= 0.88 * len(errors)


def test_error_falls_with_the_square_of_the_period():
    """Linear models of a smooth curve: twice the rate, a quarter of the error."""
    coarse, fine = (max(multi_rate(period, 1, frequency=0.3)[0]) for period in (32, 16))
    assert 3.0 < coarse / fine < 5.0


def test_error_estimate_is_that_of_the_last_models():
    solver, tissue = SlowSolver(Stiffening()), Stiffening()
    path = ((1e-3, 0.0), (2e-3, 0.02), (4e-3, 0.04))
    first, second, third = (solver.solve(depth, 0.02, time) for depth, time in path)
    assert first.error == pytest.approx(tissue.force(1e-3))
    assert second.error == pytest.approx(max(abs(force_of(first, 2e-3) - tissue.force(2e-3)), 0.8 * first.error))
    assert third.error == pytest.approx(max(abs(force_of(first, 4e-3) - tissue.force(4e-3)), 0.8 * second.error))
    assert (third.wrench[2], third.stiffness_matrix[2][2]) == pytest.approx((tissue.force(4e-3), 400 + 18e6 * 16e-6))


def test_solver_without_equilibrium_keeps_its_time_and_error():
    class Stuck:
        answers = iter([ToolForce.from_axial_force(1.0, 100.0, ForceStatus.CONVERGED),
                        ToolForce.from_axial_force(1.1, 100.0, ForceStatus.STOPPED, age=0.05, depth=1e-3),
                        ToolForce.from_axial_force(math.nan, 100.0, ForceStatus.CONVERGED),
                        ToolForce.from_axial_force(1.1, 100.0, ForceStatus.REFUSED)])

        def step(self, depth, dt):
            return next(self.answers)

    solver = SlowSolver(Stuck())
    known = solver.solve(1e-3, 0.05, 1.0)
    stopped = solver.solve(2e-3, 0.05, 1.05)
    assert stopped.time == pytest.approx(1.0)
    assert stopped.error == known.error
    assert solver.solve(2e-3, 0.05, 1.1) is None
    assert solver.solve(2e-3, 0.05, 1.15) is None


def test_models_of_the_air_teach_no_error():
    class Surface(Stiffening):
        def force(self, depth):
            return super().force(max(depth, 0.0))

    solver, blend = SlowSolver(Surface()), LocalModelBlend()
    for n in range(5):
        model = solver.solve(-1e-3, 0.1, 0.1 * n)
        assert model.error is None
    blend.time = 0.4
    assert blend.publish(model) and blend.error == math.inf
    assert blend.step(-1e-3, DT).force_error is None
    first = solver.solve(2e-3, 0.1, 0.5)
    assert first.error == pytest.approx(abs(force_of(model, 2e-3) - Surface().force(2e-3)))
    for n in range(6, 10):
        assert solver.solve(-1e-3, 0.1, 0.1 * n).error >= 0.8 * first.error


def test_an_answer_states_the_ages_of_its_parts():
    class Aged(Stiffening):
        def step(self, depth, dt):
            return replace(super().step(depth, dt), stiffness_age=0.25, force_error=5.0)

    solver, blend = SlowSolver(Aged()), LocalModelBlend(oldest=math.inf)
    blend.time = 1.0
    assert blend.publish(solver.solve(1e-3, 0.1, 1.0))
    answer = blend.step(1e-3, 0.125)
    assert (answer.age, answer.stiffness_age, answer.error_age) == pytest.approx((0.125, 0.375, 0.125))
    assert answer.force_error == pytest.approx(5.0 + abs(blend.offset[2]))
