"""Meaning of columns and titles: measures of stress and strain, constant speed, tests without a kind, flags."""

import json
import re

import numpy as np
import openpyxl
import pytest

import calibration
import tissue_sim as ts
from calibration import ImportOptions, InterpretationOverrides
from scenes.cli import main

MU = 400e3
STRETCH = np.linspace(1.0, 1.6, 61)
STRESS = MU * (STRETCH - STRETCH**-2)
SHORT = np.linspace(1.0, 0.6, 61)
#: Cross-section, m2.
AREA = 20e-6
#: Length, m.
LENGTH = 50.0
SHEET = f"Tensile test\nGauge length,{LENGTH:g},mm\nWidth,10,mm\nThickness,2,mm\n\n"


def write(folder, header, *columns, above="", name="a.csv", mark=","):
    rows = "".join(mark.join(f"{value:.7g}" for value in row) + "\n" for row in zip(*columns, strict=True))
    path = folder / name
    path.write_text(f"{above}{header}\n{rows}", encoding="utf-8")
    return path


def load(path, **stated):
    return calibration.import_files([path], path.with_suffix(".toml"), ImportOptions(
        InterpretationOverrides(**stated), laws=("neo_hooke",)), overwrite=True)


def shear_modulus(imported, folder):
    assert imported.is_complete, (imported.missing, imported.questions, imported.problem)
    result, = calibration.calibrate([imported.output], folder / "out", figures=False, overwrite=True)
    return 2.0 * result.best.parameters["C10"]


COMPRESSED = MU * (SHORT - SHORT**-2)
MEASURED = {
    "logarithmic strain": ("Hencky strain [-],Engineering stress [kPa]", (np.log(STRETCH), 1e-3 * STRESS), ""),
    "Cauchy stress": ("Stretch [-],Cauchy stress [kPa]", (STRETCH, 1e-3 * STRESS * STRETCH), ""),
    "both": ("True strain [-],True stress [kPa]", (np.log(STRETCH), 1e-3 * STRESS * STRETCH), ""),
    "German": ("Wahre Dehnung (%),Wahre Spannung (MPa)", (100 * np.log(STRETCH), 1e-6 * STRESS * STRETCH), ""),
    "French": ("Déformation vraie (-),Contrainte vraie (kPa)", (np.log(STRETCH), 1e-3 * STRESS * STRETCH), ""),
    "without blanks": ("eps_true,sigma_true_kPa", (np.log(STRETCH), 1e-3 * STRESS * STRETCH), ""),
    "in brackets": ("Strain (true),Stress (true) (kPa)", (np.log(STRETCH), 1e-3 * STRESS * STRETCH), ""),
    "Green-Lagrange": ("Green-Lagrange strain,2nd Piola-Kirchhoff stress (kPa)",
                       ((STRETCH**2 - 1) / 2, 1e-3 * STRESS / STRETCH), ""),
    "Almansi": ("Almansi strain,True stress (kPa)", ((1 - STRETCH**-2) / 2, 1e-3 * STRESS * STRETCH), ""),
    "engineering first": ("True strain,True stress (kPa),Engineering strain,Engineering stress (kPa)",
                          (0.5 * STRETCH, 1e-3 * STRESS, STRETCH - 1, 1e-3 * STRESS), ""),
    "compression": ("True strain,True stress (kPa)", (-np.log(SHORT), -1e-3 * COMPRESSED * SHORT), "Compression\n"),
    "shear": ("Shear strain,True shear stress (kPa)", (STRETCH - 1, 1e-3 * MU * (STRETCH - 1)), "Simple shear\n"),
    "displacement": ("Extension (mm),True stress (kPa)", (LENGTH * (STRETCH - 1), 1e-3 * STRESS * STRETCH), SHEET),
    "strain and force": ("Tensile strain (%),Load (N)", (100 * (STRETCH - 1), STRESS * AREA), SHEET),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MEASURED)
def test_measures_are_converted(tmp_path, name):
    header, columns, above = MEASURED[name]
    path = write(tmp_path, header, *columns, above=above or "Uniaxial tension\n")
    assert shear_modulus(load(path), tmp_path) == pytest.approx(MU, rel=1e-4)


