"""The closed-form fit: the study's tables, recovery of parameters, offsets."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import calibration
import tissue_sim as ts

STUDY = {"C10": 1404.9, "C20": 699.4}
LAWS = ["neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "ogden_1"]


def run(folder, recordings, fit, *, test="", noise="", kind="lubricated_compression"):
    """Fits of a campaign on these recordings of the study's specimen."""
    folder.mkdir(exist_ok=True)
    for i, recording in enumerate(recordings):
        ts.write_recording(recording, folder / f"run_{i:02d}.csv")
    path = folder / "study.toml"
    path.write_text(f"""
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "{kind}"
recordings = ["run_*.csv"]
{test}
[fit]
{fit}
[noise]
{noise}
""", encoding="utf-8")
    result, = calibration.calibrate([path], folder / "out", figures=False, overwrite=True)
    return {fit.law: fit for fit in result.fits}


def compression(law, values, *, points=41, strain=0.14, force_noise=0.0, offset=0.0, zero=0.0, seed=0):
    """A lubricated compression of the study's specimen."""
    displacement = np.linspace(0.0, strain, points) * 70e-3
    stretch = np.minimum(1.0 - (displacement - offset) / 70e-3, 1.0)
    force = -ts.find_law(law).nominal_stress(stretch, values) * np.pi * 0.04**2 + zero
    force = force + np.random.default_rng(seed).normal(0.0, force_noise, points)
    return ts.Recording({"displacement": displacement, "force": force})


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """All laws of the study's table fitted to its polynomial, strain 0 to 0.14 in 41 points."""
    return run(tmp_path_factory.mktemp("study"), [compression("reduced_polynomial_2", STUDY)],
               f"laws = {LAWS}".replace("'", '"'), noise="force_N = 0.02")


def test_study_parameters(study):
    assert study["neo_hooke"].parameters["C10"] == pytest.approx(1461.6, abs=1.0)
    assert 620 <= study["mooney_rivlin"].parameters["C10"] <= 644
    assert 729 <= study["mooney_rivlin"].parameters["C01"] <= 750
    assert study["reduced_polynomial_2"].parameters == pytest.approx(STUDY, rel=1e-8)
    assert pytest.approx(1.0, abs=1e-12) == study["reduced_polynomial_2"].R2
    assert 0.99954 < study["mooney_rivlin"].R2 < 1.0


@pytest.mark.parametrize(("law", "parameters", "E0", "mu0"), [
    ("reduced_polynomial_2", STUDY, 8429.6, 2809.8),
    ("mooney_rivlin", {"C10": 624.3, "C01": 746.1}, 8223.0, 2741.0),
    ("ogden_1", {"mu1": 3225.9, "alpha1": 14.8}, 9677.9, 3225.9),
    ("neo_hooke", {"C10": 1461.6}, 8769.6, 2923.2),
])
def test_study_moduli(law, parameters, E0, mu0):
    assert ts.find_law(law).E0(parameters) == pytest.approx(E0, abs=1.0)
    assert ts.find_law(law).mu0(parameters) == pytest.approx(mu0, abs=1.0)


def test_ogden_has_two_minima_and_the_global_one_is_found(study):
    fit = study["ogden_1"]
    best, second = fit.minima
    assert fit.parameters == best.parameters
    assert best.parameters["mu1"] == pytest.approx(2729, rel=2e-3)
    assert best.parameters["alpha1"] == pytest.approx(-0.57, abs=0.05)
    assert pytest.approx(0.99997, abs=5e-6) == best.R2
    # The values of the study are (3225.9, 14.8).
    assert second.parameters["mu1"] == pytest.approx(3226, rel=0.01)
    assert second.parameters["alpha1"] == pytest.approx(14.8, rel=0.05)
    assert second.R2 < best.R2 - 5e-4
    assert best.starts + second.starts == fit.starts


