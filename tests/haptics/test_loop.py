"""The loop: one tick on a simulated clock, and the loop process: killed, commanded and read."""

import importlib
import json
import math
import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from child_environment import child_environment
from waiting import wait_until

from haptics.devices.contracts import AxialMotion, DeviceError, HapticDevice
from haptics.devices.motions import SineMotion, TargetFollowingMotion
from haptics.loop.loop import Loop, LoopSettings, read_peak_memory_bytes_or_none
from haptics.loop.process import LoopError
from haptics.loop.ring import PAUSED, RingReader, RingWriter
from haptics.loop.shared_slots import SnapshotReader, SnapshotWriter
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering, RenderFlag
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

HERE = Path(__file__).parent


@pytest.fixture
def tissues(monkeypatch):
    """The module of tissues; the process of the loop inherits the search path and finds it there."""
    monkeypatch.syspath_prepend(HERE)
    return importlib.import_module("loop_tissues")


class FakeClock:
    def __init__(self):
        self.now = 0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += round(seconds * 1e9)


class Ramp(AxialMotion):
    """20 mm/s."""

    def depth(self, time):
        return 0.02 * time


@pytest.fixture
def run(tmp_path, tissues):
    """Run a loop on a fake clock: the report and its ticks; `published` is the last snapshot, of tissues that have
    some."""
    clock = FakeClock()

    def run(tissue, seconds, *, source=None, listen=None, force=10.0):
        settings = LoopSettings(seconds=seconds, real_time=False, snapshot_rate=30.0)
        rendering = ForceRendering(ForceLimiter(force=force, rate=1.0))
        with ExitStack() as stack:
            ring = stack.enter_context(RingWriter(tmp_path / "ring"))
            reader = stack.enter_context(RingReader(tmp_path / "ring"))
            board = None
            if hasattr(tissue, "snapshot"):
                board = stack.enter_context(SnapshotWriter(tmp_path / "snapshots", tissue.snapshot()))
                snapshots = stack.enter_context(SnapshotReader(tmp_path / "snapshots", tissue.snapshot()))
            loop = Loop(tissue, source or Ramp(), rendering, settings, ring, snapshots=board, listen=listen,
                        clock=clock, sleep=clock.sleep)
            report = loop.run()
            run.published = snapshots.latest() if board else None
            return report, reader.read_ticks_after().records

    run.clock = clock
    return run


def answers(report):
    """Return the number of answers of each status that occurs."""
    return {name: count for name, count in report.statuses.items() if count}


def test_a_tick_goes_from_pose_to_force(run, tissues):
    tissue = tissues.Gel(200.0)
    report, ticks = run(tissue, 0.5)
    assert (report.ticks, report.late, report.missed, report.ended_by) == (500, 0, 0, "time")
    assert report.seconds == pytest.approx(0.5) and answers(report) == {"converged": 500}
    times = 1e-3 * np.arange(1, 501)
    np.testing.assert_allclose(ticks["time"], times, rtol=1e-12)
    np.testing.assert_array_equal(ticks["tick"], np.arange(1, 501))
    for name in ("device_depth", "tool_depth"):
        np.testing.assert_allclose(ticks[name], 0.02 * times, rtol=1e-12)
    np.testing.assert_allclose(ticks["force"], 4.0 * times, rtol=1e-12)
    np.testing.assert_allclose([dt for _, dt in tissue.steps], 1e-3, rtol=1e-9)
    assert set(ticks["stiffness"]) == {200.0} and set(ticks["iterations"]) == {1} and set(ticks["inertial"]) == {1}
    assert report.largest_force == pytest.approx(2.0)
    # Published at 30 Hz: every 33 ticks from the first one on, the last at tick 496.
    assert run.published.number == 16 and run.published.time == pytest.approx(0.496)
    assert run.published.snapshot.depth == pytest.approx(0.02 * 0.496)


