"""The whole job: files, ranking, held-out tests, resuming, several campaigns."""

import csv
import json
import re

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.fit import ordinary

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


@pytest.mark.slow
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
    assert written.valid_range.stretch == pytest.approx((0.6, 0.6**-0.5))
    assert [r.file for r in written.provenance.recordings] == ["fit_1.csv", "fit_2.csv", "fit_3.csv"]
    assert written.parameters["C10"].standard_error == pytest.approx(result.best.standard_errors["C10"])

    saved = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))
    assert saved == json.loads(json.dumps(calibration.to_json_dictionary([result])))
    keys = {"law", "parameters", "covariance", "R2", "RMSE_N", "RMSE_Pa", "AIC", "BIC", "E0_Pa", "mu0_Pa",
            "stable_from", "stable_to", "intervals95", "not_identifiable", "iterations", "fem_solves", "cpu_s",
            "material_file"}
    assert keys <= set(saved["fits"][0])
    assert saved["best"] == "reduced_polynomial_2"
    # Relative to fit.json, so that the folder may move.
    (tmp_path / "out").rename(tmp_path / "moved")
    assert (tmp_path / "moved" / saved["fits"][0]["material_file"]).is_file()
    (tmp_path / "moved").rename(tmp_path / "out")

    residuals = table(tmp_path / "out" / "residuals.csv")
    mine = [float(row["residual [N]"]) for row in residuals
            if row["law"] == "reduced_polynomial_2" and row["replicate"].startswith("plates/")]
    assert np.sqrt(np.mean(np.square(mine))) == pytest.approx(result.best.RMSE_N, rel=1e-6)
    curves = [row for row in table(tmp_path / "out" / "curves.csv")
              if row["law"] == "reduced_polynomial_2" and row["test"] == "plates"]
    assert float(curves[-1]["displacement [mm]"]) == pytest.approx(28.0)
    assert float(curves[-1]["force [N]"]) == pytest.approx(float(curves[-1]["nominal stress [Pa]"]) * -np.pi * 0.04**2)

    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2 + 2 + 2 + 3, \
        "tests, segments, windows and correlation of the best, formulas"
    assert len(re.findall(r'<img class="formula" width="\d+"', page)) == 3
    assert "<th>BIC</th>" not in page and "<i>E</i><sub>0</sub> [kPa]" in page
    assert not re.search(r"(src|href)=[\"']?https?:", page)
    other = next(fit for fit in result.fits if fit.law == "mooney_rivlin")
    for text in ("frictionless", "Self-weight is not included", "held out", "Standard error",
                 "<th>Correlation</th>", f"<td>{other.correlation[0][1]:.3f}</td>".replace("-", "−")):
        assert text in page


@pytest.mark.slow
def test_overwrite_and_resume(campaign, tmp_path, monkeypatch):
    out = tmp_path / "out"
    first, = calibration.calibrate([campaign], out, figures=False)
    assert not first.resumed

    def fail(*arguments):
        raise AssertionError("a finished campaign was fitted again")

    with monkeypatch.context() as patch:
        patch.setattr(ordinary, "fit_law_to_descents_and_estimate", fail)
        again, = calibration.calibrate([campaign], out, figures=False)
    assert again.resumed
    assert again.fits == first.fits
    assert calibration.to_json_dictionary([again]) == calibration.to_json_dictionary([first])

    # An interrupted run with lost files: all of them are written again.
    for name in ("fit.json", "report.html", "residuals.csv", "neo_hooke.material.json"):
        (out / name).unlink()
        assert not calibration.calibrate([campaign], out, figures=False)[0].resumed
        assert (out / name).exists()

    campaign.write_text(TEXT.replace('"mooney_rivlin", ', ""), encoding="utf-8")
    before = sorted(path.name for path in out.iterdir())
    with pytest.raises(ts.InputError, match=r"results of other campaigns. .*--overwrite"):
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
    with pytest.raises(ts.InputError, match="this is a file"):
        calibration.calibrate([campaign], out / "thesis.txt")