def test_start_alone_does_not_choose_the_minimum(tmp_path):
    fits = run(tmp_path, [compression("reduced_polynomial_2", STUDY)],
               'laws = ["ogden_1"]\nstart = { mu1 = 3226.0, alpha1 = 14.8 }')
    assert fits["ogden_1"].parameters["alpha1"] < 0


def test_bounds_can_choose_the_second_minimum(tmp_path):
    fits = run(tmp_path, [compression("reduced_polynomial_2", STUDY)],
               'laws = ["ogden_1"]\nbounds = { alpha1 = [5, 25] }')
    assert fits["ogden_1"].parameters["alpha1"] == pytest.approx(14.3, abs=0.3)


def test_fixed_prior_and_bound(tmp_path):
    recording = compression("reduced_polynomial_2", STUDY)
    law = "reduced_polynomial_2"
    fit = run(tmp_path, [recording], f'laws = ["{law}"]\nfixed = {{ C10 = 1300.0 }}')[law]
    assert fit.parameters["C10"] == 1300.0
    assert fit.standard_errors["C10"] == 0.0
    assert fit.parameters["C20"] > STUDY["C20"]
    fit = run(tmp_path, [recording], 'laws = ["reduced_polynomial_2"]\nprior = { C20 = [100.0, 0.01] }',
              noise="force_N = 0.02")["reduced_polynomial_2"]
    assert fit.parameters["C20"] == pytest.approx(100.0, abs=0.1)
    fit = run(tmp_path, [recording], f'laws = ["{law}"]\nbounds = {{ C20 = [0.0, 50.0] }}')[law]
    assert fit.parameters["C20"] == pytest.approx(50.0, rel=1e-6)
    assert fit.on_bound == ["C20"]
    assert fit.warnings == ["C20 ended on its bound 50"] and fit.warnings[0] in fit.message
    # Nothing is known about what a bound holds; the other one is as sure as if it had been fixed.
    assert fit.standard_errors["C20"] is None and fit.intervals95["C20"] is None
    held = run(tmp_path, [recording], f'laws = ["{law}"]\nfixed = {{ C20 = 50.0 }}')[law]
    assert fit.standard_errors["C10"] == pytest.approx(held.standard_errors["C10"], rel=1e-3)


def test_priors_and_bounds_with_replicates_that_scatter(tmp_path):
    """The scatter of the replicates is added to what is free, and to nothing else."""
    recordings = [compression("mooney_rivlin", [scale, scale], force_noise=0.01, seed=i)
                  for i, scale in enumerate((680.0, 700.0, 730.0))]
    fit = run(tmp_path, recordings, 'laws = ["mooney_rivlin"]\nprior = { C10 = [700.0, 1.0] }',
              noise="force_N = 0.01")["mooney_rivlin"]
    assert fit.covariance_from == "replicates"
    assert fit.standard_errors["C10"] < 1.5
    fit = run(tmp_path, recordings, 'laws = ["mooney_rivlin"]\nbounds = { C01 = [2000.0, 5000.0] }',
              noise="force_N = 0.01")["mooney_rivlin"]
    assert fit.on_bound == ["C01"] and fit.standard_errors["C01"] is None
    free = run(tmp_path, recordings, 'laws = ["mooney_rivlin"]\nfixed = { C01 = 2000.0 }',
               noise="force_N = 0.01")["mooney_rivlin"]
    assert fit.standard_errors["C10"] == pytest.approx(free.standard_errors["C10"], rel=1e-3)
    near = run(tmp_path, recordings, 'laws = ["mooney_rivlin"]\nbounds = { C10 = [690.0, 5000.0] }',
               noise="force_N = 0.01")["mooney_rivlin"]
    assert near.intervals95["C10"] is None or near.intervals95["C10"][0] >= 690.0


