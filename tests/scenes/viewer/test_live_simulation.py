"""Live simulation: start, read-outs, snapshots, and the death of its process."""

import os
import signal
from types import SimpleNamespace

import numpy as np
import pytest

import tissue_sim as ts
from haptics.devices.motions import TargetFollowingMotion
from haptics.loop.loop import LoopSettings
from haptics.loop.ring import PAUSED, TICK, RingReader, RingWriter
from haptics.loop.shared_slots import SnapshotReader, SnapshotWriter
from scenes.viewer.frame import Phase
from scenes.viewer.live_simulation import LiveSimulation
from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.parameters import with_values
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot
from tissue_sim.tool_force import ForceStatus, ToolForce

#: A tick each 4 ms: what is shown is the same as of one each millisecond, for a quarter of the work.
LOOP = LoopSettings(period=4e-3, snapshot_rate=30.0, real_time=False)


class Watched:
    """Start a simulation; return it with the messages of its start."""

    def __init__(self, simulation):
        self.simulation, self.said, self.ticks = simulation, [], 0

    def __call__(self):
        records = self.simulation.poll_loop_process()
        self.ticks += 0 if records is None else len(records)
        word = (self.simulation.phase, self.simulation.message)
        if not self.said or self.said[-1] != word:
            self.said.append(word)
        return self.simulation


@pytest.fixture(scope="module")
def needle_loop(needle, until):
    simulation = LiveSimulation(needle.model, TargetFollowingMotion(0.0, 0.05), settings=LOOP)
    watched = Watched(simulation)
    assert simulation.phase is Phase.STARTING and simulation.readouts is None and simulation.snapshot is None
    with pytest.raises(ts.InputError, match=r"The simulation is not running \(starting\)\."):
        simulation.send_command_and_wait("aim", depth=1e-3)
    try:
        until(watched, lambda seen: seen.readouts is not None and seen.snapshot is not None)
        yield watched
    finally:
        simulation.close()


def at_rest(depth):
    """Return a condition: the tool and the displayed tissue rest at a depth."""
    def at_rest(seen):
        return abs(seen.readouts.depth - depth) < 1e-8 and abs(seen.snapshot.depth - depth) < 1e-8
    return at_rest


def steady_force(watched, until):
    """Return the force, N, once it is constant for 50 ticks: late ticks and the waves of an arrival are over."""
    last = {"force": None, "ticks": 0}

    def is_steady(seen):
        force = seen.readouts.force
        if last["force"] is None or abs(force - last["force"]) > 1e-5 * abs(force):
            last.update(force=force, ticks=watched.ticks)
        return watched.ticks > last["ticks"] + 50

    return until(watched, is_steady).readouts.force


def simulator_at(simulation, model, depth):
    """Force of a simulator with the mesh of the loop after a slow motion."""
    resolution = simulation.readouts.mesh.partition(",")[0]
    simulator = ts.Simulator(model, resolution=resolution, inertia="off")
    for part in np.linspace(0.0, depth, 9)[1:]:
        answer = simulator.step(part, 1.0)
    assert answer.status is ForceStatus.CONVERGED
    return simulator, answer


@pytest.mark.slow
def test_messages_describe_the_start(needle_loop):
    words = [message for _, message in needle_loop.said]
    assert "making the tissue" in words or any("loading the solver" in word for word in words)
    assert needle_loop.said[-1] == (Phase.RUNNING, "running")
    assert {phase for phase, _ in needle_loop.said} == {Phase.STARTING, Phase.RUNNING}


