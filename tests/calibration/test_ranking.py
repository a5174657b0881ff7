"""Order of the laws, and fits that are not usable."""

import csv

import numpy as np
import pytest

import calibration
import tissue_sim as ts

TREE = {"C10": 1404.9, "C20": 699.4}
HEAD = "[[specimen]]\nradius_mm = 40.0\nheight_mm = 70.0\n"


def press(folder, name, strain, *, law="reduced_polynomial_2", values=None, seed=0, noise=0.02, factor=1.0):
    displacement = np.linspace(0.0, strain, 120) * 70e-3
    stress = ts.find_law(law).nominal_stress(1 - displacement / 70e-3, values or TREE)
    force = -factor * stress * np.pi * 0.04**2 + np.random.default_rng(seed).normal(0.0, noise, 120)
    ts.write_recording(ts.Recording({"displacement": displacement, "force": force}), folder / f"{name}.csv")


def stretch_stress(folder, name, stretch, stress):
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": stress}), folder / f"{name}.csv")


def shear(folder, name, strain, stress, **more):
    ts.write_recording(ts.Recording({**more, "shear strain": strain, "nominal stress": stress}), folder / f"{name}.csv")


def fit(folder, text, out="out"):
    (folder / "study.toml").write_text(text, encoding="utf-8")
    result, = calibration.calibrate([folder / "study.toml"], folder / out, figures=False, overwrite=True)
    return result


def test_held_out_tests_rank_closed_forms_too(tmp_path):
    """Yeoh with three terms has the lowest BIC on a short window, and misses what was held out."""
    press(tmp_path, "short", 0.12, law="neo_hooke", values={"C10": 1500.0}, seed=2)
    press(tmp_path, "deep", 0.6, law="neo_hooke", values={"C10": 1500.0}, seed=9)
    text = HEAD + ('[[test]]\nname = "short"\nkind = "lubricated_compression"\nrecordings = ["short.csv"]\n'
                   '[[test]]\nname = "deep"\nkind = "lubricated_compression"\nrecordings = ["deep.csv"]\n'
                   'hold_out = true\n[fit]\nlaws = ["reduced_polynomial_3", "neo_hooke"]\n[noise]\nforce_N = 0.001\n')
    result = fit(tmp_path, text)
    assert result.best.law == "neo_hooke"
    best, other = result.fits
    assert other.BIC < best.BIC and best.left_out < 0.2 < 20 < other.left_out
    assert "neo_hooke predicts held-out tests best: deep within" in result.message


def test_each_test_is_predicted_from_the_others_in_closed_form(tmp_path):
    stretch, strain, law = np.linspace(1.0, 1.4, 60), np.linspace(0.0, 0.4, 60), ts.find_law("ogden_1")
    values, rng = {"mu1": 2e4, "alpha1": 6.0}, np.random.default_rng(1)
    stretch_stress(tmp_path, "pull", stretch, law.nominal_stress(stretch, values, "uniaxial") + rng.normal(0, 20, 60))
    shear(tmp_path, "shear", strain, law.nominal_stress(strain, values, "simple_shear") + rng.normal(0, 20, 60))
    result = fit(tmp_path, '[[test]]\nkind = "uniaxial_tension"\nrecordings = ["pull.csv"]\n[[test]]\nkind = '
                           '"simple_shear"\nrecordings = ["shear.csv"]\n[fit]\nlaws = ["neo_hooke", "ogden_1"]\n')
    assert result.best.law == "ogden_1"
    left = {p.test: p for p in result.predictions if p.law == "ogden_1"}
    assert left["simple_shear"].fitted == ["uniaxial_tension"] and left["uniaxial_tension"].fitted == ["simple_shear"]
    assert max(p.percent for p in left.values()) < 2 < result.fits[1].left_out
    assert "from the others" in result.message


