"""Fits of compressible foams: measured foam against another implementation, confined compression, refusals."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import tissue_sim as ts
from calibration import ImportOptions, InterpretationOverrides, calibrate, import_files
from calibration.report.fit_text import format_young_modulus
from calibration.report.quantities import ReportUnits, format_value_and_error

#: Name of the file -> kind of test, channel of its abscissa.
TESTS = {"UT": ("uniaxial_tension", "stretch"), "UC": ("lubricated_compression", "stretch"),
         "SS": ("simple_shear", "shear strain")}


def write_campaign(folder, curves, fit, specimen=""):
    """Write recordings and a campaign; curves: kind -> (channel, abscissa, nominal stress in Pa)."""
    lines = [specimen]
    for kind, (channel, abscissa, stress) in curves.items():
        ts.write_recording(ts.Recording({channel: abscissa, "nominal stress": stress}), folder / f"{kind}.csv")
        lines += ["[[test]]", f'name = "{kind}"', f'kind = "{kind}"', f'recordings = ["{kind}.csv"]']
    (folder / "study.toml").write_text("\n".join([*lines, "[fit]", *fit]) + "\n", encoding="utf-8")
    return folder / "study.toml"


def compute_stress(parameters, curves):
    """Stresses of all curves, Pa; written without the program, the lateral stretch by bisection."""
    mu, alpha, nu = parameters
    beta, found = nu / (1.0 - 2.0 * nu), []
    for kind, (_, x, _) in curves.items():
        if kind == "simple_shear":
            first = x / 2.0 + np.sqrt(1.0 + x**2 / 4.0)
            found.append(2.0 * mu / alpha * (first**alpha - first**-alpha) / (first + 1.0 / first))
            continue
        low, high = np.full(x.shape, -4.0), np.full(x.shape, 2.0)
        for _ in range(60):
            lateral = 0.5 * (low + high)
            positive = alpha * lateral > -alpha * beta * (np.log(x) + 2.0 * lateral)
            positive = positive if alpha > 0 else ~positive
            low, high = np.where(positive, low, lateral), np.where(positive, lateral, high)
        J = x * np.exp(2.0 * lateral)
        found.append(2.0 * mu / alpha * (x**alpha - J**(-alpha * beta)) / x)
    return np.concatenate(found)


@pytest.mark.parametrize(("foam", "rms"), [("leap", {"UT": 8.999, "UC": 2.058, "SS": 6.176}),
                                           ("turbo", {"UT": 13.855, "UC": 8.012, "SS": 3.507})])
def test_joint_fit_of_measured_foam_is_the_minimum(foam, rms, data_folder, tmp_path):
    """The reference descends from 10 random starts."""
    curves = {}
    for name, (kind, channel) in TESTS.items():
        x, stress = np.loadtxt(data_folder / "foam_compressible" / f"foam_{foam}__foam_{name}.csv", delimiter=",",
                               skiprows=1).T
        curves[kind] = (channel, x, 1e6 * stress)
    data = np.concatenate([stress for *_, stress in curves.values()])

    def compute_residual(parameters):
        return (compute_stress(parameters, curves) - data) / 1e5

    rng, low, high = np.random.default_rng(5), [1e3, -40.0, -0.9], [1e7, 40.0, 0.49]
    reference = min((least_squares(compute_residual, rng.uniform([3e4, -15.0, -0.3], [3e5, 20.0, 0.45]), x_scale="jac",
                                   bounds=(low, high)) for _ in range(10)), key=lambda each: each.cost)
    result, = calibrate([write_campaign(tmp_path, curves, ['laws = ["hyperfoam"]'])], tmp_path / "out", figures=False)
    found = list(result.fits[0].parameters.values())
    np.testing.assert_allclose(found, reference.x, rtol=1e-4)
    assert float(np.sum(compute_residual(found)**2)) <= 2.0 * reference.cost * (1.0 + 1e-8)
    parts = np.split(1e5 * compute_residual(found), np.cumsum([len(x) for _, x, _ in curves.values()])[:-1])
    for part, expected in zip(parts, rms.values(), strict=True):
        assert 1e-3 * np.sqrt(np.mean(part**2)) == pytest.approx(expected, rel=1e-3)
    material = ts.load_material(tmp_path / "out" / "hyperfoam_1.material.json")
    assert material.bulk.kind == "of_law" and material.parameters == pytest.approx(dict(result.fits[0].parameters))


def test_confined_compression_needs_no_bulk_modulus(tmp_path):
    law, exact = ts.find_law("hyperfoam_1"), [2e4, 5.0, 0.2]
    stretch = np.linspace(1.0, 0.6, 30)
    curves = {kind: ("stretch", stretch, law.nominal_stress(stretch, exact, mode))
              for kind, mode in (("confined_compression", "confined"), ("lubricated_compression", "uniaxial"))}
    specimen = '[[specimen]]\nname = "foam"\nradius_mm = 20\nheight_mm = 20\n'
    path = write_campaign(tmp_path, curves, ['laws = ["hyperfoam"]'], specimen)
    result, = calibrate([path], tmp_path / "out", figures=False)
    np.testing.assert_allclose(list(result.fits[0].parameters.values()), exact, rtol=1e-5)


def write_true_stress_campaign(folder, kind, mode, laws, measure="true"):
    """Write stretch and true stress of a foam with mu 10 kPa, alpha 4, nu 0.2, and their campaign."""
    stretch, law = np.linspace(1.0, 0.7, 30), ts.find_law("hyperfoam_1")
    stretches = law.compute_principal_stretches(stretch, [1e4, 4.0, 0.2], mode)
    _, tau = law.compute_energy_and_kirchhoff_stresses(stretches, [1e4, 4.0, 0.2])
    np.savetxt(folder / "foam.csv", np.stack([stretch, tau[:, 0] / stretches.prod(axis=1)], axis=-1), delimiter=",",
               header="stretch,true stress (Pa)", comments="")
    stress = '"true stress (Pa)"' if measure is None else f'{{name = "true stress (Pa)", measure = "{measure}"}}'
    (folder / "study.toml").write_text("\n".join([
        '[[specimen]]', 'name = "foam"', "radius_mm = 20", "height_mm = 20",
        "[[test]]", 'name = "foam"', f'kind = "{kind}"', 'recordings = ["foam.csv"]', 'specimen = "foam"',
        "[test.columns]", 'stretch = "stretch"', f'"nominal stress" = {stress}', "[fit]", f"laws = {laws}"]) + "\n",
        encoding="utf-8")
    return folder / "study.toml"


@pytest.mark.parametrize(("laws", "volume"), [
    ('["hyperfoam"]', "compressible with the volumetric response of hyperfoam_1"),
    ('["hyperfoam", "neo_hooke"]', "compressible with the volumetric response of hyperfoam_1, and with the other laws "
     "incompressible"), ('["neo_hooke"]', "incompressible")])
def test_report_states_the_change_of_volume(laws, volume, tmp_path):
    law, exact = ts.find_law("hyperfoam_1"), [2e4, 5.0, 0.2]
    stretch = np.linspace(1.0, 0.6, 30)
    curves = {"lubricated_compression": ("stretch", stretch, law.nominal_stress(stretch, exact))}
    calibrate([write_campaign(tmp_path, curves, [f"laws = {laws}"])], tmp_path / "out", figures=False)
    methods, page = ((tmp_path / "out" / name).read_text(encoding="utf-8") for name in ("methods.txt", "report.html"))
    assert f"The material is {volume}." in methods and f"The material is {volume}. It is elastic" in page
    assert ("Storåkers" in methods) == ("hyperfoam" in laws)
    assert "incompressible" in volume or "incompressible" not in methods


def test_error_of_young_modulus_contains_that_of_poisson_ratio(tmp_path):
    """E = 2 mu (1 + nu): its variance has the terms of mu, nu and their covariance."""
    law, exact = ts.find_law("hyperfoam_1"), [2e4, 5.0, 0.2]
    stretch, rng = np.linspace(1.0, 0.6, 60), np.random.default_rng(3)
    stress = law.nominal_stress(stretch, exact) + 100.0 * rng.standard_normal(60)
    path = write_campaign(tmp_path, {"lubricated_compression": ("stretch", stretch, stress)}, ['laws = ["hyperfoam"]'])
    result, = calibrate([path], tmp_path / "out", figures=False)
    fit = result.best
    mu, nu = fit.parameters["mu1"], fit.parameters["nu1"]
    order = list(fit.covariance.order)
    rates = np.array([{"mu1": 2.0 * (1.0 + nu), "nu1": 2.0 * mu}.get(name, 0.0) for name in order])
    error = float(np.sqrt(rates @ np.array(fit.covariance.matrix) @ rates))
    units = ReportUnits.choose_for_best_fit(result)
    assert format_young_modulus(fit, units) == format_value_and_error(
        2.0 * mu * (1.0 + nu) / units.pressure.size, error / units.pressure.size, units.pressure.name)


@pytest.mark.parametrize(("kind", "mode", "laws", "message"), [
    ("lubricated_compression", "uniaxial", '["neo_hooke", "hyperfoam"]', "must have nominal stress with hyperfoam_1"),
    ("confined_compression", "confined", '["hyperfoam"]', "equals the true one"),
    ("confined_compression", "confined", '["neo_hooke"]\nbulk_ratio = 2.0', "equals the true one")])
def test_true_stress_of_a_foam_is_refused(kind, mode, laws, message, tmp_path):
    with pytest.raises(ts.InputError, match=message):
        calibrate([write_true_stress_campaign(tmp_path, kind, mode, laws)], tmp_path / "out", figures=False)


def test_stresses_that_do_not_depend_on_the_volume_are_fitted(tmp_path):
    """Between lateral walls the true stress is the nominal one."""
    path = write_true_stress_campaign(tmp_path, "confined_compression", "confined", '["hyperfoam"]', None)
    stretch, law = np.linspace(1.0, 0.7, 30), ts.find_law("hyperfoam_1")
    measured = np.loadtxt(tmp_path / "foam.csv", delimiter=",", skiprows=1)[:, 1]
    np.testing.assert_allclose(measured, law.nominal_stress(stretch, [1e4, 4.0, 0.2], "confined"), rtol=1e-9)
    result, = calibrate([path], tmp_path / "out", figures=False)
    assert result.fits[0].RMSE_Pa < 1.0


def test_import_refuses_true_stress_with_a_compressible_law(tmp_path):
    write_true_stress_campaign(tmp_path, "lubricated_compression", "uniaxial", '["hyperfoam"]')
    wishes = ImportOptions(InterpretationOverrides(kind="lubricated_compression"), laws=("hyperfoam_1",))
    imported = import_files([tmp_path / "foam.csv"], tmp_path / "imported.toml", wishes)
    assert imported.problem is not None and "must have nominal stress with hyperfoam_1" in imported.problem


@pytest.mark.parametrize(("kind", "line", "message"), [
    ("lubricated_compression", "bulk_ratio = 10.0", r"fit\.bulk_ratio.*must not be given with hyperfoam"),
    ("lubricated_compression", "start = {\"bulk.K_Pa\" = 1e4}", r"fit\.start\.bulk\.K_Pa.*must not be given with"),
    ("lubricated_compression", "start = {\"viscoelastic.terms[0].g\" = 0.2, \"viscoelastic.terms[0].tau_s\" = 1.0}",
     r"viscoelastic.*must not be fitted with hyperfoam"),
    ("lubricated_compression", "stable = true", r"fit\.stable.*must be false with hyperfoam.*Use hyperfoam_1"),
    ("torsion", "", r"fit\.laws.*torsion has a closed form of constant volume only"),
])
def test_refusals(kind, line, message, tmp_path):
    stretch = np.linspace(1.0, 0.8, 20)
    curves = {kind: ("stretch" if kind != "torsion" else "shear strain", stretch, -1e3 * (1.0 - stretch))}
    with pytest.raises(ts.InputError, match=message):
        calibrate([write_campaign(tmp_path, curves, ['laws = ["hyperfoam"]', line])], tmp_path / "out", figures=False)
