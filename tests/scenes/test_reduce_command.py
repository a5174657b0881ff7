"""`tissue-sim reduce`: report of the reduced model, and errors."""

import json

import pytest

import tissue_sim as ts
from scenes.cli import main

SMALL = ["reduce", "needle_indentation", "--radius-mm", "30", "--height-mm", "20", "--tool-radius-mm", "8",
         "--friction", "bonded", "--depth-mm", "2"]


@pytest.mark.slow
def test_default_box_is_a_motion_along_the_axis(tmp_path, capsys):
    """By default the tool moves along its axis only; a few modes suffice."""
    path = tmp_path / "axis.reduced.npz"
    assert main([*SMALL, "--strokes", "3", "--tried", "1", "-o", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["force_rms_error"] < 0.01 and report["not_converged"] == 0.0 and report["modes"] < 24
    reduced = ts.load_reduced(path)
    curve = ts.simulate(reduced.model, solver="reduced", mesh=reduced)
    assert len(curve.force) > 10 and (curve.force[1:] > curve.force[:-1]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("modes", "says"), [("2", True), ("12", False)])
def test_an_inaccurate_model_gives_a_remedy(modes, says, tmp_path, capsys):
    assert main([*SMALL, "--sideways-mm", "2", "--strokes", "2", "--modes", modes, "--tried", "1", "-o",
                 str(tmp_path / "poor.reduced.npz")]) == 0
    said = capsys.readouterr().out
    assert ("Use more training paths (--strokes 4)" in said) is says, said


@pytest.mark.parametrize("shape", [["--radius-mm", "30", "--height-mm", "20"],
                                   ["--shape", "block", "--length-mm", "60", "--width-mm", "40", "--height-mm", "20"]])
def test_a_box_beyond_the_specimen_is_refused(shape, tmp_path, capsys):
    path = tmp_path / "wide.reduced.npz"
    assert main(["reduce", "needle_indentation", *shape, "--tool", "round", "--tool-radius-mm", "8", "--friction",
                 "0.3", "--sideways-mm", "35", "-o", str(path)]) == 2
    error = capsys.readouterr().err
    assert "the tool would leave the top of the specimen" in error and "at -35 and -35 mm. Use a smaller box" in error
    assert not path.exists()


def test_the_help_names_no_flag_that_the_command_lacks(capsys):
    assert main(["reduce", "--help"]) == 0
    assert "--solid" not in capsys.readouterr().out
    assert main(["simulate", "--help"]) == 0
    assert "all shapes but the cylinder require" in " ".join(capsys.readouterr().out.split())
