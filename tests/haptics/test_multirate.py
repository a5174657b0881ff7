"""Multirate simulation of a solid in the loop, with its bulk in this process or in another one."""

import copy
import math
import pickle
import time
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from delayed_bulk import DelayedBulkLink
from waiting import wait_for_value

import tissue_sim as ts
from haptics.devices.motions import SineMotion
from haptics.loop.loop import Loop, LoopSettings
from haptics.loop.multirate import BulkProcess, MultiRateTissue, make_real_time_tissue_factory
from haptics.loop.process import LoopProcess
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose, interpolate_pose
from tissue_sim.realtime.model_transition import TRANSITION
from tissue_sim.tool_force import ERROR_FLOOR, ERROR_SHARE, ForceStatus

PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
MESH = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX8P0, smallest=2.4e-3, growth=2.2, largest=20e-3, around=2)
DT = 1e-3


def model(tool="round", friction=0.3, material=PHANTOM, **changes):
    return ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(3e-3, 3), friction=friction,
                                  tool=ts.Tool(tool, radius=8e-3), **changes), material)


def delayed(delay=0.016, tangent=None, **settings):
    tested = model(**settings)
    bulk = SolidLineariser(make_solver(tested, mesh=MESH))
    tissue = MultiRateTissue(tested, link=DelayedBulkLink(bulk, delay, tangent))
    tissue.warm_up()
    return tissue


def tilted(degrees):
    half = 0.5 * math.radians(degrees)
    return (math.cos(half), 0.0, math.sin(half), 0.0)


def hand(seed, ticks, deepest=2e-3, aside=3e-3):
    """A random walk in all directions that lifts off, at up to some 40 mm/s."""
    rng = np.random.default_rng(seed)
    phases, rates = rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(4.0, 16.0, (3, 3))
    t = DT * np.arange(ticks)[:, None]
    x, y, z = (np.sin(rates[k] * t + phases[k]).sum(axis=1) / 3.0 for k in range(3))
    ramp = np.minimum(1.0, 4.0 * t[:, 0])
    return [Pose((aside * r * a, aside * r * b, 1e-3 * (1.0 - r) - deepest * r * (0.3 + c)))
            for a, b, c, r in zip(x.tolist(), y.tolist(), z.tolist(), ramp.tolist(), strict=True)]


@pytest.mark.slow
def test_a_random_walk_has_a_force_in_every_tick_and_no_jump():
    """Lift-off, touch, lateral drag and friction; what a change of model may add to a tick is 0.01 N."""
    tissue, poses = delayed(), hand(3, 1500)
    answers, models = [], []
    for pose in poses:
        answers.append(tissue.step(pose, DT))
        models.append(tissue.models)
    late = sum(answer.status is not ForceStatus.CONVERGED for answer, count in zip(answers, models, strict=True)
               if count)
    wrenches = np.array([answer.wrench[:3] for answer in answers])
    assert late <= 15 and np.isfinite(wrenches).all() and wrenches[:, 2].max() > 0.05
    assert (wrenches[:, 2] > -TRANSITION.force_step).all(), "nothing pulls"
    assert (wrenches[:, 2] == 0.0).sum() > 50 and np.hypot(*wrenches[:, :2].T).max() > 0.01
    steps = np.linalg.norm(np.diff(wrenches, axis=0), axis=1)
    ways = [np.linalg.norm(np.subtract(b.position, a.position)) for a, b in pairwise(poses)]
    # 250 N/m is the stiffest that this tip feels there.
    assert (steps - 250.0 * np.array(ways)).max() < TRANSITION.force_step + 1e-3
    assert tissue.models > 50


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "friction", "gain"), [("round", 0.3, 3.0), ("flat", "bonded", 8.0)])
def test_forces_of_now_on_a_tangent_of_then_are_nearer_than_models_as_late_as_the_tangent(tool, friction, gain):
    """60 ms for a tangent, 8 ms for an iterate: against the whole solid, in rms."""
    tested = model(tool, friction)
    aside = [Pose((1e-3 * x, 0.0, -1e-3 * z)) for x, z in [*((0.0, 0.04 * k) for k in range(50)),
                                                           *((0.04 * k, 2.0) for k in range(100))]]
    solver, off = make_solver(tested, mesh=MESH), {}
    exact = np.array([solver.step(pose, tolerance=1e-7, max_iterations=40).wrench[:3] for pose in aside[::5]])
    for name, delays in (("then", (0.06, None)), ("now", (0.008, 0.06))):
        tissue = delayed(*delays, tool=tool, friction=friction)
        found = np.array([tissue.step(pose, DT).wrench[:3] for pose in aside])[::5]
        off[name] = np.sqrt(((found - exact) ** 2).sum(axis=1).mean())
    assert off["now"] < off["then"] / gain
    assert off["now"] < 0.02 * np.linalg.norm(exact, axis=1).max()