def test_a_column_that_the_user_names_keeps_the_measure_of_its_header(tmp_path):
    path = write(tmp_path, "True strain [-],True stress [kPa]", np.log(STRETCH), 1e-3 * STRESS * STRETCH,
                 above="Uniaxial tension\n")
    imported = load(path, columns={"strain": "1", "nominal stress": "2"},
                    units={"strain": "-", "nominal stress": "kPa"})
    assert 'measure = "logarithmic"' in imported.text and 'measure = "true"' in imported.text
    assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-4)
    stated = load(path, measures={"strain": "engineering", "nominal stress": "engineering"})
    assert "measure =" not in stated.text.replace("--measure", "")


@pytest.mark.slow
@pytest.mark.parametrize(("header", "columns", "words"), [
    ("True strain,Stress (kPa)", (np.log(STRETCH), 1e-3 * STRESS), "--measure stress=true"),
    ("Strain,True stress (kPa)", (STRETCH - 1, 1e-3 * STRESS), "--measure strain=logarithmic"),
    ("Lagrangian strain,Engineering stress (kPa)", (STRETCH - 1, 1e-3 * STRESS), "--measure strain=engineering"),
    ("Strain,Stress (kPa)", (100 * (STRETCH - 1), 1e-3 * STRESS), "--unit strain=%")])
def test_measures_and_units_that_fit_as_well_are_a_question(tmp_path, capsys, header, columns, words):
    path = write(tmp_path, header, *columns, above="Uniaxial tension\n")
    question, = load(path).questions
    assert words in question
    flag, value = words.split(" ", 1)
    assert main(["import", str(path)]) == 1 and main(["import", str(path), flag, value]) == 0
    # The same at strains where the two hardly differ is no question.
    if "measure" in words:
        small = write(tmp_path, header, *(0.05 * column for column in columns), above="Uniaxial tension\n")
        assert load(small).questions == ()


@pytest.mark.slow
@pytest.mark.parametrize(("header", "strain", "stress", "above"), [
    ("Strain (mm/mm),Stress (kPa)", STRETCH - 1, 1e-3 * STRESS, "Uniaxial tension\n"),
    ("Strain [-],Stress [kPa]", STRETCH - 1, 1e-3 * STRESS, "Uniaxial tension\n"),
    ("Strain,Stress\nin/in,kPa", STRETCH - 1, 1e-3 * STRESS, "Uniaxial tension\n"),
    ("Strain (mm/mm),Load (N)", STRETCH - 1, STRESS * AREA, SHEET),
    ("Strain,Load (N)", STRETCH - 1, STRESS * AREA, SHEET)])
def test_large_strains_under_the_unit_of_a_ratio_are_a_question(tmp_path, header, strain, stress, above):
    percent = write(tmp_path, header, 100 * strain, stress, above=above)
    question, = load(percent).questions
    assert "--unit strain=%" in question
    assert shear_modulus(load(percent, units={"strain": "%"}), tmp_path) == pytest.approx(MU, rel=1e-4)
    assert load(write(tmp_path, header, strain, stress, above=above, name="b.csv")).questions == ()
    # A user may state that the unit of the file is true.
    assert load(percent, units={"strain": "-"}).questions == ()


@pytest.mark.slow
def test_a_displacement_over_the_gauge_length_confirms_a_large_strain(tmp_path):
    strain = np.linspace(0.0, 3.0, 61)
    force = MU * AREA * (1 + strain - (1 + strain)**-2)
    header = "Crosshead (mm),Load (N),Video strain (mm/mm)"
    assert load(write(tmp_path, header, 1.02 * LENGTH * strain, force, strain, above=SHEET)).questions == ()
    moved = write(tmp_path, header, 0.01 * LENGTH * strain, force, strain, above=SHEET, name="b.csv")
    assert any("--unit strain=%" in question for question in load(moved).questions)


@pytest.mark.parametrize(("columns", "words"), [
    ({"nominal stress": {"name": "P", "unit": "Pa", "measure": "true"}}, "needs the stretch"),
    ({"stretch": {"name": "l", "measure": "true"}}, "must be one of logarithmic, green_lagrange, almansi; got 'true'"),
    ({"displacement": {"name": "l", "unit": "mm", "measure": "logarithmic"}}, "must be left out"),
    ({"shear strain": {"name": "l", "unit": "-"}, "nominal stress": {
        "name": "P", "unit": "Pa", "measure": "second_piola_kirchhoff"}}, "no conversion to nominal stress in simple"),
    ({"stretch": {"name": "l", "measure": "logarithmic"}}, 'unit = "%"'),
    ({"stretch": {"name": "l", "unit": "%", "measure": "almansi"}}, "must be below 0.5")])
