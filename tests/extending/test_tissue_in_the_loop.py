"""A tissue that knows all six directions goes through loop, multi-rate and server with its wrench unchanged."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from waiting import wait_for_value

import tissue_sim as ts
from haptics.loop.loop import LoopSettings
from haptics.loop.process import LoopProcess
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from haptics.server.client import TissueClient
from haptics.server.server import TissueServer
from haptics.server.steps import StepService
from haptics.server.wire import Request, Status, decode_reply, encode_request
from scenes.viewer.live_simulation import SETTINGS, LiveSimulation
from tissue_sim.pose import Pose
from tissue_sim.realtime.local_model import LocalModelBlend, SlowSolver
from tissue_sim.tool_force import ForceStatus

DT = 1e-3


@pytest.fixture
def toy(plugin):
    return plugin("toy_tissue")


@pytest.fixture
def motion(plugin):
    """Oblique, and turning about its line."""
    return plugin("spiral_motion").SpiralMotion(0.006)


@pytest.fixture
def path(motion):
    return [motion.pose(DT * number) for number in range(400)]


def generous():
    return ForceLimiter(1e3, 1e3, torque=1e3, torque_rate=1e3)


def same(wrench, expected):
    np.testing.assert_allclose(wrench, expected, rtol=1e-12, atol=1e-12)


def whole(ticks):
    """Those whose force is given whole: a loop that a busy computer has begun late begins without a force, see
    `ForceFader`."""
    return ticks["status"] == ForceStatus.CONVERGED


def test_the_tissue_uses_all_directions_and_slides(toy, path):
    tissue = toy.ToyTissue()
    wrenches = np.array([tissue.step(pose, DT).wrench for pose in path])
    assert np.abs(wrenches).max(axis=0).min() > 1e-3 and 50 < tissue.slips < 350
    assert np.hypot(*wrenches.T[:2]).max() == pytest.approx(toy.GRIP)


def test_through_a_loop_in_its_own_process(toy, motion, ticks_of):
    with LoopProcess(toy.ToyTissue, motion, ForceRendering(generous()), LoopSettings(real_time=False)) as loop:
        ticks = ticks_of(loop)
    tissue = toy.ToyTissue()
    poses = [Pose(tuple(each[:3]), tuple(each[3:])) for each in ticks["tool_pose"].tolist()]
    expected = np.array([tissue.step(pose, DT).wrench for pose in poses])
    assert tissue.slips > 5 and whole(ticks).sum() >= 500
    same(ticks["tissue_wrench"][whole(ticks)], expected[whole(ticks)])
    same(ticks["wrench"][whole(ticks)], expected[whole(ticks)])
    same(ticks["stiffness_matrix"][-1], toy.stiffness())


def test_through_what_the_viewer_sees(toy, motion, monkeypatch):
    """The loop of a viewer: what is felt is the tissue's wrench; there is no mesh to show."""
    class OfToy(LoopProcess):
        def __init__(self, _, *others):
            super().__init__(toy.ToyTissue, *others)

    monkeypatch.setattr("scenes.viewer.live_simulation.LoopProcess", OfToy)
    needle = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(2e-3), tool=ts.Tool("flat", radius=8e-3))
    needle_model = ts.Model(needle, ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3)))
    simulation = LiveSimulation(needle_model, motion, settings=replace(SETTINGS, real_time=False))
    tissue, ticks = toy.ToyTissue(), 0

    try:
        while ticks < 400:
            records = wait_for_value(simulation.poll_loop_process, lambda new: new is not None and len(new) > 0)
            poses = [Pose(tuple(each[:3]), tuple(each[3:])) for each in records["tool_pose"].tolist()]
            expected = np.array([tissue.step(pose, DT).wrench for pose in poses])
            same(records["tissue_wrench"][whole(records)], expected[whole(records)])
            ticks += whole(records).sum()
        assert simulation.readouts.depth == -poses[-1].position[2] and simulation.snapshot is None
        assert simulation.readouts.force == records["tissue_wrench"][-1, 2]
    finally:
        simulation.close()


def test_through_rendering_the_energy_is_that_of_all_six_directions(toy, path):
    """A spring without a slider gives back what it took, by the trapezoidal rule, on a closed oblique path."""
    tissue, rendering = toy.ToyTissue(grip=1e9), ForceRendering(generous())
    closed = path + path[::-1]
    rendered = [rendering.render(tissue.step(rendering.advance_proxy(pose, DT), DT), DT) for pose in closed]
    middle = np.array(tissue.step(path[250], DT).wrench)
    stored = 0.5 * middle @ np.linalg.solve(toy.stiffness(), middle)
    assert rendered[250].energy == pytest.approx(stored, rel=1e-9)
    assert rendered[-1].energy == pytest.approx(0.0, abs=1e-9 * stored)


def test_through_multi_rate(toy, path):
    """At the pose of a model the wrench is that of the tissue; at other poses too, while the foot sticks."""
    slow, blend, twin = SlowSolver(toy.ToyTissue()), LocalModelBlend(jump=1e3, torque_jump=1e3), toy.ToyTissue()
    for pose in path:
        assert blend.publish(slow.solve(pose, DT, blend.time))
        answer = blend.step(pose, DT)
        assert answer.status is ForceStatus.LATE
        same(answer.wrench, twin.step(pose, DT).wrench)
        same(answer.stiffness_matrix, toy.stiffness())
    slow, blend = SlowSolver(toy.ToyTissue(grip=1e9)), LocalModelBlend(jump=1e3, torque_jump=1e3)
    twin = toy.ToyTissue(grip=1e9)
    for number, pose in enumerate(path):
        if number % 30 == 0:
            model = slow.solve(pose, 30 * DT, blend.time)
            assert blend.publish(model) and (number == 0 or number == 30 or model.error < 1.0)
        same(blend.step(pose, DT).wrench, twin.step(pose, DT).wrench)


def test_through_the_step_service(toy, path):
    service, tissue = StepService(toy.ToyTissue()), toy.ToyTissue()
    for number, pose in enumerate(path):
        request = encode_request(Request(number, DT * number, pose.position, pose.orientation))
        assert service.receive(request, "client", 0.0) is None
        packet, _ = service.step(0.0)
        reply, expected = decode_reply(packet), tissue.step(pose, DT)
        assert reply.status == Status.CONVERGED
        same(reply.force + reply.torque, expected.wrench)
        same(reply.stiffness, expected.stiffness_matrix)


def test_through_a_server(toy, path):
    tissue = toy.ToyTissue()
    with TissueServer(toy.ToyTissue(), releases=False) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            with TissueClient(server.address[1], timeout=60.0) as client:
                for number, pose in enumerate(path):
                    reply, expected = client.step(pose, at=DT * number), tissue.step(pose, DT)
                    same(reply.force + reply.torque, expected.wrench)
                    same(reply.stiffness, expected.stiffness_matrix)
        finally:
            server.stop()
            thread.join(60.0)
    assert not thread.is_alive()
