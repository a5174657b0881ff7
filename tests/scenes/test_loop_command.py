"""`tissue-sim loop`: flags, report, interruptions and errors."""

import importlib
import json
import os
import signal
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_until

import tissue_sim as ts
from haptics.devices.motions import ProtocolMotion, RandomWalk, SineMotion, SpatialWalk
from haptics.devices.virtual.hand import VirtualHand
from haptics.loop.process import LoopProcess
from haptics.loop.ring import RingReader, RingWriter
from scenes.cli import main
from scenes.commands.loop import LoopStatusLine
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

ROOT = Path(__file__).resolve().parents[2]
KEYS = {"scene", "motion", "resolution", "ended_by", "seconds", "period_us", "ticks", "late", "missed",
        "missed_percent", "lateness_us", "compute_us", "statuses", "flagged", "largest_force_N", "real_time",
        "peak_memory_MB", "device", "force_error_percent"}


def writer_of(ring, ticks=50, seconds=600.0, alive=lambda: True):
    """Wait until a ring buffer has `ticks` ticks, and return the identifier of the process that writes it."""
    def while_alive(condition):
        assert alive(), "the loop has ended"
        return condition()

    wait_until(lambda: while_alive(ring.exists), "the ring buffer", seconds)
    with RingReader(ring) as reader:
        wait_until(lambda: while_alive(lambda: reader.written_count >= ticks), f"{ticks} ticks", seconds)
        return reader.writer


@pytest.fixture
def asked(monkeypatch):
    """Function that runs the command and returns the parts of its loop process, which is not started."""
    class NotStartedError(Exception):
        pass

    class Recorded(LoopProcess):
        def start(self):
            raise NotStartedError(self._parts, self.ring_path)

    monkeypatch.setattr("haptics.loop.process.LoopProcess", Recorded)

    def asked(*words):
        with pytest.raises(NotStartedError) as caught:
            main(["loop", *words])
        (build, source, rendering, settings), ring = caught.value.args
        return build, source, rendering, settings, ring

    return asked


@pytest.fixture
def of_tissue(monkeypatch):
    """Function that replaces the tissue of loops: their processes start without kernels, four seconds earlier."""
    monkeypatch.syspath_prepend(ROOT / "tests" / "haptics")  # the loop process inherits the path
    tissues = importlib.import_module("loop_tissues")

    def of_tissue(make):
        class OfTissue(LoopProcess):
            def __init__(self, _, *others, **options):
                super().__init__(make(tissues), *others, **options)

        monkeypatch.setattr("haptics.loop.process.LoopProcess", OfTissue)

    return of_tissue


@pytest.fixture
def of_springs(of_tissue):
    """Replace the tissue of loops by a spring of 200 N/m."""
    of_tissue(lambda tissues: tissues.Spring)


@pytest.mark.slow
def test_a_short_loop_reports_in_json(capsys):
    """Without inertia, the needle at 2 mm has 0.3601 N in the reference curve."""
    assert main(["loop", "--seconds", "0.6", "--protocol", "ramp 2mm @5mm/s; hold 1s", "--budget-us", "0",
                 "--inertia", "off", "--no-real-time", "--json"]) == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert err == "" and set(answer) == KEYS
    assert answer["ticks"] + answer["missed"] >= 600 and answer["seconds"] >= 0.6 and answer["ended_by"] == "time"
    assert sum(answer["statuses"].values()) == answer["ticks"] and answer["statuses"]["refused"] == 0
    assert (answer["scene"], answer["motion"], answer["real_time"]) == ("needle_indentation", "protocol", [])
    assert answer["largest_force_N"] == pytest.approx(0.3601, rel=0.02)
    assert answer["resolution"] == "realtime"