@pytest.mark.slow
def test_the_live_force_equals_the_force_of_the_simulator(needle_loop, needle, until):
    simulation, meshes = needle_loop.simulation, set()
    for depth in (2e-3, 3e-3):
        simulation.send_command_and_wait("aim", depth=depth)
        seen = until(needle_loop, at_rest(depth))
        simulator, expected = simulator_at(simulation, needle.model, seen.readouts.depth)
        assert seen.readouts.force == pytest.approx(expected.force, rel=1e-4)
        assert seen.readouts.stiffness == pytest.approx(expected.stiffness, rel=1e-3)
        # The tissue that is shown: the same equilibrium, and the face of the tool where the tool is.
        np.testing.assert_allclose(seen.snapshot.node_positions, simulator.snapshot().node_positions, atol=1e-7)
        nodes = seen.snapshot.fields.mesh.nodes
        face = (nodes[:, 1] == 0.0) & (nodes[:, 0] < 0.99 * needle.experiment.tool.radius)
        assert face.sum() > 3
        np.testing.assert_allclose(seen.snapshot.node_positions[face, 1], -seen.snapshot.depth, atol=1e-9)
        np.testing.assert_allclose(seen.snapshot.fields.at_nodes("von_mises"),
                                   simulator.snapshot().fields.at_nodes("von_mises"), rtol=1e-2, atol=1.0)
        meshes.add(id(seen.snapshot.fields.mesh))
    assert len(meshes) == 1, "pictures look at a mesh once"


@pytest.mark.slow
def test_a_pause_holds_the_tool(needle_loop, until):
    simulation = needle_loop.simulation
    simulation.send_command_and_wait("aim", depth=1e-3)
    until(needle_loop, at_rest(1e-3))
    simulation.send_command_and_wait("pause")
    assert simulation.phase is Phase.PAUSED
    simulation.send_command_and_wait("aim", depth=2e-3)
    ticks = needle_loop.ticks
    seen = until(needle_loop, lambda seen: needle_loop.ticks > ticks + 100)
    assert seen.phase is Phase.PAUSED and seen.readouts.depth == pytest.approx(1e-3, abs=1e-8)
    simulation.send_command_and_wait("resume")
    assert simulation.phase is Phase.RUNNING
    until(needle_loop, at_rest(2e-3))


def test_a_refused_command_changes_nothing(needle_loop, until):
    simulation = needle_loop.simulation
    simulation.send_command_and_wait("aim", depth=2e-3)
    until(needle_loop, at_rest(2e-3))
    force = steady_force(needle_loop, until)
    for command, values, expected in (("aim", {"depth": float("nan")},
                                       "depth: the target depth must be a finite number"),
                                      ("set_parameters", {"C10": -1.0}, "must give a positive shear modulus"),
                                      ("set_parameters", {"C77": 1.0}, "C77")):
        with pytest.raises(ts.InputError, match=expected):
            simulation.send_command_and_wait(command, **values)
    ticks = needle_loop.ticks
    seen = until(needle_loop, lambda seen: needle_loop.ticks > ticks + 50)
    assert seen.phase is Phase.RUNNING and seen.readouts.force == pytest.approx(force, rel=1e-4)


