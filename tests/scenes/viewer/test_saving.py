"""Save tab: a curve without equilibria is a notification, and the thread that shows the frames continues."""

from types import SimpleNamespace

import numpy as np
import pytest
import viser

import tissue_sim as ts
from haptics.loop.ring import TICK
from scenes.catalogue import SCENES
from scenes.viewer.page.readouts import FAILED
from scenes.viewer.page.saving import SaveControls
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace
from tissue_sim.tool_force import ForceStatus


class Browser:
    """A client that keeps its notifications and downloads."""

    def __init__(self):
        self.notices, self.files = [], []

    def add_notification(self, title, body, **options):
        self.notices.append((title, body))

    def send_file_download(self, name, content, **options):
        self.files.append(name)


@pytest.fixture
def controls():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield SaveControls(server, SimpleNamespace(), SimpleNamespace(), lambda run: run())
    finally:
        server.stop()


def pressed(status):
    """A trace of a press of 1 mm whose ticks have a status."""
    records = np.zeros(200, TICK)
    records["time"] = 1e-3 * np.arange(200)
    records["tool_depth"] = np.linspace(0.0, 1e-3, 200)
    records["tissue_force"] = 200.0 * records["tool_depth"]
    records["status"] = status
    trace = Trace()
    trace.append_ticks_and_count_new_points(records)
    return trace


@pytest.mark.parametrize("status", [ForceStatus.LATE, ForceStatus.CONVERGED])
def test_a_curve_of_late_points_is_a_notification(controls, status):
    trace, browser = pressed(status), Browser()
    points = len(trace)
    assert points > 5
    kind = "needle_indentation"
    experiment = ts.KINDS[kind].experiment(specimen=ts.Specimen(0.040, 0.070), protocol=ts.Protocol.ramp(4e-3, 5),
                                           tool=ts.Tool("sphere", radius=6e-3))
    scene = Scene(SCENES[kind], experiment, ts.Material("neo_hooke", {"C10": 1000.0}))
    controls._frame = SimpleNamespace(scene=scene, curves=SimpleNamespace(trace=trace))
    controls._send_curve_files(SimpleNamespace(client=browser))
    if status is ForceStatus.CONVERGED:
        assert [name.rsplit(".", 1)[1] for name in browser.files] == ["csv", "json"] and not browser.notices
    else:
        (title, sentence), = browser.notices
        assert title == FAILED and not browser.files
        assert sentence.startswith("The curve must have at least two equilibrium points.")
    assert len(trace) == points
