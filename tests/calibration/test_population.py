"""Specimens as a population: against closed forms, a published analysis by another program, and simulated ones."""

import json

import numpy as np
import pytest
from scipy import stats

import calibration
import tissue_sim as ts
from calibration.statistics.population import estimate_population
from scenes.cli import main
from tissue_sim.errors import InputError


def alone(values, variances):
    """The population of one parameter."""
    values = np.asarray(values, dtype=float)
    return estimate_population(["a"], [str(i) for i in range(values.size)], values[:, None],
                               np.reshape(variances, (-1, 1, 1)))


@pytest.mark.parametrize("n", [2, 3, 5, 10])
def test_specimens_measured_without_error_are_an_ordinary_sample(n):
    x = np.random.default_rng(n).normal(1500.0, 200.0, n)
    found, deviation, t = alone(x, np.full(n, 1e-6)), x.std(ddof=1), stats.t.ppf(0.975, n - 1)
    assert found.mean[0] == pytest.approx(x.mean()) and found.spread[0] == pytest.approx(deviation, rel=1e-5)
    # The distribution of the spread is taken at 400 shares: the far tail of two specimens is cut a little short.
    rel = 0.03 if n == 2 else 0.005
    half = t * deviation * np.array([1 / np.sqrt(n), np.sqrt(1 + 1 / n)])
    ends = np.stack([found.mean_intervals[0], found.next_specimen[0]])
    np.testing.assert_allclose(ends - x.mean(), half[:, None] * [-1.0, 1.0], rtol=rel)
    squares = (n - 1) * deviation**2
    np.testing.assert_allclose(found.spread_intervals[0],
                               np.sqrt(squares / stats.chi2.ppf([0.975, 0.025], n - 1)), rtol=1e-5)
    np.testing.assert_allclose(found.shrunken[:, 0], x, rtol=1e-6)


def test_trials_of_a_vaccine():
    """13 trials of the BCG vaccine, log relative risks (Colditz et al., JAMA 271 (1994) 698): metafor prints
    for restricted likelihood a mean of -0.7145 with standard error 0.1798, tau^2 0.3132 and its Q-profile interval
    0.1197 to 1.1115 (Viechtbauer, J. Statistical Software 36 (2010) 3)."""
    treated = np.array([4, 6, 3, 62, 33, 180, 8, 505, 29, 17, 186, 5, 27])
    treated_well = np.array([119, 300, 228, 13536, 5036, 1361, 2537, 87886, 7470, 1699, 50448, 2493, 16886])
    control = np.array([11, 29, 11, 248, 47, 372, 10, 499, 45, 65, 141, 3, 29])
    control_well = np.array([128, 274, 209, 12619, 5761, 1079, 619, 87892, 7232, 1600, 27197, 2338, 17825])
    risks = treated / (treated + treated_well), control / (control + control_well)
    variances = (1 / treated - 1 / (treated + treated_well) + 1 / control - 1 / (control + control_well))
    found = alone(np.log(risks[0] / risks[1]), variances)
    assert found.mean[0] == pytest.approx(-0.7145, abs=5e-5) and found.mean_errors[0] == pytest.approx(0.1798, abs=5e-5)
    assert found.between[0, 0] == pytest.approx(0.3132, abs=1e-4)
    np.testing.assert_allclose(found.spread_intervals[0]**2, [0.1197, 1.1115], atol=1e-4)


def test_equal_specimens_have_no_scatter():
    """Estimates that differ by less than their errors: spread 0, each specimen shrunken to the mean."""
    found = alone([1000.0, 1010.0, 990.0, 1004.0], np.full(4, 50.0**2))
    assert found.spread[0] < 1.0 and found.spread_intervals[0, 0] == 0.0
    np.testing.assert_allclose(found.shrunken, 1001.0, atol=0.5)
    assert (found.shrunken_errors < 26.0).all() and found.mean_errors[0] == pytest.approx(25.0, rel=1e-3)


