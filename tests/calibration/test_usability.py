"""The usability rule: several optima, laws at a limit or without a fit, recordings that disagree, misfits."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured_curves
from calibration.fit.identifiability import assess_modulus_error_and_bound_dependence
from calibration.fit.usability import (
    USABILITY,
    UsabilitySettings,
    compute_displacement_r_squared,
    list_findings_contradicting_fit,
)
from calibration.report.sections.fits import CRITERIA
from scenes.cli import main
from tissue_sim.recording.screening import ControlledQuantityFindings, LeftOutSamples, Preload, Screening

#: Cross-section, m2.
AREA = np.pi * 0.0125**2
#: Height, m.
HEIGHT = 0.0125


def shear(stress, noise=2.0):
    """A simple shear to 1.5 in 76 samples."""
    strain = np.linspace(0.0, 1.5, 76)
    return ts.Recording({"shear strain": strain,
                         "nominal stress": stress(strain) + np.random.default_rng(1).normal(0.0, noise, strain.size)})


def compression(mu=20e3, *, law="neo_hooke", values=None, factor=1.0, noise=0.01, seed=0, strain=0.2, points=80):
    """A lubricated compression of a cylinder of 25 x 12.5 mm."""
    displacement = np.linspace(0.0, strain * HEIGHT, points)
    stress = ts.find_law(law).nominal_stress(1.0 - displacement / HEIGHT, values or {"C10": mu / 2})
    force = -factor * stress * AREA + np.random.default_rng(seed).normal(0.0, factor * noise, points)
    return ts.Recording({"displacement": displacement, "force": force})


def write(folder, recordings, laws, kind="lubricated_compression", fit="", noise=""):
    """A campaign file of one test."""
    for i, recording in enumerate(recordings, 1):
        ts.write_recording(recording, folder / f"gel_{i}.csv")
    specimen = "" if kind == "simple_shear" else "[[specimen]]\nradius_mm = 12.5\nheight_mm = 12.5\n"
    path = folder / "c.toml"
    path.write_text(f'{specimen}[[test]]\nname = "gel"\nkind = "{kind}"\nrecordings = ["gel_*.csv"]\n[fit]\n'
                    f"laws = {laws}\n{fit}\n[noise]\n{noise}\n".replace("'", '"'), encoding="utf-8")
    return path


def calibrate(folder, *arguments, **options):
    """Result of the campaign of `write`, and its fits by law."""
    result, = calibration.calibrate([write(folder, *arguments, **options)], folder / "out", figures=False)
    return SimpleNamespace(result=result, **{fit.law: fit for fit in result.fits})


def failing(fit):
    """Names of the clauses that fail."""
    return [clause.name for clause in fit.clauses if not clause.holds]


def stiffening(strain):
    return ts.find_law("ogden_1").nominal_stress(strain, {"mu1": 2000.0, "alpha1": 8.0}, "simple_shear")


@pytest.mark.parametrize("method", ["analytical", "inverse_fem"])
def test_shear_leaves_the_sign_of_the_exponent_open(tmp_path, method):
    fit = calibrate(tmp_path, [shear(stiffening)], ["ogden_1"], "simple_shear",
                    f'method = "{method}"' + ("\nbulk_ratio = 1000.0" if method == "inverse_fem" else "")).ogden_1
    assert fit.parameters["alpha1"] == pytest.approx(8.0, abs=0.01)
    assert fit.status == "ambiguous" and failing(fit) == ["unique"] and "alpha1 -8" in fit.unusable
    other, = fit.alternatives
    assert other.parameters["alpha1"] == pytest.approx(-8.0, abs=0.01) and other.rise < 1e-3
    # A parameter that differs between equal optima has no interval; the modulus is common to both.
    assert fit.standard_errors["alpha1"] is None and fit.intervals95["alpha1"] is None
    assert 0.5 < fit.standard_errors["mu1"] < 10.0
    low, high = sorted(abs(stress) for stress in (other.stress_Pa, other.alternative_stress_Pa))
    assert high / low == pytest.approx(4.17, abs=0.05) and "4.17 times" in fit.unusable


@pytest.mark.slow
def test_report_and_material_file_carry_the_other_optimum(tmp_path):
    path = write(tmp_path, [shear(stiffening)], ["ogden_1"], "simple_shear")
    assert main(["calibrate", str(path), "-o", str(tmp_path / "out")]) == 1
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "parameters that fit equally well" in page and CRITERIA["unique"] in page and "8 or −8" in page
    settings = ts.read_material_file(tmp_path / "out" / "ogden_1.material.json").provenance.settings
    assert settings["status"] == "ambiguous"
    assert settings["alternatives"][0]["parameters"]["alpha1"] == pytest.approx(-8.0, abs=0.01)


def test_a_second_kind_of_test_decides_the_sign(tmp_path):
    ts.write_recording(shear(stiffening), tmp_path / "shear.csv")
    stretch = np.linspace(0.75, 1.0, 60)
    stress = ts.find_law("ogden_1").nominal_stress(stretch, {"mu1": 2000.0, "alpha1": 8.0})
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": stress}), tmp_path / "pressed.csv")
    path = tmp_path / "both.toml"
    path.write_text('[[test]]\nkind = "simple_shear"\nrecordings = ["shear.csv"]\n[[test]]\n'
                    'kind = "lubricated_compression"\nrecordings = ["pressed.csv"]\n[fit]\nlaws = ["ogden_1"]\n'
                    "[noise]\nnominal_stress_Pa = 2.0\n", encoding="utf-8")
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert result.best.unusable is None and not result.best.alternatives
    assert result.best.parameters["alpha1"] == pytest.approx(8.0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("stress", "mu", "R2", "neo_hooke"), [
    (lambda g: 700.0 * np.tanh(g / 0.35), 820.0, 0.239, 665.0),
    (lambda g: 2000.0 * g / (1.0 + g / 0.8), 1038.0, 0.912, 851.0)])
def test_softening_shear_ends_at_the_limit_of_ogden(tmp_path, stress, mu, R2, neo_hooke):
    found = calibrate(tmp_path, [shear(stress)], ["neo_hooke", "ogden_1", "ogden_2"], "simple_shear")
    fit = found.ogden_1
    assert abs(fit.parameters["alpha1"]) < 1e-2 and fit.mu0 == pytest.approx(mu, abs=20.0)
    assert pytest.approx(R2, abs=2e-3) == fit.R2 and fit.status == "misfit" and "explained" in failing(fit)
    assert fit.standard_errors["alpha1"] is None and "alpha1 is at its limit 0" in fit.message
    assert found.neo_hooke.mu0 == pytest.approx(neo_hooke, abs=5.0)
    assert {fit.law for fit in found.result.fits} == {"neo_hooke", "ogden_1", "ogden_2"}


def test_ogden_tends_to_the_energy_of_hencky():
    law, stretch = ts.find_law("ogden_1"), np.array([0.5, 0.9, 1.1, 2.0])
    for alpha in (0.0, -0.0, 1e-9, -5e-5):
        found = law.nominal_stress(stretch, {"mu1": 1000.0, "alpha1": alpha})
        assert found == pytest.approx(3.0 * 1000.0 * np.log(stretch) / stretch, rel=1e-4)
    assert law.describe_limiting_cases({"mu1": 1.0, "alpha1": 1e-3})
    assert not law.describe_limiting_cases({"mu1": 1.0, "alpha1": -0.5})


@pytest.mark.slow
def test_a_law_that_fails_leaves_the_others(tmp_path, monkeypatch):
    from calibration.fit import ordinary

    whole = ordinary.fit_law_to_descents_and_estimate

    def fails(problem):
        if problem.space.law == "ogden_1":
            raise FloatingPointError("overflow in power")
        return whole(problem)

    monkeypatch.setattr(ordinary, "fit_law_to_descents_and_estimate", fails)
    path = write(tmp_path, [compression()], ["ogden_1", "neo_hooke"])
    assert main(["calibrate", str(path), "-o", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "overflow in power" in page
    again, = calibration.calibrate([path], tmp_path / "out", figures=False)
    assert again.resumed and again.best.law == "neo_hooke" and again.failures == {"ogden_1": "overflow in power"}


def test_a_report_is_written_where_every_law_fails(tmp_path, monkeypatch):
    def fails(problem):
        raise ts.InputError("alpha is out of range")

    monkeypatch.setattr("calibration.fit.ordinary.fit_law_to_descents_and_estimate", fails)
    with pytest.raises(ts.ConvergenceError, match="alpha is out of range"):
        calibrate(tmp_path, [compression()], ["neo_hooke"])
    path = write(tmp_path, [compression()], ["neo_hooke"])
    assert main(["calibrate", str(path), "-o", str(tmp_path / "out"), "--overwrite"]) == 1
    assert "alpha is out of range" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("second", "words"), [
    (lambda: compression(40e3, seed=4), "gel/gel_4 is 1.9"),
    (lambda: compression(20e3, factor=1e3, seed=4), "a factor of 1000 is that of N to mN")])
def test_disagreeing_recordings_are_named(tmp_path, second, words):
    recordings = [*(compression(mu, seed=i) for i, mu in enumerate((20e3, 21e3, 20.5e3))), second()]
    found = calibrate(tmp_path, recordings, ["neo_hooke"])
    assert found.neo_hooke.status == "misfit" and "replicates" in failing(found.neo_hooke)
    assert words in found.result.message and "another law" not in found.neo_hooke.unusable


def test_scatter_between_specimens_is_no_disagreement_and_no_misfit(tmp_path):
    moduli = 20e3 * np.exp(0.2 * np.array([-1.2, -0.7, -0.2, 0.1, 0.5, 0.9, 1.4]))
    fit = calibrate(tmp_path, [compression(mu, seed=i) for i, mu in enumerate(moduli)], ["neo_hooke"]).neo_hooke
    assert USABILITY.smallest_R2 > fit.R2 and not {"replicates", "explained"} & set(failing(fit))


def test_noise_is_no_misfit_and_a_precise_wrong_law_is(tmp_path):
    noisy = calibrate(tmp_path, [compression(noise=1.0)], ["neo_hooke"], noise="force_N = 1.0").neo_hooke
    assert USABILITY.smallest_R2 > noisy.R2 and noisy.unusable is None
    wrong = tmp_path / "wrong"
    wrong.mkdir()
    bent = compression(law="reduced_polynomial_3", values={"C10": 10.0, "C20": 0.0, "C30": 1e5}, noise=1e-4, strain=0.4)
    fit = calibrate(wrong, [bent], ["neo_hooke"]).neo_hooke
    assert fit.status == "misfit" and "explained" in failing(fit) and "limit is 0.95" in fit.unusable


def test_a_relaxation_between_two_samples_does_not_determine_the_modulus(tmp_path):
    """An elastic recording fitted with a Prony term: the force before the relaxation is in no sample."""
    recording = compression(points=81)
    recording = ts.Recording({"time": 0.1 * np.arange(81.0), **{name: recording.channel(name)
                                                                for name in ("displacement", "force")}})
    start = 'start = { "viscoelastic.terms[0].g" = 0.4, "viscoelastic.terms[0].tau_s" = 0.01 }\n'
    bounds = 'bounds = { "viscoelastic.terms[0].g" = [0.3, 0.5], "viscoelastic.terms[0].tau_s" = [0.009, 0.011] }'
    fit = calibrate(tmp_path, [recording], ["neo_hooke"], fit=start + bounds).neo_hooke
    assert "determined" in failing(fit) and "is shorter than the sampling interval, 0.1 s" in fit.unusable


@pytest.fixture
def curve(tmp_path):
    """A recording as it is fitted."""
    campaign = load_campaign(write(tmp_path, [compression()], ["neo_hooke"]))
    return read_measured_curves(campaign)["gel"][0]


def test_screening_contradicts_an_elastic_law(curve):
    loses = replace(curve,
                    screening=Screening(control=ControlledQuantityFindings("displacement", "oscillation",
                                                                           loss_factor=0.3, frequency=1.0)))
    assert "viscoelastic.terms[0].g" in list_findings_contradicting_fit(loses, remembers=False)[0]
    assert not list_findings_contradicting_fit(loses, remembers=True)
    follows = replace(curve,
                      screening=Screening(control=ControlledQuantityFindings("displacement", "ramp",
                                                                             loading=curve.force.size)))
    assert not list_findings_contradicting_fit(follows, remembers=False)
    zeroed = replace(curve, screening=Screening(preload=Preload(0.65, 0.11, 4e-4, False, "begins under 0.65 N")))
    assert list_findings_contradicting_fit(zeroed, remembers=True) == ["begins under 0.65 N"]
    kept = replace(curve, screening=Screening(suspected=(LeftOutSamples((61,), "force", "sample 61 is 50 N"),)))
    assert "sample 61 is 50 N" in list_findings_contradicting_fit(kept, remembers=False)[0]


def test_creep_at_constant_force_is_a_misfit_of_the_displacement(curve):
    size = curve.force.size
    creeps = replace(curve, displacement=np.linspace(2.9e-3, 4.5e-3, size), force=np.full(size, 0.3))
    elastic = 0.3 * creeps.displacement / creeps.displacement.mean()
    assert compute_displacement_r_squared(creeps, elastic) < 0.1
    assert compute_displacement_r_squared(creeps, creeps.force) == pytest.approx(1.0)


def test_a_preload_is_covered_by_the_contact_offset_of_an_inverse_fit(tmp_path):
    displacement = np.linspace(0.0, 2.6e-3, 66)
    stress = ts.find_law("neo_hooke").nominal_stress(1.0 - (displacement + 0.4e-3) / HEIGHT, {"C10": 10e3})
    force = -stress * AREA + np.random.default_rng(3).normal(0.0, 0.01, displacement.size)
    recording = ts.Recording({"time": displacement / 0.5e-3, "displacement": displacement, "force": force})
    options = 'method = "inverse_fem"\nbulk_ratio = 1000.0'
    covered = calibrate(tmp_path, [recording], ["neo_hooke"], fit=options).neo_hooke
    assert covered.unusable is None and covered.parameters["C10"] == pytest.approx(10e3, rel=0.02)
    folder = tmp_path / "fixed"
    folder.mkdir()
    # Without a contact offset the zero of the force takes the preload, and the modulus is wrong.
    fixed = calibrate(folder, [recording], ["neo_hooke"], fit=options, noise="contact_jitter_mm = 0.0").neo_hooke
    assert "recordings" in failing(fixed) and "the moduli are wrong" in fixed.unusable


def organs(tmp_path, liver, kidney):
    """The calibration of two tests of one kind with different moduli, Pa."""
    tests = ""
    for name, modulus in (("liver", liver), ("kidney", kidney)):
        ts.write_recording(compression(modulus), tmp_path / f"{name}.csv")
        tests += f'[[test]]\nname = "{name}"\nkind = "lubricated_compression"\nrecordings = ["{name}.csv"]\n'
    path = tmp_path / "organs.toml"
    path.write_text("[[specimen]]\nradius_mm = 12.5\nheight_mm = 12.5\n" + tests + '[fit]\nlaws = ["neo_hooke"]\n',
                    encoding="utf-8")
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    return result


def test_tests_that_differ_in_stiffness_only_are_named_where_a_common_law_misses_them(tmp_path):
    result = organs(tmp_path, 6e3, 8.1e3)
    assert failing(result.best) == ["explained"] and "another law" not in result.best.unusable
    assert re.search(r"disagree in stiffness, not in shape \(.*: liver 0\.\d+, kidney 1\.\d+\); different materials\?",
                     result.best.unusable)


def test_tests_of_one_kind_that_disagree_are_named_with_their_moduli(tmp_path):
    result = organs(tmp_path, 6e3, 15e3)
    assert "replicates" in failing(result.best) and "another law" not in result.best.unusable
    assert result.best.unusable.startswith("tests of lubricated_compression disagree: liver ")
    assert "kidney" in result.message and "different materials?" in result.message


def test_an_undetermined_modulus_is_not_usable_and_an_undetermined_c20_is(tmp_path):
    free = calibrate(tmp_path, [compression()], ["reduced_polynomial_2"]).reduced_polynomial_2
    assert free.not_identifiable == ["C20"] and free.unusable is None
    loud = tmp_path / "loud"
    loud.mkdir()
    noisy = calibrate(loud, [compression(noise=20.0)], ["neo_hooke"], noise="force_N = 20.0").neo_hooke
    assert failing(noisy) == ["determined"] and noisy.status == "not_determined"
    assert "do not determine the shear modulus" in noisy.unusable and "limit is 25%" in noisy.unusable


@pytest.mark.parametrize(("missing", "stated", "held"), [(0.5, (), ("b",)), (0.5, ("b",), ()), (0.0, (), ())])
def test_a_modulus_that_depends_on_a_bound_that_is_not_stated(missing, stated, held):
    """Data a x + missing x^2 with noise, fitted with a x + b x^2 and b held at 0; the modulus is a."""
    x = np.linspace(0.0, 1.0, 50)
    jacobian = np.column_stack([x, x**2]) / 0.01
    data = (x + missing * x**2) / 0.01 + np.random.default_rng(0).normal(0.0, 1.0, x.size)
    a = float(jacobian[:, 0] @ data / (jacobian[:, 0] @ jacobian[:, 0]))
    residual = jacobian[:, 0] * a - data
    space = SimpleNamespace(free=("a", "b"), get_values_by_name=lambda theta: theta,
                            compute_typical_parameter_sizes=lambda values: np.ones(2))
    estimate = SimpleNamespace(theta=np.array([a, 0.0]), problem=SimpleNamespace(space=space),
                               evaluation=SimpleNamespace(projected_residual_and_jacobian=(residual, jacobian)))
    spread = SimpleNamespace(on_bound=np.array([False, True]), covariance=np.diag([1e-4, 0.0]),
                             ratio=float(np.sqrt(np.mean(residual**2))))
    found = assess_modulus_error_and_bound_dependence(estimate, spread, lambda theta: float(theta[0]), stated)
    assert found.held == held and found.is_precise_enough
    if held:
        assert found.change == pytest.approx(1.0 / a - 1.0, abs=0.02)


def test_a_stretch_below_zero_is_an_error_of_the_recording(tmp_path):
    elongation = np.linspace(0.0, 4e-3, 40)
    stretch = 1.0 + elongation / HEIGHT
    force = ts.find_law("neo_hooke").nominal_stress(stretch, {"C10": 10e3}) * AREA
    elongation = elongation.copy()
    elongation[20:22] = -30e-3
    path = write(tmp_path, [ts.Recording({"displacement": elongation, "force": force})], ["neo_hooke"],
                 "uniaxial_tension")
    path.write_text(path.read_text().replace('kind = "uni', 'leave_out = []\nkind = "uni'), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"the stretch must be above zero; got -1\.4"):
        calibration.calibrate([path], tmp_path / "out", figures=False)


def test_own_limits_decide_and_are_recorded_in_the_result(tmp_path):
    bent = compression(law="reduced_polynomial_3", values={"C10": 10.0, "C20": 0.0, "C30": 1e5}, noise=1e-4, strain=0.4)
    path, out = write(tmp_path, [bent], ["neo_hooke"]), tmp_path / "out"
    strict, = calibration.calibrate([path], out, figures=False)
    assert strict.best.status == "misfit" and calibration.to_json_dictionary([strict])["usability_settings"] == {}
    lenient = UsabilitySettings(noise_ratio=1e6)
    found, = calibration.calibrate([path], out, figures=False, overwrite=True, usability=lenient)
    assert {"residuals", "explained"}.isdisjoint(failing(found.best)) and found.digest != strict.digest
    assert calibration.to_json_dictionary([found])["usability_settings"] == {"noise_ratio": 1e6}
    again, = calibration.calibrate([path], out, figures=False, usability=lenient)
    assert again.resumed and again.usability_settings == {"noise_ratio": 1e6}


@pytest.mark.parametrize(("limits", "words"), [
    ({"smallest_R2": 1.0}, "smallest_R2 must be below 1; got 1"),
    ({"largest_residual": 0.0}, "largest_residual must be positive; got 0")])
def test_limits_without_meaning_are_refused(limits, words):
    with pytest.raises(ts.InputError, match=re.escape(words)):
        UsabilitySettings(**limits)