@pytest.mark.slow
def test_the_same_motion_gives_the_same_forces_also_after_a_reset():
    poses, tissue = hand(5, 150), delayed()
    first = [tissue.step(pose, DT).wrench for pose in poses]
    tissue.reset()
    again = [tissue.step(pose, DT).wrench for pose in poses]
    np.testing.assert_allclose(again, first, atol=2e-4)
    assert [delayed_answer.wrench for delayed_answer in map(delayed().step, poses, [DT] * len(poses))] == first


@pytest.mark.slow
def test_a_model_that_is_too_old_is_no_equilibrium_any_more():
    class Dead(DelayedBulkLink):
        def receive_model(self, now):
            return None

    tested = model()
    link = Dead(SolidLineariser(make_solver(tested, mesh=MESH)), 0.016)
    tissue = MultiRateTissue(tested, link=link, oldest=0.1)
    pose = Pose((0.0, 0.0, -2e-4))
    statuses = [tissue.step(pose, DT).status for _ in range(150)]
    assert set(statuses[:95]) == {ForceStatus.CONVERGED} and set(statuses[105:]) == {ForceStatus.LATE}


def test_before_a_second_model_a_long_way_is_no_equilibrium():
    tissue = delayed(2.0)
    answers = [tissue.step(Pose((0.0, 0.0, -depth)), DT) for depth in np.linspace(0.0, 3e-3, 60)]
    assert tissue.models == 0 and answers[-1].status is ForceStatus.LATE


@pytest.mark.slow
@pytest.mark.parametrize("delays", [(0.016, None), (0.008, 0.06)])
def test_after_a_reset_models_come_as_at_first(delays):
    tissue, pose = delayed(*delays), Pose((0.0, 0.0, -1e-3))
    for _ in range(200):
        tissue.step(pose, DT)
    tissue.reset()
    before = tissue.models
    for _ in range(60):
        tissue.step(pose, DT)
    assert tissue.models > before


def test_a_bulk_that_the_elements_do_not_take_is_refused_before_it_is_sent():
    tissue = delayed()
    with pytest.raises(ts.InputError, match="K/mu0"):
        tissue.set_parameters(**{"bulk.bulk_ratio": 1.5})
    # With K in Pa the ratio has no declared bounds.
    stiff = delayed(material=ts.Material(PHANTOM.law, PHANTOM.parameters, ts.Bulk("K_Pa", 1e8)))
    with pytest.raises(ts.InputError, match=r"K/mu0 must be 2 to 1e\+06.*got 5e\+06"):
        stiff.set_parameters(C10=100.0, C20=50.0, **{"bulk.K_Pa": 1e9})
    assert tissue.step(Pose((0.0, 0.0, -1e-4)), DT).status is ForceStatus.CONVERGED


def test_parameters_of_a_compressible_law_reach_the_bulk():
    """The ratio K/mu0 is 4/3, and a factor on the modulus changes the force by the same factor."""
    tissue = delayed(tool="flat", friction="bonded",
                     material=ts.Material("hyperfoam_1", {"mu1": 1000.0, "alpha1": 4.0, "nu1": 0.2}))
    pose = Pose((0.0, 0.0, -1e-3))
    for _ in range(60):
        soft = tissue.step(pose, DT)
    tissue.set_parameters(mu1=2000.0)
    for _ in range(200):
        stiff = tissue.step(pose, DT)
    assert stiff.force == pytest.approx(2.0 * soft.force, rel=1e-3)
    with pytest.raises(ts.InputError, match="K/mu0 of at most 10 with hyperfoam_1"):
        tissue.set_parameters(nu1=0.48)


