"""Calibration of specimens that weigh: recovery, what ignoring gravity costs, and what is said about it."""

import json
from dataclasses import replace

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.closed import ColumnTest
from calibration.forward.forms import build_closed_form_or_column_test
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.closed_form.column import Column

LAW = ts.find_law("reduced_polynomial_2")
PHANTOM = {"C10": 1404.9, "C20": 699.4}
STUDY = ts.Specimen(0.04, 0.07, density=1040.0, gravity=9.81)
GRAVITY = "gravity = true\ndensity_kg_m3 = 1040.0"


def compression(specimen=STUDY, values=PHANTOM, *, depth=9.8e-3, points=41, offset=0.0, noise=0.0, seed=0):
    """A lubricated compression of a specimen that settled."""
    displacement = np.linspace(0.0, depth, points)
    force = -specimen.area * Column(specimen).nominal_stress(LAW, displacement - offset, values)
    force += np.random.default_rng(seed).normal(0.0, noise, points)
    return ts.Recording({"displacement": displacement, "force": force})


def write_campaign(folder, recordings, specimen, *, fit='laws = ["reduced_polynomial_2"]', noise="", test="",
                   kind="lubricated_compression"):
    folder.mkdir(exist_ok=True)
    for i, recording in enumerate(recordings):
        ts.write_recording(recording, folder / f"run_{i}.csv")
    path = folder / "study.toml"
    path.write_text(f'[[specimen]]\n{specimen}\n[[test]]\nkind = "{kind}"\nrecordings = ["run_*.csv"]\n{test}\n'
                    f"[fit]\n{fit}\n[noise]\n{noise}\n", encoding="utf-8")
    return path


def run(folder, recordings, specimen, **keys):
    result, = calibration.calibrate([write_campaign(folder, recordings, specimen, **keys)], folder / "out",
                                    figures=False, overwrite=True)
    return result


def errors(fit):
    """Percent by which the parameters miss the truth."""
    return [100 * (fit.parameters[name] / value - 1) for name, value in PHANTOM.items()]


def test_confined_compression_under_weight_needs_the_finite_elements(tmp_path):
    path = write_campaign(tmp_path, [compression()], f"radius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY}",
                          kind="confined_compression", fit='laws = ["neo_hooke"]\nbulk_ratio = 8.0')
    with pytest.raises(ts.InputError, match=r"gravity = true has no closed form in confined_compression\. Set"):
        calibration.calibrate([path], tmp_path / "out", figures=False)


@pytest.mark.parametrize("shape", ["radius_mm = 40.0", f'shape = "prism"\narea_mm2 = {1600 * np.pi}'])
@pytest.mark.parametrize("height_is", ["moulded", "placed"])
def test_with_gravity_the_parameters_come_back(tmp_path, shape, height_is):
    settled = Column(STUDY).settle(LAW, PHANTOM)
    height = {"moulded": settled.moulded_height, "placed": settled.height}[height_is]
    specimen = f'{shape}\nheight_mm = {height * 1e3}\nheight_is = "{height_is}"\n{GRAVITY}'
    fit = run(tmp_path, [compression()], specimen).best
    assert fit.parameters == pytest.approx(PHANTOM, rel=1e-6)
    assert fit.sag_mm == {"specimen": pytest.approx(2.780, abs=5e-4)}
    # The base is compressed more than the displacement over the height says.
    base = float(Column(STUDY).base_stretch_at_displacement(LAW, 9.8e-3, PHANTOM))
    assert fit.stretch_range == pytest.approx((base, base**-0.5), rel=1e-5)
    assert base < 1 - 9.8 / 70


@pytest.mark.parametrize(("density", "moulded", "as_placed"), [
    # 41 points to 10 mm; the height and the radius as they are on the plate, or the height alone.
    (1000.0, (12.1, 88.4), (3.5, 51.0)),
    (1040.0, (12.7, 92.0), (3.7, 52.7))])
