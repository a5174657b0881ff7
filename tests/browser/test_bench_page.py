"""Bench page in a browser: the run of a recorder."""

import threading

import pytest

from haptics.recorder.recorder import RunProgress
from haptics.recorder.run_folder import RunFolder
from scenes.viewer.bench_page import BenchPage, RunFolderSource


@pytest.fixture
def watched(tmp_path):
    page = BenchPage(RunFolderSource(tmp_path / "run"), "127.0.0.1", 0)
    stop = threading.Event()
    thread = threading.Thread(target=page.run_until_stopped, args=(stop,))
    thread.start()
    yield page, tmp_path / "run"
    stop.set()
    thread.join()
    page.close()


@pytest.mark.slow
def test_a_running_recorder_is_displayed(watched, open_page):
    from haptics.recorder.recorder import LiveProgressFile

    shown, path = watched
    page = open_page(shown.server)
    page.get_by_text("No run in").wait_for()
    folder = RunFolder(path, "digest")
    live = LiveProgressFile(path)
    with folder, live.run_writing_thread():
        folder.update_state(state="running")
        live.set_progress(RunProgress("needle", "ramp", 1, 5e-3, 3e-3, 0.437, 0.25))
        partial = folder.create_partial_recording("needle_1", ["time [s]", "displacement [mm]", "force [N]", "segment"])
        partial.queue_rows([(0.01 * row, 0.1 * row, 0.02 * row, "ramp") for row in range(30)])
        page.get_by_text("needle 1: ramp; 0 recordings done").wait_for()
        page.get_by_text("0.437").wait_for()
        page.locator(".uplot canvas").first.wait_for()
        partial.close()
        folder.update_state(state="stopped", stops=[{"message": "the sensor was silent for 0.06 s"}])
    page.get_by_text("the sensor was silent for 0.06 s").wait_for()
