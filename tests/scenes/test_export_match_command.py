"""`tissue-sim material export --match`: refusals, and the written file, table, JSON and figure."""

import json

import numpy as np
import pytest

import tissue_sim as ts
from calibration.targets.matching import CalibratedForces
from calibration.targets.runner import RUNNERS, TargetCurve, TargetRunner
from scenes.cli import main
from tissue_sim.material.file import MaterialFile, write_material_file

#: Calibrated forces that replace the simulation in fast tests.
DEPTHS = np.arange(1, 5) * 1e-3
TEST = ["--match", "needle_indentation", "--depth-mm", "4", "--points", "5"]


class SoftProgram(TargetRunner):
    """Program whose force is E depth mm up to a depth."""

    title = "soft program"
    deepest = 1.0
    missing = ""

    def describe_missing_program(self):
        return self.missing

    def run(self, test, material, progress=None):
        depths = -test.positions[:, 2]
        reached = depths <= self.deepest
        forces = np.zeros((int(reached.sum()), 3))
        forces[:, 2] = 1e-3 * material.young * depths[reached] * (1.0 + 10.0 * depths[reached])
        return TargetCurve(test.positions[reached], forces, "" if reached.all() else "at 4 mm: not at rest",
                           version="soft 1")


@pytest.fixture
def program(monkeypatch):
    """Replace MuJoCo by a program of known forces, and the calibrated simulation by known forces."""
    runner = SoftProgram()
    monkeypatch.setattr(RUNNERS, "find", lambda name, field=None: runner)
    monkeypatch.setattr("calibration.targets.matching.compute_calibrated_forces",
                        lambda model, **options: CalibratedForces(
                            DEPTHS, DEPTHS * model.material.mu0 / 400.0, 1e-3, 16.0))
    return runner


@pytest.fixture
def material(tmp_path):
    path = tmp_path / "m.material.json"
    gel = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3), 1040.0, "gel")
    write_material_file(MaterialFile.of(gel, covariance=np.array([[100.0**2]])), path)
    return path


def export(material, program, out, *flags):
    return main(["material", "export", str(material), "--to", program, "-o", str(material.parent / out), *flags])


@pytest.mark.parametrize(("target", "flags", "message"), [
    ("mujoco", TEST, "requires --in-target"), ("abaqus", TEST, "its constants are exact"),
    ("abaqus", [*TEST, "--in-target"], "Programs that run: "), ("newton", ["--draws", "3"], "requires a test"),
    ("newton", [*TEST, "--element-mm", "2"], "requires --in-target"), ("mujoco", ["--units", "mm-N-MPa"], "must be SI"),
    ("mujoco", ["--match", "needle", "--in-target"], "unknown scene"),
    ("mujoco", [*TEST, "--in-target", "--figure", "f.txt"], "must end in")])
def test_refusals_name_the_remedy(target, flags, message, material, capsys):
    assert export(material, target, "out", *flags) == 2
    assert message in capsys.readouterr().err
    assert not (material.parent / "out").exists()


def test_a_missing_program_is_named_with_its_remedy(material, program, capsys):
    program.missing = "MuJoCo is not installed. Run: pip install 'tissue_sim[mujoco]'"
    assert export(material, "mujoco", "out.xml", *TEST, "--in-target") == 2
    assert "pip install 'tissue_sim[mujoco]'" in capsys.readouterr().err


@pytest.mark.parametrize("target", ["mujoco", "newton"])
def test_constants_without_a_test_warn_on_the_terminal_and_in_the_file(target, material, capsys):
    assert export(material, target, "out") == 0
    assert "is not stated" in capsys.readouterr().out
    assert "is not stated" in (material.parent / "out").read_text(encoding="utf-8")


def test_matched_constants_are_written_with_their_errors(material, program, capsys):
    figure = material.parent / "f.png"
    assert export(material, "mujoco", "out.xml", *TEST, "--in-target", "--figure", str(figure)) == 0
    printed = capsys.readouterr().out
    assert "error %" in printed
    assert "wrote" in printed
    text = (material.parent / "out.xml").read_text(encoding="utf-8")
    assert "Test: needle_indentation, radius 40 mm, height 70 mm" in text
    assert "linear tetrahedra" in text
    assert "depth 4 mm: calibrated 0.03 N" in text
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_json_states_constants_and_errors_of_all_draws(material, program, capsys):
    assert export(material, "newton", "out.py", *TEST, "--in-target", "--draws", "2", "--seed", "5", "--json") == 0
    content = json.loads(capsys.readouterr().out)
    constants, match = content["constants"], content["match"]
    assert len(constants) == 3
    assert len({one["young_Pa"] for one in constants}) == 3
    assert len({one["poisson"] for one in constants}) == 1
    assert match["reaches_all_depths"]
    assert match["depth_mm"] == pytest.approx([1.0, 2.0, 3.0, 4.0])
    assert np.abs(match["error"]).max() < 0.02
    assert (material.parent / "out.py").read_text(encoding="utf-8").count("k_mu") == 4  # its comment and three bodies


def test_a_program_that_ends_early_gives_exit_code_1_and_the_depth(material, program, capsys):
    program.deepest = 2.5e-3
    assert export(material, "mujoco", "out.xml", *TEST, "--in-target") == 1
    assert "valid to 2 mm: soft 1 ended at 4 mm: not at rest" in capsys.readouterr().out
    assert "Valid to a depth of 2 mm. Do not use it deeper" in (material.parent / "out.xml").read_text(encoding="utf-8")
