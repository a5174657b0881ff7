"""Calibration of biaxial tension: both axes jointly, from stretches and stresses or from displacements and forces."""

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration import ImportOptions, InterpretationOverrides
from calibration.campaign.measured import read_measured_curves
from calibration.effects.effect import DiagnosisData

LAW = ts.find_law("mooney_rivlin")
TRUTH = {"C10": 5000.0, "C01": 2000.0}
TIME = np.linspace(0.0, 10.0, 41)
#: Stretches along both axes, shape (n, 2).
STRETCH = np.stack([1.0 + 0.05 * TIME, 1.0 + 0.02 * TIME], axis=-1)
#: Sides of the sheet along axis 1 and axis 2, and its thickness, m.
SIDES = (0.020, 0.040, 0.002)
SHEET = '[[specimen]]\nshape = "block"\nheight_mm = 20.0\nlength_mm = 40.0\nwidth_mm = 2.0\n\n'
FIT = '[fit]\nlaws = ["mooney_rivlin"]\n'


def write(folder, name, stress, stretch=STRETCH, **channels):
    ts.write_recording(ts.Recording({
        "stretch": stretch[:, 0], "nominal stress": stress[:, 0], "stretch 2": stretch[:, 1],
        "nominal stress 2": stress[:, 1], **channels}), folder / f"{name}.csv")


def calibrate(folder, text):
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return calibration.calibrate([path], folder / "out", figures=False)[0]


def make_test(recordings="*.csv", kind="biaxial_tension", more=""):
    return f'[[test]]\nkind = "{kind}"\nrecordings = ["{recordings}"]\n{more}\n'


def test_stretches_and_stresses_give_the_parameters(tmp_path):
    write(tmp_path, "a", LAW.nominal_stress(STRETCH, TRUTH, "biaxial"), time=TIME)
    result = calibrate(tmp_path, make_test() + FIT)
    assert result.best.parameters == pytest.approx(TRUTH, rel=1e-8)
    assert [test.name for test in result.campaign.tests] == ["biaxial_tension axis 1", "biaxial_tension axis 2"]


def test_displacements_and_forces_give_the_parameters(tmp_path):
    """The force of an axis is its stress times the other side times the thickness."""
    stress = LAW.nominal_stress(STRETCH, TRUTH, "biaxial")
    first, second, thickness = SIDES
    ts.write_recording(ts.Recording({
        "displacement": (STRETCH[:, 0] - 1.0) * first, "force": stress[:, 0] * second * thickness,
        "displacement 2": (STRETCH[:, 1] - 1.0) * second, "force 2": stress[:, 1] * first * thickness}),
        tmp_path / "a.csv")
    assert calibrate(tmp_path, SHEET + make_test() + FIT).best.parameters == pytest.approx(TRUTH, rel=1e-8)
    with pytest.raises(ts.InputError, match="must be a block with height_mm along axis 1"):
        calibrate(tmp_path, '[[specimen]]\nshape = "prism"\narea_mm2 = 80.0\nheight_mm = 20.0\n\n' + make_test() + FIT)


@pytest.mark.parametrize("method", ["analytical", "inverse_fem"])
def test_axes_and_other_kinds_are_fitted_jointly(tmp_path, method):
    """Both axes and a uniaxial test have noise; the parameters lie within four standard errors."""
    noise = np.random.default_rng(5)
    stress = LAW.nominal_stress(STRETCH, TRUTH, "biaxial")
    write(tmp_path, "a_sheet", stress + noise.normal(0.0, 20.0, stress.shape), time=TIME)
    ts.write_recording(ts.Recording({"time": TIME, "stretch": STRETCH[:, 0], "nominal stress": LAW.nominal_stress(
        STRETCH[:, 0], TRUTH) + noise.normal(0.0, 20.0, TIME.size)}), tmp_path / "strip.csv")
    result = calibrate(tmp_path, make_test("a_*.csv") + make_test("strip.csv", "uniaxial_tension") + FIT
                       + f'method = "{method}"\n\n[noise]\nnominal_stress_Pa = 20.0\n')
    best = result.best
    for name, value in TRUTH.items():
        assert abs(best.parameters[name] - value) < 4.0 * best.standard_errors[name] < 0.1 * value


