"""`tissue-sim demo` runs without hardware and prints the paths of its results."""

import json
from pathlib import Path

import pytest

from scenes.cli import main


@pytest.mark.slow
def test_demo(tmp_path, capsys):
    out = tmp_path / "demo"
    assert main(["demo", "-o", str(out), "--json"]) == 0
    stdout, stderr = capsys.readouterr()
    answer = json.loads(stdout)
    assert stderr == ""
    # The calibration recovers the law of the measurements; its prediction error is below the sensor noise.
    assert answer["law"] == "reduced_polynomial_2"
    assert answer["parameters"]["C10"] == pytest.approx(1404.9, rel=0.01)
    assert answer["prediction_rmse_N"] < answer["noise_N"] and abs(answer["prediction_error_N"]) < 0.05
    needle, bonded = answer["predictions"]
    assert (needle["test"], bonded["test"]) == ("needle_indentation", "bonded_compression")
    assert (needle["RMSE_N"], needle["error_N"]) == (answer["prediction_rmse_N"], answer["prediction_error_N"])
    # Independent reference solution: 2.078 and 9.456 N at 10 mm.
    assert needle["predicted_N"] == pytest.approx(2.078, rel=0.02)
    assert bonded["predicted_N"] == pytest.approx(9.456, rel=0.01) and bonded["RMSE_N"] < 2 * answer["noise_N"]
    assert Path(answer["figure"]).read_bytes().startswith(b"\x89PNG")
    assert Path(answer["report"]).is_file()
    assert out in Path(answer["figure"]).parents and out in Path(answer["report"]).parents
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert main(["demo", "-o", str(out)]) == 2, "a folder named by the user is kept"
    assert "--overwrite" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == files