def test_what_is_no_number_is_refused_and_changes_nothing():
    tissue, pose = delayed(), Pose((0.0, 0.0, -5e-4))
    before = tissue.step(pose, DT)
    for pose_asked, dt in ((Pose((math.nan, 0.0, 0.0)), DT), (pose, math.inf)):
        refused = tissue.step(pose_asked, dt)
        assert refused.status is ForceStatus.REFUSED and refused.wrench == before.wrench
    with pytest.raises(ts.InputError, match="oldest must be positive"):
        MultiRateTissue(model(), oldest=0.0)


def test_parameters_reach_the_bulk():
    tissue, pose = delayed(tool="flat", friction="bonded"), Pose((0.0, 0.0, -1e-3))
    for _ in range(60):
        soft = tissue.step(pose, DT)
    tissue.set_parameters(C10=2 * 1404.9, C20=2 * 699.4)
    for _ in range(200):
        stiff = tissue.step(pose, DT)
    assert stiff.force == pytest.approx(2.0 * soft.force, rel=1e-3)
    with pytest.raises(ts.InputError, match="must be at most 1e\\+09 Pa"):
        tissue.set_parameters(C10=1e12)


@pytest.mark.slow
def test_a_bonded_tool_feels_the_whole_solid_with_its_bulk_in_another_process():
    tested = model("flat", "bonded")
    tissue = MultiRateTissue(tested, link=BulkProcess(tested, mesh=MESH))
    exact = make_solver(tested, mesh=MESH)
    try:
        tissue.warm_up()
        pose = Pose((5e-4, 0.0, -1e-3))
        tissue.step(Pose((0.0, 0.0, 0.0)), DT)
        answer = wait_for_value(lambda: tissue.step(pose, DT), lambda answer: tissue.models >= 12
                                and answer.status is ForceStatus.CONVERGED and not any(tissue._transition.offset))
        np.testing.assert_allclose(answer.wrench, exact.step(pose, tolerance=1e-9).wrench, atol=1e-7)
        seen = tissue.snapshot()
        assert seen.node_positions[:, 2].min() < -0.0699 and seen.fields.at_nodes("von_mises").max() > 0.0
    finally:
        tissue.close()
    assert not tissue._link.is_alive


@pytest.mark.slow
def test_the_loop_takes_it():
    made = partial(MultiRateTissue, model(), mesh=MESH)
    loop = LoopProcess(made, SineMotion(1.5e-3, -5e-4, 2.0), ForceRendering(ForceLimiter(5.0, 0.5)),
                       LoopSettings(real_time=False))
    with loop:
        loop.wait_until_ready(300.0)
        with loop.open_ring_reader() as ring:
            deadline, number, force = time.monotonic() + 120.0, 0, 0.0
            while force <= 0.0:
                assert loop.wait(0.02) is None and time.monotonic() < deadline, loop.message
                ticks = ring.read_ticks_after(number)
                number = ticks.number
                if len(ticks.records):
                    force = float(ticks.records["tissue_force"].max())
                    statuses = set(ticks.records["status"].tolist())
                    assert statuses <= {ForceStatus.CONVERGED, ForceStatus.LATE, ForceStatus.FADING,
                                        ForceStatus.RETURNING}


def test_solvers_with_a_bulk_take_two_rates():
    made = make_real_time_tissue_factory(model(), solver="solid", resolution="realtime", budget=8e-4)
    assert made.func is MultiRateTissue
    made = make_real_time_tissue_factory(model(), solver="axisymmetric", resolution="fast", budget=None)
    assert made.func is ts.Simulator
    with pytest.raises(ts.InputError, match="has no mass"):
        make_real_time_tissue_factory(model(), solver="solid", resolution="realtime", budget=None, inertia="on")


