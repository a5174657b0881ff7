"""Specimens with numbers of their own: who is in the population, what predicts one that no fit has seen, and the
figures of the material that stands for all."""

import csv
import json

import numpy as np
import pytest
from scipy import stats

import calibration
import tissue_sim as ts
from calibration.fit.result import describe_self_weight
from calibration.report.fit_text import compute_shear_modulus_error_or_none
from scenes.cli import main
from tissue_sim.closed_form.column import Column
from tissue_sim.errors import InputError

pytestmark = pytest.mark.usefixtures("undrawn")

LAW = ts.find_law("reduced_polynomial_2")
#: Radius, m.
RADIUS = 0.015
#: Height, m.
HEIGHT = 0.020
#: Depth, m.
DEPTH = 6e-3
#: Standard deviation of the force, N.
NOISE = 0.01
#: Cross-section, m2.
AREA = np.pi * RADIUS**2
ORDER = ["C10", "C20"]
FIVE = np.array([(1400.0, 700.0), (1250.0, 600.0), (1600.0, 820.0), (1350.0, 650.0), (1500.0, 760.0)])


def campaign(folder, truth, *, law=LAW, scope=ORDER, held=(), fit="", after="", weighs=False, contact=0.0, depth=DEPTH,
             short=()):
    """A campaign of specimens of these numbers, each compressed twice; its file.

    Args:
        held: numbers of the specimens whose test is held out. fit, after: lines of ``[fit]`` and behind it.
        contact: deviation of the depth at which a recording begins to touch, m. short: numbers of those that are
            compressed by a third of the depth only.
    """
    rng, text = np.random.default_rng(7), ""
    specimen = ts.Specimen(RADIUS, HEIGHT, density=1040.0, gravity=9.81)
    for k, numbers in enumerate(truth, 1):
        values = dict(zip(law.parameters, map(float, numbers), strict=True))
        for replicate in range(2):
            displacement = np.linspace(0.0, depth / 3 if k in short else depth, 61)
            way = np.maximum(displacement - contact * rng.standard_normal(), 0.0)
            stress = Column(specimen).nominal_stress(law, way, law.convert_parameters_to_array(values)) if weighs else \
                law.nominal_stress(1 - way / HEIGHT, values)
            ts.write_recording(ts.Recording({"displacement": displacement,
                                             "force": -AREA * stress + rng.normal(0.0, NOISE, 61)}),
                               folder / f"a{k}_{replicate}.csv")
        text += f'[[specimen]]\nname = "animal_{k}"\nradius_mm = 15.0\nheight_mm = 20.0\n'
        text += "gravity = true\ndensity_kg_m3 = 1040.0\n" if weighs else ""
        text += (f'[[test]]\nname = "plates_{k}"\nspecimen = "animal_{k}"\nkind = "lubricated_compression"\n'
                 f'recordings = ["a{k}_*.csv"]\n{"hold_out = true" if k in held else ""}\n')
    scopes = "".join(f'{name} = "per_specimen"\n' for name in scope)
    path = folder / "c.toml"
    path.write_text(f'{text}[fit]\nlaws = ["{law.name}"]\nbulk_ratio = 1000.0\n{fit}[fit.scope]\n{scopes}'
                    f"[noise]\nforce_N = {NOISE}\n{after}")
    return path


def calibrated(path):
    result, = calibration.calibrate([path], path.parent / "out", figures=False)
    return result


POSITIVE = "[fit.bounds]\nC20 = [0.0, 20000.0]\n"