def test_a_law_on_its_bound_is_named_and_not_the_best(tmp_path):
    press(tmp_path, "plates", 0.4)
    text = HEAD + ('[[test]]\nkind = "lubricated_compression"\nrecordings = ["plates.csv"]\n'
                   '[fit]\nlaws = ["reduced_polynomial_2", "neo_hooke"]\n[fit.bounds]\nC20 = [0.0, 600.0]\n')
    result = fit(tmp_path, text)
    assert [one.law for one in result.fits] == ["neo_hooke", "reduced_polynomial_2"]
    assert result.fits[1].BIC < result.best.BIC and result.fits[1].parameters_on_bounds == ["C20"]
    assert "reduced_polynomial_2 (held by the bounds of C20)" in result.message
    alone = fit(tmp_path, text.replace(', "neo_hooke"', ""))
    assert alone.best.law == "reduced_polynomial_2" and "is held by the bounds of C20" in alone.message


def test_tension_through_rupture_is_never_usable(tmp_path):
    stretch, rng = np.linspace(1.0, 2.0, 200), np.random.default_rng(0)
    stress = ts.find_law("neo_hooke").nominal_stress(stretch, {"C10": 1e4}, "uniaxial")
    text = ('[[test]]\nkind = "uniaxial_tension"\nrecordings = ["pull.csv"]\n'
            '[fit]\nlaws = ["neo_hooke"]\n')
    stretch_stress(tmp_path, "pull", stretch, np.where(stretch < 1.6, stress, 0.03 * stress) + rng.normal(0, 50, 200))
    torn = fit(tmp_path, text.replace('"]\n[fit]', '"]\nfailure = "keep"\n[fit]')).best
    assert torn.status == "misfit" and torn.misfits["uniaxial_tension"] > 30
    assert "does not describe the data" in torn.message and "max_strain" in torn.unusable
    assert fit(tmp_path, text).best.status == "converged", "what comes after the failure is cut"
    whole = fit(tmp_path, text.replace('"]\n[fit]', '"]\nmax_strain = 0.55\n[fit]')).best
    assert whole.status == "converged" and whole.misfits["uniaxial_tension"] < 1
    # Noise alone, however large, is no reason.
    stretch_stress(tmp_path, "pull", stretch, stress + rng.normal(0, 0.3 * stress.max(), 200))
    noisy = fit(tmp_path, text).best
    assert noisy.misfits["uniaxial_tension"] > 10 and noisy.status == "converged"


@pytest.mark.parametrize("timed", [False, True])
def test_both_sides_of_zero_are_fitted_and_drawn(tmp_path, timed):
    time = np.linspace(0.0, 40.0, 401)
    strain = 0.3 * np.sin(2 * np.pi * time / 40) if timed else np.linspace(-0.3, 0.3, 401)
    stress = 2e4 * strain + 3e4 * strain**3 + np.random.default_rng(0).normal(0, 20, 401)
    shear(tmp_path, "shear", strain, stress, **({"time": time} if timed else {}))
    fit(tmp_path, '[[test]]\nkind = "simple_shear"\nrecordings = ["shear.csv"]\n[fit]\nlaws = ["neo_hooke"]\n')
    for name in ("curves", "residuals"):
        with (tmp_path / "out" / f"{name}.csv").open(encoding="utf-8", newline="") as stream:
            values = [float(row["value"]) for row in csv.DictReader(stream)]
        assert (min(values), max(values)) == pytest.approx((-0.3, 0.3), abs=1e-3)


@pytest.mark.slow
def test_an_assumed_scatter_has_the_size_of_the_test(tmp_path):
    """A millimetre that is pressed by 2 um."""
    displacement = np.linspace(0.0, 2e-6, 80)
    force = 1e-3 * displacement / 2e-6 + np.random.default_rng(0).normal(0, 1e-6, 80)
    ts.write_recording(ts.Recording({"displacement": displacement, "force": force}), tmp_path / "small.csv")
    result = fit(tmp_path, '[[specimen]]\nradius_mm = 0.5\nheight_mm = 1.0\n[[test]]\nkind = "lubricated_compression"\n'
                           'recordings = ["small.csv"]\n[fit]\nmethod = "inverse_fem"\nlaws = ["neo_hooke"]\n')
    assert result.best.jitter.contact_mm == pytest.approx(0.02 * 2e-3, rel=1e-6)
    assert any("contact 0.04 µm, zero 0.002 mN" in words for words in result.best.warnings)