@pytest.mark.slow
def test_what_the_bulk_refuses_is_said_where_it_is_made():
    tissue = MultiRateTissue(model(friction_base=0.3), mesh=MESH)
    with pytest.raises(ts.InputError, match="a base that slides or lifts off would not hold the bulk"):
        tissue.warm_up()
    tissue.close()


def down(depth, x=0.0):
    return Pose((x, 0.0, -depth))


def statuses_and_errors(tissue, depth, ticks, right):
    """Push to a depth at 20 mm/s and hold; the answers that are CONVERGED and miss by more than they promise."""
    answers = [tissue.step(down(min(2e-5 * tick, depth)), DT) for tick in range(ticks)]
    wrong = [answer for answer in answers[-100:] if answer.status is ForceStatus.CONVERGED
             and abs(answer.force - right) > max(ERROR_FLOOR, ERROR_SHARE * right)]
    return answers, wrong


@pytest.fixture(scope="module")
def deep():
    """Force at 6 mm, models every 16 ms, held until nothing changes."""
    return statuses_and_errors(delayed(), 6e-3, 600, 0.0)[0][-1].force


@pytest.mark.slow
@pytest.mark.parametrize("history", ["air", "light touch", "deep touch"])
@pytest.mark.parametrize("delay", [0.1, 0.4])
def test_a_slow_bulk_is_never_wrong_and_converged(history, delay, deep):
    """Many models of the air, or of a light touch, teach nothing about 6 mm."""
    tissue = delayed(delay)
    if history != "air":
        depth = 2e-4 if history == "light touch" else 4e-3
        for tick in range(round(2.5 * delay / DT) + 200):
            tissue.step(down(min(2e-5 * tick, depth)), DT)
    for _ in range(1000):
        in_air = tissue.step(down(-1e-3), DT)
    assert in_air.status is ForceStatus.CONVERGED and in_air.force == 0.0
    if history == "air":
        assert in_air.force_error is None and tissue.error == math.inf and not tissue.has_touched
    answers, wrong = statuses_and_errors(tissue, 6e-3, 700, deep)
    assert not wrong and all(answer.force_error is None or math.isfinite(answer.force_error) for answer in answers)
    for _ in range(round(3.0 * delay / DT)):
        answer = tissue.step(down(6e-3), DT)
    # Friction remembers what it was on the models of then.
    assert answer.status is ForceStatus.CONVERGED and answer.force == pytest.approx(deep, rel=0.1)


@pytest.mark.slow
def test_a_step_that_waits_is_right_at_any_speed(deep):
    """The bulk takes half a second, the tool comes down in two steps."""
    tested = model()
    link = DelayedBulkLink(SolidLineariser(make_solver(tested, mesh=MESH)), 0.5)
    tissue = MultiRateTissue(tested, link=link, waits=True)
    assert tissue.step(down(-1e-3), DT).force == 0.0
    for depth in np.linspace(0.0, 6e-3, 13):
        answer = tissue.step(down(float(depth)), DT)
        assert answer.status is ForceStatus.CONVERGED
    assert answer.force == pytest.approx(deep, rel=0.02) and answer.force_error < 0.01 * deep
    with pytest.raises(ts.InputError, match="waits must be False in a loop"):
        Loop(tissue, SineMotion(1e-3), ForceRendering(ForceLimiter(5.0, 0.5)), LoopSettings(), None)


def test_waiting_for_a_process_that_has_ended_comes_to_an_end():
    class Ended(DelayedBulkLink):
        is_alive = False

        def send_state_and_wait_for_model(self, state):
            return None

    tested = model()
    tissue = MultiRateTissue(tested, link=Ended(SolidLineariser(make_solver(tested, mesh=MESH)), 0.5), waits=True)
    assert tissue.step(down(1e-3), DT).status is ForceStatus.LATE