@pytest.mark.slow
def test_specimens_that_are_left_out_are_named_with_the_reason(tmp_path, capsys):
    path = campaign(tmp_path, [(1400, 700), (1250, -300), (1600, 820), (1700, 900)], after=POSITIVE, held=(4,))
    assert main(["calibrate", str(path), "-o", str(tmp_path / "out")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "no part of the population: animal_2 (C20 on its bound 0 Pa)" in out and "held out, by the mean of 2" in out
    fit, = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]
    why = {"animal_2": "C20 on its bound 0 Pa"}
    assert fit["left_out_specimens"] == why
    assert fit["material_of"] == fit["population"]["specimens"] == ["animal_1", "animal_3"]
    file = ts.read_material_file(tmp_path / "out" / fit["material_file"])
    assert file.population.left_out == why and set(file.population.specimens) == {"animal_1", "animal_3"}
    assert file.provenance.settings["material_of"] == ["animal_1", "animal_3"]
    assert file.material.parameters["C10"] == pytest.approx(1500.0, rel=0.01)
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Not in the population of" in report and ": animal_2 (C20 on its bound 0 Pa).</p>" in report
    methods = (tmp_path / "out" / "methods.txt").read_text(encoding="utf-8")
    assert "Population of 2 specimens" in methods and "not included: animal_2 (C20 on its bound 0 Pa)" in methods


@pytest.mark.slow
def test_without_two_determined_specimens_there_is_no_material(tmp_path, capsys):
    """Results of one specimen are not reported for all; a file of an earlier calibration in the folder is removed."""
    path = campaign(tmp_path, [(1400, -300), (1250, -300), (1600, 820)])
    calibrated(path)
    assert list((tmp_path / "out").glob("*.material.json"))
    path.write_text(path.read_text() + POSITIVE)
    capsys.readouterr()
    assert main(["calibrate", str(path), "-o", str(tmp_path / "out"), "--overwrite"]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "No law is usable" in out and "no population: of 3 specimens these are not determined: animal_1 (C20" in out
    assert not list((tmp_path / "out").glob("*.material.json"))
    fit, = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]
    assert (fit["status"], fit["material_file"], fit["population"]) == ("no_population", None, None)
    assert fit["material_of"] == ["animal_3"] and "no material file is written" in fit["unusable"]
    assert fit["E0_Pa"] == pytest.approx(6 * fit["parameters"]["C10@animal_3"])
    assert list(fit["left_out_specimens"]) == ["animal_1", "animal_2"]


def test_no_determined_specimen_is_no_material(tmp_path):
    fit = calibrated(campaign(tmp_path, [(1400, -300), (1250, -300)], after=POSITIVE)).best
    assert (fit.status, fit.material_file, fit.material_of) == ("no_population", None, ["animal_1"])
    assert list(fit.left_out_specimens) == ["animal_1", "animal_2"]


def test_the_material_of_a_single_specimen_says_whose_it_is(tmp_path):
    fit = calibrated(campaign(tmp_path, FIVE[:1])).best
    assert fit.status == "converged" and fit.population is None and fit.material_of == ["animal_1"]
    assert any("the material is that of animal_1: a single specimen" in warning for warning in fit.warnings)
    file = ts.read_material_file(tmp_path / "out" / fit.material_file)
    assert file.provenance.settings["material_of"] == ["animal_1"]
    assert file.standard_errors == {name: fit.standard_errors[f"{name}@animal_1"] for name in ORDER}
    np.testing.assert_allclose(file.paths_and_covariance_SI[1], fit.covariance.matrix)


def test_a_file_that_leaves_out_what_it_holds_is_refused(tmp_path):
    calibrated(campaign(tmp_path, FIVE[:2]))
    path = tmp_path / "out" / f"{LAW.name}.material.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    content["population"]["left_out"] = {"animal_2": "on its bound"}
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match="among the specimens too") as caught:
        ts.read_material_file(path)
    assert caught.value.field == "population.left_out.animal_2"


def linear_rates(displacement):
    """Return the derivatives of the force with respect to C10 and C20, N/Pa, shape (n, 2)."""
    return np.column_stack([-AREA * LAW.nominal_stress(1 - displacement / HEIGHT, {"C10": a, "C20": b})
                            for a, b in ((1.0, 0.0), (0.0, 1.0))])