def test_relaxation_of_both_axes(tmp_path):
    """Axis 2 is stretched first and then held, so that its stress depends on the motion of axis 1."""
    material = ts.Material("neo_hooke", {"C10": 5000.0}, viscoelastic=ts.Prony((ts.PronyTerm(0.4, 2.0),)))
    stretch = np.stack([1.0 + 0.3 * np.clip(TIME - 3.0, 0.0, 2.0), 1.0 + 0.2 * np.clip(TIME, 0.0, 2.0)], axis=-1)
    kind = ts.KINDS["biaxial_tension"]
    stress = np.stack([kind.select_load(axis).require_closed_form().stress_history(
        material, TIME, stretch[:, ::1 - 2 * axis], 0.01) for axis in (0, 1)], axis=-1)
    write(tmp_path, "a", stress, stretch, time=TIME)
    result = calibrate(tmp_path, make_test() + '[fit]\nlaws = ["neo_hooke"]\nstart = { "viscoelastic.terms[0].g" = 0.3,'
                       ' "viscoelastic.terms[0].tau" = 1.0 }\n')
    assert list(result.best.parameters.values()) == pytest.approx([5000.0, 0.4, 2.0], rel=1e-5)


def test_table_without_time_is_fitted_completely(tmp_path):
    """Series of one stretch with a varying other one, as Kawabata measured, are neither cycles nor unloading."""
    stretch = np.array([(l1, l2) for l1 in (1.1, 1.2, 1.4, 1.7, 2.0)
                        for l2 in np.linspace(l1**-0.5, l1, 6)])
    write(tmp_path, "a", LAW.nominal_stress(stretch, TRUTH, "biaxial"), stretch)
    result = calibrate(tmp_path, make_test() + FIT)
    measured = read_measured_curves(calibration.load_campaign(tmp_path / "study.toml"))
    assert [curve.force.size for curves in measured.values() for curve in curves] == [30, 30]
    assert result.best.parameters == pytest.approx(TRUTH, rel=1e-8)


def test_uniaxial_test_of_a_biaxial_machine(tmp_path):
    """The noise of the second load has no sign. A second load of zero is not a measurement."""
    stretch = np.stack([STRETCH[:, 0], STRETCH[:, 0]**-0.5], axis=-1)
    stress = LAW.nominal_stress(stretch, TRUTH, "biaxial")
    stress[:, 1] = np.random.default_rng(4).normal(0.0, 10.0, TIME.size)
    write(tmp_path, "a", stress, stretch, time=TIME)
    assert calibrate(tmp_path, make_test() + FIT).best.parameters == pytest.approx(TRUTH, rel=0.02)
    stress[:, 1] = 0.0
    write(tmp_path, "a", stress, stretch, time=TIME)
    with pytest.raises(ts.InputError, match=r"a\.csv must have a load in 'nominal stress 2'; all samples are 0"):
        calibrate(tmp_path, make_test() + FIT)


@pytest.mark.parametrize("second", [np.ones(TIME.size), STRETCH[:, 0]**-0.5, 2.0 - STRETCH[:, 0] / 2.0 - 0.5])
def test_axes_with_different_stresses_do_not_disagree(tmp_path, second):
    """Planar tension, uniaxial tension and a second axis that is compressed, each with exact data."""
    stretch = np.stack([STRETCH[:, 0], second], axis=-1)
    write(tmp_path, "a", LAW.nominal_stress(stretch, TRUTH, "biaxial"), stretch, time=TIME)
    best = calibrate(tmp_path, make_test() + FIT).best
    assert best.parameters == pytest.approx(TRUTH, rel=1e-8)
    assert best.status == "converged", best.message


@pytest.mark.parametrize(("stretch", "factor", "status"), [
    (np.stack([1.0 - 0.01 * TIME, STRETCH[:, 0]], axis=-1), 1.0, "converged"), (STRETCH, 2.0, "misfit")])