def test_a_prior_counts_in_the_ranking(tmp_path):
    """A prior far from the data: a law that must break it does not win over the one in which it is nested."""
    fits = run(tmp_path, [compression("reduced_polynomial_2", STUDY, force_noise=0.02)],
               'laws = ["neo_hooke", "reduced_polynomial_2"]\nprior = { C10 = [500.0, 1.0] }', noise="force_N = 0.02")
    assert fits["neo_hooke"].BIC > fits["reduced_polynomial_2"].BIC


def test_quantised_forces_have_the_noise_of_their_step(tmp_path):
    exact = compression("neo_hooke", [1461.6], points=5000)
    recording = exact.with_channels(force=0.02 * np.round(exact.force / 0.02))
    fit = run(tmp_path, [recording], 'laws = ["neo_hooke"]')["neo_hooke"]
    assert fit.noise_ratio == pytest.approx(1.0, abs=0.1)
    assert fit.status == "converged" and "model error" not in fit.message
    assert "resolution of the sensor" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_strain_points_do_not_make_the_errors_smaller(tmp_path):
    answers, errors = [], []
    for seed in range(60):
        recording = compression("neo_hooke", [1461.6], force_noise=0.02, seed=seed)
        fit = run(tmp_path / str(seed), [recording], 'laws = ["neo_hooke"]\nstrain_points = 33',
                  noise="force_N = 0.02")["neo_hooke"]
        answers.append(fit.parameters["C10"])
        errors.append(fit.standard_errors["C10"])
    assert np.median(errors) == pytest.approx(np.std(answers), rel=0.3)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(law=st.sampled_from(LAWS), scale=st.floats(300.0, 3e5), shape=st.floats(0.2, 1.5), seed=st.integers(0, 999))
def test_recovers_parameters_from_noisy_data(tmp_path_factory, law, scale, shape, seed):
    values = {"neo_hooke": [scale], "mooney_rivlin": [scale, shape * scale],
              "reduced_polynomial_2": [scale, shape * scale], "ogden_1": [scale, 10 * shape]}[law]
    assume(np.isfinite(values).all())
    peak = compression(law, values, strain=0.5).force.max()
    recording = compression(law, values, strain=0.5, points=200, force_noise=1e-3 * peak, seed=seed)
    fit = run(tmp_path_factory.mktemp("noisy"), [recording], f'laws = ["{law}"]', noise=f"force_N = {1e-3 * peak}")[law]
    assert fit.covariance_from in ("noise", "residuals")
    for name, value in zip(ts.find_law(law).parameters, values, strict=True):
        assert abs(fit.parameters[name] - value) < 5 * fit.standard_errors[name]
        assert fit.standard_errors[name] < 0.2 * value


@pytest.mark.parametrize(("kind", "channel"), [("uniaxial_tension", "stretch"), ("simple_shear", "shear strain")])
def test_other_homogeneous_tests(tmp_path, kind, channel):
    law, values = ts.find_law("mooney_rivlin"), {"C10": 800.0, "C01": 300.0}
    mode = "simple_shear" if kind == "simple_shear" else "uniaxial"
    strain = np.linspace(0.0, 0.8, 50)
    direct = strain if kind == "simple_shear" else 1.0 + strain
    stress = law.nominal_stress(direct, values, mode)
    stated = ts.Recording({channel: direct, "nominal stress": stress})
    measured = ts.Recording({"displacement": strain * 70e-3, "force": stress * np.pi * 0.04**2})
    for recording in (stated, measured):
        fit = run(tmp_path / str(id(recording)), [recording], 'laws = ["mooney_rivlin", "neo_hooke"]', kind=kind)
        found = fit["mooney_rivlin"].parameters
        if kind == "simple_shear":
            # Simple shear sees the sum of the two only.
            assert found["C10"] + found["C01"] == pytest.approx(1100.0, rel=1e-6)
            assert set(fit["mooney_rivlin"].not_identifiable) == {"C10", "C01"}
            assert fit["neo_hooke"].parameters["C10"] == pytest.approx(1100.0, rel=1e-6)
        else:
            assert found == pytest.approx(values, rel=1e-6)
            assert fit["mooney_rivlin"].stretch_range == pytest.approx((1.8**-0.5, 1.8))