@pytest.mark.slow
@pytest.mark.parametrize("waits", [False, True])
def test_after_changes_of_material_only_a_model_of_the_newest_one_counts(waits):
    tested = model("flat", "bonded")
    link = DelayedBulkLink(SolidLineariser(make_solver(tested, mesh=MESH)), 0.05)
    tissue = MultiRateTissue(tested, link=link, waits=waits)
    tissue.warm_up()
    for tick in range(200):
        soft = tissue.step(down(min(2e-5 * tick, 1e-3)), DT)
    answers = []
    for factor in (2.0, 4.0):
        tissue.set_parameters(C10=factor * 1404.9, C20=factor * 699.4)
        answers += [tissue.step(down(1e-3), DT) for _ in range(30)]
    answers += [tissue.step(down(1e-3), DT) for _ in range(200)]
    right = [2.0 * soft.force] * 30 + [4.0 * soft.force] * 230
    for answer, expected in zip(answers, right, strict=True):
        if answer.status is ForceStatus.CONVERGED:
            assert answer.force == pytest.approx(expected, rel=ERROR_SHARE)
    assert (answers[0].status is ForceStatus.CONVERGED) == waits
    assert answers[-1].status is ForceStatus.CONVERGED and answers[-1].force == pytest.approx(right[-1], rel=1e-3)
    tissue.reset()
    after = [tissue.step(down(1e-3), DT) for _ in range(300)]
    for answer in after:
        if answer.status is ForceStatus.CONVERGED:
            assert answer.force == pytest.approx(right[-1], rel=ERROR_SHARE)
    assert after[-1].status is ForceStatus.CONVERGED


def test_a_reset_while_a_model_is_on_its_way():
    tissue = delayed(0.05)
    for tick in range(130):
        tissue.step(down(min(2e-5 * tick, 2e-3)), DT)
    tissue.reset()
    for _ in range(60):
        answer = tissue.step(down(-1e-3), DT)
        assert answer.force == 0.0 and answer.status is ForceStatus.CONVERGED
    assert tissue.error == math.inf and not tissue.has_touched


@pytest.mark.slow
@pytest.mark.parametrize("end", [Pose((0.0, 0.0, 1e-5)), Pose((8e-4, 0.0, 1e-5)), Pose((0.0, 0.0, 1e-5), tilted(4.0)),
                                 Pose((-5e-4, 4e-4, 1e-5), tilted(3.0))])
def test_a_tool_that_holds_tissue_holds_it_where_it_touched(end):
    """A bonded tool that moved and tilted in the air has from the touch on the force of a tool on the axis."""
    moved, plain = (delayed(tool="flat", friction="bonded") for _ in range(2))
    begin = Pose((0.0, 0.0, 2e-3))
    for share in np.linspace(0.0, 1.0, 50):
        answer = moved.step(interpolate_pose(begin, end, float(share)), DT)
        assert not any(answer.wrench) and answer.status is ForceStatus.CONVERGED
        plain.step(interpolate_pose(begin, Pose((0.0, 0.0, 1e-5)), float(share)), DT)
    for tick in range(60):
        depth = 2e-5 * tick
        x, y, _ = end.position
        one = moved.step(Pose((x, y, -depth), end.orientation), DT)
        other = plain.step(down(depth), DT)
        np.testing.assert_allclose(one.wrench, other.wrench, atol=1e-6)
        assert one.status is other.status
    assert one.force > 0.1 and one.pose.position[:2] == pytest.approx(end.position[:2], abs=1e-9)


def test_a_first_step_inside_has_no_past():
    """A tool first seen at rest, 1 mm deep and 0.8 mm aside, has the force of a vertical approach."""
    inside, plain = (delayed(tool="flat", friction="bonded") for _ in range(2))
    for _ in range(60):
        one, other = inside.step(down(1e-3, 8e-4), DT), plain.step(down(1e-3), DT)
    assert one.force > 0.1 and abs(one.force_vector[0]) < 1e-6
    np.testing.assert_allclose(one.wrench, other.wrench, atol=1e-9)


def test_a_sticking_tool_that_goes_aside_in_the_air_drags_nothing():
    tissue = delayed(tool="flat", friction="stick")
    for x in np.linspace(0.0, 8e-4, 20):
        assert not any(tissue.step(Pose((float(x), 0.0, 1e-5)), DT).wrench)
    for tick in range(1, 30):
        answer = tissue.step(down(1e-5 * tick, 8e-4), DT)
    assert answer.force > 0.01 and abs(answer.force_vector[0]) < 0.1 * answer.force