@pytest.mark.parametrize("tests", [("*.csv",), ("a.csv", "b.csv")])
def test_only_recordings_with_equal_motions_are_compared(tmp_path, tests, stretch, factor, status):
    """The stress of another path of stretches differs. On the same path twice the stress is a contradiction."""
    write(tmp_path, "a", LAW.nominal_stress(STRETCH, TRUTH, "biaxial"), time=TIME)
    write(tmp_path, "b", factor * LAW.nominal_stress(stretch, TRUTH, "biaxial"), stretch, time=TIME)
    text = "".join(make_test(each, more=f'name = "test {number}"') for number, each in enumerate(tests))
    best = calibrate(tmp_path, text + FIT).best
    assert best.status == status
    said, = (clause.reason for clause in best.clauses if clause.name == "replicates")
    assert ("axis 1 disagree" in said or "tests of biaxial_tension disagree: test 0 axis 1" in said) == (factor != 1.0)


def read_notes(folder, text):
    (folder / "study.toml").write_text(text, encoding="utf-8")
    measured = read_measured_curves(calibration.load_campaign(folder / "study.toml"))
    return [curve.notes.get("failure", "") for curves in measured.values() for curve in curves]


@pytest.mark.parametrize(("first", "second"), [(1.06, 1.04), (1.05, 1.06), (0.97, 1.08)])
def test_unloading_of_one_axis_is_no_failure(tmp_path, first, second):
    """Axis 1 is unloaded from the middle of the test on. A drop of the loads under loading is a failure."""
    stretch = np.stack([1.0 + (first - 1.0) * np.minimum(TIME, 10.0 - TIME), 1.0 + (second - 1.0) * TIME], axis=-1)
    stress = LAW.nominal_stress(stretch, TRUTH, "biaxial")
    write(tmp_path, "a", stress, stretch, time=TIME)
    assert read_notes(tmp_path, make_test() + FIT) == ["", ""]
    stress[15:] *= 0.6
    write(tmp_path, "a", stress, stretch, time=TIME)
    assert all("the force drops" in note and "(sample 15 of 41)" in note
               for note in read_notes(tmp_path, make_test() + FIT))


def test_diagnosis_of_both_axes(tmp_path):
    """The trial size of an effect follows from the shear modulus. Exact data with noise show no effect."""
    noise = np.random.default_rng(1).normal(0.0, 20.0, STRETCH.shape)
    stress = ts.find_law("neo_hooke").nominal_stress(STRETCH, {"C10": 5000.0}, "biaxial")
    write(tmp_path, "a", stress + noise, time=TIME)
    path = tmp_path / "study.toml"
    path.write_text(make_test() + '[fit]\nlaws = ["neo_hooke"]\nmethod = "inverse_fem"\n', encoding="utf-8")
    campaign = calibration.load_campaign(path)
    assert DiagnosisData(campaign, read_measured_curves(campaign), "neo_hooke").estimated_shear_modulus == \
        pytest.approx(1e4, rel=0.01)
    result, = calibration.diagnose([path], tmp_path / "out", figures=False)
    assert not result.diagnosis.effects, result.diagnosis.message
    assert result.diagnosis.fit_before.parameters["C10"] == pytest.approx(5000.0, rel=0.01)


@pytest.mark.parametrize("names", ["a", "ab"])
def test_an_inverse_fit_has_no_contact_offset(tmp_path, names):
    """The loads of a recording have the same two stretches: only the zero of each load scatters."""
    noise = np.random.default_rng(8)
    for name in names:
        write(tmp_path, name, LAW.nominal_stress(STRETCH, TRUTH, "biaxial") + noise.normal(0.0, 20.0, STRETCH.shape),
              time=TIME)
    best = calibrate(tmp_path, make_test() + FIT + 'method = "inverse_fem"\n').best
    assert names != "a" or len(best.nuisances) == 2
    assert all(each.contact_offset_mm == each.contact_offset_error_mm == 0.0 for each in best.nuisances)
    assert best.jitter.contact_mm == 0.0 and "contact_jitter_mm" not in best.message
    for name, value in TRUTH.items():
        assert abs(best.parameters[name] - value) < 4.0 * best.standard_errors[name]