def test_without_gravity_they_err(tmp_path, density, moulded, as_placed):
    """C10 and C20 in percent, while the curve fits to R2 0.99999; 12 and 88, 3 and 51 are the known figures."""
    specimen = replace(STUDY, density=density)
    height = Column(specimen).settle(LAW, PHANTOM).height
    recordings = [compression(specimen, depth=10e-3)]
    fit = run(tmp_path / "moulded", recordings, "radius_mm = 40.0\nheight_mm = 70.0").best
    assert errors(fit) == pytest.approx(moulded, abs=0.1)
    assert fit.R2 > 0.99998 and fit.sag_mm == {}
    # The radius of the settled cylinder, whose volume is that of the moulded one.
    radius = 40.0 * np.sqrt(0.07 / height)
    fit = run(tmp_path / "placed", recordings,
              f'radius_mm = {radius}\nheight_mm = {height * 1e3}\nheight_is = "placed"').best
    assert errors(fit) == pytest.approx(as_placed, abs=0.1)
    assert fit.R2 > 0.99998


def test_the_wrong_height_errs_less_than_no_weight(tmp_path):
    height = Column(STUDY).settle(LAW, PHANTOM).height * 1e3
    fit = run(tmp_path / "a", [compression()], f'radius_mm = 40.0\nheight_mm = {height}\n{GRAVITY}').best
    assert errors(fit) == pytest.approx([-3.8, -17.0], abs=0.1)
    fit = run(tmp_path / "b", [compression()], f'radius_mm = 40.0\nheight_mm = 70.0\nheight_is = "placed"\n{GRAVITY}')
    assert errors(fit.best) == pytest.approx([3.9, 19.5], abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["neo_hooke", "mooney_rivlin", "reduced_polynomial_3", "ogden_1", "ogden_2"])
def test_every_law_finds_its_own_curve(tmp_path, law):
    found = ts.find_law(law)
    values = {"neo_hooke": [300.0], "mooney_rivlin": [300.0, 200.0], "reduced_polynomial_3": [800.0, 60.0, 30.0],
              "ogden_1": [1200.0, 9.0], "ogden_2": [900.0, 3.0, 400.0, -6.0]}[law]
    displacement = np.linspace(0.0, 25e-3, 60)
    force = -STUDY.area * Column(STUDY).nominal_stress(found, displacement, values)
    fit = run(tmp_path, [ts.Recording({"displacement": displacement, "force": force})],
              f"radius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY}", fit=f'laws = ["{law}"]').best
    assert fit.RMSE_N / force.max() < 1e-7
    assert fit.mu0 == pytest.approx(found.mu0(values), rel=1e-5)


def test_two_thirds_of_the_height_with_noise(tmp_path):
    """Far from the guess that the starts are made of: a linear solve along the weighing curve led nowhere."""
    specimen = ts.Specimen(0.025, 0.03, density=1040.0, gravity=9.81)
    law, values = ts.find_law("reduced_polynomial_3"), {"C10": 800.0, "C20": 45.0, "C30": 18.0}
    displacement = np.linspace(0.0, 20e-3, 300)
    force = -specimen.area * Column(specimen).nominal_stress(law, displacement, values)
    recordings = [ts.Recording({"displacement": displacement, "force": scale * force}) for scale in (0.98, 1.0, 1.02)]
    fit = run(tmp_path, recordings, f"radius_mm = 25.0\nheight_mm = 30.0\n{GRAVITY}",
              fit='laws = ["reduced_polynomial_3"]').best
    assert fit.status == "converged"
    assert fit.parameters == pytest.approx(values, rel=0.02)


def test_offsets_beside_gravity(tmp_path):
    recordings = [compression(depth=20e-3, points=150, offset=offset, noise=0.005, seed=i)
                  for i, offset in enumerate((0.1e-3, -0.05e-3, 0.0))]
    specimen = f"radius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY}"
    offsets = 'laws = ["reduced_polynomial_2"]\noffset = "fit"\noffset_prior_mm = 0.1\nzero_prior_N = 0.02'
    fit = run(tmp_path, recordings, specimen, fit=offsets, noise="force_N = 0.005").best
    for found, offset in zip(fit.nuisances, (0.1, -0.05, 0.0), strict=True):
        assert abs(found.contact_offset_mm - offset) < 4 * found.contact_offset_error_mm < 0.2
    for name, value in PHANTOM.items():
        assert abs(fit.parameters[name] - value) < 4 * fit.standard_errors[name]
    assert fit.noise_ratio == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_intervals_hold_the_truth_with_jitter(tmp_path):
    """Standard errors of C10 against the scatter of 40 calibrations with a contact jitter of 0.1 mm."""
    specimen = f"radius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY}"
    answers, stated = [], []
    random = np.random.default_rng(1)
    for i in range(40):
        recordings = [compression(points=60, offset=random.normal(0.0, 0.1e-3), noise=0.02, seed=random.integers(1e6))]
        fit = run(tmp_path / str(i), recordings, specimen, noise="force_N = 0.02\ncontact_jitter_mm = 0.1").best
        answers.append(fit.parameters["C10"])
        stated.append(fit.standard_errors["C10"])
    assert np.median(stated) == pytest.approx(np.std(answers), rel=0.35)


