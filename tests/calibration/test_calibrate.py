"""The whole job: files, ranking, held-out tests, resuming, several campaigns."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration import analytical

VALUES = {"C10": 1404.9, "C20": 699.4}
TEXT = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
name = "plates"
kind = "lubricated_compression"
recordings = ["fit_*.csv"]
[[test]]
name = "later"
kind = "lubricated_compression"
recordings = ["later.csv"]
hold_out = true
[fit]
laws = ["neo_hooke", "mooney_rivlin", "reduced_polynomial_2"]
bulk_ratio = 2000
[noise]
force_N = 0.02
"""


@pytest.fixture
def campaign(tmp_path):
    law = ts.find_law("reduced_polynomial_2")
    for i, name in enumerate(("fit_1", "fit_2", "fit_3", "later")):
        displacement = np.linspace(0.0, 0.5 if name == "later" else 0.4, 120) * 70e-3
        force = -law.nominal_stress(1 - displacement / 70e-3, VALUES) * np.pi * 0.04**2
        force += np.random.default_rng(i).normal(0.0, 0.02, force.size)
        ts.write_recording(ts.Recording({"displacement": displacement, "force": force}), tmp_path / f"{name}.csv")
    path = tmp_path / "study.toml"
    path.write_text(TEXT, encoding="utf-8")
    return path


def table(path):
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_files_ranking_and_prediction(campaign, tmp_path):
    sentences = []
    result, = calibration.calibrate([campaign], tmp_path / "out", progress=sentences.append)
    assert len(sentences) == 3
    assert result.best.law == "reduced_polynomial_2"
    for name, value in VALUES.items():
        assert abs(result.best.parameters[name] - value) < 4 * result.best.standard_errors[name]
    assert pytest.approx(0.02, rel=0.15) == result.best.RMSE_N
    assert result.best.status == "converged"
    assert "model error" in next(fit for fit in result.fits if fit.law == "neo_hooke").message
    by_law = {p.law: p for p in result.predictions}
    assert set(by_law) == {"neo_hooke", "mooney_rivlin", "reduced_polynomial_2"}
    assert by_law["reduced_polynomial_2"].RMSE_N < 0.05 < by_law["neo_hooke"].RMSE_N
    assert by_law["reduced_polynomial_2"].test == "later"

    written = ts.read_material_file(tmp_path / "out" / "reduced_polynomial_2.material.json")
    assert written.material.parameters == pytest.approx(result.best.parameters)
    assert written.material.bulk == ts.Bulk("bulk_ratio", 2000)
    assert written.valid_range.stretch == pytest.approx((0.6, 1.0))
    assert [r.file for r in written.provenance.recordings] == ["fit_1.csv", "fit_2.csv", "fit_3.csv"]
    assert written.parameters["C10"].standard_error == pytest.approx(result.best.standard_errors["C10"])

    saved = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))
    assert saved == json.loads(json.dumps(calibration.to_json([result])))
    keys = {"law", "parameters", "covariance", "R2", "RMSE_N", "RMSE_Pa", "AIC", "BIC", "E0_Pa", "mu0_Pa",
            "stable_from", "stable_to", "intervals95", "not_identifiable", "iterations", "fem_solves", "cpu_s",
            "material_file"}
    assert keys <= set(saved["fits"][0])
    assert saved["best"] == "reduced_polynomial_2"
    assert Path(saved["fits"][0]["material_file"]).is_file()

    residuals = table(tmp_path / "out" / "residuals.csv")
    mine = [float(row["residual [N]"]) for row in residuals
            if row["law"] == "reduced_polynomial_2" and row["replicate"].startswith("plates/")]
    assert np.sqrt(np.mean(np.square(mine))) == pytest.approx(result.best.RMSE_N, rel=1e-6)
    curves = [row for row in table(tmp_path / "out" / "curves.csv")
              if row["law"] == "reduced_polynomial_2" and row["test"] == "plates"]
    assert float(curves[-1]["displacement [mm]"]) == pytest.approx(28.0)
    assert float(curves[-1]["force [N]"]) == pytest.approx(float(curves[-1]["nominal stress [Pa]"]) * -np.pi * 0.04**2)

    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2 + 3
    assert not re.search(r"(src|href)=[\"']?https?:", page)
    for text in ("frictionless", "Self-weight is not included", "held out", "Standard error"):
        assert text in page