def test_a_changed_material_is_shown_on_the_same_mesh(needle_loop, needle, until):
    simulation = needle_loop.simulation
    simulation.send_command_and_wait("aim", depth=2e-3)
    until(needle_loop, at_rest(2e-3))
    mesh, force = simulation.snapshot.fields.mesh, steady_force(needle_loop, until)
    simulation.send_command_and_wait("set_parameters", C10=2000.0)
    material = with_values(needle.material, {"C10": 2000.0})
    seen = until(needle_loop, lambda seen: seen.readouts.force > 1.1 * force and at_rest(2e-3)(seen)
                 and seen.snapshot.fields.material.parameters["C10"] == 2000.0)
    assert seen.snapshot.fields.mesh is mesh
    model = ts.Model(needle.experiment, material)
    expected = simulator_at(simulation, model, seen.readouts.depth)[1].force
    assert steady_force(needle_loop, until) == pytest.approx(expected, rel=1e-4)


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_a_killed_process_gives_a_message(of_gel, needle, until):
    simulation = LiveSimulation(needle.model, TargetFollowingMotion(0.0, 0.05), settings=LOOP)
    try:
        until(simulation.poll_loop_process, lambda _: simulation.snapshot is not None)
        process = simulation.haptic_loop_process
        os.kill(process.pid, signal.SIGKILL)
        # The last polls may still read a newer snapshot.
        until(simulation.poll_loop_process, lambda records: records is None)
        seen = simulation.snapshot
        assert simulation.phase is Phase.DIED
        assert simulation.message == "the process of the loop was killed by signal 9; before that: running"
        assert simulation.poll_loop_process() is None and simulation.snapshot is seen, "the last snapshot is kept"
        with pytest.raises(ts.InputError, match=r"is not running .*killed by signal 9"):
            simulation.send_command_and_wait("pause")
        assert not process.alive and not process.ring_path.exists() and not process.snapshot_path.exists()
    finally:
        simulation.close()


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_a_process_killed_during_its_start_gives_a_message(of_gel, needle, until):
    simulation = LiveSimulation(needle.model, TargetFollowingMotion(0.0, 0.05), settings=LOOP)
    try:
        os.kill(simulation.haptic_loop_process.pid, signal.SIGKILL)
        until(simulation.poll_loop_process, lambda _: simulation.phase is Phase.DIED)
        assert "was killed by signal 9 during its start" in simulation.message
    finally:
        simulation.close()


def tick(number, depth=0.0, force=0.0, stiffness=0.0, status=0, iterations=0, compute_time=0.0, late=0, missed=0,
         flags=0):
    """Arguments of `RingWriter.append` for a tick along z."""
    answer = ToolForce.from_axial_force(force, stiffness, ForceStatus(status), iterations)
    return (number, number * 1e-3, Pose.at_depth(depth), Pose.at_depth(depth), answer.wrench, answer, compute_time, 0.0,
            late, missed, flags)


class Written:
    """Loop without a process: the test writes its ticks and sets its clock."""

    resolution = "realtime_35"
    force_error = 0.015

    def __init__(self, folder):
        self.ring_path, self.snapshot_path = folder / "ring", folder / "snapshots"
        self.writer = RingWriter(self.ring_path)
        empty = np.zeros(0)
        fields = Fields(None, None, 0.0, np.zeros((1, 2)), None, empty, empty, empty, empty)
        self.pattern = Snapshot(Pose.at_depth(0.0), 0.0, fields)
        self.board = SnapshotWriter(self.snapshot_path, self.pattern)
        self.message, self.report, self.now, self.number = "running", None, 100.0, 0

    def __call__(self, *arguments, **options):
        return self

    def start(self):
        pass

    def read_message_and_check_ready(self):
        return True

    def open_ring_reader(self):
        return RingReader(self.ring_path)

    def open_snapshot_reader(self):
        return SnapshotReader(self.snapshot_path, self.pattern)

    def stop(self):
        self.writer.close()
        self.board.close()

    def write(self, count, **values):
        """Append ticks at intervals of 1 ms."""
        for _ in range(count):
            self.number += 1
            self.writer.append_tick(*tick(self.number, **values))


@pytest.fixture
def written(monkeypatch, needle, tmp_path):
    """Simulation with a loop whose ticks the test writes."""
    loop = Written(tmp_path)
    monkeypatch.setattr("scenes.viewer.live_simulation.LoopProcess", loop)
    monkeypatch.setattr("scenes.viewer.live_simulation.time", SimpleNamespace(monotonic=lambda: loop.now))
    simulation = LiveSimulation(needle.model, TargetFollowingMotion())
    yield simulation, loop
    simulation.close()