def test_the_tissue_gets_the_time_that_has_passed(run, tissues):
    """Tick 100 takes 7.4 ms: 6 deadlines pass, and the next step is as long as all of them."""
    class Slow(tissues.Spring):
        def step(self, pose, dt):
            answer = super().step(pose, dt)
            run.clock.now += 7_400_000 if len(self.steps) == 100 else 250_000
            return answer

    tissue = Slow()
    report, ticks = run(tissue, 0.2)
    assert (report.ticks, report.missed, report.late) == (194, 6, 1)
    assert list(ticks["tick"][98:102]) == [99, 100, 107, 108] and list(ticks["missed"][98:102]) == [0, 0, 6, 6]
    assert ticks["lateness"][100] == pytest.approx(6.4e-3) and ticks["time"][100] == pytest.approx(0.1074)
    steps = [dt for _, dt in tissue.steps]
    assert steps[100] == pytest.approx(7.4e-3) and steps[101] == pytest.approx(0.6e-3)
    assert sum(steps) == pytest.approx(0.2), "no time is lost"
    np.testing.assert_allclose(ticks["tool_depth"], 0.02 * ticks["time"])
    assert report.compute_time.p50 == pytest.approx(0.25e-3, rel=0.02)
    assert report.compute_time.maximum == pytest.approx(7.4e-3) == ticks["compute_time"].max()
    assert report.lateness.maximum == pytest.approx(6.4e-3)


def test_a_loop_with_long_ticks_is_listened_to_after_each_of_them(run, tissues):
    """Every 10 ms by its deadlines: each tick of a tissue that takes 30 ms, each tenth one of a quick one."""
    class Slow(tissues.Spring):
        taken = 30_000_000

        def step(self, pose, dt):
            answer = super().step(pose, dt)
            run.clock.now += self.taken
            return answer

    quick = Slow()
    quick.taken = 250_000
    for tissue, every in ((Slow(), 1), (quick, 10)):
        heard = []
        report, _ = run(tissue, 0.6, listen=lambda _, heard=heard: heard.append(run.clock.now))
        assert len(heard) == pytest.approx(report.ticks / every, abs=1.5)


def test_a_force_without_an_equilibrium_is_let_go_and_comes_back(run, tissues):
    class Lost(tissues.Spring):
        """Tissue without an equilibrium from 0.2 to 0.6 s."""

        def step(self, pose, dt):
            super().step(pose, dt)
            status = ForceStatus.STOPPED if 200 <= len(self.steps) < 600 else ForceStatus.CONVERGED
            return ToolForce.from_axial_force(1.5, 300.0, status)

    report, ticks = run(Lost(), 0.8)
    assert answers(report)["fading"] > 340 and 0 < answers(report)["returning"] < 110
    assert ticks["tissue_force"][0] == ticks["stiffness"][0] == 0.0, "a hand that begins inside begins without a force"
    np.testing.assert_allclose(ticks["tissue_force"][60:245], 1.5)
    assert not ticks["tissue_force"][300:599].any() and not ticks["stiffness"][300:599].any()
    assert not ticks["force"][310:599].any() and ticks["tissue_force"][-1] == 1.5
    with pytest.raises(InputError, match="patience"):
        LoopSettings(patience=0.0)


def test_statuses_and_limits_are_counted_and_shown(run, tissues):
    class Doubtful(tissues.Spring):
        def step(self, pose, dt):
            answer = super().step(pose, dt)
            status = ForceStatus.LATE if len(self.steps) % 4 == 0 else ForceStatus.CONVERGED
            return ToolForce.from_axial_force(answer.force, answer.stiffness, status, 3, 1e-3, age=0.25)

    report, ticks = run(Doubtful(), 0.4, force=1.0)
    assert answers(report) == {"converged": 300, "late": 100}
    assert (ticks["status"][3::4] == ForceStatus.LATE).all() and set(ticks["age"]) == {0.25}
    limited = ticks["tissue_force"] > 1.0
    assert report.flagged["limited"] == limited.sum() == 150 and report.largest_force == 1.0
    np.testing.assert_array_equal(ticks["flags"] & RenderFlag.LIMITED != 0, limited)