def test_a_short_loop_prints_a_table(of_springs, capsys):
    assert main(["loop", "--seconds", "0.6", "--protocol", "ramp 2mm @5mm/s; hold 1s"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0].split() == ["p50", "p99", "p99.9", "max"]
    for part in ("lateness [us]", "compute time [us]", "ticks in 0.6", "peak memory", "real time: "):
        assert part in out
    force = float(out.split("largest force: ")[1].split()[0])
    assert force == pytest.approx(200 * 2e-3, rel=0.02)


def test_flags_select_the_motion(asked):
    _, source, *_ = asked("--depth-mm", "6", "--seed", "3", "--top-speed-mm-s", "100")
    twin = RandomWalk(3, 6e-3, -1.2e-3, 0.1)
    assert isinstance(source, RandomWalk)
    np.testing.assert_allclose([source.depth(t) for t in range(9)], [twin.depth(t) for t in range(9)], rtol=1e-12)
    _, source, *_ = asked("--motion", "sine", "--depth-mm", "5", "--frequency-hz", "2")
    assert isinstance(source, SineMotion) and source.depth(0.25) == pytest.approx(5e-3)
    assert source.depth(0.5) == pytest.approx(-1e-3)
    _, source, *_ = asked("--protocol", "ramp 4mm @2mm/s; unload")
    assert isinstance(source, ProtocolMotion) and source.depth(6.0) == pytest.approx(4e-3), "a closed protocol repeats"
    _, source, *_ = asked("--motion", "protocol", "--depth-mm", "3", "--speed-mm-s", "1")
    assert source.depth(1.0) == pytest.approx(1e-3) and source.depth(9.0) == pytest.approx(3e-3)
    _, source, *_ = asked("--motion", "sine:depth_mm=2,frequency_hz=4", "--depth-mm", "5")
    assert source.depth(0.125) == pytest.approx(2e-3), "settings in the name take precedence"
    _, source, *_ = asked("--device", "virtual:hand:depth_mm=3")
    assert isinstance(source, VirtualHand) and source.pose(0.0).depth == 0.0


def test_random_motion_with_lateral_displacement_and_rotation(asked):
    _, source, *_ = asked("--solid", "--depth-mm", "4", "--sideways-mm", "3", "--turn-deg", "5", "--seed", "2",
                          "--top-speed-mm-s", "50", "--offset-mm", "12", "--tilt-deg", "10", "--tool", "round")
    twin = SpatialWalk(2, 4e-3, -0.8e-3, 3e-3, np.radians(5.0), 0.05, approach=ts.Approach(12e-3, np.radians(10.0)))
    assert isinstance(source, SpatialWalk)
    assert [source.pose(t) for t in range(9)] == [twin.pose(t) for t in range(9)]


@pytest.mark.parametrize("words", [("--motion", "sine"), ("--protocol", "ramp 4mm; unload"), ("--motion", "random"),
                                   ("--device", "virtual:sine")])
def test_every_motion_starts_at_first_contact(words, asked):
    """With --offset-mm and --tilt-deg the first pose lies on the line of approach."""
    _, source, *_ = asked("--solid", "--offset-mm", "12", "--tilt-deg", "10", "--tool", "round", *words)
    pose, approach = source.pose(0.0), ts.Approach(12e-3, np.radians(10.0))
    assert pose.orientation == approach.pose(0.0).orientation
    assert pose.position == pytest.approx(approach.pose(pose.depth / np.cos(np.radians(10.0))).position, abs=1e-12)


@pytest.mark.parametrize("words", [["--motion", "sine"], ["--motion", "random:depth_mm=4"],
                                   ["--device", "virtual:hand"]])
@pytest.mark.parametrize("flag", ["--sideways-mm", "--turn-deg"])
def test_lateral_flags_are_refused_for_other_motions(words, flag, capsys):
    assert main(["loop", "--solid", *words, flag, "3"]) == 2
    assert f"{flag}: applies only to the random motion of the other flags" in capsys.readouterr().err


def test_a_tilted_tool_stays_in_the_box_of_a_reduced_model(asked, monkeypatch):
    """A tilted tool moves sideways as it goes deeper."""
    file, start = reduced_file(monkeypatch, 0.3, ts.Approach(5e-3, 0.3))
    _, source, *_ = asked("--reduced", "any.reduced.npz", "--top-speed-mm-s", "50")
    poses = [source.pose(t) for t in np.arange(0.0, 20.0, 0.05)]
    assert all(file.box.contains_pose(pose, start) for pose in poses if pose.depth >= 0.0)
    assert np.ptp([pose.position[1] for pose in poses]) > 1e-3 and max(pose.depth for pose in poses) > 2e-3


@pytest.mark.parametrize(("words", "said"), [
    (["--sideways-mm", "3"],
     "--sideways-mm: must be at most 1.072 to stay in the box of poses of the reduced model, because a tilted"),
    (["--turn-deg", "10"], "--turn-deg: must be at most 5.73 to stay in the box of poses")])
def test_a_motion_beyond_the_box_of_a_reduced_model_is_refused(words, said, monkeypatch, capsys):
    reduced_file(monkeypatch, 0.3, ts.Approach(5e-3, 0.3))
    assert main(["loop", "--reduced", "any.reduced.npz", *words]) == 2
    assert said in capsys.readouterr().err


def reduced_file(monkeypatch, friction, approach):
    """Make the command load a reduced model that has only a box; return the model and the first pose of its tool."""
    holds = friction == "bonded"
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(3e-3, 3), friction=friction,
        tool=ts.Tool("flat" if holds else "round", radius=8e-3), approach=approach)
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
    box = ts.PoseBox(2e-3, 3e-3, 0.1)
    file = ts.ReducedModel(ts.Model(experiment, material), None, None, 12 if holds else 0, None, None, box, 1e-3, 300.0)
    monkeypatch.setattr("tissue_sim.load_reduced", lambda path: file)
    return file, experiment.tool_pose(0.0)


