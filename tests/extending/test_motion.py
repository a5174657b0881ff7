"""A motion from one file outside of the house: opened by name, followed by a loop in its own process, in the help."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from haptics.devices.back_ends import MOTIONS, make_motion
from haptics.loop.loop import LoopSettings
from haptics.loop.process import LoopProcess
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from tissue_sim.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
PLUGINS = Path(__file__).parent / "plugins"


@pytest.fixture
def spiral(plugin, registers):
    module = plugin("spiral_motion")
    registers(MOTIONS, module.open_spiral, "spiral")
    return module


def test_a_loop_follows_it(spiral, ticks_of):
    motion = make_motion("spiral:reach_mm=4")
    with LoopProcess(spiral.tissue_that_needs_the_name, motion, ForceRendering(ForceLimiter(1e3, 1e3)),
                     LoopSettings(real_time=False)) as loop:
        ticks = ticks_of(loop)
    expected = [motion.pose(time) for time in ticks["time"]]
    np.testing.assert_allclose(ticks["device_pose"], [[*pose.position, *pose.orientation] for pose in expected],
                               atol=1e-12)
    np.testing.assert_array_equal(ticks["tool_pose"], ticks["device_pose"])
    assert np.ptp(ticks["tool_pose"], axis=0)[[0, 1, 2, 3, 4, 5, 6]].min() > 1e-4, "it is oblique, and it turns"


@pytest.mark.slow
def test_the_command_line_knows_a_motion_of_an_installed_package(tmp_path):
    """The help names a motion registered by an entry point, and the loop follows it."""
    installed = tmp_path / "spirals-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: spirals\nVersion: 1.0\n", encoding="utf-8")
    (installed / "entry_points.txt").write_text("[tissue_sim.motions]\nspiral = spiral_motion:open_spiral\n",
                                                encoding="utf-8")
    path = os.pathsep.join(map(str, filter(None, [ROOT, PLUGINS, tmp_path, os.environ.get("PYTHONPATH")])))

    def run(*words):
        done = subprocess.run([sys.executable, "-m", "scenes.cli", "loop", *words], cwd=tmp_path, text=True,
                              env={**os.environ, "PYTHONPATH": path}, capture_output=True, encoding="utf-8")
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "random, sine, protocol, hand, spiral" in " ".join(run("--help").split())
    answer = json.loads(run("--motion", "spiral:reach_mm=2", "--seconds", "0.3", "--no-real-time", "--json"))
    assert answer["motion"] == "spiral:reach_mm=2" and answer["ticks"] + answer["missed"] >= 300
    assert answer["largest_force_N"] > 0.05


def test_a_name_belongs_to_one(spiral):
    assert MOTIONS.register(spiral.open_spiral, "spiral") is spiral.open_spiral, "the same thing again is no other"
    for name in ("spiral", "sine"):
        with pytest.raises(InputError, match=f"the name '{name}' is taken by another motion"):
            MOTIONS.register(lambda text: None, name)
    with pytest.raises(InputError, match="unknown motion 'spirall'; did you mean 'spiral'"):
        make_motion("spirall:")
    with pytest.raises(InputError, match=r"spiral\.reach: unknown setting; did you mean 'reach_mm'"):
        make_motion("spiral:reach=3")