def test_scatter_of_two_parameters_and_its_correlation():
    """Many specimens: the covariance between them comes out of estimates whose own errors are correlated the other
    way."""
    rng = np.random.default_rng(3)
    between = np.array([[200.0**2, 0.8 * 200 * 90], [0.8 * 200 * 90, 90.0**2]])
    errors = np.array([[100.0**2, -0.9 * 100 * 60], [-0.9 * 100 * 60, 60.0**2]])
    truth = rng.multivariate_normal([1400.0, 700.0], between, 3000)
    estimates = truth + rng.multivariate_normal([0.0, 0.0], errors, 3000)
    found = estimate_population(["C10", "C20"], list(map(str, range(3000))), estimates, np.tile(errors, (3000, 1, 1)))
    np.testing.assert_allclose(found.mean, [1400.0, 700.0], atol=2.5 * found.mean_errors.max())
    np.testing.assert_allclose(found.spread, [200.0, 90.0], rtol=0.05)
    assert found.between[0, 1] / found.spread.prod() == pytest.approx(0.8, abs=0.05)
    # The shrunken ones are nearer to the truth than each alone, by as much as they say.
    left, alone_left = found.shrunken - truth, estimates - truth
    assert (np.std(left, axis=0) < 0.95 * np.std(alone_left, axis=0)).all()
    np.testing.assert_allclose(np.std(left, axis=0), found.shrunken_errors.mean(axis=0), rtol=0.12)


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """At least 51 of 60 intervals of 95 % contain the truth; fewer have a probability of 0.1 %.

    Each population has five specimens, whose errors are as large as the scatter between specimens;
    benchmarks/inverse/population.py runs thousands of populations.
    """
    rng, held = np.random.default_rng(8), np.zeros(3)
    for _ in range(60):
        variances = rng.uniform(50.0, 200.0, 5)**2
        truth = rng.normal(1500.0, 120.0, 6)
        found = alone(truth[:5] + rng.normal(0.0, np.sqrt(variances)), variances)
        held += [low <= value <= high for (low, high), value in (
            (found.mean_intervals[0], 1500.0), (found.spread_intervals[0], 120.0), (found.next_specimen[0], truth[5]))]
    assert held.min() >= 51


def test_too_few_specimens_and_undetermined_parameters_are_refused():
    with pytest.raises(InputError, match="a population must have at least 2 specimens; got 1"):
        alone([1.0], [1.0])
    with pytest.raises(InputError, match="the fit of 1 must determine a; got no finite estimate"):
        alone([1.0, 2.0], [1.0, np.inf])
    with pytest.raises(InputError, match="the fit of b must determine y; got no finite estimate"):
        estimate_population(["x", "y"], ["a", "b"], np.ones((2, 2)), [np.eye(2), np.diag([1.0, 0.0])])
    with pytest.raises(InputError, match="must have the shapes"):
        estimate_population(["a"], ["x", "y"], np.zeros((2, 2)), np.zeros((2, 2, 2)))


#: Name of the law.
LAW = "reduced_polynomial_2"
#: Radius, m.
RADIUS = 0.015
#: Height, m.
HEIGHT = 0.020
MEAN = np.array([1400.0, 700.0])
SPREAD = np.array([200.0, 90.0])


@pytest.fixture(scope="module")
def animals(tmp_path_factory):
    """Five specimens of a population, each compressed twice; their campaign with and without numbers of their own."""
    folder, rng, law = tmp_path_factory.mktemp("animals"), np.random.default_rng(2), ts.find_law(LAW)
    truth = rng.normal(MEAN, SPREAD, (5, 2))
    specimens = tests = ""
    for k, (C10, C20) in enumerate(truth, 1):
        for j in range(2):
            displacement = np.linspace(0.0, 6e-3, 61)
            stretch = 1 - displacement / HEIGHT
            force = -law.nominal_stress(stretch, {"C10": C10, "C20": C20}) * np.pi * RADIUS**2
            ts.write_recording(ts.Recording({"displacement": displacement,
                                             "force": force + rng.normal(0.0, 0.01, 61)}), folder / f"a{k}_{j}.csv")
        specimens += f'[[specimen]]\nname = "animal_{k}"\nradius_mm = 15.0\nheight_mm = 20.0\n'
        tests += (f'[[test]]\nname = "plates_{k}"\nspecimen = "animal_{k}"\nkind = "lubricated_compression"\n'
                  f'recordings = ["a{k}_*.csv"]\n')
    (folder / "pooled.toml").write_text(f'{specimens}{tests}[fit]\nlaws = ["{LAW}"]\nbulk_ratio = 1000.0\n')
    (folder / "each.toml").write_text((folder / "pooled.toml").read_text()
                                      + '[fit.scope]\nC10 = "per_specimen"\nC20 = "per_specimen"\n')
    return folder, truth