def test_measures_without_a_conversion_are_refused(tmp_path, columns, words):
    path = write(tmp_path, "l,P", np.linspace(0.0, 60.0, 9), np.arange(9.0))
    columns = {**columns} if "nominal stress" in columns else {**columns, "nominal stress": {"name": "P", "unit": "Pa"}}
    with pytest.raises(ts.InputError) as caught:
        ts.read_recording(path, columns=columns)
    assert words in caught.value.problem


def test_time_and_force_at_a_constant_speed(tmp_path):
    """A cylinder of 20 x 10 mm pressed at 0.5 mm/s; no column of the motion."""
    force = -COMPRESSED * np.pi * 0.01**2
    path = write(tmp_path, "time_ms,force_N", 1e3 * (1 - SHORT) * 10 / 0.5, force)
    with pytest.raises(ts.InputError, match=r"or state the constant speed \(--speed-mm-s\)"):
        calibration.import_files([path])
    wishes = ImportOptions(InterpretationOverrides(kind="lubricated_compression"),
                           {"radius_mm": 10.0, "height_mm": 10.0},
                           {"speed_mm_s": 0.5}, ("neo_hooke",))
    imported = calibration.import_files([path], tmp_path / "c.toml", wishes)
    assert "speed_mm_s = 0.5" in imported.text and "displacement = speed x time from the first sample" in imported.text
    assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-3)
    recording = ts.read_recording(path, speed=0.5e-3, columns={"time": "time_ms", "force": "force_N"})
    np.testing.assert_allclose(recording.displacement, 0.01 * (1 - SHORT), atol=1e-9)


def test_a_speed_in_the_file_counts_too(tmp_path):
    above = "Druckversuch\nGeschwindigkeit: 30 mm/min\nDurchmesser;20;mm\nHöhe;10;mm\n\n"
    path = write(tmp_path, "Zeit (s);Kraft (N)", (1 - SHORT) * 20, -COMPRESSED * np.pi * 0.01**2, above=above, mark=";")
    assert shear_modulus(load(path), tmp_path) == pytest.approx(MU, rel=1e-3)


@pytest.mark.parametrize(("title", "header"), [
    ("Sweep at 1 Hz, strain 1 %", "Frequency (Hz),Storage modulus (Pa),Loss modulus (Pa),Oscillation strain (%)"),
    ("Amplitude sweep", "Oscillation strain (%),Storage modulus (Pa),Oscillation stress (Pa),Tan delta"),
    ("", "f (Hz),G' (Pa),G'' (Pa),|G*| (Pa)"), ("", "Frequenz (Hz),Speichermodul (Pa),Verlustmodul (Pa),Kraft (N)"),
    ("", "Frequency (Hz),Strain amplitude (%),Stress amplitude (Pa),Temperature (degC)")])
@pytest.mark.parametrize("kind", [None, "simple_shear"])
def test_moduli_over_amplitude_or_at_one_frequency_are_refused(tmp_path, title, header, kind):
    path = write(tmp_path, header, *np.full((4, 9), 1.0), above=f"{title}\n\n")
    with pytest.raises(ts.InputError, match="moduli must be over at least 5 frequencies"):
        load(path, kind=kind)


@pytest.mark.slow
def test_the_extensometer_is_read_before_the_crosshead_and_the_difference_is_noted(tmp_path):
    way, force = LENGTH * (STRETCH - 1), STRESS * AREA
    for header, own in (("Extensometer (mm)", way), ("Video strain (%)", 100 * (STRETCH - 1))):
        path = write(tmp_path, f"Time (s),Crosshead (mm),Load (N),{header}", STRETCH, 1.2 * way, force, own,
                     above=SHEET)
        imported = load(path)
        assert any(f"'Crosshead (mm)' has 20 % more displacement than {header!r}" in each for each in imported.warnings)
        assert "Columns not used: a.csv: 'Crosshead (mm)'" in imported.text
        assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-3)
    path = write(tmp_path, "Time (s),Crosshead (mm),Load (N),Extensometer (mm)", STRETCH, way, force, 0 * way,
                 above=SHEET)
    imported = load(path)
    assert "does not move, so that" in imported.warnings[0]
    assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-3)