def test_overwrite_and_resume(campaign, tmp_path, monkeypatch):
    out = tmp_path / "out"
    first, = calibration.calibrate([campaign], out, figures=False)
    assert not first.resumed

    def fail(*arguments):
        raise AssertionError("a finished campaign was fitted again")

    with monkeypatch.context() as patch:
        patch.setattr(analytical, "fit_law", fail)
        again, = calibration.calibrate([campaign], out, figures=False)
    assert again.resumed
    assert again.fits == first.fits
    assert calibration.to_json([again]) == calibration.to_json([first])

    # An interrupted run: fit.json is written last.
    (out / "fit.json").unlink()
    assert not calibration.calibrate([campaign], out, figures=False)[0].resumed
    assert (out / "fit.json").exists()

    campaign.write_text(TEXT.replace('"mooney_rivlin", ', ""), encoding="utf-8")
    before = sorted(path.name for path in out.iterdir())
    with pytest.raises(ts.InputError, match=r"other work; .*--overwrite"):
        calibration.calibrate([campaign], out, figures=False)
    assert sorted(path.name for path in out.iterdir()) == before
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    calibration.calibrate([campaign], out, overwrite=True, figures=False)
    assert not (out / "mooney_rivlin.material.json").exists()
    assert (out / "notes.txt").read_text(encoding="utf-8") == "mine"


def test_foreign_folder_and_file_are_left_alone(campaign, tmp_path):
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "thesis.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ts.InputError, match="other files"):
        calibration.calibrate([campaign], out)
    assert [path.name for path in out.iterdir()] == ["thesis.txt"]
    with pytest.raises(ts.InputError, match="is a file"):
        calibration.calibrate([campaign], out / "thesis.txt")


def test_changed_recording_is_other_work(campaign, tmp_path):
    calibration.calibrate([campaign], tmp_path / "out", figures=False)
    recording = ts.read_recording(tmp_path / "fit_1.csv")
    ts.write_recording(recording.with_channels(force=1.1 * recording.force), tmp_path / "fit_1.csv")
    with pytest.raises(ts.InputError, match="other work"):
        calibration.calibrate([campaign], tmp_path / "out", figures=False)


def test_several_campaigns(campaign, tmp_path):
    other = tmp_path / "other.toml"
    other.write_text(TEXT.replace('"mooney_rivlin", ', ""), encoding="utf-8")
    results = calibration.calibrate([campaign, other], tmp_path / "out", figures=False)
    assert [len(result.fits) for result in results] == [3, 2]
    assert (tmp_path / "out" / "other" / "fit.json").exists()
    rows = table(tmp_path / "out" / "summary.csv")
    assert [(row["campaign"], row["rank"]) for row in rows] == [
        ("study", "1"), ("study", "2"), ("study", "3"), ("other", "1"), ("other", "2")]
    assert float(rows[0]["C20 [Pa]"]) == pytest.approx(results[0].best.parameters["C20"])
    assert rows[-1]["law"] == "neo_hooke" and rows[-1]["C20 [Pa]"] == ""
    content = calibration.to_json(results)
    assert [entry["campaign"] for entry in content["campaigns"]] == ["study", "other"]

    # One finished, one lost: only the lost one is computed.
    (tmp_path / "out" / "other" / "fit.json").unlink()
    results = calibration.calibrate([campaign, other], tmp_path / "out", figures=False)
    assert [result.resumed for result in results] == [True, False]


def test_a_bad_second_campaign_writes_nothing(campaign, tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text(TEXT.replace("height_mm = 70.0", "height_mm = 20.0"), encoding="utf-8")
    with pytest.raises(ts.InputError, match="deeper than the specimen"):
        calibration.calibrate([campaign, bad], tmp_path / "out")
    same = tmp_path / "again"
    same.mkdir()
    moved = TEXT.replace('["fit_', '["../fit_').replace('["later', '["../later')
    (same / "study.toml").write_text(moved, encoding="utf-8")
    with pytest.raises(ts.InputError, match="rename one"):
        calibration.calibrate([campaign, same / "study.toml"], tmp_path / "out")
    with pytest.raises(ts.InputError, match="at least one campaign"):
        calibration.calibrate([], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_too_few_points_for_a_law(campaign, tmp_path):
    campaign.write_text(TEXT.replace('"neo_hooke"', '"ogden_3"').replace('"fit_*', '"fit_1*').replace(
        "[fit]", "[fit]\nstrain_points = 5"), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"fit\.laws\[0\]: ogden_3 has 6 parameters"):
        calibration.calibrate([campaign], tmp_path / "out")


def test_a_fit_that_is_no_material_gets_no_file(campaign, tmp_path):
    campaign.write_text(TEXT.replace("bulk_ratio = 2000", "fixed = { C10 = -500.0 }"), encoding="utf-8")
    result, = calibration.calibrate([campaign], tmp_path / "out", figures=False)
    fits = {fit.law: fit for fit in result.fits}
    assert fits["neo_hooke"].status == "not_physical"
    assert fits["neo_hooke"].material_file is None
    assert "modulus at rest" in fits["neo_hooke"].message
    assert not (tmp_path / "out" / "neo_hooke.material.json").exists()