def test_pooled_specimens_are_said_to_differ(animals, tmp_path):
    folder, _ = animals
    result, = calibration.calibrate([folder / "pooled.toml"], tmp_path / "out", figures=False)
    assert result.best.population is None
    warning, = (each for each in result.best.warnings if "the specimens differ" in each)
    assert "individual values of C10, C20" in warning and "'per_specimen'" in warning


def test_one_material_in_all_specimens_differs_in_nothing(animals, tmp_path):
    """The same campaign with five times the recordings of the first animal."""
    folder, _ = animals
    for path in folder.glob("a*.csv*"):
        tmp_path.joinpath(path.name).write_bytes((folder / f"a1_{path.name[3:]}").read_bytes())
    (tmp_path / "same.toml").write_text((folder / "pooled.toml").read_text())
    result, = calibration.calibrate([tmp_path / "same.toml"], tmp_path / "out", figures=False)
    assert not any("the specimens differ" in each for each in result.best.warnings)


@pytest.mark.slow
def test_a_campaign_finds_the_population(animals, tmp_path, capsys):
    """A campaign gives parameters of each specimen, and a material file with their mean."""
    folder, truth = animals
    assert main(["calibrate", str(folder / "each.toml"), "-o", str(tmp_path / "out")]) == 0
    assert "between specimens" in capsys.readouterr().out
    fit, = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]
    found = fit["population"]
    assert found["order"] == ["C10", "C20"] and found["specimens"] == [f"animal_{k}" for k in range(1, 6)]
    np.testing.assert_allclose(found["estimates"], truth, rtol=0.02)
    ordinary = [truth.mean(axis=0), truth.std(axis=0, ddof=1)]
    np.testing.assert_allclose([found["mean"], found["spread"]], ordinary, rtol=0.03)
    for (low, high), value in zip(found["mean_intervals"] + found["spread_intervals"], [*MEAN, *SPREAD], strict=True):
        assert low < value < high
    file = ts.read_material_file(tmp_path / "out" / fit["material_file"])
    assert file.material.parameters == pytest.approx(dict(zip(found["order"], found["mean"], strict=True)))
    assert file.population.spread == pytest.approx(found["spread"])
    assert file.population.specimens["animal_3"] == pytest.approx(found["estimates"][2])
    assert file.standard_errors["C10"] == pytest.approx(found["mean_errors"][0])
    np.testing.assert_allclose(file.paths_and_covariance_SI[1], found["mean_covariance"])
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Specimens as a population" in report
    methods = (tmp_path / "out" / "methods.txt").read_text(encoding="utf-8")
    assert "Population of 5 specimens" in methods and "Harville DA (1977)" in methods


@pytest.mark.slow
def test_a_specimen_that_was_left_out_is_predicted_by_the_mean_of_the_others(animals, tmp_path):
    folder, truth = animals
    (tmp_path / "each.toml").write_text((folder / "each.toml").read_text().replace(
        "[fit]", '[fit]\nmethod = "inverse_fem"\nstarts = 1').replace('recordings = ["', f'recordings = ["{folder}/')
        + "[noise]\nforce_N = 0.01\ncontact_jitter_mm = 0.0\nzero_jitter_N = 0.0\n")
    result, = calibration.calibrate([tmp_path / "each.toml"], tmp_path / "out", figures=False)
    assert [prediction.test for prediction in result.predictions] == [f"plates_{k}" for k in range(1, 6)]
    for k, prediction in enumerate(result.predictions):
        others = np.delete(truth, k, axis=0)
        assert prediction.parameters[f"C10@animal_{k + 1}"] == pytest.approx(others[:, 0].mean(), rel=0.02)
        # The scatter between specimens is what chance makes, not the noise of 0.01 N.
        assert prediction.expected_N > 0.05 and 5 * prediction.expected_N > prediction.RMSE_N


