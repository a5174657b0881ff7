"""A solver from one file outside the packages, in a `Simulator`: through multi-rate and a server, wrench unchanged."""

import json
import threading

import numpy as np
import pytest

import tissue_sim as ts
from haptics.server.client import TissueClient
from haptics.server.server import TissueServer
from scenes.cli import main
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.realtime.local_model import LocalModelBlend, SlowSolver
from tissue_sim.tool_force import ForceStatus

DT = 1e-3
MODEL = ts.Model(NEEDLE.experiment(specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(8e-3, 9)),
                 ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3)))


@pytest.fixture
def spring(plugin, registers):
    module = plugin("spring_solver")
    registers(SOLVERS, module.SpringSolver, "spring")
    return module


@pytest.fixture
def path(plugin):
    """Oblique and turning, in and out, so far that the slider gives way."""
    spiral = plugin("spiral_motion").SpiralMotion(8e-3)
    return [spiral.pose(DT * number) for number in range(500)]


def simulator() -> ts.Simulator:
    return ts.Simulator(MODEL, solver="spring", inertia="off")


def same(found, expected) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_through_multi_rate(spring, path):
    """At the pose of a model, the wrench is that of the solver."""
    slow, blend, twin = SlowSolver(simulator()), LocalModelBlend(jump=1e3, torque_jump=1e3), simulator()
    for pose in path:
        assert blend.publish(slow.solve(pose, DT, blend.time))
        answer, expected = blend.step(pose, DT), twin.step(pose, DT)
        assert answer.status is ForceStatus.LATE
        same(answer.wrench, expected.wrench)
        same(answer.stiffness_matrix, spring.STIFFNESS)


def test_through_a_server(spring, path):
    twin, pulls = simulator(), []
    with TissueServer(simulator(), releases=False) as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            with TissueClient(server.address[1], timeout=60.0) as client:
                for number, pose in enumerate(path):
                    reply, expected = client.step(pose, at=DT * number), twin.step(pose, DT)
                    same(reply.force + reply.torque, expected.wrench)
                    same(reply.stiffness, spring.STIFFNESS)
                    pulls.append(np.hypot(*reply.force[:2]))
        finally:
            server.stop()
            thread.join(60.0)
    assert not thread.is_alive()
    assert max(pulls) == pytest.approx(spring.LIMIT), "the slider has given way"


def test_it_is_served_by_name(spring, tmp_path, capsys, monkeypatch):
    """`tissue-sim serve --solver spring` says what it serves, and that it has no mesh."""
    described, make = {}, TissueServer.__init__

    def keep(server, *arguments, description, **options):
        described.update(description())
        make(server, *arguments, description=description, **options)

    monkeypatch.setattr(TissueServer, "__init__", keep)
    monkeypatch.setattr(TissueServer, "run", lambda server: None)
    material = tmp_path / "m.material.json"
    ts.write_material_file(ts.MaterialFile.of(MODEL.material), material)
    assert main(["serve", "--material", str(material), "--solver", "spring", "--port", "0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["port"] > 0
    assert described["solver"] == "spring" and described["mesh"] is None