@pytest.mark.parametrize("sample", [0, 4, -1])
def test_one_lost_value_of_the_crosshead_does_not_decide_between_it_and_the_extensometer(tmp_path, sample):
    way, force = LENGTH * (STRETCH - 1), STRESS * AREA
    crosshead = 1.2 * way
    crosshead[sample] = 9999.0
    path = write(tmp_path, "Time (s),Crosshead (mm),Load (N),Extensometer (mm)", STRETCH, crosshead, force, way,
                 above=SHEET)
    imported = load(path)
    assert any("20 % more displacement than 'Extensometer (mm)'" in each for each in imported.warnings)
    assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-3)


@pytest.mark.slow
def test_of_two_loads_the_corrected_one_is_read_and_equal_names_are_a_question(tmp_path):
    way, force = LENGTH * (STRETCH - 1), STRESS * AREA
    path = write(tmp_path, "Extension (mm),Load (N),Corrected load (N)", way, 1.1 * force, force, above=SHEET)
    imported = load(path)
    assert "'Load (N)' has 10 % more force than 'Corrected load (N)'" in imported.warnings[0]
    assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-3)
    path = write(tmp_path, "Extension (mm),Load 1 (N),Load 2 (N)", way, force, 1.1 * force, above=SHEET)
    question, = load(path).questions
    assert '--column force="Load 2 (N)"' in question
    path = write(tmp_path, "Extension (mm),Load 1 (N),Load 2 (N)", way, force, 1.005 * force, above=SHEET)
    assert load(path).is_complete


def test_a_campaign_with_an_open_question_is_refused(tmp_path):
    path = write(tmp_path, "True strain,Stress (kPa)", np.log(STRETCH), 1e-3 * STRESS, above="Uniaxial tension\n")
    imported = load(path)
    with pytest.raises(ts.InputError, match=r"measure of nominal stress: engineering stress .* Import again"):
        calibration.load_campaign(imported.output)
    accepted = tmp_path / "accepted.toml"
    without = re.sub(r"^questions = \[.*?\]\n\n", "", imported.text, flags=re.DOTALL | re.MULTILINE)
    accepted.write_text(without, encoding="utf-8")
    assert without != imported.text and len(calibration.load_campaign(accepted).tests) == 1
    with pytest.raises(ts.InputError, match="measure of nominal stress: engineering"):
        ts.read_recordings(path, format="table")


def test_words_and_headers_that_contradict_each_other_are_a_question(tmp_path):
    path = write(tmp_path, "Compression (mm),Load (N)", 10 * (1 - SHORT), -COMPRESSED * AREA,
                 name="gel_indentation.csv", above="Diameter,20,mm\nHeight,10,mm\n\n")
    question, = load(path).questions
    assert "--kind needle_indentation" in question and "'indentation' in the name of the file" in question