@pytest.mark.slow
def test_a_file_states_a_population_in_its_units(animals, tmp_path):
    folder, _ = animals
    calibration.calibrate([folder / "each.toml"], tmp_path / "out", figures=False)
    path = tmp_path / "out" / f"{LAW}.material.json"
    content, before = json.loads(path.read_text(encoding="utf-8")), ts.read_material_file(path).population
    for entry in content["parameters"].values():
        entry.update(value=entry["value"] / 1e3, unit="kPa", standard_error=entry["standard_error"] / 1e3)
    stated = content["population"]
    for key in ("mean", "spread", "mean_interval95", "spread_interval95"):
        stated[key] = (np.array(stated[key]) / 1e3).tolist()
    stated["between_specimens"] = (np.array(stated["between_specimens"]) / 1e6).tolist()
    stated["specimens"] = {name: (np.array(values) / 1e3).tolist() for name, values in stated["specimens"].items()}
    del content["covariance"]
    path.write_text(json.dumps(content), encoding="utf-8")
    after = ts.read_material_file(path).population
    np.testing.assert_allclose(after.between_specimens, before.between_specimens)
    assert after.specimens["animal_2"] == pytest.approx(before.specimens["animal_2"])
    for key, value, message in (("order", ["C10", "C30"], "no parameter 'C30'"),
                                ("mean", [1.0], "2 entries, one for each parameter in order; got 1"),
                                ("between_specimens", [[1.0, 2.0], [2.0, 1.0]], "must be positive semi-definite")):
        path.write_text(json.dumps(content | {"population": stated | {key: value}}), encoding="utf-8")
        with pytest.raises(InputError, match=message) as caught:
            ts.read_material_file(path)
        assert caught.value.field.startswith("population")


def test_an_error_that_all_specimens_share_is_no_scatter_and_no_rest():
    """Estimates that all move by one error of 100: the spread stays that of the specimens, the mean errs by it."""
    rng, n = np.random.default_rng(5), 6
    truth = rng.normal(1500.0, 30.0, n)
    estimates = truth + rng.normal(0.0, 10.0, n) + 80.0
    found = estimate_population(["a"], list(map(str, range(n))), estimates[:, None], np.full((n, 1, 1), 100.0),
                                np.full((n, 1, 1), 100.0))
    alone_found = alone(estimates, np.full(n, 100.0))
    assert found.spread[0] == pytest.approx(alone_found.spread[0]) and found.mean[0] == pytest.approx(estimates.mean())
    assert found.mean_errors[0] == pytest.approx(np.hypot(alone_found.mean_errors[0], 100.0))
    low, high = found.mean_intervals[0]
    assert high - low > 3.9 * 100.0 and low < 1500.0 < high
    assert (found.errors == pytest.approx(np.hypot(10.0, 100.0)))


@pytest.mark.slow
def test_a_shared_exponent_is_no_scatter(tmp_path):
    """mu1 of each of four specimens, alpha1 of all: the mean's error is that of the fit's own covariance."""
    rng, law = np.random.default_rng(4), ts.find_law("ogden_1")
    text = ""
    for k, mu1 in enumerate(rng.normal(3000.0, 200.0, 4), 1):
        displacement = np.linspace(0.0, 2e-3, 41)
        force = -law.nominal_stress(1 - displacement / HEIGHT, {"mu1": mu1, "alpha1": 8.0}) * np.pi * RADIUS**2
        ts.write_recording(ts.Recording({"displacement": displacement, "force": force + rng.normal(0.0, 0.02, 41)}),
                           tmp_path / f"s{k}.csv")
        text += f'[[specimen]]\nname = "s{k}"\nradius_mm = 15.0\nheight_mm = 20.0\n'
        text += (f'[[test]]\nname = "t{k}"\nspecimen = "s{k}"\nkind = "lubricated_compression"\n'
                 f'recordings = ["s{k}.csv"]\n')
    (tmp_path / "c.toml").write_text(text + '[fit]\nlaws = ["ogden_1"]\n[fit.scope]\nmu1 = "per_specimen"\n'
                                     "[noise]\nforce_N = 0.02\n")
    result, = calibration.calibrate([tmp_path / "c.toml"], tmp_path / "out", figures=False)
    fit = result.best
    place = [fit.covariance.order.index(f"mu1@s{k}") for k in range(1, 5)]
    plain = np.array(fit.covariance.matrix)[np.ix_(place, place)].mean()
    assert fit.population.mean_errors[0]**2 > plain
    assert 60.0 < fit.population.spread[0] < 600.0


def test_a_test_without_a_specimen_has_no_value_of_its_own(tmp_path):
    stretch = np.linspace(1.0, 1.4, 21)
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": 3e3 * (stretch - stretch**-2)}),
                       tmp_path / "pull.csv")
    (tmp_path / "c.toml").write_text('[[test]]\nname = "pull"\nkind = "uniaxial_tension"\nrecordings = ["pull.csv"]\n'
                                     '[fit]\nlaws = ["neo_hooke"]\n[fit.scope]\nC10 = "per_specimen"\n')
    with pytest.raises(InputError, match="pull has none") as caught:
        calibration.load_campaign(tmp_path / "c.toml")
    assert caught.value.field == "fit.scope.C10"