def test_offsets_are_recovered_and_a_bound_is_reported(tmp_path):
    recordings = [compression("reduced_polynomial_2", STUDY, points=150, strain=0.3, force_noise=0.005, offset=offset,
                              zero=zero, seed=i)
                  for i, (offset, zero) in enumerate([(0.1e-3, 0.01), (-0.05e-3, -0.01), (0.0, 0.0)])]
    settings = 'laws = ["reduced_polynomial_2"]\noffset = "fit"\noffset_prior_mm = 0.1\nzero_prior_N = 0.02'
    fit = run(tmp_path, recordings, settings, noise="force_N = 0.005")["reduced_polynomial_2"]
    for found, (offset, zero) in zip(fit.nuisances, [(0.1, 0.01), (-0.05, -0.01), (0.0, 0.0)], strict=True):
        assert abs(found.contact_offset_mm - offset) < 4 * found.contact_offset_error_mm
        assert abs(found.zero_offset_N - zero) < 4 * found.zero_offset_error_N
    assert abs(fit.parameters["C10"] - STUDY["C10"]) < 4 * fit.standard_errors["C10"]
    without = run(tmp_path, recordings, 'laws = ["reduced_polynomial_2"]',
                  noise="force_N = 0.005")["reduced_polynomial_2"]
    assert without.nuisances == []
    assert without.RMSE_N > 1.5 * fit.RMSE_N
    tight = run(tmp_path, recordings, settings + "\noffset_bounds_mm = 0.03",
                noise="force_N = 0.005")["reduced_polynomial_2"]
    assert tight.nuisances[0].on_bound == ["contact_offset_mm"]
    assert tight.nuisances[0].contact_offset_mm == pytest.approx(0.03, rel=1e-3)
    place = tight.nuisances[0].replicate
    assert f"{place}: contact_offset_mm ended on its bound 0.03" in tight.message


def test_samples_before_contact_feel_nothing(tmp_path):
    clean = compression("neo_hooke", [1000.0], points=30)
    early = ts.Recording({"displacement": np.concatenate([np.linspace(-5e-3, -1e-4, 20), clean.displacement]),
                          "force": np.concatenate([np.zeros(20), clean.force])})
    fit = run(tmp_path, [early], 'laws = ["neo_hooke"]')["neo_hooke"]
    assert fit.parameters["C10"] == pytest.approx(1000.0, rel=1e-9)


def test_unloading_and_hold_are_not_fitted(tmp_path):
    up = compression("neo_hooke", [1000.0], points=30)
    both = ts.Recording({"displacement": np.concatenate([up.displacement, np.full(9, up.displacement[-1]),
                                                         up.displacement[::-1]]),
                         "force": np.concatenate([up.force, np.full(9, 0.9 * up.force[-1]), 0.8 * up.force[::-1]])},
                        labels={"segment": ["ramp"] * 30 + ["hold"] * 9 + ["unload"] * 30})
    fit = run(tmp_path, [both], 'laws = ["neo_hooke"]')["neo_hooke"]
    assert fit.parameters["C10"] == pytest.approx(1000.0, rel=1e-9)


def test_evenly_spaced_points_and_window(tmp_path):
    # Dense at the start: unweighted samples would favour small strains.
    strain = 0.3 * np.linspace(0.0, 1.0, 400)**3
    force = -ts.find_law("reduced_polynomial_2").nominal_stress(1 - strain, STUDY) * np.pi * 0.04**2
    recording = ts.Recording({"displacement": strain * 70e-3, "force": force})
    fit = run(tmp_path, [recording], 'laws = ["neo_hooke"]\nstrain_points = 41', test="max_strain = 0.14")["neo_hooke"]
    assert fit.parameters["C10"] == pytest.approx(1461.6, abs=1.0)
    assert fit.stretch_range == pytest.approx((0.86, 0.86**-0.5), abs=1e-12)