def test_a_source_without_a_pose_is_passed_on(run, tissues):
    class Lost(AxialMotion):
        def depth(self, time):
            return 5e-3 if time < 0.1 else None

    report, ticks = run(tissues.Spring(), 0.5, source=Lost())
    assert np.isnan(ticks["device_depth"][100:]).all() and (ticks["tool_depth"] == 5e-3).all()
    assert ticks["force"][50] == pytest.approx(1.0) and ticks["force"][-1] == 0.0
    assert report.flagged["lost_pose"] == np.count_nonzero(ticks["flags"] & RenderFlag.LOST_POSE) > 300


def test_a_pause_holds_the_motion_and_fades_the_force(run, tissues):
    def listen(loop):
        {100: loop.pause, 400: loop.resume}.get(len(tissue.steps), lambda: None)()

    tissue = tissues.Spring()
    report, ticks = run(tissue, 0.8, listen=listen)
    paused = ticks["flags"] & PAUSED != 0
    assert report.flagged["paused"] == paused.sum() == 300
    np.testing.assert_allclose(ticks["tool_depth"][paused], 2e-3)
    assert ticks["force"][399] == 0.0 and np.abs(np.diff(ticks["force"])).max() < 0.02
    np.testing.assert_allclose(ticks["device_depth"][400:], 2e-3 + 0.02e-3 * np.arange(1, 401))
    assert ticks["force"][-1] == pytest.approx(200 * 10e-3)


def test_a_reset_begins_again(run, tissues):
    def listen(loop):
        if len(tissue.steps) == 200 and not done:
            done.append(True)
            loop.reset()

    tissue, done = tissues.Spring(), []
    _, ticks = run(tissue, 0.4, listen=listen)
    np.testing.assert_allclose(ticks["device_depth"], np.tile(0.02e-3 * np.arange(1, 201), 2), rtol=1e-9)
    assert len(tissue.steps) == 200, "the tissue began again, too"


def test_a_paused_motion_can_go_on_for_a_while(run, tissues):
    def listen(loop):
        step = len(tissue.steps)
        if step == 100:
            loop.pause()
        elif step == 200:
            loop.advance_paused_motion(0.03)
            loop.advance_paused_motion(0.02)

    tissue = tissues.Spring()
    report, ticks = run(tissue, 0.4, listen=listen)
    assert report.flagged["paused"] == 250
    np.testing.assert_allclose(ticks["tool_depth"][[199, 210, 249, 399]], [2e-3, 2.22e-3, 3e-3, 3e-3])


def test_another_source_is_followed_and_a_hand_is_steered(run, tissues):
    def listen(loop):
        step = len(tissue.steps)
        if step == 50:
            with pytest.raises(InputError,
                               match=r"requires a steerable motion; got a Ramp\. Switch to a TargetFollowingMotion"):
                loop.aim(1e-3)
        elif step == 100:
            loop.switch_device(TargetFollowingMotion(2e-3))
            loop.aim(5e-3)

    tissue = tissues.Spring()
    _, ticks = run(tissue, 0.6, listen=listen)
    after = ticks["tool_depth"][99:]
    assert after[0] == pytest.approx(2e-3) and after[-1] == pytest.approx(5e-3, abs=1e-7)
    assert (np.diff(after) >= 0).all() and np.diff(after).max() < 0.1e-3


def test_a_hand_takes_the_tool_over_where_it_is(run, tissues):
    """A hand takes the tool over at its present pose, without a jump to an older one."""
    def listen(loop):
        if len(tissue.steps) == 100:
            loop.switch_device(TargetFollowingMotion(None))
            loop.aim(5e-3)

    tissue = tissues.Spring()
    _, ticks = run(tissue, 0.6, listen=listen)
    way = np.diff(ticks["tool_depth"])
    assert way[98] == pytest.approx(0.02e-3) and 0 < way[99] < 0.02e-3, "from the tick before, not from the touch"
    assert (way >= 0).all() and ticks["tool_depth"][-1] == pytest.approx(5e-3, abs=1e-7)


def test_another_device_can_restart_the_motion(run, tissues):
    def listen(loop):
        if len(tissue.steps) == 100 and not done:
            done.append(True)
            loop.switch_device(TargetFollowingMotion(-1e-3), restart=True)

    tissue, done = tissues.Spring(), []
    _, ticks = run(tissue, 0.2, listen=listen)
    np.testing.assert_allclose(ticks["tool_depth"][98:102], [1.98e-3, 2e-3, -1e-3, -1e-3])
    assert len(tissue.steps) == 100, "the tissue began again, too"