@pytest.mark.slow
def test_a_specimen_that_no_fit_has_seen_is_predicted_by_the_mean(tmp_path):
    """Error and band of the held-out test against the sums of the linear law, with Student's t of four degrees of
    freedom for what five specimens tell."""
    calibrated(campaign(tmp_path, [*FIVE, (1700, 900)], held=(6,)))
    content = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))
    held, = (p for p in content["predictions"] if p["test"] == "plates_6")
    assert held["fitted"] == [] and held["mean_of"] == [f"animal_{k}" for k in range(1, 6)]
    found = content["fits"][0]["population"]
    further = np.array(found["between"]) + np.array(found["mean_covariance"])
    rates = linear_rates(np.linspace(0.0, DEPTH, 61))
    truth = rates @ (np.array(found["mean"]) - [1700.0, 900.0])
    assert held["RMSE_N"] == pytest.approx(np.sqrt(np.mean(truth**2) + NOISE**2), rel=0.01)
    variance = np.einsum("np,pq,nq->n", rates, further, rates)
    assert held["expected_N"] == pytest.approx(np.sqrt(np.mean(variance) + NOISE**2), rel=1e-3)
    with (tmp_path / "out" / "curves.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["test"] == "plates_6"]
    way, force, error, band = (np.array([float(row[key]) for row in rows]) for key in (
        "displacement [mm]", "force [N]", "standard error [N]", "band95 [N]"))
    rates = linear_rates(way * 1e-3)
    np.testing.assert_allclose(force, rates @ found["mean"], atol=1e-6)
    variance = np.einsum("np,pq,nq->n", rates, further, rates)
    np.testing.assert_allclose(error, np.sqrt(variance), rtol=1e-6, atol=1e-9)
    wanted = np.sqrt(stats.t.ppf(0.975, 4)**2 * variance + stats.norm.ppf(0.975)**2 * NOISE**2)
    np.testing.assert_allclose(band, wanted, rtol=1e-3)
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "held out of all fits; its specimen from the mean of 5 others" in report


@pytest.mark.slow
def test_an_inverse_fit_predicts_it_alike(tmp_path):
    after = "contact_jitter_mm = 0.0\nzero_jitter_N = 0.0\n"
    result = calibrated(campaign(tmp_path, [*FIVE[:3], (1700, 900)], held=(4,), after=after,
                                 fit='method = "inverse_fem"\nstarts = 1\n'))
    held, = (p for p in result.predictions if p.test == "plates_4")
    assert held.mean_of == ["animal_1", "animal_2", "animal_3"]
    assert [held.parameters[f"{name}@animal_4"] for name in ORDER] == pytest.approx(result.best.population.mean)
    assert 0.1 < held.expected_N < 1.0


def test_a_specimen_that_no_fit_has_seen_needs_others(tmp_path):
    result = calibrated(campaign(tmp_path, FIVE[:2], held=(2,)))
    prediction, = result.predictions
    assert prediction.percent is None and prediction.mean_of == []
    assert prediction.note == "no test of animal_2 is fitted, and there is no mean of other specimens"


def test_a_bound_is_no_answer_of_the_others(tmp_path):
    """C20 of the second specimen stays on its bound when its test is left out; it is the mean that predicts."""
    result = calibrated(campaign(tmp_path, [(1400, 700), (1250, -300), (1600, 820)], after=POSITIVE))
    prediction = result.predictions[1]
    assert prediction.mean_of == ["animal_1", "animal_3"]
    displacement = np.linspace(0.0, DEPTH, 61)
    wrong = float(np.sqrt(np.mean((linear_rates(displacement) @ [250.0, 1060.0])**2)))
    np.testing.assert_allclose(prediction.RMSE_N, wrong, rtol=0.02)


@pytest.mark.slow
def test_an_exponent_that_all_share_moves_the_mean(tmp_path):
    """The mean of mu1 and the shared alpha1 err together, in the population, the file and the prediction."""
    law = ts.find_law("ogden_1")
    path = campaign(tmp_path, [(mu1, 8.0) for mu1 in (3000, 3300, 2800, 3100, 2900)], law=law, scope=["mu1"], held=(5,),
                    depth=2e-3)
    result = calibrated(path)
    fit, population = result.best, result.best.population
    assert population.covariance.order == ["mu1", "alpha1"]
    order, matrix = fit.covariance.order, np.array(fit.covariance.matrix)
    together = [matrix[order.index(f"mu1@animal_{k}"), order.index("alpha1")] for k in range(1, 5)]
    (_, cross), (_, alone) = population.covariance.matrix
    assert cross == pytest.approx(np.mean(together), rel=0.02)
    assert alone == pytest.approx(matrix[order.index("alpha1"), order.index("alpha1")])
    file = ts.read_material_file(tmp_path / "out" / fit.material_file)
    np.testing.assert_allclose(file.paths_and_covariance_SI[1], population.covariance.matrix)
    # mu0 is mu1 of Ogden's law: E0 has the error of the mean.
    assert compute_shear_modulus_error_or_none(fit) == pytest.approx(population.mean_errors[0], rel=1e-6)
    # The error of the exponent takes back part of that of the mean: apart they would make more than they do.
    held, = (p for p in result.predictions if p.test == "plates_5")
    stretch, mean = 1 - np.linspace(0.0, 2e-3, 61) / HEIGHT, np.array([population.mean[0], fit.parameters["alpha1"]])
    rates = np.column_stack([-AREA * (law.nominal_stress(stretch, mean + step) - law.nominal_stress(stretch, mean))
                             / step.sum() for step in np.diag([1.0, 1e-4])])
    further = np.array(population.covariance.matrix)
    further[0, 0] += population.between[0][0]
    variance = np.mean(np.einsum("np,pq,nq->n", rates, further, rates)) + NOISE**2
    assert held.expected_N == pytest.approx(np.sqrt(variance), rel=1e-3)


@pytest.mark.slow
def test_a_fitted_contact_is_no_scatter_between_specimens(tmp_path):
    """Five specimens that are alike: what the fitted contact of each leaves open is its own error."""
    path = campaign(tmp_path, np.tile([1400.0, 700.0], (5, 1)), fit='offset = "fit"\n',
                    after="contact_jitter_mm = 0.05\n", contact=5e-5)
    population = calibrated(path).best.population
    assert all(low == 0.0 for low, _ in population.spread_intervals)


@pytest.mark.slow
def test_specimens_that_weigh_sag_by_their_own_numbers(tmp_path):
    soft = FIVE[:3] / 4
    calibrated(campaign(tmp_path, soft, weighs=True))
    content = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))
    fit, specimen = content["fits"][0], ts.Specimen(RADIUS, HEIGHT, density=1040.0, gravity=9.81)
    sags = [1e3 * Column(specimen).settle(LAW, numbers).sag for numbers in soft]
    assert [fit["sag_mm"][f"animal_{k}"] for k in (1, 2, 3)] == pytest.approx(sags, rel=0.02)
    # From the stiffest to the softest.
    assert f"sag {min(fit['sag_mm'].values()):.3g} to {max(fit['sag_mm'].values()):.3g} mm" in content["self_weight"]
    assert "animal_1, animal_2, animal_3: 1040 kg/m3" in content["self_weight"]