def test_sheets_of_different_kinds_are_different_tests(tmp_path):
    """Uniaxial and planar tension of a neo-Hookean rubber in one book."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, stress in (("Uniaxial tension", STRESS), ("Planar tension", MU * (STRETCH - STRETCH**-3))):
        sheet = book.create_sheet(title)
        sheet.append(["Stretch", "Nominal stress (kPa)"])
        for row in zip(STRETCH, 1e-3 * stress, strict=True):
            sheet.append([float(value) for value in row])
    path = tmp_path / "rubber.xlsx"
    book.save(path)
    imported = load(path)
    assert [test.kind for test in imported.tests] == ["uniaxial_tension", "planar_tension"]
    assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-4)


def test_sheets_of_other_tests_are_left_out_with_a_note(tmp_path):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title in ("Uniaxial tension", "Volumetric compression"):
        sheet = book.create_sheet(title)
        sheet.append(["Stretch", "Nominal stress (kPa)"])
        for row in zip(STRETCH, 1e-3 * STRESS, strict=True):
            sheet.append([float(value) for value in row])
    path = tmp_path / "rubber.xlsx"
    book.save(path)
    imported = load(path)
    assert [test.kind for test in imported.tests] == ["uniaxial_tension"]
    assert "a table is omitted: volumetric compression" in imported.warnings[0]
    assert shear_modulus(imported, tmp_path) == pytest.approx(MU, rel=1e-4)


@pytest.mark.parametrize(("flags", "words"), [
    (["--speed-mm-s", "1"], "--speed-mm-s: the speed counts only where"),
    (["--tool", "sphere"], "lubricated_compression has no tool to state"),
    (["--tool-radius-mm", "2"], "has no tool radius to state"), (["--friction", "0.3"], "has no friction to state"),
    (["--unit", "strain=%"], "no column of strain is read"), (["--scale", "stress=2"], "no column of stress is read"),
    (["--sign", "temperature=1"], "no column of temperature is read"), (["--sheet", "1"], "only spreadsheets"),
    (["--measure", "force=true"], "measure of force must be"), (["--measure", "stress=logarithmic"], "must be one of"),
    (["--format", "native"], "format must be one of"), (["--overwrite"], "has an effect only with -o"),
    (["--column", "strain=2", "--column", "stretch=2"], "but a strain is read as a stretch. Leave out")])
def test_a_flag_without_effect_is_refused(tmp_path, capsys, flags, words):
    path = write(tmp_path, "Time (s),Displacement (mm),Force (N)", STRETCH, 10 * (1 - SHORT), -COMPRESSED * AREA,
                 above="Unconfined compression\n\n")
    assert main(["import", str(path), "--radius-mm", "10", "--height-mm", "10", *flags]) == 2
    assert words in capsys.readouterr().err


def test_sizes_are_refused_where_stress_and_strain_are_read(tmp_path, capsys):
    path = write(tmp_path, "Stretch,Stress (kPa)", STRETCH, 1e-3 * STRESS)
    assert main(["import", str(path), "--radius-mm", "10"]) == 2
    assert "--radius-mm: stress and strain are read" in capsys.readouterr().err


def test_assumptions_are_one_table_everywhere(tmp_path, capsys):
    path = write(tmp_path, "Hencky strain [-],Engineering stress [kPa],Counter", np.log(STRETCH), 1e-3 * STRESS,
                 STRETCH, above="Uniaxial tension\n\n")
    assert main(["import", str(path), "-o", str(tmp_path / "a.toml")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    campaign = " ".join((tmp_path / "a.toml").read_text(encoding="utf-8").replace("#", " ").split())
    assert main(["import", str(path), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    subjects = {each["subject"]: each for each in answer["assumptions"]}
    assert {"format", "column of stretch", "unit of nominal stress", "sign of stretch", "measure of stretch",
            "kind of test"} <= set(subjects)
    assert subjects["measure of stretch"]["value"] == "logarithmic strain"
    assert subjects["measure of stretch"]["flag"] == "--measure strain=logarithmic"
    for words in ("measure of stretch", "logarithmic strain", "--measure strain=logarithmic"):
        assert words in said and words in campaign
    assert answer["files"][0]["unused_columns"] == ["Counter"]
    assert "columns not used: a.csv: 'Counter'" in said and "Columns not used: a.csv: 'Counter'" in campaign


@pytest.mark.slow
def test_a_unit_that_the_row_below_contradicts_is_a_question(tmp_path):
    way, force = LENGTH * (STRETCH - 1), STRESS * AREA
    path = write(tmp_path, "Extension [mm],Load\n(in),(N)", way, force, above=SHEET)
    question, = load(path).questions
    assert "unit of displacement: mm (--unit displacement=mm) or in (--unit displacement=in)" in question
    assert shear_modulus(load(path, units={"displacement": "mm"}), tmp_path) == pytest.approx(MU, rel=1e-3)


def test_a_speed_that_contradicts_the_file_is_refused(tmp_path, capsys):
    path = write(tmp_path, "Time (s),Load (N)", LENGTH * (STRETCH - 1) / 0.5, STRESS * AREA,
                 above=SHEET + "The grips move at 0.5 mm/s\n")
    assert shear_modulus(load(path), tmp_path) == pytest.approx(MU, rel=1e-3)
    assert main(["import", str(path), "--speed-mm-s", "0.5"]) == 0
    assert main(["import", str(path), "--speed-mm-s", "40"]) == 2
    assert "speed of 40 mm/s contradicts the file" in capsys.readouterr().err