def listing(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_overwrite_spares_what_no_calibration_wrote(campaign, tmp_path):
    """Results in the folder of the input: a material made by hand, and a recording with the name of a result."""
    ts.write_material_file(ts.MaterialFile.of(ts.Material("neo_hooke", {"C10": 1.0})), tmp_path / "mine.material.json")
    before = listing(tmp_path)
    calibration.calibrate([campaign], tmp_path, overwrite=True, figures=False)
    after = listing(tmp_path)
    assert before.items() <= after.items()
    assert "fit.json" in after

    (tmp_path / "neo_hooke.material.json").rename(tmp_path / "kept.json")
    campaign.write_text(TEXT.replace('"mooney_rivlin", ', '"ogden_1", '), encoding="utf-8")
    (tmp_path / "ogden_1.material.json").write_text("by hand", encoding="utf-8")
    before = listing(tmp_path)
    with pytest.raises(ts.InputError, match=r"ogden_1\.material\.json: a result would replace this file"):
        calibration.calibrate([campaign], tmp_path, overwrite=True, figures=False)
    assert listing(tmp_path) == before


def test_a_result_never_replaces_what_it_is_made_from(campaign, tmp_path):
    (tmp_path / "fit_1.csv").rename(tmp_path / "curves.csv")
    (tmp_path / "fit_1.json").rename(tmp_path / "curves.json")
    campaign.write_text(TEXT.replace('"fit_*.csv"', '"fit_*.csv", "curves.csv"'), encoding="utf-8")
    before = listing(tmp_path)
    with pytest.raises(ts.InputError, match=r"curves\.csv: a result would replace this input file"):
        calibration.calibrate([campaign], tmp_path, overwrite=True, figures=False)
    assert listing(tmp_path) == before


def test_a_recording_called_fit_keeps_its_sidecar(campaign, tmp_path):
    (tmp_path / "fit_1.csv").rename(tmp_path / "fit.csv")
    (tmp_path / "fit_1.json").rename(tmp_path / "fit.json")
    campaign.write_text(TEXT.replace('"fit_*.csv"', '"fit.csv"'), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"fit\.json: a result would replace this input file"):
        calibration.calibrate([campaign], tmp_path, overwrite=True, figures=False)


@pytest.mark.slow
def test_overwrite_clears_the_folders_of_the_earlier_work(campaign, tmp_path):
    other = tmp_path / "other.toml"
    other.write_text(TEXT.replace('"mooney_rivlin", ', ""), encoding="utf-8")
    out = tmp_path / "out"
    calibration.calibrate([campaign, other], out, figures=False)
    (out / "other" / "notes.txt").write_text("mine", encoding="utf-8")
    calibration.calibrate([campaign], out, overwrite=True, figures=False)
    assert set(listing(out)) == {"work.json", "fit.json", "report.html", "methods.txt", "curves.csv", "residuals.csv",
                                 "other/notes.txt", *(f"{law}.material.json" for law in (
                                     "neo_hooke", "mooney_rivlin", "reduced_polynomial_2"))}
    assert not (out / "study").exists()


def test_a_forged_list_of_files_removes_nothing_outside(campaign, tmp_path):
    out = tmp_path / "out"
    calibration.calibrate([campaign], out, figures=False)
    work = json.loads((out / "work.json").read_text(encoding="utf-8"))
    for name in ("../study.toml", str(campaign)):
        (out / "work.json").write_text(json.dumps({**work, "files": [name]}), encoding="utf-8")
        with pytest.raises(ts.InputError):
            calibration.calibrate([campaign], out, overwrite=True, figures=False)
        assert campaign.exists()


def test_an_unsound_law_may_have_the_lower_bic(tmp_path):
    """Data that soften under compression: the law that follows them is not stable, and the message says so."""
    displacement = np.linspace(0, 0.5, 200) * 70e-3
    stress = ts.find_law("reduced_polynomial_2").nominal_stress(1 - displacement / 70e-3, {"C10": 1400.0, "C20": -200})
    ts.write_recording(ts.Recording({"displacement": displacement, "force": -stress * np.pi * 0.04**2}),
                       tmp_path / "fit_1.csv")
    text = TEXT.split("[[test]]\nname = \"later\"")[0] + TEXT[TEXT.index("[fit]"):]
    (tmp_path / "soft.toml").write_text(text.replace('"mooney_rivlin", ', ""), encoding="utf-8")
    result, = calibration.calibrate([tmp_path / "soft.toml"], tmp_path / "out", figures=False)
    assert result.best.law == "neo_hooke" and result.fits[1].BIC < result.best.BIC
    assert result.message.startswith("Best of the laws that are usable over the data: neo_hooke; ")
    assert "Lower BIC, but not usable: reduced_polynomial_2 (not stable in uniaxial loading below" in result.message
    assert result.fits[1].status == "unstable"
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<td>0</td>" in page and "<td>-</td>" in page


def test_loss_of_stability_in_other_loading_is_a_warning(tmp_path):
    """Yeoh's law with a negative last coefficient in tension: equibiaxial loading is lost first."""
    law, values = ts.find_law("reduced_polynomial_3"), {"C10": 7300.0, "C20": 53.0, "C30": -0.0527}
    lost = ts.find_stability_range(law, law.convert_parameters_to_array(values), (0.3, 20.0)).limits
    end = 0.5 * (lost["equibiaxial"][1] + lost["uniaxial"][1])
    assert lost["equibiaxial"][1] < end < lost["uniaxial"][1]
    stretch = np.linspace(1.0, end, 200)
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": law.nominal_stress(stretch, values)}),
                       tmp_path / "pull.csv")
    (tmp_path / "pull.toml").write_text('[[test]]\nkind = "uniaxial_tension"\nrecordings = ["pull.csv"]\n[fit]\n'
                                        'laws = ["reduced_polynomial_3", "neo_hooke"]\n', encoding="utf-8")
    result, = calibration.calibrate([tmp_path / "pull.toml"], tmp_path / "out", figures=False)
    assert (result.best.law, result.best.status, result.best.unusable) == ("reduced_polynomial_3", "converged", None)
    warning, = result.best.warnings
    assert "equibiaxial loading above stretch" in warning and "not measured" in warning
    assert "uniaxial loading" not in warning.replace("equibiaxial", "") and warning in result.best.message


