"""Progress of commands without a terminal: log lines at intervals, and none with `--json`."""

import re

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from scenes.commands.shared import console

LINE = re.compile(r"\d+:\d\d \S.*")
SIMULATE = ["simulate", "lubricated_compression", "--radius-mm", "20", "--height-mm", "20", "--depth-mm", "1",
            "--points", "4", "--resolution", "fast", "--no-force-error"]


@pytest.fixture
def always(monkeypatch):
    monkeypatch.setattr(console, "MIN_INTERVAL", 0.0)


@pytest.fixture
def material(tmp_path):
    path = tmp_path / "soft.material.json"
    material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e4))
    ts.write_material_file(ts.MaterialFile.of(material), path)
    return str(path)


def test_each_task_prints_a_line(always, material, capsys):
    assert main([*SIMULATE, "--material", material]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert all(LINE.fullmatch(line) for line in lines) and lines[-1].endswith("simulating: 4 of 4 samples"), lines


def test_json_prints_no_lines(always, material, capsys):
    assert main([*SIMULATE, "--material", material, "--json"]) == 0
    assert capsys.readouterr().err == ""


def test_lines_keep_their_interval(monkeypatch, capsys):
    now = 100.0
    monkeypatch.setattr(console.time, "monotonic", lambda: now)
    monkeypatch.setattr(console, "MIN_INTERVAL", 60.0)
    status = console.TaskLogLines()
    for now in (101.0, 159.0, 161.0, 200.0, 230.0):
        status.update(f"at {now:g}")
    assert capsys.readouterr().err == "1:01 at 161\n2:10 at 230\n"


@pytest.mark.slow
def test_a_calibration_prints_lines(always, tmp_path, capsys):
    displacement = np.linspace(0.0, 8e-3, 30)
    stress = ts.find_law("neo_hooke").nominal_stress(1 - displacement / 0.07, {"C10": 1000.0})
    recording = ts.Recording({"time": displacement / 1e-3, "displacement": displacement,
                              "force": -np.pi * 0.04**2 * stress + np.random.default_rng(0).normal(0, 0.01, 30)})
    ts.write_recording(recording, tmp_path / "one.csv")
    (tmp_path / "campaign.toml").write_text("""
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
kind = "lubricated_compression"
recordings = ["one.csv"]

[fit]
laws = ["neo_hooke"]
""", encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "campaign.toml"), "-o", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines and all(LINE.fullmatch(line) for line in lines), lines