class Felt(HapticDevice):
    """Rests at 3 mm, and notes what is done with it."""

    def __init__(self, there=True):
        self.there, self.said, self.wrenches = there, [], []

    def start(self):
        if not self.there:
            raise DeviceError("no handle is plugged in; plug one in")
        self.said.append("start")

    def pose(self, time):
        return Pose((1e-3, 2e-3, -3e-3), (0.6, 0.0, 0.0, 0.8))

    def render(self, wrench):
        self.wrenches.append(wrench)

    def stop(self):
        self.said.append("stop")


def test_a_device_is_given_what_the_ring_says(run, tissues):
    device = Felt()
    _, ticks = run(tissues.Spring(200.0), 0.1, source=device)
    assert device.said == ["stop"] and len(device.wrenches) == 100
    np.testing.assert_array_equal(ticks["wrench"], device.wrenches)
    assert ticks["force"][-1] == pytest.approx(0.6)
    np.testing.assert_array_equal(ticks["device_pose"], [[1e-3, 2e-3, -3e-3, 0.6, 0.0, 0.0, 0.8]] * 100)
    np.testing.assert_array_equal(ticks["tool_pose"], ticks["device_pose"])


def test_a_device_is_stopped_whatever_happens(run, tissues):
    device = Felt()
    with pytest.raises(ZeroDivisionError):
        run(tissues.Fuse(), 0.1, source=device)
    assert device.said == ["stop"] and len(device.wrenches) == 9


def test_a_loop_changes_from_one_device_to_another_that_is_there(run, tissues):
    def listen(loop):
        step = len(tissue.steps)
        if step == 20:
            with pytest.raises(DeviceError, match="no handle is plugged in"):
                loop.switch_device(Felt(there=False))
            assert first.said == [] and len(first.wrenches) == 20
        elif step == 40:
            loop.switch_device(other)

    tissue, first, other = tissues.Spring(), Felt(), Felt()
    run(tissue, 0.1, source=first, listen=listen)
    assert (first.said, other.said) == (["stop"], ["start", "stop"])
    assert (len(first.wrenches), len(other.wrenches)) == (40, 60)


def test_a_tissue_without_the_ability_says_so(run, tissues):
    class Plain:
        def step(self, depth, dt):
            return ToolForce.from_axial_force(0.0, 0.0, ForceStatus.CONVERGED)

    with pytest.raises(InputError, match=r"this tissue \(Plain\) has no method reset"):
        run(Plain(), 0.1, listen=lambda loop: loop.reset())


@pytest.mark.parametrize(("wrong", "field"), [
    ({"period": 0.0}, "period"), ({"spin": 2e-3}, "spin"), ({"seconds": 0.0}, "seconds"),
    ({"seconds": math.inf}, "seconds"), ({"snapshot_rate": -1.0}, "snapshot_rate"),
    ({"snapshot_rate": math.nan}, "snapshot_rate"),
])
def test_settings_that_make_no_sense_are_refused(wrong, field):
    with pytest.raises(InputError) as caught:
        LoopSettings(**wrong)
    assert caught.value.field == field


def test_a_report_is_json(run, tissues):
    report, _ = run(tissues.Spring(), 0.1)
    answer = json.loads(json.dumps(report.as_json(), allow_nan=False))
    assert answer["ticks"] == 100 and answer["missed_percent"] == 0.0 and answer["period_us"] == 1000.0
    assert set(answer["lateness_us"]) == set(answer["compute_us"]) == {"p50", "p99", "p99.9", "max"}
    assert answer["real_time"] == []
    assert 5 < answer["peak_memory_MB"] < 4000


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_peak_memory_is_that_of_this_program(tissues):
    """A process that a large one starts does not begin with the memory of its parent."""
    ballast = bytearray(os.urandom(1)) * 400_000_000
    code = "from haptics.loop.loop import read_peak_memory_bytes_or_none; print(read_peak_memory_bytes_or_none())"
    done = subprocess.run([sys.executable, "-c", code], env=child_environment(HERE), capture_output=True, text=True,
                          check=True)
    assert read_peak_memory_bytes_or_none() > len(ballast) > int(done.stdout) > 5e6


