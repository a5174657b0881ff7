"""`tissue-sim calibrate`: tables, JSON, exit codes and errors."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from child_environment import child_environment

import tissue_sim as ts
from calibration.fit import ordinary
from scenes.cli import main
from scenes.commands.shared.console import PrintedTableLimits

TRUE = {"C10": 1404.9, "C20": 699.4}
#: Radius, m.
RADIUS = 0.04
#: Height, m.
HEIGHT = 0.07
CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
kind = "lubricated_compression"
recordings = ["compression_*.csv"]
max_strain = 0.14

[fit]
laws = ["neo_hooke", "reduced_polynomial_2"]

[noise]
force_N = 0.02
"""


@pytest.fixture
def campaign(tmp_path):
    """Three replicates of the study's compression test with its sensor noise, and their campaign file."""
    random = np.random.default_rng(7)
    displacement = np.linspace(0, 0.0098, 60)
    stress = ts.find_law("reduced_polynomial_2").nominal_stress(1 - displacement / HEIGHT, TRUE)
    for replicate in (1, 2, 3):
        force = -np.pi * RADIUS**2 * stress + random.normal(0, 0.02, displacement.size)
        recording = ts.Recording({"time": displacement / 0.248e-3, "displacement": displacement, "force": force})
        ts.write_recording(recording, tmp_path / f"compression_{replicate}.csv")
    path = tmp_path / "campaign.toml"
    path.write_text(CAMPAIGN, encoding="utf-8")
    return path


def test_json(campaign, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["calibrate", str(campaign), "-o", str(out), "--json"]) == 0
    stdout, stderr = capsys.readouterr()
    answer = json.loads(stdout)
    assert stderr == ""
    assert answer["best"] == "reduced_polynomial_2"
    best = next(fit for fit in answer["fits"] if fit["law"] == answer["best"])
    for name, value in TRUE.items():
        assert abs(best["parameters"][name] - value) < 4 * best["standard_errors"][name]
    material = ts.load_material(out / "reduced_polynomial_2.material.json")
    assert dict(material.parameters) == pytest.approx(best["parameters"])
    assert json.loads((out / "fit.json").read_text(encoding="utf-8")) == answer
    assert (out / "report.html").is_file()


@pytest.mark.usefixtures("undrawn")
def test_table(campaign, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["calibrate", str(campaign), "-o", str(out)]) == 0
    text = capsys.readouterr().out
    for expected in ("reduced_polynomial_2 *", "neo_hooke", "±", "E0 kPa", "dBIC", "Self-weight is not included"):
        assert expected in text
    assert f"wrote {out / 'report.html'}" in text


@pytest.mark.usefixtures("undrawn")
def test_material_of_a_calibration_can_be_shown_and_checked(campaign, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["calibrate", str(campaign), "-o", str(out), "--json"]) == 0
    capsys.readouterr()
    path = str(out / "reduced_polynomial_2.material.json")
    assert main(["material", "check", path]) == 0
    assert main(["material", "show", path]) == 0
    assert "compression_1.csv" in capsys.readouterr().out


