"""A shape of tool from one file: simulated, by flags, and in a campaign that states it."""

import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from scenes.cli import main
from scenes.viewer.tool_picture import make_drawn_tool_outline

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
SPECIMEN = ts.Specimen(0.040, 0.070)
WORDS = ["simulate", "needle_indentation", "--tool", "chamfered", "--tool-radius-mm", "8", "--chamfer-mm", "1",
         "--depth-mm", "2", "--points", "3", "--json"]
CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
kind = "needle_indentation"
recordings = ["run_*.csv"]
tool = "chamfered"
tool_radius_mm = 8.0
chamfer_mm = 1.0

[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 1000.0
starts = 1
start = { C10 = 1000.0 }

[noise]
force_N = 0.005
correlation_time_s = 0
contact_jitter_mm = 0.01
zero_jitter_N = 0.005
"""


@pytest.fixture
def chamfered(plugin, registers):
    return registers(ts.TOOLS, plugin("chamfered").Chamfered)


@pytest.fixture
def material_file(tmp_path):
    path = tmp_path / "m.material.json"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), path)
    return str(path)


def pressed(tool, points=3, resolution="fast", **options):
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=SPECIMEN, protocol=ts.Protocol.ramp(2e-3, points), tool=tool, **options)
    return ts.simulate(ts.Model(experiment, MATERIAL), resolution=resolution)


def test_shape_of_one_file(chamfered):
    tool = ts.Tool("chamfered", radius=8e-3, chamfer=1e-3)
    assert isinstance(tool, chamfered) and isinstance(tool, ts.Tool) and tool.shape == "chamfered"
    assert pickle.loads(pickle.dumps(tool)) == tool
    # Between the punch of its face and that of its shaft.
    for friction in ("bonded", "stick"):
        narrow, own, wide = (pressed(each, resolution="accurate", friction=friction).force[-1] for each in (
            ts.Tool("flat", radius=7e-3), tool, ts.Tool("flat", radius=8e-3)))
        assert 1.01 * narrow < own < 0.99 * wide
    assert make_drawn_tool_outline(tool, SPECIMEN)[:, 0].max() == pytest.approx(8e-3, rel=0.05)


def test_its_size_is_a_parameter(chamfered):
    model = ts.Model(ts.Experiment(SPECIMEN, ts.Protocol.ramp(2e-3, 3), ts.Tool("chamfered", 8e-3, 1e-3)), MATERIAL)
    more = ts.with_values(model, {"experiment.tool.chamfer": 2e-3})
    assert more.experiment.tool == ts.Tool("chamfered", 8e-3, 2e-3)


@pytest.mark.slow
def test_flags_of_an_installed_package(plugin, material_file, tmp_path):
    """The package says by an entry point that it has the shape; no program imports it by name."""
    installed = tmp_path / "site" / "shapes-1.0.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: shapes\nVersion: 1.0\n", encoding="utf-8")
    (installed / "entry_points.txt").write_text("[tissue_sim.tools]\nchamfered = chamfered:Chamfered\n",
                                                encoding="utf-8")
    path = os.pathsep.join([str(installed.parent), os.environ["PYTHONPATH"], *filter(None, sys.path)])
    code = "import sys; from scenes.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run([sys.executable, "-c", code, *WORDS, "--material", material_file],
                          env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)["force_N"]
    own = plugin("chamfered").Chamfered(8e-3, 1e-3)
    np.testing.assert_allclose(answer, pressed(own).force, rtol=1e-9)


def test_flags_say_what_a_shape_lacks(chamfered, material_file, capsys):
    assert main([*WORDS[:4], "--material", material_file]) == 2
    assert "a chamfered tool needs a chamfer" in capsys.readouterr().err
    assert main(["simulate", "needle_indentation", "--chamfer-mm", "1", "--material", material_file]) == 2
    assert "a flat tool has no chamfer; leave it out" in capsys.readouterr().err


@pytest.mark.slow
def test_a_campaign_states_it(chamfered, tmp_path):
    curve = pressed(ts.Tool("chamfered", 8e-3, 1e-3), points=21)
    noise = np.random.default_rng(3)
    for number in (1, 2):
        force = curve.force + noise.normal(0.0, 0.005, curve.force.size)
        ts.write_recording(ts.Recording({"time": curve.time, "displacement": curve.displacement, "force": force}),
                           tmp_path / f"run_{number}.csv")
    path = tmp_path / "study.toml"
    path.write_text(CAMPAIGN, encoding="utf-8")
    test, = calibration.load_campaign(path).tests
    assert test.experiment.tool == ts.Tool("chamfered", 8e-3, 1e-3)
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(1500.0, rel=0.02)
    path.write_text(CAMPAIGN.replace("chamfer_mm", "chamfr_mm"), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"test\[0\]\.chamfr_mm: unknown key; did you mean 'chamfer_mm'"):
        calibration.load_campaign(path)


def test_an_unknown_shape_has_no_keys(tmp_path):
    (tmp_path / "run_1.csv").write_text("time [s],displacement [mm],force [N]\n", encoding="utf-8")
    path = tmp_path / "study.toml"
    path.write_text(CAMPAIGN, encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"test\[0\]\.chamfer_mm: unknown key"):
        calibration.load_campaign(path)


def test_a_name_that_is_taken_is_refused(chamfered):
    with pytest.raises(ts.InputError, match="the name 'flat' is taken by another tool shape"):
        ts.TOOLS.register(chamfered, "flat")
    with pytest.raises(ts.InputError, match="give a frozen dataclass derived from Tool"):
        ts.TOOLS.register(object, "thing")