# ---- the process ----

def is_running(pid):
    """Return whether a process runs; a process that ended and was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_process_ticks_to_its_end(tissues):
    said = []
    with tissues.loop_process(seconds=0.5, real_time=True) as loop:
        loop.wait_until_ready(300, said.append)
        assert said[-1] == "running"
        with loop.open_ring_reader() as ring:
            report = loop.wait(300)
            ticks = ring.read_ticks_after().records
        assert report.ended_by == "time" and report.ticks + report.missed >= 500
        assert len(report.real_time) == 4 and any(feature.obtained for feature in report.real_time)
        assert ring_is_right(ticks) and report.statuses["converged"] == report.ticks == len(ticks)
        assert report.largest_force == ticks["force"].max()
        assert not loop.alive and loop.exit_code == 0 and loop.message == "ended"
    assert not loop.ring_path.exists() and not loop.snapshot_path.exists()


@pytest.mark.slow
def test_an_unrelated_process_reads_the_ring(tissues):
    with tissues.loop_process() as loop:
        loop.wait_until_ready(300)
        assert loop.alive and loop.exit_code is None and loop.report is None
        with loop.open_ring_reader() as ring:
            command = [sys.executable, HERE / "loop_tissues.py", "read", loop.ring_path, "100"]
            read, lost, _ = subprocess.run(command, env=child_environment(HERE), capture_output=True, text=True,
                                           check=True).stdout.split()
            report = loop.stop()
            ticks = ring.read_ticks_after().records
            assert ring.ended
    assert 100 <= int(read) <= len(ticks) and lost == "0"
    assert report.ended_by == "stop" and report.ticks == len(ticks)
    assert ring_is_right(ticks)


def ring_is_right(ticks):
    """Every tick has the force of the spring at the depth of the sine at its time."""
    depth = np.array([SineMotion(4e-3, -1e-3, 5.0).depth(time) for time in ticks["time"]])
    np.testing.assert_allclose(ticks["tool_depth"], depth, atol=1e-12)
    np.testing.assert_allclose(ticks["tissue_force"], 200.0 * np.maximum(depth, 0), atol=1e-12)
    return (np.diff(ticks["tick"].astype(int)) >= 1).all()


def test_commands_work_and_a_refusal_does_not_end_the_loop(tissues):
    with tissues.loop_process() as loop:
        with pytest.raises(LoopError, match="not ready"):
            loop.pause()
        loop.wait_until_ready(300)
        with loop.open_ring_reader() as ring:
            loop.set_parameters(stiffness=300.0)
            with pytest.raises(InputError, match="stiffness: -1 N/m is no stiffness"):
                loop.set_parameters(stiffness=-1.0)
            loop.pause()
            written = ring.written_count
            wait_until(lambda: ring.written_count > written + 1)
            latest = ring.latest()
            assert latest["flags"] & PAUSED and np.isnan(latest["device_depth"])
            loop.resume()
            wait_until(lambda: not np.isnan(ring.latest()["device_depth"]))
            wait_until(lambda: ring.latest()["stiffness"] == 300.0)
            time_before = float(ring.latest()["time"])
            loop.reset()
            wait_until(lambda: ring.latest()["time"] > time_before)
            assert loop.alive
        report = loop.stop()
    assert report.ended_by == "stop" and report.flagged["paused"] >= 1 and loop.exit_code == 0
    assert loop.stop() is report and loop.wait() is report
    with pytest.raises(InputError, match="was started before"):
        loop.start()


def test_snapshots_are_published_and_follow_the_material(tissues):
    with tissues.loop_process(tissues.Gel, snapshot_rate=200.0) as loop:
        loop.wait_until_ready(300)
        with loop.open_snapshot_reader() as snapshots, loop.open_ring_reader() as ring:
            wait_until(lambda: snapshots.written_count > 3)
            seen = snapshots.latest()
            depth = seen.snapshot.depth
            np.testing.assert_array_equal(seen.snapshot.fields.displacements, [[depth, 2 * depth]])
            assert seen.snapshot.fields.material == 200.0 and snapshots.latest(after=10**9) is None
            loop.set_parameters(stiffness=300.0)
            assert loop.pattern.fields.material == 300.0
            loop.switch_device(TargetFollowingMotion(0.0))
            loop.aim(3e-3)
            wait_until(lambda: abs(ring.latest()["tool_depth"] - 3e-3) < 1e-6)
            wait_until(lambda: abs(snapshots.latest().snapshot.depth - 3e-3) < 1e-6)
            loop.pause()
            loop.advance_paused_motion(0.01)
        path = loop.snapshot_path
    assert not path.exists()


@pytest.mark.parametrize(("tissue", "rate"), [("Gel", 0.0), ("Spring", 30.0), ("Bare", 30.0)])
def test_who_publishes_no_snapshots_has_none(tissues, tissue, rate):
    with tissues.loop_process(getattr(tissues, tissue), seconds=0.05, snapshot_rate=rate) as loop:
        loop.wait_until_ready(300)
        assert loop.open_snapshot_reader() is None and loop.pattern is None


def test_an_error_of_the_tissue_arrives_as_one_sentence(tissues, capfd):
    with tissues.loop_process(tissues.Fuse) as loop, pytest.raises(LoopError, match=r"^ZeroDivisionError: the tenth"):
        loop.wait(300)
    assert loop.exit_code == 1 and not loop.alive and loop.message == "ZeroDivisionError: the tenth step"
    assert "Traceback" in capfd.readouterr().err, "a fault of the program can be found"
    with tissues.loop_process(tissues.refuse) as loop, pytest.raises(InputError, match="12 layers are too many"):
        loop.wait_until_ready(300)
    assert capfd.readouterr().err == "" and loop.stop() is None


def test_a_child_that_is_killed_is_seen(tissues):
    with tissues.loop_process() as loop:
        loop.wait_until_ready(300)
        os.kill(loop.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        with pytest.raises(LoopError, match="before that: running"):
            loop.wait(300)
        assert not loop.alive and loop.exit_code not in (None, 0) and loop.report is None
        assert not loop.ring_path.exists(), "nothing is left behind"
        for command in (loop.pause, loop.reset, loop.wait):
            with pytest.raises(LoopError, match="the process of the loop"):
                command()
    with tissues.loop_process(tissues.die) as loop, pytest.raises(LoopError, match="making the tissue"):
        loop.wait_until_ready(300)


def test_a_build_that_takes_long_can_be_stopped(tissues):
    with tissues.loop_process(partial(tissues.build_slowly, 600.0)) as loop:
        with pytest.raises(LoopError, match=r"not ready after 0.5 s"):
            loop.wait_until_ready(0.5)
        assert loop.alive
    assert not loop.alive and loop.report is None and not loop.ring_path.exists()


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize("what", ["parent", "building"])
def test_no_loop_outlives_its_parent(what, tmp_path):
    ring = tmp_path / "ring"
    with subprocess.Popen([sys.executable, HERE / "loop_tissues.py", what, ring], env=child_environment(HERE),
                          stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        wait_until(ring.exists)
        assert is_running(child)
        parent.kill()
    wait_until(lambda: not is_running(child))
    assert list(tmp_path.iterdir()) == []


def test_a_loop_without_main_guard_is_told_so(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text("from loop_tissues import loop_process\n"
                      "with loop_process() as loop:\n    loop.wait_until_ready()\n", encoding="utf-8")
    ended = subprocess.run([sys.executable, script], env=child_environment(HERE), capture_output=True, text=True)
    assert ended.returncode == 1
    assert "if __name__ == '__main__':" in ended.stderr.splitlines()[-1]


def test_what_cannot_be_sent_is_refused(tissues, tmp_path):
    with pytest.raises(InputError, match="cannot be sent to another process"), \
            tissues.loop_process(lambda: tissues.Spring()) as loop:
        loop.wait()
    (tmp_path / "ring").touch()
    with pytest.raises(InputError, match="exists already"):
        tissues.loop_process(ring_path=tmp_path / "ring")