def test_a_recording_that_disagrees_is_named_and_windows_are_fitted(tmp_path):
    for number in range(5):
        press(tmp_path, f"plates_{number}", 0.4, seed=number, factor=(1.3 if number == 3 else 1.0) + 0.005 * number)
    text = HEAD + ('[[test]]\nkind = "lubricated_compression"\nrecordings = ["plates_*.csv"]\n'
                   '[fit]\nlaws = ["reduced_polynomial_2"]\n')
    best = fit(tmp_path, text).best
    assert best.odd_recordings == ["lubricated_compression/plates_3"]
    assert "plates_3 disagrees with the other recordings" in best.message
    # The linear step is the fit without it.
    (tmp_path / "plates_3.csv").unlink()
    rest = fit(tmp_path, text).best
    assert best.influence["lubricated_compression/plates_3"] == pytest.approx(rest.parameters, rel=1e-5)
    assert not rest.odd_recordings and len(rest.influence) == 4
    assert [window.share for window in rest.windows] == [0.4, 0.6, 0.8, 1.0]
    narrow = fit(tmp_path, text.replace('"]\n[fit]', f'"]\nmax_strain = {0.6 * 0.4 + 1e-6}\n[fit]')).best
    assert rest.windows[1].parameters == pytest.approx(narrow.parameters, rel=1e-3)
    assert rest.windows[-1].parameters == pytest.approx(rest.parameters)


@pytest.mark.slow
def test_methods_that_disagree_on_the_same_recordings_are_compared(tmp_path):
    """Each recording begins 0.2 mm above the tissue: only one of the methods may move the contact."""
    for number in range(3):
        displacement = np.linspace(0.0, 21e-3, 120)
        stretch = 1 - np.maximum(displacement - 0.2e-3, 0) / 70e-3
        force = -ts.find_law("neo_hooke").nominal_stress(stretch, {"C10": 1500.0}) * np.pi * 0.04**2
        force += np.random.default_rng(number).normal(0, 0.02, 120)
        ts.write_recording(ts.Recording({"displacement": displacement, "force": force}),
                           tmp_path / f"plates_{number}.csv")
    text = HEAD + ('[[test]]\nkind = "lubricated_compression"\nrecordings = ["plates_*.csv"]\n'
                   '[fit]\nlaws = ["neo_hooke"]\nmethod = "{}"\n[noise]\nforce_N = 0.02\n{}')
    (tmp_path / "plain.toml").write_text(text.format("analytical", ""), encoding="utf-8")
    (tmp_path / "inverse.toml").write_text(text.format("inverse_fem", "contact_jitter_mm = 0.2\n"), encoding="utf-8")
    results = calibration.calibrate([tmp_path / "plain.toml", tmp_path / "inverse.toml"], tmp_path / "out",
                                    figures=False)
    plain, inverse = (one.best.intervals95["C10"] for one in results)
    assert plain[1] < inverse[0] < 1500.0 < inverse[1]
    sentence, = calibration.to_json_dictionary(results)["agreement"]
    assert "do not overlap: C10" in sentence and "contact offset (0.2 mm)" in sentence
    again, = calibration.to_json_dictionary([results[0], results[0]])["agreement"] or [""]
    assert not again, "one method agrees with itself"


@pytest.mark.slow
def test_samples_cut_at_a_failure_are_no_holds_and_returns(tmp_path):
    time, rng = np.linspace(0.0, 20.0, 200), np.random.default_rng(0)
    displacement = 0.5e-3 * time
    force = -ts.find_law("neo_hooke").nominal_stress(1 - displacement / 70e-3, {"C10": 1400.0}) * np.pi * 0.04**2
    force = np.where(time < 12.0, force, 0.2 * force) + rng.normal(0.0, 2e-3, 200)
    ts.write_recording(ts.Recording({"time": time, "displacement": displacement, "force": force}),
                       tmp_path / "torn.csv")
    torn = fit(tmp_path, HEAD + '[[test]]\nkind = "lubricated_compression"\nrecordings = ["torn.csv"]\n'
               '[fit]\nmethod = "inverse_fem"\nlaws = ["neo_hooke"]\nbulk_ratio = 1000.0\nstarts = 1\n')
    words = f"{torn.message} {torn.best.message}"
    assert "fitted up to this sample" in words and "holds and returns" not in words