@pytest.mark.parametrize("friction", ["bonded", 0.3])
def test_no_motion_leaves_the_box_of_a_reduced_model(friction, asked, monkeypatch):
    """A bonded tool does not lift off either."""
    holds = friction == "bonded"
    file, start = reduced_file(monkeypatch, friction, ts.Approach(5e-3))
    box = file.box
    for motion in ("random", "sine"):
        _, source, *_ = asked("--reduced", "any.reduced.npz", "--motion", motion, "--top-speed-mm-s", "50")
        poses = [source.pose(t) for t in np.arange(0.0, 20.0, 0.05)]
        assert all(box.contains_pose(pose, start) for pose in poses if holds or pose.depth >= 0.0)
        assert (min(pose.depth for pose in poses) < 0.0) is not holds, "only a tool that is not bonded lifts off"
        if motion == "random":
            assert np.ptp([pose.position[1] for pose in poses]) > 2e-3 and isinstance(source, SpatialWalk)
    _, source, *_ = asked("--reduced", "any.reduced.npz", "--sideways-mm", "0", "--turn-deg", "0")
    assert isinstance(source, RandomWalk) and source.pose(1.0).position[0] == 5e-3


def test_flags_reach_model_settings_and_limits(asked, tmp_path):
    build, _, rendering, settings, ring = asked(
        "lubricated_compression", "--radius-mm", "20", "--spin-us", "50", "--seconds", "2", "--no-real-time",
        "--force-limit-N", "5", "--force-rate-N", "0.1", "--ring", str(tmp_path / "r"), "--resolution", "accurate",
        "--budget-us", "500", "--inertia", "off")
    model, = build.args
    assert build.func is ts.Simulator
    assert build.keywords == {"resolution": "accurate", "inertia": "off", "budget": pytest.approx(5e-4),
                              "solver": "axisymmetric", "looks_ahead": False}
    assert asked("--budget-us", "0")[0].keywords["budget"] is None
    assert model.experiment.specimen.radius == pytest.approx(0.02) and model.material.parameters["C10"] == 1404.9
    assert settings.spin == pytest.approx(50e-6) and settings.seconds == 2.0 and not settings.real_time
    assert (rendering.limits.force, rendering.limits.rate) == (5.0, 0.1) and ring == tmp_path / "r"
    assert asked("--gravity")[0].args[0].experiment.specimen.density == 1040.0, "the default material has a density"


