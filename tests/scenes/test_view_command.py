"""`tissue-sim view`: run without a browser, JSON output, and errors of one sentence."""

import json
import multiprocessing
import os
import signal
import socket
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from scenes.viewer.frame import Phase
from scenes.viewer.live_simulation import SETTINGS
from scenes.viewer.trace import Trace

KEYS = {"frames", "seconds", "phase", "message", "time_s", "displacement_mm", "force_N", "largest_force_N", "rate_Hz",
        "late_percent", "RMSE_N"}


def recorded(path, **metadata):
    """Write a recording of a needle ramp to 1 mm."""
    depth = np.linspace(0.0, 1e-3, 21)
    ts.write_recording(ts.Recording({"time": depth / 1e-3, "displacement": depth, "force": 180 * depth}, {}, metadata),
                       path)
    return path


@pytest.mark.slow
def test_headless_run_returns_the_forces(of_gel, capsys):
    before = set(multiprocessing.active_children())
    assert main(["view", "--headless", "--seconds", "0.5", "--protocol", "ramp 2mm @20mm/s; hold 1s", "--json",
                 "--no-real-time"]) == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert err == "" and set(answer) == KEYS
    assert (answer["phase"], answer["message"], answer["seconds"]) == ("running", "running", 0.5)
    assert answer["frames"] >= 2 and answer["rate_Hz"] > 0 and 0 <= answer["late_percent"] <= 100
    time, depth, force = (np.array(answer[name]) for name in ("time_s", "displacement_mm", "force_N"))
    assert time.size == depth.size == force.size >= 3 and (np.diff(time) > 0).all()
    assert depth.max() == pytest.approx(2.0, abs=1e-6) and (np.diff(depth) > -1e-9).all()
    np.testing.assert_allclose(force, 0.2 * depth, atol=1e-9)
    assert answer["largest_force_N"] == force.max() and answer["RMSE_N"] is None, "nothing was measured"
    assert set(multiprocessing.active_children()) <= before


class Staged:
    """Session whose simulation starts at the third frame; then `on_frame` and `refuses` define its behaviour."""

    is_waiting_for_curve = False

    def __init__(self, scene, **options):
        self.scene, self.options, self.frames, self.posted, self.closed = scene, options, 0, [], False
        self.refuses, self.on_frame = None, lambda number: None
        Staged.newest = self

    def update_and_make_frame(self):
        self.frames += 1
        self.on_frame(self.frames)
        return SimpleNamespace(phase=Phase.STARTING if self.frames < 3 else Phase.RUNNING, message="running",
                               curves=SimpleNamespace(trace=Trace(), residual=None), readouts=None)

    def post(self, command, *, reply=None, **values):
        self.posted.append((command, values))
        if reply is not None:
            reply(self.refuses)

    def run(self, viewer, stop, seconds=None):
        if not stop.is_set():
            viewer.show(self.update_and_make_frame())

    def close(self):
        self.closed = True


@pytest.fixture
def staged(monkeypatch):
    monkeypatch.setattr("scenes.viewer.run.Session", Staged)
    return Staged


HEADLESS = ["view", "--headless", "--seconds", "0.1", "--json"]


def test_flags_reach_the_session(staged, capsys, tmp_path):
    path = recorded(tmp_path / "plates.csv", kind="bonded_compression")
    assert main([*HEADLESS, "--protocol", "ramp 3mm", "--speed-mm-s", "20", "--resolution", "fast", "--no-real-time",
                 "--measured", str(path), "--radius-mm", "30"]) == 0
    session = staged.newest
    assert session.options == {"resolution": "fast", "settings": replace(SETTINGS, real_time=False)} and session.closed
    scene = session.scene
    assert (scene.kind.name, scene.source) == ("needle_indentation", "silicone of the study")
    assert scene.max_tool_displacement == 3e-3
    assert scene.experiment.specimen.radius == pytest.approx(0.03) and scene.measurement is None
    assert set(scene.measurements) == {"bonded_compression"}
    (command, values), = session.posted
    assert (command, values["text"]) == ("play", "ramp 3mm")
    assert values["speed"] == pytest.approx(20e-3), "the speed where the protocol names none"
    answer = json.loads(capsys.readouterr().out)
    assert set(answer) == KEYS and answer["time_s"] == [] and answer["largest_force_N"] == 0.0
    assert (answer["rate_Hz"], answer["RMSE_N"]) == (None, None)


