"""Layouts of public recordings: two directions, rheometer steps, repeated headers, abbreviations in file names."""

import numpy as np
import openpyxl
import pytest

import calibration
import tissue_sim as ts

STRETCH = np.linspace(1.0, 1.5, 21)


def write_table(folder, name, header, *columns):
    rows = "".join(",".join(f"{value:.6g}" for value in row) + "\n" for row in zip(*columns, strict=True))
    (folder / name).write_text(f"{header}\n{rows}", encoding="utf-8")
    return folder / name


@pytest.mark.parametrize(("name", "kind"), [
    ("rubber_ET.csv", "equibiaxial_tension"), ("rubber_ET_2.csv", "equibiaxial_tension"),
    ("rubber_PS.csv", "planar_tension"), ("rubber_UT.csv", "uniaxial_tension"),
    ("charge_et_decharge.csv", "uniaxial_tension")])
def test_abbreviations_of_the_three_tests_of_rubber(tmp_path, name, kind):
    path = write_table(tmp_path, name, "lambda,P_MPa", STRETCH, STRETCH - STRETCH**-2)
    imported = calibration.import_files([path])
    assert imported.tests[0].kind == kind and imported.is_complete


BIAXIAL = "lambda_x,lambda_y,sigma_xx [MPa],sigma_yy [MPa]"


def test_a_table_of_two_directions_is_uniaxial_only_if_stated(tmp_path):
    other = 1.0 + 0.3 * (STRETCH - 1.0)
    path = write_table(tmp_path, "skin.csv", BIAXIAL, STRETCH, other, STRETCH - 1.0, other - 1.0)
    assert calibration.import_files([path]).tests[0].kind == "biaxial_tension"
    stated = calibration.InterpretationOverrides({"stretch": "lambda_x", "nominal stress": "sigma_xx [MPa]"})
    imported = calibration.import_files([path], wishes=calibration.ImportOptions(stated))
    assert imported.tests[0].kind == "uniaxial_tension"


def test_lateral_strain_with_one_force_is_not_read_as_biaxial(tmp_path):
    strain = STRETCH - 1.0
    path = write_table(tmp_path, "strip.csv", "Strain xx,Strain yy,Stress (kPa)", strain, -0.4 * strain, 30 * strain)
    stated = calibration.InterpretationOverrides(kind="uniaxial_tension")
    imported = calibration.import_files([path], wishes=calibration.ImportOptions(stated))
    assert not imported.missing
    # Which of the strains is that along the force is a question.
    question, = imported.questions
    assert "Strain xx" in question and "Strain yy" in question


def write_workbook(path, sheets):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


@pytest.mark.parametrize(("sample", "kind"), [("shear-inplane-1", None),
                                              ("compression-inplane-1", "lubricated_compression")])
def test_axial_step_of_a_shear_procedure_of_a_rheometer(tmp_path, sample, kind):
    """The gap moves along the axis: the axial force is not a shear force, whatever the name of the sample is."""
    gap = np.linspace(9000.0, 8000.0, 60)
    rows = [(0.1 * i, 25.0, 4e3 * (9.0 - 1e-3 * g), 0.2 * (9.0 - 1e-3 * g), g) for i, g in enumerate(gap.tolist())]
    path = write_workbook(tmp_path / "run.xls.xlsx", {
        "Details": [("Filename", sample), ("Procedure name", "Axial")],
        "Axial - 1": [("Axial - 1",), ("Step time", "Temperature", "Normal stress", "Axial force", "Gap"),
                      ("s", "°C", "Pa", "N", "µm"), *rows]})
    imported = calibration.import_files([path])
    assert imported.tests[0].kind == kind
    assert ("the kind of test (--kind)" in imported.missing) == (kind is None)


def test_all_blocks_with_the_same_headers_are_read(tmp_path):
    """Four blocks of two tests: ``P`` belongs to a stretch and to a shear strain, so that it occurs twice as often."""
    names, units = ("lambda", "P", "gamma", "P"), ("[-]", "[kPa]", "[-]", "[kPa]")
    strain = np.linspace(0.0, 0.2, 11).tolist()
    rows = [[cell for modulus in (1.0, 2.0, 3.0) for cell in
             (1.0 + a, 3.0 * modulus * a, a, modulus * a, None)] for a in strain]
    path = write_workbook(tmp_path / "regions.xlsx", {"Sheet1": [
        3 * [*names, None], 3 * [*units, None], *rows]})
    imported = calibration.import_files([path], tmp_path / "regions.toml")
    assert imported.is_complete
    assert [test.kind for test in imported.tests] == ["uniaxial_tension"] * 3 + ["simple_shear"] * 3
    largest = [part.reading.recordings[0].channel("nominal stress").max() for test in imported.tests
               for part in test.parts]
    np.testing.assert_allclose(largest, [600.0, 1200.0, 1800.0, 200.0, 400.0, 600.0], rtol=1e-12)
    result, = calibration.calibrate([tmp_path / "regions.toml"], tmp_path / "out", figures=False)
    assert len(result.campaign.tests) == 6


def test_a_header_shear_with_a_ratio_is_a_shear_strain(tmp_path):
    strain = np.linspace(0.0, 0.2, 21)
    path = write_table(tmp_path, "steak.csv", "Shear,Stress\n[-],[kPa]", strain, 20.0 * strain)
    imported = calibration.import_files([path])
    assert imported.tests[0].kind == "simple_shear" and imported.is_complete


def test_the_gap_of_a_rheometer_is_counted_from_its_first_value(tmp_path):
    """Cycles between the plates: the gap falls from 9 to 5 mm and returns; it is no oscillation about 7 mm."""
    time = np.linspace(0.0, 40.0, 401)
    depth = 2.0 * (1.0 - np.cos(2 * np.pi * time / 8.0))
    path = write_table(tmp_path, "foam-confcomp-1.csv", "Time (s),Encoder (rad),Torque (Nm),Normal force (N),Gap (um)",
                       time, 0.0 * time, 0.0 * time, 2.0 * depth, 1e3 * (9.0 - depth))
    imported = calibration.import_files([path])
    assert imported.tests[0].kind == "confined_compression"
    motion, = imported.tests[0].parts[0].motions
    assert motion.reach == pytest.approx((4e-3, 0.0), abs=1e-9) and motion.loading_cycle_count == 5


@pytest.mark.parametrize("header", ["Creep Compliance", "Relaxation Modulus"])
def test_a_compliance_or_modulus_over_time_is_refused_with_the_remedy(tmp_path, header):
    path = write_table(tmp_path, "table.csv", f"Time,{header}", STRETCH, STRETCH)
    with pytest.raises(ts.InputError, match=r"contains a creep compliance .* multiply a compliance by"):
        calibration.import_files([path])
