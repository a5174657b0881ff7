"""Bench page: it reads the folder of a run and devices, and moves nothing."""

import json

import numpy as np
import pytest

from haptics.devices.contracts import DeviceError
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.recorder.recorder import LIVE_FILE, LiveProgressFile, RunProgress, convert_progress_to_dict
from haptics.recorder.run_folder import RunFolder
from scenes.viewer.bench_page import ConnectedDevicesSource, RunFolderSource, make_bench_status_html
from tissue_sim.errors import InputError

HEADER = ["time [s]", "displacement [mm]", "force [N]", "segment"]


def test_the_folder_of_a_running_recorder_is_read(tmp_path):
    source = RunFolderSource(tmp_path / "run")
    assert "No run in" in source.read().title and "tissue-sim record" in source.read().message
    folder = RunFolder(tmp_path / "run", "digest")
    with folder:
        folder.update_state(state="running")
        assert "may have been killed" in source.read().message
        moment = RunProgress("needle", "ramp", 2, 5e-3, 3e-3, 0.4, 0.25)
        (tmp_path / "run" / LIVE_FILE).write_text(json.dumps(convert_progress_to_dict(moment)), encoding="utf-8")
        partial = folder.create_partial_recording("needle_2", HEADER)
        partial.queue_rows([(0.01 * row, 0.1 * row, 0.02 * row, "ramp") for row in range(5)])
        partial.close()
        view = source.read()
        assert view.title == "needle 2: ramp; 0 recordings done" and not view.message
        assert (view.force, view.depth, view.progress) == (0.4, 3.0, 0.25)
        np.testing.assert_allclose(view.forces, 0.02 * np.arange(5))
        with partial.path.open("a", encoding="utf-8") as file:
            file.write("0.05,0.5,0.1,ramp\n0.06,0.6,0.1")  # half a row is none yet
        assert source.read().time.size == 6
        partial.path.unlink()
        again = folder.create_partial_recording("needle_2", HEADER)
        again.queue_rows([(0.01 * row, 0.2, 1.0, "ramp") for row in range(20)])
        again.close()
        np.testing.assert_allclose(source.read().forces, np.ones(20))
        (tmp_path / "run" / LIVE_FILE).unlink()
        folder.update_state(state="stopped", stops=[{"message": "the force was 9 N"}])
        assert source.read().message == "the force was 9 N"


def test_the_live_file_is_written_by_another_thread_and_removed_at_the_end(tmp_path):
    live = LiveProgressFile(tmp_path)
    file = tmp_path / LIVE_FILE
    with live.run_writing_thread():
        live.set_progress(RunProgress("a", "approach", 0, 1e-3, float("nan"), float("nan"), 0.0))
        while not file.exists():
            pass
        assert json.loads(file.read_text(encoding="utf-8")) == {
            "test": "a", "phase": "approach", "replicate": 0, "position_mm": 1.0, "share": 0.0}
    assert not file.exists()


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


def load(time):
    return (0.0, 0.0, time - 100.0, 0.0, 0.0, 0.0)


def test_a_sensor_is_displayed_and_the_stage_does_not_move(monkeypatch):
    from haptics.devices.contracts import StageLimits
    from haptics.devices.virtual.stage import VirtualStage

    clock = Clock()
    sensor = VirtualForceSensor(load, ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), 100.0, 1e-3, clock=clock)
    stage = VirtualStage(StageLimits(-0.01, 0.01, 0.01), start_at=-2e-3, clock=clock)
    moved = []
    for name in ("home", "move"):
        monkeypatch.setattr(stage, name, lambda *_: moved.append("moved"))
    source = ConnectedDevicesSource(sensor, stage)
    assert source.read().message == "The sensor has not sent a sample yet."
    clock.now += 1.0
    view = source.read()
    assert view.force == pytest.approx(1.0) and view.depth == -2.0 and view.time.size == 100
    clock.now += 100.0
    view = source.read()
    assert view.time.min() >= -20.0 and "limit of its range" in view.message
    source.close()
    assert not moved
    with pytest.raises(DeviceError):
        sensor.read()


def test_an_unknown_channel_is_refused():
    with pytest.raises(InputError, match=r"axis: must be one of .*; got 'Fz'"):
        ConnectedDevicesSource(VirtualForceSensor(load, ("Fx", "Fy")))


def test_texts_are_escaped_in_html():
    from scenes.viewer.bench_page import BenchState

    page = make_bench_status_html(BenchState("<b>", "a & b", None, None, 0.5))
    assert "&lt;b&gt;" in page and "a &amp; b" in page and "width:50.0%" in page and "–" in page