def test_flags_reach_the_coupling_and_the_controller(asked):
    rendering = asked("--coupling-stiffness-N-m", "800", "--coupling-damping-N-s-m", "2", "--passivity-damping-N-s-m",
                      "3")[2]
    assert (rendering.coupling.stiffness, rendering.coupling.damping) == (800.0, 2.0)
    assert rendering.controller.damping == 3.0 and rendering.limits.force == 100.0
    rendering = asked()[2]
    assert rendering.coupling is None and rendering.controller is None
    build, device, rendering, *_ = asked("--device", "haply:ws://127.0.0.1:10001,largest_force_N=3",
                                         "--force-limit-N", "2")
    assert build.keywords["inertia"] == "off", "inertia is off with a coupling"
    assert device.largest_force == 3.0 and rendering.limits.force == 2.0
    assert rendering.coupling.stiffness == 1000.0 and rendering.controller.damping == 2.0, "defaults of a real device"
    rendering = asked("--device", "haply:ws://127.0.0.1:10001", "--coupling-stiffness-N-m", "0",
                      "--passivity-damping-N-s-m", "0")[2]
    assert rendering.coupling is None and rendering.controller is None
    assert asked("--coupling-stiffness-N-m", "800", "--inertia", "on")[0].keywords["inertia"] == "on"