def test_a_contact_jitter_applies_to_the_other_tests(tmp_path):
    noise = np.random.default_rng(9)
    write(tmp_path, "a_sheet", STRESS + noise.normal(0.0, 20.0, STRESS.shape), time=TIME)
    ts.write_recording(ts.Recording({"time": TIME, "stretch": STRETCH[:, 0], "nominal stress": LAW.nominal_stress(
        STRETCH[:, 0], TRUTH) + noise.normal(0.0, 20.0, TIME.size)}), tmp_path / "strip.csv")
    best = calibrate(tmp_path, make_test("a_*.csv") + make_test("strip.csv", "uniaxial_tension") + FIT
                     + 'method = "inverse_fem"\n\n[noise]\ncontact_jitter_mm = 5.0\nzero_jitter_N = 10.0\n').best
    errors = {each.replicate.partition("/")[0]: each.contact_offset_error_mm for each in best.nuisances}
    assert errors.pop("uniaxial_tension") > 0.0
    assert errors == {"biaxial_tension axis 1": 0.0, "biaxial_tension axis 2": 0.0}
    for name, value in TRUTH.items():
        assert abs(best.parameters[name] - value) < 4.0 * best.standard_errors[name]


@pytest.mark.parametrize(("text", "message"), [
    ('method = "inverse_fem"\noffset = "fit"\n', r"fit\.offset: offset must be \"none\", because biaxial_tension"),
    ('method = "inverse_fem"\n[noise]\ncontact_jitter_mm = 1.0\n', "contact_jitter_mm must be left out; got 1"),
    ("[noise]\ncontact_jitter_mm = 1.0\n", "biaxial_tension has a motion for each axis and no contact offset")])
def test_a_stated_contact_offset_is_refused(tmp_path, text, message):
    write(tmp_path, "a", LAW.nominal_stress(STRETCH, TRUTH, "biaxial"), time=TIME)
    with pytest.raises(ts.InputError, match=message):
        calibrate(tmp_path, make_test() + FIT + text)


def test_invalid_biaxial_recordings_are_refused(tmp_path):
    stress = LAW.nominal_stress(STRETCH, TRUTH, "biaxial")
    write(tmp_path, "a", stress * [1.0, -1.0], time=TIME)
    with pytest.raises(ts.InputError, match=r"a\.csv has a force or stress of the wrong sign"):
        calibrate(tmp_path, make_test() + FIT)
    write(tmp_path, "a", stress, time=TIME)
    with pytest.raises(ts.InputError, match="strain_points must be left out, because several motions"):
        calibrate(tmp_path, make_test() + FIT + "strain_points = 10\n")
    write(tmp_path, "a", stress, STRETCH - [0.0, 1.1], time=TIME)
    with pytest.raises(ts.InputError, match=r"stretch must be above zero; got -0\.1 in sample 1"):
        calibrate(tmp_path, make_test() + FIT)
    ts.write_recording(ts.Recording({"stretch": STRETCH[:, 0], "nominal stress": stress[:, 0]}), tmp_path / "a.csv")
    with pytest.raises(ts.InputError, match=r"biaxial_tension needs columns .* or 'stretch' and 'nominal stress' and "
                                            "'stretch 2' and 'nominal stress 2'; this file has stretch"):
        calibrate(tmp_path, make_test() + FIT)