def test_folder_with_other_files_is_kept(campaign, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("do not lose", encoding="utf-8")
    assert main(["calibrate", str(campaign), "-o", str(out)]) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and "--overwrite" in stderr and stderr.count("\n") == 1
    assert [path.name for path in out.iterdir()] == ["thesis.txt"]


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_two_campaigns_in_one_call(campaign, tmp_path, capsys):
    second = tmp_path / "second.toml"
    second.write_text(CAMPAIGN.replace('"neo_hooke", ', ""), encoding="utf-8")
    out = tmp_path / "out"
    assert main(["calibrate", str(campaign), str(second), "-o", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [len(one["fits"]) for one in answer["campaigns"]] == [2, 1]
    assert main(["calibrate", str(campaign), str(second), "-o", str(out)]) == 0, "the same calibration is resumed"
    text = capsys.readouterr().out
    assert text.count("* best usable law") == 2
    for name in ("campaign", "second"):
        assert f"read from {out / name}, where this calibration was already finished" in text


@pytest.mark.slow
def test_tables_fit_on_80_columns(tmp_path, capsys, monkeypatch):
    """Stresses of MPa and the longest rows: Ogden N = 3 and Yeoh."""
    stretch = np.linspace(1.0, 3.0, 60)
    values = {"C10": 1.5e6, "C20": -2e3, "C30": 90.0}
    stress = ts.find_law("reduced_polynomial_3").nominal_stress(stretch, values)
    stress += np.random.default_rng(3).normal(0.0, 2e3, stress.size)
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": stress}), tmp_path / "pull.csv")
    (tmp_path / "pull.toml").write_text(
        '[[test]]\nkind = "uniaxial_tension"\nrecordings = ["pull.csv"]\n[fit]\n'
        'laws = ["neo_hooke", "reduced_polynomial_3", "ogden_3"]\n[noise]\nnominal_stress_Pa = 2000.0\n',
        encoding="utf-8")
    monkeypatch.setattr("scenes.commands.shared.console.TABLES", PrintedTableLimits(pipe_width=80))
    main(["calibrate", str(tmp_path / "pull.toml"), "-o", str(tmp_path / "out")])
    lines = capsys.readouterr().out.splitlines()
    end = next(i for i, line in enumerate(lines) if line.startswith("Best of"))
    assert all(len(line) <= 80 and "…" not in line for line in lines[:end])
    text = "\n".join(lines[:end])
    fits = {fit["law"]: fit for fit in json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]}
    assert "E0 MPa" in text and "RMSE MPa" in text
    for law, fit in fits.items():
        # Moduli are printed with the decimals of their standard error.
        E0, mu0 = (float(cell) for cell in next(line for line in lines if line.startswith(law)).split()[-5:-3])
        assert (E0, mu0) == pytest.approx((fit["E0_Pa"] / 1e6, fit["mu0_Pa"] / 1e6), rel=0.02)
    assert all(name in text for fit in fits.values() for name in fit["parameters"])


@pytest.mark.slow
def test_a_closed_pipe_is_no_error(campaign, tmp_path):
    """``calibrate ... | head -1``: rich alone would end with exit code 1."""
    words = [sys.executable, "-m", "scenes.cli", "calibrate", str(campaign), "-o", str(tmp_path / "out")]
    environment = child_environment()
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, env=environment, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(("fits", "expected"), [(1, "no campaign was finished"),
                                                (3, "finished campaigns are kept")])
def test_ctrl_c_reports_finished_campaigns(fits, expected, campaign, tmp_path, capsys, monkeypatch):
    second = tmp_path / "second.toml"
    second.write_text(CAMPAIGN, encoding="utf-8")
    words = ["calibrate", str(campaign), str(second), "-o", str(tmp_path / "out")]
    original, calls = ordinary.fit_law_to_descents_and_estimate, []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) > fits:
            raise KeyboardInterrupt
        return original(*arguments)

    monkeypatch.setattr(ordinary, "fit_law_to_descents_and_estimate", interrupted)
    assert main(words) == 130
    assert f"stopped by Ctrl-C; {expected}. Run the same command" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_only_files_of_this_call_are_listed(campaign, tmp_path, capsys):
    second = tmp_path / "second.toml"
    second.write_text(CAMPAIGN, encoding="utf-8")
    out = tmp_path / "out"
    assert main(["calibrate", str(campaign), str(second), "-o", str(out)]) == 0
    text = capsys.readouterr().out
    wrote = [line.removeprefix("wrote ") for line in text.splitlines() if line.startswith("wrote ")]
    assert wrote == [str(out / name) for name in ("campaign/report.html", "second/report.html", "summary.csv")]
    (out / "second" / "report.html").rename(tmp_path / "moved.html")
    (out / "second" / "keep").mkdir()
    (tmp_path / "moved.html").rename(out / "second" / "keep" / "report.html")
    assert main(["calibrate", str(campaign), "-o", str(out), "--overwrite"]) == 0
    text = capsys.readouterr().out
    assert [line for line in text.splitlines() if line.startswith("wrote ")] == [f"wrote {out / 'report.html'}"]


@pytest.mark.usefixtures("undrawn")
def test_table_marks_fixed_and_bounded_parameters(campaign, tmp_path, capsys):
    text = CAMPAIGN.replace('"neo_hooke", ', '"mooney_rivlin", ').replace(
        "[noise]", "fixed = { C20 = 700.0 }\nbounds = { C01 = [2000.0, 5000.0] }\n[noise]")
    campaign.write_text(text, encoding="utf-8")
    main(["calibrate", str(campaign), "-o", str(tmp_path / "out")])
    shown = capsys.readouterr().out
    assert "0.7 kPa (fixed)" in shown and "2 kPa (on its bound)" in shown
    assert "mooney_rivlin: C01 ended on its bound 2000" in shown


@pytest.mark.slow
def test_no_usable_law_is_exit_code_1(tmp_path, capsys):
    """The data soften in compression, where the only law of the campaign is unstable."""
    displacement = np.linspace(0, 0.035, 60)
    law, softening = ts.find_law("reduced_polynomial_2"), {"C10": 1400.0, "C20": -500.0}
    force = -np.pi * RADIUS**2 * law.nominal_stress(1 - displacement / HEIGHT, softening)
    ts.write_recording(ts.Recording({"displacement": displacement, "force": force}), tmp_path / "compression_1.csv")
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(CAMPAIGN.replace("max_strain = 0.14", "").replace('"neo_hooke", ', ""), encoding="utf-8")
    assert main(["calibrate", str(campaign), "-o", str(tmp_path / "out"), "--json"]) == 1
    (fit,) = json.loads(capsys.readouterr().out)["fits"]
    assert fit["status"] == "unstable" and fit["stable_from"] > 0.5


@pytest.mark.parametrize(("old", "new", "expected"), [
    ("radius_mm", "radius_m", "did you mean 'radius_mm'?"),
    ("height_mm = 70.0", "height_mm = -70.0", "height_mm"),
    ("compression_*", "compresion_*", "recordings"),
    ("neo_hooke", "neo_hook", "did you mean 'neo_hooke'?"),
    ("[fit]", "[fit", "campaign.toml:"),
])
def test_bad_campaign_writes_nothing(campaign, tmp_path, capsys, old, new, expected):
    campaign.write_text(CAMPAIGN.replace(old, new, 1), encoding="utf-8")
    out = tmp_path / "out"
    assert main(["calibrate", str(campaign), "-o", str(out), "--json"]) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr.count("\n") == 1
    assert expected in stderr and "campaign.toml" in stderr
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_measured_silicone(data_folder, tmp_path, capsys):
    """Ecoflex 00-10, ten pooled recordings to 66 % strain: published Yeoh parameters 7.702, -0.063, 0.248 kPa."""
    path = tmp_path / "ef10.toml"
    path.write_text(f"""
[[specimen]]
radius_mm = 25.0
height_mm = 30.0

[[test]]
kind = "lubricated_compression"
recordings = ["{(data_folder / "ecoflex_compression").resolve().as_posix()}/EF10_0T_*.csv"]
format = "instron"

[fit]
laws = ["reduced_polynomial_3"]
""", encoding="utf-8")
    assert main(["calibrate", str(path), "-o", str(tmp_path / "out"), "--json"]) == 0
    (fit,) = json.loads(capsys.readouterr().out)["fits"]
    C = fit["parameters"]
    assert C["C10"] == pytest.approx(7702, rel=0.02)
    assert C["C20"] == pytest.approx(-63, abs=50)
    assert C["C30"] == pytest.approx(248, rel=0.02)