def test_the_loop_rate_is_measured_with_the_wall_clock(written):
    """The window is two seconds of wall time, independent of the simulated time."""
    simulation, loop = written
    for ticks, rate in ((40, 0), (30, 900), (30, 900), (30, 900)):
        loop.write(ticks, late=3, missed=1)
        simulation.poll_loop_process()
        assert simulation.readouts.rate == pytest.approx(rate)
        loop.now += 1 / 30
    assert simulation.readouts.late == pytest.approx(4 / 130)
    for _ in range(30):
        loop.now += 0.1
        loop.write(50)
        simulation.poll_loop_process()
    assert simulation.readouts.rate == pytest.approx(500)
    readouts = simulation.readouts
    assert readouts.mesh == "realtime_35, force within 1.5 %"
    assert len(simulation.poll_loop_process()) == 0 and simulation.readouts is readouts, "no tick, no news"


def test_statistics_cover_the_last_half_second(written):
    simulation, loop = written
    loop.write(300, compute_time=5e-3, iterations=9)
    simulation.poll_loop_process()
    assert simulation.readouts.step_time == pytest.approx(5e-3) and simulation.readouts.iterations == 9
    for _ in range(8):
        loop.write(30, compute_time=1e-4, iterations=1, depth=2e-3, force=0.4, stiffness=200.0)
        simulation.poll_loop_process()
    now = simulation.readouts
    assert (now.time, now.depth, now.force, now.stiffness) == pytest.approx((0.54, 2e-3, 0.4, 200.0))
    # 240 new ticks, and the 260 before them.
    assert now.step_time == pytest.approx(5e-3) and now.iterations == pytest.approx((260 * 9 + 240) / 500, rel=0.01)
    loop.write(30, compute_time=1e-4, iterations=1)
    simulation.poll_loop_process()
    assert simulation.readouts.step_time == pytest.approx(1e-4)


@pytest.mark.parametrize("status", [status for status in ForceStatus if status is not ForceStatus.CONVERGED])
def test_the_status_is_the_newest_and_unconverged_ticks_of_a_second_are_counted(written, status):
    """A single tick is visible for one frame only; therefore, unconverged ticks are counted over one second."""
    simulation, loop = written
    loop.write(1, status=status)
    simulation.poll_loop_process()
    now = simulation.readouts
    assert (now.status, now.warning, now.unconverged) == (status.name.lower(), status.message, 1)
    for _ in range(30):
        loop.write(33)
        simulation.poll_loop_process()
        now = simulation.readouts
        assert (now.status, now.warning, now.unconverged) == ("in equilibrium", "", 1)
    loop.write(33)
    simulation.poll_loop_process()
    assert simulation.readouts.unconverged == 0
    loop.write(1, flags=PAUSED)
    simulation.poll_loop_process()
    assert simulation.readouts.status == "paused"


def test_the_end_of_the_loop_is_reported(written):
    simulation, loop = written
    loop.write(5)
    simulation.poll_loop_process()
    loop.report = SimpleNamespace(ended_by="parent")
    assert simulation.poll_loop_process() is None and simulation.phase is Phase.DIED
    assert simulation.message == "the loop has ended (parent)"


def test_forget_skips_unread_ticks(written):
    simulation, loop = written
    loop.write(10)
    assert len(simulation.poll_loop_process()) == 10
    loop.write(10)
    simulation.skip_unread_ticks()
    loop.write(3)
    records = simulation.poll_loop_process()
    assert records["tick"].tolist() == [21, 22, 23] and records.dtype == TICK


def test_the_budget_is_extended_for_slow_solvers_only(needle, monkeypatch):
    """With the original budget, a slow solver would make no progress in most ticks."""
    from scenes.viewer.background_simulation import ExtendableBudgetSimulator

    quick = ExtendableBudgetSimulator(needle.model, resolution="realtime_20", budget=10.0)
    quick.warm_up()
    assert quick.budget == 10.0
    slow = ExtendableBudgetSimulator(needle.model, resolution="realtime_20", budget=1e-9)
    slow.warm_up()
    assert slow.budget == 2.0 * slow.linear_solve_time > 1e-9
    statuses = [slow.step(5e-5, 1e-3).status for _ in range(40)]
    assert ForceStatus.CONVERGED in statuses