@pytest.mark.slow
def test_the_error_of_the_youngs_modulus_is_that_of_the_mean(tmp_path):
    fit = calibrated(campaign(tmp_path, FIVE)).best
    # mu0 = 2 C10; the scatter of five specimens makes the error.
    assert compute_shear_modulus_error_or_none(fit) == pytest.approx(2 * np.std(FIVE[:, 0], ddof=1) / 5**0.5, rel=0.02)
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<i>E</i><sub>0</sub> = 8.5 ± 0.4 kPa" in report
    # Without weight the sentence says how far each would sag.
    assert "it would sag 0.2 to 0.26 mm" in report


def test_a_bonded_specimen_that_weighs_is_not_said_to_have_no_weight(tmp_path):
    """Without the sag of a column, which it is not."""
    path = campaign(tmp_path, FIVE[:2])
    fit = calibrated(path).best
    path.write_text(path.read_text().replace('kind = "lubricated', 'kind = "bonded').replace(
        "radius_mm", "density_kg_m3 = 1040.0\ngravity = true\nradius_mm").replace(
        "[fit]", '[fit]\nmethod = "inverse_fem"'))
    assert describe_self_weight(calibration.load_campaign(path), fit) == (
        "Self-weight of animal_1, animal_2: 1040 kg/m3 at 9.81 m/s2, settled before the test; height 20 mm as moulded.")


@pytest.mark.slow
def test_a_miss_within_the_scatter_of_specimens_is_no_failure_of_the_law(tmp_path):
    """A further specimen stiffer by 0.3 than the mean of five that scatter by 0.17; one of three times the mean is."""
    wide = FIVE.mean(axis=0) * np.array([0.8, 1.2, 0.9, 1.15, 0.95])[:, None]
    usual = calibrated(campaign(tmp_path, [*wide, 1.3 * wide.mean(axis=0)], held=(6,)))
    held, = (p for p in usual.predictions if p.test == "plates_6")
    assert held.percent > 10.0 and "predicts held-out tests: plates_6 within" in usual.message
    assert "by the mean of 5 other specimens, whose scatter makes" in usual.message
    (tmp_path / "far").mkdir()
    far = calibrated(campaign(tmp_path / "far", [*wide, 3 * wide.mean(axis=0)], held=(6,)))
    assert "does not predict held-out tests: plates_6 within" in far.message


@pytest.mark.slow
def test_a_further_test_tells_the_numbers_of_its_specimen_alone(tmp_path):
    """C20 of the third, which was hardly compressed, is the weakest: the test that is suggested is of that specimen."""
    fit = calibrated(campaign(tmp_path, FIVE[:3], short=(3,), fit='method = "inverse_fem"\nstarts = 1\n',
                              after="contact_jitter_mm = 0.01\nzero_jitter_N = 0.002\n")).best
    best = fit.suggestions[0]
    assert best.test.endswith(", of animal_3")
    assert best.standard_errors["C20@animal_3"] < 0.1 * fit.standard_errors["C20@animal_3"]
    for name in ("C10@animal_1", "C20@animal_1", "C10@animal_2", "C20@animal_2"):
        assert best.standard_errors[name] == pytest.approx(fit.standard_errors[name], rel=1e-6)