@pytest.mark.slow
@pytest.mark.parametrize("pose", [Pose((0.0, math.nan, 0.0)), Pose((0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)),
                                  Pose((math.inf, 0.0, 0.0)), Pose((1e300, 0.0, -1e-4)), Pose((0.0, 0.0, -5.0)), 1e9])
def test_wild_poses_are_refused_and_change_nothing(pose):
    tissue, twin = delayed(), delayed()
    path = [down(1e-5 * tick) for tick in range(50)]
    for there in path:
        tissue.step(there, DT)
        twin.step(there, DT)
    assert tissue.step(pose, DT).status is ForceStatus.REFUSED
    assert tissue.step(down(6e-4), DT).wrench == twin.step(down(6e-4), DT).wrench


def test_what_owns_kernels_is_not_copied():
    tissue = delayed()
    for refused in (copy.copy, copy.deepcopy, pickle.dumps, MultiRateTissue.clone):
        with pytest.raises(ts.InputError, match="Make another MultiRateTissue"):
            refused(tissue)
    with pytest.raises(ts.InputError, match="must be a Pose"):
        tissue.step("deep", DT)


def test_every_part_of_an_answer_has_its_age():
    """Forces of some milliseconds ago on a tangent of some tens of them."""
    tissue = delayed(0.008, 0.04)
    for tick in range(300):
        answer = tissue.step(down(min(2e-5 * tick, 3e-3)), DT)
    assert 0.0 < answer.age < 0.02 and answer.age <= answer.stiffness_age < 0.1
    assert answer.status is ForceStatus.CONVERGED and answer.force_error == pytest.approx(tissue.error)
    assert 0.0 <= answer.error_age < 0.1


@pytest.mark.slow
def test_a_bulk_that_is_killed_is_late_and_can_be_closed():
    tested = model()
    tissue = MultiRateTissue(tested, link=BulkProcess(tested, mesh=MESH), waits=True)
    try:
        tissue.step(down(0.0), DT)
        assert tissue.step(down(2e-3), DT).status is ForceStatus.CONVERGED
        tissue._link._process.kill()
        tissue._link._process.wait()
        assert tissue.step(down(2e-3), DT).status is ForceStatus.LATE
        with pytest.raises(ts.InputError, match="process of the bulk has ended"):
            tissue.set_parameters(C10=1000.0)
    finally:
        tissue.close()


@pytest.mark.slow
def test_a_step_that_waits_gets_its_answers_from_the_process(deep):
    """Changes of the material too, in the very step."""
    tested = model()
    tissue = MultiRateTissue(tested, link=BulkProcess(tested, mesh=MESH), waits=True)
    try:
        for tick in range(301):
            answer = tissue.step(down(2e-5 * tick), DT)
            assert answer.status is ForceStatus.CONVERGED
        assert answer.force == pytest.approx(deep, rel=0.02)
        tissue.set_parameters(C10=2 * 1404.9, C20=2 * 699.4)
        stiff = tissue.step(down(6e-3), DT)
        assert stiff.status is ForceStatus.CONVERGED and stiff.force == pytest.approx(2.0 * answer.force, rel=0.02)
    finally:
        tissue.close()


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.05, 0.1, 0.2])
def test_a_tool_that_stops_before_the_pose_of_its_model_is_not_in_the_air(delay):
    """200 mm/s to 2 mm: models are made for where the tool would have gone, and there is no contact on them at 2 mm."""
    tissue, tested = delayed(delay), model()
    waiting = MultiRateTissue(tested, link=DelayedBulkLink(SolidLineariser(make_solver(tested, mesh=MESH)), delay),
                              waits=True)
    for tick in range(-5, 800):
        pose = down(min(2e-4 * tick, 2e-3))
        answer, right = tissue.step(pose, DT), waiting.step(pose, DT)
        if answer.status is ForceStatus.CONVERGED:
            assert abs(answer.force - right.force) <= max(ERROR_FLOOR, ERROR_SHARE * right.force)