def test_summary_is_one_line(staged, capsys):
    assert main(HEADLESS[:-1]) == 0
    assert capsys.readouterr().out == "1 frames in 0.1 s; running; largest force 0.000 N\n"
    assert staged.newest.posted == [], "without a protocol the tool rests at first contact"


def test_a_crashed_simulation_is_exit_code_1(staged, monkeypatch, capsys):
    def died(session):
        seen = frame(session)
        seen.phase, seen.message = Phase.DIED, "The simulation has stopped: killed."
        return seen

    frame = Staged.update_and_make_frame
    monkeypatch.setattr(Staged, "update_and_make_frame", died)
    assert main(HEADLESS) == 1
    assert json.loads(capsys.readouterr().out)["phase"] == "stopped"
    assert main(HEADLESS[:-1]) == 1
    out, err = capsys.readouterr()
    assert out == "" and err == "tissue-sim: The simulation has stopped: killed.\n"


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_ctrl_c_before_the_first_frame_is_no_traceback(staged, monkeypatch, capsys):
    monkeypatch.setattr(Staged, "update_and_make_frame", interrupted(Staged.update_and_make_frame))
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    assert main(HEADLESS) in (0, 130)
    assert staged.newest.closed and "Traceback" not in capsys.readouterr().err
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def interrupted(frame):
    """Return `frame` with a Ctrl-C at its first call."""
    def interrupted(session):
        if session.frames == 0:
            signal.raise_signal(signal.SIGINT)
        return frame(session)
    return interrupted


def refused(capsys, *words):
    """Run `view`; check exit code 2, one sentence on stderr and an empty stdout; return the sentence."""
    assert main(["view", *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("tissue-sim: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


@pytest.mark.parametrize(("words", "expected"), [
    (["needle"], "unknown scene 'needle'"),
    (["--headless"], "--seconds: is required with --headless"),
    (["--headless", "--seconds", "0"], "must be a positive number; got '0'"),
    (["--port", "70000"], "must be at most 65535"),
    (["--resolution", "coarse"], "'coarse'"),
    (["--depth-mm", "70"], "deeper than the specimen is high"),
    (["--depth-mm", "3", "--protocol", "ramp 2mm"], "--depth-mm: cannot be combined with --protocol"),
    (["--material", "missing.material.json"], "missing.material.json"),
    (["--measured", "missing.csv"], "missing.csv"),
    (["--measured", "words.csv"], "words.csv"),
    (["--measured", "pulled.csv"],
     "pulled.csv: kind: the kind of test of a recording must be one of lubricated_compression"),
    (["--measured", "force.csv"], "force.csv"),
])
def test_invalid_arguments_get_one_sentence(words, expected, capsys, tmp_path, monkeypatch):
    """No session is started for invalid arguments."""
    def start(*_, **__):
        raise AssertionError("a session was started")

    monkeypatch.setattr("scenes.viewer.run.Session", start)
    monkeypatch.chdir(tmp_path)
    recorded(tmp_path / "pulled.csv", kind="tension")
    (tmp_path / "words.csv").write_text("these are words\nand more of them\n", encoding="utf-8")
    (tmp_path / "force.csv").write_text("force_N\n1\n2\n3\n4\n5\n6\n", encoding="utf-8")
    assert expected in refused(capsys, *words)


@pytest.mark.slow
def test_a_page_that_cannot_be_served_is_one_sentence(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "Use --expose to allow this" in refused(capsys, "--host", "0.0.0.0", "--port", "0")
    assert "must be an IP address" in refused(capsys, "--host", "my computer", "--port", "0")
    assert "nowhere: this folder does not exist" in refused(capsys, "--materials", "nowhere", "--port", "0")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is in use" in refused(capsys, "--port", str(port))