@pytest.mark.parametrize("weighs", [False, True])
def test_slopes_of_the_forward_model(tmp_path, weighs):
    path = write_campaign(tmp_path, [compression()], f"radius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY if weighs else ''}")
    campaign = calibration.load_campaign(path)
    (test,), (curves,) = campaign.tests, calibration.read_measured_curves(campaign).values()
    # Before the touch, on the way, and the deepest point, which stays: the curve is sampled alike.
    places = STUDY.height * np.array([-0.05, 0.02, 0.07, 0.14])
    form = build_closed_form_or_column_test(test, [replace(curves[0], displacement=places, force=np.zeros(4))],
                                            campaign.fit)
    assert isinstance(form, ColumnTest) == weighs
    space, width = ParameterSpace.from_campaign("reduced_polynomial_2", campaign), 1e-6 * STUDY.height
    answer = form.solve(space, np.array(list(PHANTOM.values())), SimulationCache())
    force, rates, contact = form.evaluate_force_and_derivatives(answer, 0, 0.0)
    assert force[0] == contact[0] == 0 and not rates[0].any()
    numeric = (form.evaluate_force_and_derivatives(answer, 0, width)[0]
               - form.evaluate_force_and_derivatives(answer, 0, -width)[0]) / (2 * width)
    np.testing.assert_allclose(contact[:3], numeric[:3], rtol=1e-6)
    for i, step in enumerate(1e-6 * np.eye(2) * list(PHANTOM.values())):
        truth = np.array(list(PHANTOM.values()))
        ends = [form.evaluate_force_and_derivatives(form.solve(space, truth + sign * step, SimulationCache()), 0,
                                                    0.0)[0]
                for sign in (1, -1)]
        np.testing.assert_allclose(rates[:, i], (ends[0] - ends[1]) / (2 * step[i]), rtol=1e-5)


def test_reports_say_what_gravity_was_assumed(tmp_path):
    specimen = f"radius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY}"
    result = run(tmp_path / "on", [compression()], specimen)
    line = "Self-weight: 1040 kg/m3 at 9.81 m/s2, settled before the test; height 70 mm as moulded, sag 2.78 mm."
    assert calibration.to_json_dictionary([result])["self_weight"] == line
    out = tmp_path / "on" / "out"
    assert line in (out / "report.html").read_text(encoding="utf-8")
    saved = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    assert saved["self_weight"] == line and saved["fits"][0]["sag_mm"] == {"specimen": pytest.approx(2.780, abs=1e-3)}
    material = ts.read_material_file(out / "reduced_polynomial_2.material.json")
    assert material.provenance.settings["self_weight"] == line
    assert material.valid_range.stretch[0] < 0.81
    assert (out / "curves.csv").read_text(encoding="utf-8").count("1 - displacement/height [-]") == 101
    again, = calibration.calibrate([tmp_path / "on" / "study.toml"], out, figures=False)
    assert again.resumed and calibration.to_json_dictionary([again]) == calibration.to_json_dictionary([result])

    result = run(tmp_path / "off", [compression()], 'radius_mm = 40.0\nheight_mm = 70.0\nheight_is = "placed"')
    line = ("Self-weight is not included: the height, 70 mm as placed, is taken for the undeformed one; standing at "
            "1000 kg/m3 (water) it would sag 2.6 mm.")
    assert calibration.to_json_dictionary([result])["self_weight"] == line
    assert line in (tmp_path / "off" / "out" / "report.html").read_text(encoding="utf-8")