def write_text(folder, header, columns, name="sheet"):
    rows = (",".join(f"{value:.8g}" for value in row) for row in zip(*columns, strict=True))
    (folder / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return folder / f"{name}.csv"


STRESS = LAW.nominal_stress(STRETCH, TRUTH, "biaxial")
FORCE = STRESS * [SIDES[1] * SIDES[2], SIDES[0] * SIDES[2]]
TRAVEL = (STRETCH - 1.0) * SIDES[:2]


@pytest.mark.parametrize(("header", "columns"), [
    ("Time (s),stretch x,stretch y,P11 (kPa),P22 (kPa)", (TIME, *STRETCH.T, *STRESS.T / 1e3)),
    ("lambda1,lambda2,P1 [MPa],P2 [MPa]", (*STRETCH.T, *STRESS.T / 1e6)),
    ("Time (s),Strain XX (%),Stress XX (kPa),Strain YY (%),Stress YY (kPa)",
     (TIME, 100.0 * (STRETCH[:, 0] - 1.0), STRESS[:, 0] / 1e3, 100.0 * (STRETCH[:, 1] - 1.0), STRESS[:, 1] / 1e3)),
    ("Green strain x,Green strain y,Cauchy stress x (kPa),Cauchy stress y (kPa)",
     (*(STRETCH.T**2 - 1.0) / 2.0, *(STRETCH * STRESS).T / 1e3)),
    ("Cruciform\nTime (s),Displacement 1 (mm),Force 1 (N),Displacement 2 (mm),Force 2 (N)",
     (TIME, 1e3 * TRAVEL[:, 0], FORCE[:, 0], 1e3 * TRAVEL[:, 1], FORCE[:, 1])),
    ("Time (s),Displacement X (mm),Displacement Y (mm),Force X (N),Force Y (N)",
     (TIME, *1e3 * TRAVEL.T, *FORCE.T))])
def test_columns_of_two_axes_are_imported(tmp_path, monkeypatch, header, columns):
    monkeypatch.chdir(tmp_path)
    path = write_text(tmp_path, header, columns)
    sizes = {"shape": "block", "height_mm": 20.0, "length_mm": 40.0, "width_mm": 2.0} if "Force" in header else {}
    imported = calibration.import_files([path], wishes=ImportOptions(specimen=sizes, laws=("mooney_rivlin",)))
    assert imported.is_complete, (imported.missing, imported.problem)
    assert [test.kind for test in imported.tests] == ["biaxial_tension"]
    assert calibrate(tmp_path, imported.text).best.parameters == pytest.approx(TRUTH, rel=1e-5)


def test_sizes_of_the_sheet_are_asked_for(tmp_path):
    path = write_text(tmp_path, "Biaxial\nDisplacement 1 (mm),Force 1 (N),Displacement 2 (mm),Force 2 (N)",
                      (1e3 * TRAVEL[:, 0], FORCE[:, 0], 1e3 * TRAVEL[:, 1], FORCE[:, 1]))
    assert calibration.import_files([path]).missing == (
        "the length of the specimen (--shape block --length-mm)",
        "the width of the specimen (--shape block --width-mm)",
        "the height of the specimen (--shape block --height-mm)")


def test_numbered_columns_of_two_specimens_are_two_recordings(tmp_path):
    """Without a word for a biaxial test, interleaved columns belong to two specimens."""
    path = write_text(tmp_path, "Displacement 1 (mm),Force 1 (N),Displacement 2 (mm),Force 2 (N)",
                      (TIME, TIME, TIME, 1.1 * TIME))
    assert [len(reading.recordings) for each in calibration.import_files([path]).files for reading in each.readings] \
        == [1, 1]


def test_biaxial_words_above_one_axis_are_refused(tmp_path):
    path = write_text(tmp_path, "Biaxial test\nStretch,Stress (kPa)", (STRETCH[:, 0], STRESS[:, 0]))
    with pytest.raises(ts.InputError, match=r"'biaxial test' above the numbers.*has one load"):
        calibration.import_files([path])


def test_kawabata_is_imported(data_folder, tmp_path, monkeypatch):
    """117 points of isoprene rubber; equal stretches have equal stresses."""
    path = data_folder.resolve() / "rubber_treloar_kawabata" / "kawabata1981_biaxial.csv"
    monkeypatch.chdir(tmp_path)
    assert calibration.import_files([path]).missing == (
        "the unit of column 's1' (nominal stress) (--unit stress=...)",
        "the unit of column 's2' (nominal stress 2) (--unit stress=...)")
    imported = calibration.import_files([path], wishes=ImportOptions(
        InterpretationOverrides(units={"nominal stress": "MPa"}), laws=("ogden_2",)))
    assert imported.is_complete
    recording, = imported.files[0].readings[0].recordings
    assert len(recording) == 117 and recording.channel("stretch").max() == 3.7
    equal = recording.channel("stretch") == recording.channel("stretch 2")
    np.testing.assert_array_equal(recording.channel("nominal stress")[equal],
                                  recording.channel("nominal stress 2")[equal])
    result = calibrate(tmp_path, imported.text)
    assert result.best.status == "converged" and result.best.law == "ogden_2"
