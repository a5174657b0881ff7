"""A solid by two rates: a tissue for the loop, with its bulk in this process or in another one."""

import math
import time
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

import tissue_sim as ts
from haptics.devices.motions import SineMotion
from haptics.loop.bulk_link import BulkProcess, DelayedBulk
from haptics.loop.loop import LoopSettings
from haptics.loop.model_transition import JUMP
from haptics.loop.multirate import MultiRateTissue, real_time_tissue
from haptics.loop.process import LoopProcess
from haptics.safety.limits import ForceLimits
from haptics.safety.rendering import ForceRendering
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLinearisation
from tissue_sim.mesh.hexahedra import HEX8P0
from tissue_sim.mesh.solid import needle_solid
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus

PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
MESH = needle_solid(0.04, 0.07, 8e-3, HEX8P0, smallest=2.4e-3, growth=2.2, largest=20e-3, around=2)
DT = 1e-3


def model(tool="round", friction=0.3, **changes):
    return ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(3e-3, 3), friction=friction,
                                  tool=ts.Tool(tool, radius=8e-3), **changes), PHANTOM)


def delayed(delay=0.016, tangent=None, **settings):
    tested = model(**settings)
    bulk = SolidLinearisation(make_solver(tested, mesh=MESH))
    tissue = MultiRateTissue(tested, link=DelayedBulk(bulk, delay, tangent))
    tissue.warm_up()
    return tissue


def hand(seed, ticks, deepest=2e-3, aside=3e-3):
    """A random walk in all directions that lifts off, at up to some 40 mm/s."""
    rng = np.random.default_rng(seed)
    phases, rates = rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(4.0, 16.0, (3, 3))
    t = DT * np.arange(ticks)[:, None]
    x, y, z = (np.sin(rates[k] * t + phases[k]).sum(axis=1) / 3.0 for k in range(3))
    ramp = np.minimum(1.0, 4.0 * t[:, 0])
    return [Pose((aside * r * a, aside * r * b, 1e-3 * (1.0 - r) - deepest * r * (0.3 + c)))
            for a, b, c, r in zip(x.tolist(), y.tolist(), z.tolist(), ramp.tolist(), strict=True)]


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
    assert (wrenches[:, 2] > -JUMP).all(), "nothing pulls"
    assert (wrenches[:, 2] == 0.0).sum() > 50 and np.hypot(*wrenches[:, :2].T).max() > 0.01
    steps = np.linalg.norm(np.diff(wrenches, axis=0), axis=1)
    ways = [np.linalg.norm(np.subtract(b.position, a.position)) for a, b in pairwise(poses)]
    # 250 N/m is the stiffest that this tip feels there.
    assert (steps - 250.0 * np.array(ways)).max() < JUMP + 1e-3
    assert tissue.models > 50


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


def test_the_same_motion_gives_the_same_forces_also_after_a_reset():
    poses, tissue = hand(5, 150), delayed()
    first = [tissue.step(pose, DT).wrench for pose in poses]
    tissue.reset()
    again = [tissue.step(pose, DT).wrench for pose in poses]
    np.testing.assert_allclose(again, first, atol=2e-4)
    assert [delayed_answer.wrench for delayed_answer in map(delayed().step, poses, [DT] * len(poses))] == first


def test_a_model_that_is_too_old_is_no_equilibrium_any_more():
    class Dead(DelayedBulk):
        def receive(self, now):
            return None

    tested = model()
    link = Dead(SolidLinearisation(make_solver(tested, mesh=MESH)), 0.016)
    tissue = MultiRateTissue(tested, link=link, oldest=0.1)
    pose = Pose((0.0, 0.0, -2e-4))
    statuses = [tissue.step(pose, DT).status for _ in range(150)]
    assert set(statuses[:95]) == {ForceStatus.CONVERGED} and set(statuses[105:]) == {ForceStatus.LATE}


def test_before_a_second_model_a_long_way_is_no_equilibrium():
    tissue = delayed(2.0)
    answers = [tissue.step(Pose((0.0, 0.0, -depth)), DT) for depth in np.linspace(0.0, 3e-3, 60)]
    assert tissue.models == 0 and answers[-1].status is ForceStatus.LATE


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
    assert tissue.step(Pose((0.0, 0.0, -1e-4)), DT).status is ForceStatus.CONVERGED


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
    with pytest.raises(ts.InputError, match="stiffer than any tissue"):
        tissue.set_parameters(C10=1e12)


def test_a_bonded_tool_feels_the_whole_solid_with_its_bulk_in_another_process():
    tested = model("flat", "bonded")
    tissue = MultiRateTissue(tested, link=BulkProcess(tested, mesh=MESH))
    exact = make_solver(tested, mesh=MESH)
    try:
        tissue.warm_up()
        pose, deadline = Pose((5e-4, 0.0, -1e-3)), time.monotonic() + 120.0
        tissue.step(Pose((0.0, 0.0, 0.0)), DT)
        while tissue.models < 12:
            answer = tissue.step(pose, DT)
            assert time.monotonic() < deadline
            time.sleep(1e-3)
        while answer.status is not ForceStatus.CONVERGED or any(tissue._transition.offset):
            answer = tissue.step(pose, DT)
            assert time.monotonic() < deadline
        np.testing.assert_allclose(answer.wrench, exact.step(pose, tolerance=1e-9).wrench, atol=1e-7)
        seen = tissue.snapshot()
        assert seen.place[:, 2].min() < -0.0699 and seen.fields.at_nodes("von_mises").max() > 0.0
    finally:
        tissue.close()
    assert not tissue._link.alive


def test_the_loop_takes_it():
    made = partial(MultiRateTissue, model(), mesh=MESH)
    loop = LoopProcess(made, SineMotion(1.5e-3, -5e-4, 2.0), ForceRendering(ForceLimits(5.0, 0.5)),
                       LoopSettings(real_time=False))
    with loop:
        loop.wait_until_ready(300.0)
        with loop.ring() as ring:
            deadline, number, force = time.monotonic() + 120.0, 0, 0.0
            while force <= 0.0:
                assert loop.wait(0.02) is None and time.monotonic() < deadline, loop.message
                ticks = ring.since(number)
                number = ticks.number
                if len(ticks.records):
                    force = float(ticks.records["tissue_force"].max())
                    statuses = set(ticks.records["status"].tolist())
                    assert statuses <= {ForceStatus.CONVERGED, ForceStatus.LATE, ForceStatus.FADING,
                                        ForceStatus.RETURNING}


def test_solvers_with_a_bulk_take_two_rates():
    made = real_time_tissue(model(), solver="solid", resolution="realtime", budget=8e-4)
    assert made.func is MultiRateTissue
    assert real_time_tissue(model(), solver="axisymmetric", resolution="fast", budget=None).func is ts.Simulator
    with pytest.raises(ts.InputError, match="has no mass"):
        real_time_tissue(model(), solver="solid", resolution="realtime", budget=None, inertia="on")


def test_what_the_bulk_refuses_is_said_where_it_is_made():
    tissue = MultiRateTissue(model(friction_base=0.3), mesh=MESH)
    with pytest.raises(ts.InputError, match="the bulk would hold on to nothing"):
        tissue.warm_up()
    tissue.close()