def test_specimens_are_named_where_there_are_several(tmp_path):
    path = write_campaign(tmp_path, [compression()], f'name = "phantom"\nradius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY}',
                          test='specimen = "phantom"')
    more = ('[[specimen]]\nname = "small"\nradius_mm = 40.0\nheight_mm = 70.0\ndensity_kg_m3 = 1040.0\n[[test]]\n'
            'specimen = "small"\nname = "second"\nkind = "lubricated_compression"\nrecordings = ["run_0.csv"]\n'
            'hold_out = true\n')
    path.write_text(path.read_text(encoding="utf-8").replace("[fit]", more + "[fit]"), encoding="utf-8")
    result, = calibration.calibrate([path], tmp_path / "out", figures=False)
    line = calibration.to_json_dictionary([result])["self_weight"]
    assert line.startswith("Self-weight of phantom: 1040 kg/m3")
    assert "Self-weight of small is not included" in line and "standing at 1040 kg/m3 it would sag 2.8 mm" in line
    # The held-out test stands without weight: the forces differ as the two closed forms do.
    assert result.predictions[0].percent > 5


@pytest.mark.slow
def test_a_held_out_test_that_the_law_does_not_carry_has_no_error(tmp_path):
    softening = {"C10": 1600.0, "C20": -500.0}
    path = write_campaign(tmp_path, [compression(values=softening, depth=8e-3)],
                          f"radius_mm = 40.0\nheight_mm = 70.0\n{GRAVITY}", fit='laws = ["reduced_polynomial_2"]')
    deep = np.linspace(0.0, 35e-3, 60)
    ts.write_recording(ts.Recording({"displacement": deep, "force": 800 * deep}), tmp_path / "deep.csv")
    more = '[[test]]\nname = "deep"\nkind = "lubricated_compression"\nrecordings = ["deep.csv"]\nhold_out = true\n'
    path.write_text(path.read_text(encoding="utf-8").replace("[fit]", more + "[fit]"), encoding="utf-8")
    result, = calibration.calibrate([path], tmp_path / "out")
    prediction, = result.predictions
    assert (prediction.RMSE_N, prediction.RMSE_Pa, prediction.percent) == (None, None, None)
    for name in ("curves.csv", "residuals.csv"):
        assert "nan" not in (tmp_path / "out" / name).read_text(encoding="utf-8")
    assert "<td>-</td><td>-</td><td>-</td>" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def refused(path, field, hint):
    with pytest.raises(ts.InputError, match=hint) as error:
        calibration.calibrate([path], path.parent / "out", figures=False)
    assert error.value.field == field
    assert not (path.parent / "out").exists()


def test_what_gravity_needs(tmp_path):
    specimen = "radius_mm = 40.0\nheight_mm = 70.0\n"
    recordings = [compression()]
    refused(write_campaign(tmp_path, recordings, specimen + "gravity = true"), "specimen[0].density_kg_m3",
            "gravity = true requires the density")
    for kind in ("uniaxial_tension", "simple_shear"):
        refused(write_campaign(tmp_path, recordings, specimen + GRAVITY, kind=kind), "test[0].specimen",
                f"{kind} does not define the direction of gravity")
    stretch = np.linspace(1.0, 0.9, 20)
    table = ts.Recording({"stretch": stretch, "nominal stress": LAW.nominal_stress(stretch, PHANTOM)})
    refused(write_campaign(tmp_path, [table], specimen + GRAVITY), "test[0].recordings",
            "vary over the height with gravity = true; use displacement and force")


@pytest.mark.parametrize("fit", ["", "fixed = { C10 = 1.0 }"])
def test_a_specimen_too_heavy_for_the_law(tmp_path, fit):
    density = "1.04e7" if not fit else "1040"
    path = write_campaign(tmp_path, [compression()], "radius_mm = 40.0\nheight_mm = 70.0\ngravity = true\n"
                          f"density_kg_m3 = {density}", fit=f'laws = ["neo_hooke"]\n{fit}')
    with pytest.raises(ts.ConvergenceError, match="too heavy for it, so check density_kg_m3"):
        calibration.calibrate([path], tmp_path / "out", figures=False)