def test_noise_that_cannot_be_estimated_is_said(campaign, tmp_path):
    displacement = np.linspace(0.0, 0.4, 41) * 70e-3
    force = -ts.find_law("reduced_polynomial_2").nominal_stress(1 - displacement / 70e-3, VALUES) * np.pi * 0.04**2
    ts.write_recording(ts.Recording({"displacement": displacement, "force": force}), tmp_path / "exact.csv")
    text = TEXT.replace("fit_*.csv", "exact.csv").replace("force_N = 0.02", "").replace('"mooney_rivlin", ', "")
    campaign.write_text(text, encoding="utf-8")
    result, = calibration.calibrate([campaign], tmp_path / "out", figures=False)
    assert result.best.noise_ratio < 0.3
    assert "could not be estimated" in result.message and "state force_N in [noise]" in result.message


def test_density_of_the_specimen_goes_into_the_material(campaign, tmp_path):
    campaign.write_text(TEXT.replace("height_mm = 70.0", "height_mm = 70.0\ndensity_kg_m3 = 1040.0"), encoding="utf-8")
    calibration.calibrate([campaign], tmp_path / "out", figures=False)
    assert ts.load_material(tmp_path / "out" / "neo_hooke.material.json").density == 1040.0


def test_changed_recording_is_other_work(campaign, tmp_path):
    calibration.calibrate([campaign], tmp_path / "out", figures=False)
    recording = ts.read_recording(tmp_path / "fit_1.csv")
    ts.write_recording(recording.with_channels(force=1.1 * recording.force), tmp_path / "fit_1.csv")
    with pytest.raises(ts.InputError, match="results of other campaigns"):
        calibration.calibrate([campaign], tmp_path / "out", figures=False)


@pytest.mark.slow
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
    content = calibration.to_json_dictionary(results)
    assert [entry["campaign"] for entry in content["campaigns"]] == ["study", "other"]

    # One finished, one lost: only the lost one is computed.
    (tmp_path / "out" / "other" / "fit.json").unlink()
    results = calibration.calibrate([campaign, other], tmp_path / "out", figures=False)
    assert [result.resumed for result in results] == [True, False]