@pytest.mark.slow
def test_the_force_at_a_device_stays_within_its_limit(capsys):
    """Needle in silicone, moved 12 mm deep by the emulated hand of a Haply device with a limit of 1 N."""
    from haptics.devices.virtual.faults import Faults
    from haptics.emulators.haply import make_haply_emulator

    with make_haply_emulator(None, "port=0,depth_mm=12,frequency_hz=1,grip_N_m=800", Faults()) as service:
        device = f"{service.address},x_mm=0,y_mm=-150,z_mm=148,largest_force_N=1"
        assert main(["loop", "--seconds", "1.5", "--device", device, "--passivity-damping-N-s-m", "2", "--budget-us",
                     "0", "--no-real-time", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["largest_force_N"] == pytest.approx(1.0) and answer["flagged"]["limited"] > 0
    assert service.largest_force == pytest.approx(1.0) and service.force == (0.0, 0.0, 0.0)
    assert answer["device"]["device_id"] == "049D" and "trouble" not in answer["device"]


def test_the_status_line_is_read_from_the_ring(tmp_path):
    with RingWriter(tmp_path / "ring") as ring, RingReader(tmp_path / "ring") as reader:
        live, answer = LoopStatusLine(reader, 60.0), ToolForce.from_axial_force(0.25, 200.0, ForceStatus.CONVERGED)
        assert live.format_status_line() == "waiting for the next tick"
        for n in range(1, 101):
            ring.append_tick(n, n * 1e-3, Pose.at_depth(0.0), Pose.at_depth(1.5e-3), answer.wrench, answer, 1e-6 * n,
                             2e-6 * n, 3, 7, 0)
        assert live.format_status_line() == (
            "0 of 60 s: 1.50 mm, 0.250 N; p99 compute 99, lateness 198 us; late 3, missed 7")
        assert live.format_status_line() \
            == "waiting for the next tick", "a line covers the ticks since the line before"


@pytest.mark.parametrize(("words", "expected"), [
    (["needle"], "unknown scene 'needle'"),
    (["--seconds", "0"], "must be a positive number; got '0'"),
    (["--spin-us", "1000"], "spin: spin must be at least 0 and less than the period"),
    (["--motion", "jump"], "unknown motion 'jump'; known: random, sine, protocol, hand"),
    (["--motion", "sine:frequency_hz=fast"], "sine.frequency_hz: the value must be a number; got 'fast'"),
    (["--motion", "sine:frequncy_hz=2"], "sine.frequncy_hz: unknown setting; did you mean 'frequency_hz'?"),
    (["--motion", "random:seed=1.5"], "random.seed: the value must be a whole number; got '1.5'"),
    (["--motion", "sine:deep"], "sine.settings: a setting must be NAME=NUMBER"),
    (["--device", "jump:0"], "unknown haptic device 'jump'; known: virtual"),
    (["--device", "virtual:sine:deep=3"], "virtual.sine.deep: unknown setting; known: depth_mm, lift, frequency_hz"),
    (["--device", "virtual:", "--motion", "sine"], "--motion: cannot be combined with --device"),
    (["--device", "haply:ws://127.0.0.1:1", "--force-limit-N", "9"],
     "--force-limit-N: must be at most 5 N, the limit of the device; got 9 N"),
    (["--device", "haply:127.0.0.1"],
     "haply.address: the address must be ws://HOST:PORT, such as ws://127.0.0.1:10001; got '127.0.0.1'"),
    (["--coupling-damping-N-s-m", "2"], "--coupling-damping-N-s-m: requires a coupling"),
    (["--motion", "sine", "--protocol", "ramp 2mm"],
     "--protocol: applies only to --motion protocol; got the motion 'sine'"),
    (["--material", "missing.json"], "missing.json"),
    (["--depth-mm", "70"], "deeper than the specimen is high"),
    (["--ring", "taken"], "taken: exists already"),
    (["--reduced", "any.npz", "--slip", "0.2"], "--slip: corrects whole force curves"),
    (["--tilt-mm", "0.3"], "--tilt-mm: corrects whole force curves and is not available in real time"),
    (["--slip", "0.0001"], "--slip: corrects whole force curves and is not available in real time"),
])
def test_invalid_arguments_get_one_sentence(words, expected, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").touch()
    assert main(["loop", *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and expected in err and err.count("\n") == 1


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_a_loop_that_is_killed_is_exit_code_1(of_springs, capsys, tmp_path):
    ring = tmp_path / "ring"

    def kill():
        os.kill(writer_of(ring), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    assert main(["loop", "--ring", str(ring)]) == 1
    killer.join()
    out, err = capsys.readouterr()
    assert out == "" and err == "tissue-sim: the process of the loop was killed by signal 9; before that: running\n"
    assert not ring.exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals and process groups")
def test_ctrl_c_ends_the_loop_with_its_report(tmp_path):
    """Random motion, the default without flags."""
    ring = tmp_path / "ring"
    with subprocess.Popen([sys.executable, "-m", "scenes.cli", "loop", "--json", "--ring", ring], cwd=ROOT,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
                          # A background process of a script inherits an ignored SIGINT.
                          preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)) as process:
        writer_of(ring, alive=lambda: process.poll() is None)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        out, err = process.communicate(timeout=600)
    assert process.returncode == 130 and err == ""
    answer = json.loads(out)
    assert answer["ended_by"] == "stop" and answer["ticks"] >= 50 and set(answer) == KEYS
    assert sum(answer["statuses"].values()) == answer["ticks"] and answer["statuses"]["refused"] == 0
    assert (answer["scene"], answer["motion"]) == ("needle_indentation", "random")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_during_the_start_of_a_running_loop_has_its_report(of_springs, monkeypatch, capsys, tmp_path):
    """Ctrl-C gives a report if the loop ticks and its first message is not read yet, as on a busy machine."""
    ring = tmp_path / "ring"

    def interrupted(process, **_):
        writer_of(ring)
        raise KeyboardInterrupt

    monkeypatch.setattr("haptics.loop.process.LoopProcess.wait_until_ready", interrupted)
    assert main(["loop", "--json", "--ring", str(ring)]) == 130
    answer = json.loads(capsys.readouterr().out)
    assert answer["ended_by"] == "stop" and answer["ticks"] >= 50


def test_ctrl_c_before_the_first_tick_is_reported(of_tissue, monkeypatch, capsys):
    def interrupted(process, **_):
        raise KeyboardInterrupt

    of_tissue(lambda tissues: partial(tissues.build_slowly, 600.0))
    monkeypatch.setattr("haptics.loop.process.LoopProcess.wait_until_ready", interrupted)
    assert main(["loop", "--json"]) == 130
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("tissue-sim: stopped by Ctrl-C")