def test_a_bad_second_campaign_writes_nothing(campaign, tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text(TEXT.replace("height_mm = 70.0", "height_mm = 20.0"), encoding="utf-8")
    with pytest.raises(ts.InputError, match="must be smaller than the height"):
        calibration.calibrate([campaign, bad], tmp_path / "out")
    same = tmp_path / "again"
    same.mkdir()
    moved = TEXT.replace('["fit_', '["../fit_').replace('["later', '["../later')
    (same / "study.toml").write_text(moved, encoding="utf-8")
    with pytest.raises(ts.InputError, match="Rename one"):
        calibration.calibrate([campaign, same / "study.toml"], tmp_path / "out")
    with pytest.raises(ts.InputError, match="at least one campaign"):
        calibration.calibrate([], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_too_few_points_for_a_law(campaign, tmp_path):
    campaign.write_text(TEXT.replace('"neo_hooke"', '"ogden_3"').replace('"fit_*', '"fit_1*').replace(
        "[fit]", "[fit]\nstrain_points = 5"), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"fit\.laws\[0\]: .* more samples than the 6 parameters of ogden_3"):
        calibration.calibrate([campaign], tmp_path / "out")


def test_a_fit_that_is_no_material_gets_no_file(campaign, tmp_path):
    campaign.write_text(TEXT.replace("bulk_ratio = 2000", "fixed = { C10 = -500.0 }"), encoding="utf-8")
    result, = calibration.calibrate([campaign], tmp_path / "out", figures=False)
    fits = {fit.law: fit for fit in result.fits}
    assert fits["neo_hooke"].status == "not_physical"
    assert fits["neo_hooke"].material_file is None
    assert "modulus at rest" in fits["neo_hooke"].message
    assert not (tmp_path / "out" / "neo_hooke.material.json").exists()


@pytest.mark.parametrize("version", ["0.1.0", "0.2.0"])
def test_a_folder_of_another_version_resumes_or_is_named(version, campaign, tmp_path, monkeypatch):
    """Folders of versions 0.1.0 and 0.2.0 have the same files; `work.json` states no version, material files do."""
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        for module in ("tissue_sim", "tissue_sim.material.file"):
            patch.setattr(f"{module}.__version__", version)
        first, = calibration.calibrate([campaign], out, figures=False)
    assert set(json.loads((out / "work.json").read_text(encoding="utf-8"))) == {"schema", "campaigns", "files"}
    before = {path: path.read_bytes() for path in out.iterdir()}
    if version == ts.__version__:
        again, = calibration.calibrate([campaign], out, figures=False)
        assert again.resumed and again.fits == first.fits
    else:
        with pytest.raises(ts.InputError, match=rf"contains results of tissue_sim {version}, and this is version "
                                                rf"{ts.__version__}\. Choose an empty folder or add --overwrite"):
            calibration.calibrate([campaign], out, figures=False)
    assert {path: path.read_bytes() for path in out.iterdir()} == before
    again, = calibration.calibrate([campaign], out, figures=False, overwrite=True)
    assert not again.resumed and again.best.parameters == first.best.parameters


def test_temporary_files_of_a_killed_run_are_removed(campaign, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    mine = out / ".notes.txt.0a1b2c3d.tmp"
    for name in (".work.json.0a1b2c3d.tmp", ".fit.json.00000000.tmp", ".neo_hooke.material.json.ffffffff.tmp"):
        (out / name).write_text("{", encoding="utf-8")
    calibration.calibrate([campaign], out, figures=False)
    assert (out / "fit.json").is_file() and not list(out.glob(".*.tmp"))
    mine.write_text("mine", encoding="utf-8")
    calibration.calibrate([campaign], out, figures=False, overwrite=True)
    assert mine.read_text(encoding="utf-8") == "mine"


def test_a_refused_folder_keeps_its_temporary_files(campaign, tmp_path):
    """Another program may write them."""
    out = tmp_path / "out"
    out.mkdir()
    files = [out / name for name in ("notes.txt", ".fit.json.00000000.tmp")]
    for file in files:
        file.write_text("{", encoding="utf-8")
    with pytest.raises(ts.InputError, match="it contains other files"):
        calibration.calibrate([campaign], out, figures=False)
    assert all(file.is_file() for file in files)
