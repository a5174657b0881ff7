"""Import of tables: separators of thousands, sizes wherever a file states them, titles of different materials."""

import re

import numpy as np
import openpyxl
import pytest

import calibration
import tissue_sim as ts
from calibration import ImportOptions, InterpretationOverrides
from scenes.cli import main

#: Neo-Hooke of 60 kPa: a cylinder of 50 x 30 mm, compressed by 7.5 mm.
MODULUS_PA = 60e3
WAY_MM = np.linspace(0.0, 7.5, 61)


def load_mN(radius_mm=25.0, height_mm=30.0, way_mm=WAY_MM, modulus=MODULUS_PA):
    """Closed form of a lubricated compression: nominal stress mu (stretch - stretch^-2)."""
    stretch = 1.0 - way_mm / height_mm
    return -1e3 * modulus * (stretch - stretch**-2) * np.pi * (1e-3 * radius_mm) ** 2


def fitted(folder, path, **wishes):
    """mu0 of the campaign that an import writes, Pa."""
    imported = calibration.import_files([path], folder / "c.toml", ImportOptions(
        laws=("neo_hooke",), **{"stated": InterpretationOverrides(kind="lubricated_compression"), **wishes}))
    assert imported.is_complete, (imported.missing, imported.questions, imported.problem)
    result, = calibration.calibrate([folder / "c.toml"], folder / "r", figures=False)
    return 2.0 * result.best.parameters["C10"]


def put(folder, text, name="gel.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def in_style(value, places, decimal, separator):
    return f"{value:,.{places}f}".replace(",", "\x00").replace(".", decimal).replace("\x00", separator)


@pytest.mark.slow
@pytest.mark.parametrize(("decimal", "separator", "delimiter", "places", "encoding"), [
    (".", ",", "\t", (0, 0, 0), "utf-8"), (",", ".", ";", (0, 0, 0), "utf-8"), (".", ",", "\t", (2, 1, 1), "utf-8"),
    (",", ".", ";", (2, 1, 1), "utf-16"), (",", "\xa0", ";", (2, 1, 1), "cp1252"),
    (".", "\u2019", "\t", (0, 0, 0), "cp1252"), (",", "\u202f", ";", (0, 0, 0), "utf-8")])
def test_thousands_are_read_by_the_import_and_by_its_campaign(tmp_path, decimal, separator, delimiter, places,
                                                              encoding):
    rows = [delimiter.join(in_style(value, digits, decimal, separator)
                           for value, digits in zip(row, places, strict=True))
            for row in zip(np.arange(WAY_MM.size), 1e3 * WAY_MM, load_mN(), strict=True)]
    head = [delimiter.join(cells) for cells in (("Diameter", "50", "mm"), ("Height", "30", "mm"), ("",),
                                                ("Time", "Extension", "Load"), ("(s)", "(um)", "(mN)"))]
    path = put(tmp_path, "\n".join([*head, *rows]), encoding=encoding)
    assert fitted(tmp_path, path) == pytest.approx(MODULUS_PA, rel=2e-3)


def test_thousands_in_text_cells_of_a_spreadsheet(tmp_path):
    book = openpyxl.Workbook()
    for row in (["Diameter (mm)", 50], ["Height (mm)", 30], ["Time (s)", "Extension (mm)", "Load (mN)"],
                *([float(i), float(way), in_style(load, 0, ",", ".")] for i, (way, load) in
                  enumerate(zip(WAY_MM, load_mN(), strict=True)))):
        book.active.append(row)
    book.save(tmp_path / "gel.xlsx")
    assert fitted(tmp_path, tmp_path / "gel.xlsx") == pytest.approx(MODULUS_PA, rel=2e-3)


@pytest.mark.slow
def test_a_separator_that_fits_both_readings_is_a_question_and_a_flag_answers_it(tmp_path, capsys):
    rows = "".join(f"{i}\t{in_style(2000 + 1e3 * way, 0, '.', ',')}\t{in_style(1500 + load, 0, '.', ',')}\n"
                   for i, (way, load) in enumerate(zip(WAY_MM, load_mN(), strict=True)))
    path = put(tmp_path, "Time (s)\tExtension (um)\tLoad (mN)\n" + rows, "gel.txt")
    arguments = ["import", str(path), "-o", str(tmp_path / "c.toml"), "--overwrite", "--kind", "lubricated_compression",
                 "--radius-mm", "25", "--height-mm", "30"]
    assert main(arguments) == 1
    assert '--decimal "."' in " ".join(capsys.readouterr().out.split())
    assert main([*arguments, "--decimal", "."]) == 0
    curve, = calibration.read_measured_curves(calibration.load_campaign(tmp_path / "c.toml"))["gel"]
    assert np.ptp(curve.force) == pytest.approx(1e-3 * np.ptp(load_mN()), rel=1e-3)


def test_a_column_that_cannot_be_read_is_named_with_its_line(tmp_path, capsys):
    path = put(tmp_path, "Time (s)\tExtension (mm)\tLoad (N)\n" + "".join(f"{i}\t{i}\t1·{i}\n" for i in range(9)))
    for flags in ([], ["--column", "force=3", "--column", "displacement=2"]):
        assert main(["import", str(path), *flags]) == 2
        assert "line 2: 'Load (N)' holds '1·0', which is not a number" in capsys.readouterr().err


SMALL_MM = np.linspace(0.0, 2.5, 51)


def compression(delimiter=",", modulus=20e3, extra=()):
    names = ["Time (s)", "Extension (mm)", "Load (mN)", *(name for name, _ in extra)]
    rows = zip(SMALL_MM, SMALL_MM, load_mN(10.0, 12.0, SMALL_MM, modulus), strict=True)
    return "\n".join([delimiter.join(names), *(delimiter.join([f"{t:.2f}", f"{way:.4f}", f"{load:.4f}", *(
        value for _, value in extra)]) for t, way, load in rows)]) + "\n"


LINES = "Diameter,20,mm\nHeight,12,mm\n"


@pytest.mark.slow
@pytest.mark.parametrize("text", [
    LINES + compression(), compression() + "\n" + LINES, "Diameter,20,mm\n" + compression() + "Height (mm),12\n",
    compression() + "\nResults\nSpecimen,Diameter (mm),Height (mm)\n1,20.0,12.0\n",
    compression() + "Results\nSpecimen,Diameter,Height\n,mm,mm\n1,20.0,12.0\nMean,20.0,12.0\nSD,0,0\n",
    "Specimen,Diameter (mm),Height (mm)\n1,20,12\n\n" + compression(),
    compression(extra=[("Diameter (mm)", "20"), ("Height (mm)", "12")]),
    "Radius,10,mm\nSample thickness,12,mm\n" + compression(),
    "Diam. [mm],20\nInitial height h0 [mm],12\n" + compression(),
    "Ø,20,mm\nh,12,mm\n" + compression(), "Circumference,62.832,mm\nHeight,1.2,cm\n" + compression(),
    "Cross-sectional area (mm2),314.16\nHeight,12,mm\n" + compression(),
    "Area: 3.1416 cm²\nHeight: 12 mm\n" + compression(),
    "Specimen dimensions: diameter 20 mm, height 12 mm\n" + compression(),
    "The sample was 20 mm in diameter and 12 mm high.\nPlates of diameter 50 mm\n" + compression(),
    compression() + "Specimen Ø 20 x 12 mm\n", "Diameter,20,mm,Height,12,mm\n" + compression(),
    "Dimensions (diameter x height): 20 x 12 mm\n" + compression(),
    "Diameter = 20.0 ± 0.1 mm, h = 12 mm\n" + compression(),
    compression() + "Results\nSpecimen,Diameter (mm),Height (mm)\n" + "".join(f"{i},20,12\n" for i in range(1, 8)),
    "Probe diameter,50,mm\n" + LINES + compression() + "\nDiameter (mm),20.0\n",
    # Integers do not show the decimal mark: a size of 12,000 mm has a decimal comma.
    "Durchmesser;20,0;mm\nHöhe;12,000;mm\nTime (s);Extension (um);Load (mN)\n" + "".join(
        f"{i};{round(1e3 * way)};{round(load)}\n" for i, (way, load) in
        enumerate(zip(SMALL_MM, load_mN(10.0, 12.0, SMALL_MM, 20e3), strict=True))),
    "Durchmesser;20,0;mm\nHöhe;12,0;mm\n" + compression(";").replace(".", ","),
])
def test_sizes_are_found_wherever_the_file_states_them(tmp_path, text):
    assert fitted(tmp_path, put(tmp_path, text)) == pytest.approx(20e3, rel=2e-3)


@pytest.mark.parametrize(("text", "words"), [
    (LINES + compression() + "\nDiameter,25,mm\n", "10 mm (--radius-mm 10) or 12.5 mm"),
    (LINES + "Area,490.9,mm2\n" + compression(), "--radius-mm 10) or 12.5"),
    (LINES + "Radius,20,mm\n" + compression(), "or 20 mm"),
    (LINES + "Height,15,mm\n" + compression(), "--height-mm 15"),
])
def test_sizes_that_contradict_each_other_are_a_question(tmp_path, text, words):
    path = put(tmp_path, text)
    wishes = ImportOptions(InterpretationOverrides(kind="lubricated_compression"))
    question, = calibration.import_files([path], wishes=wishes).questions
    assert words in question
    flags = {"radius_mm": 10.0, "height_mm": 12.0}
    assert calibration.import_files([path], wishes=ImportOptions(wishes.stated, flags)).is_complete


#: Ten samples of a strip or block in tension or shear.
STRIP = "Displacement (mm),Force (N)\n" + "".join(f"{0.5 * i:g},{0.1 * i:g}\n" for i in range(10))
STRIP_SIZES = "Gauge length,50,mm\nLength,50,mm\nWidth,10,mm\nThickness,2,mm\n\n"


@pytest.mark.parametrize(("below", "kind", "words"), [
    ("Thickness,2.5,mm\n", "uniaxial_tension", "20 mm² (--area-mm2 20) or 25 mm²"),
    ("Width (cm),0.8\n", "uniaxial_tension", "20 mm² (--area-mm2 20) or 16 mm²"),
    ("The strip was 8 mm wide.\n", "uniaxial_tension", "or 16 mm²"),
    ("Width,8,mm\nThickness,2.5,mm\nThickness,4,mm\n", "uniaxial_tension", "or 32 mm²"),
    ("Gauge length,40,mm\n", "uniaxial_tension", "50 mm (--height-mm 50) or 40 mm"),
    ("Width,12,mm\n", "simple_shear", "500 mm² (--area-mm2 500) or 600 mm²"),
    ("Length,60,mm\n", "simple_shear", "500 mm² (--area-mm2 500) or 600 mm²"),
    ("Thickness,3,mm\n", "simple_shear", "2 mm (--height-mm 2) or 3 mm")])
def test_sizes_of_a_strip_or_block_that_contradict_each_other_are_a_question(tmp_path, below, kind, words):
    wishes = ImportOptions(InterpretationOverrides(kind=kind))
    questions = calibration.import_files([put(tmp_path, f"{STRIP_SIZES}{STRIP}\n{below}")], wishes=wishes).questions
    assert any(words in question for question in questions)
    # The same size again, in any unit, is no contradiction.
    again = put(tmp_path, f"{STRIP_SIZES}{STRIP}\nWidth,1.0,cm\nThickness,0.2,cm\nThe strip was 10 mm wide.\n")
    assert calibration.import_files([again], wishes=wishes).questions == ()


def test_a_contradiction_below_a_repeated_header_is_a_question(tmp_path):
    header = "Time (s),Displacement (mm),Force (N)\n"
    rows = [f"{i},{0.5 * i:g},{0.1 * i:g}\n" for i in range(10)]
    text = f"{STRIP_SIZES}{header}{''.join(rows[:5])}{header}{''.join(rows[5:])}\nThickness,2.5,mm\n"
    wishes = ImportOptions(InterpretationOverrides(kind="uniaxial_tension"))
    imported = calibration.import_files([put(tmp_path, text)], wishes=wishes)
    assert any("--area-mm2 25" in question for question in imported.questions)


def test_sizes_that_differ_by_their_rounding_do_not_contradict(tmp_path):
    path = put(tmp_path, LINES + "Area,314,mm2\nRadius,10.0,mm\n" + compression())
    wishes = ImportOptions(InterpretationOverrides(kind="lubricated_compression"))
    assert calibration.import_files([path], wishes=wishes).is_complete


def test_a_size_without_unit_is_not_said_to_be_absent(tmp_path):
    path = put(tmp_path, "Diameter,20\nHeight,12,mm\n" + compression())
    imported = calibration.import_files([path],
                                        wishes=ImportOptions(InterpretationOverrides(kind="lubricated_compression")))
    missing, = imported.missing
    assert "the file states 'Diameter: 20' without a known unit" in missing and "no file states" not in imported.text


def blocks(*titles, moduli=(20e3, 40e3, 20e3, 40e3)):
    return LINES + "\n".join(f"{title}\n{compression(modulus=modulus)}" for title, modulus in
                             zip(titles, moduli, strict=False))


@pytest.mark.slow
@pytest.mark.parametrize("titles", [
    ("Gel A", "Liver"), ("agar 1 %", "agar 2 %"), ("Specimen: gelatin", "Specimen: agar"), ("PVA 10", "PVA 50")])
def test_titles_of_different_materials_are_tests_of_their_own_and_a_question(tmp_path, titles):
    path, stated = put(tmp_path, blocks(*titles)), InterpretationOverrides(kind="lubricated_compression")
    imported = calibration.import_files([path], wishes=ImportOptions(stated))
    assert [len(test.parts[0].motions) for test in imported.tests] == [1, 1]
    question, = imported.questions
    assert "--curve 2" in question and "--one-material" in question
    one = calibration.import_files([path], wishes=ImportOptions(
        InterpretationOverrides(kind="lubricated_compression", one_material=True)))
    assert one.is_complete and len(one.tests[0].parts[0].motions) == 2
    second = InterpretationOverrides(kind="lubricated_compression", curve=2)
    assert fitted(tmp_path, path, stated=second) == pytest.approx(40e3, rel=2e-3)


@pytest.mark.parametrize("titles", [
    ("Specimen 1", "Specimen 2"), ("gel, sample 1", "gel (replicate #2)"), ("Essai n° 1", "Essai n° 2"),
    ("Probe A", "Probe B"), ("", ""), ("Run 1\n2026-05-12 10:00", "Run 2\n2026-05-13 11:00"), ("gel_1", "gel_2")])
def test_titles_that_differ_by_a_running_number_are_replicates(tmp_path, titles):
    imported = calibration.import_files([put(tmp_path, blocks(*titles))], wishes=ImportOptions(
        InterpretationOverrides(kind="lubricated_compression")))
    assert imported.is_complete and len(imported.tests[0].parts[0].motions) == 2


def test_each_material_keeps_its_own_tables(tmp_path):
    path = put(tmp_path, blocks("gel 1", "liver 1", "gel 2", "liver 2"))
    imported = calibration.import_files([path], tmp_path / "c.toml", ImportOptions(
        InterpretationOverrides(kind="lubricated_compression"), laws=("neo_hooke",)))
    # The user answers the question by deleting the key.
    text = (tmp_path / "c.toml").read_text(encoding="utf-8")
    assert "questions = " in text
    (tmp_path / "c.toml").write_text(re.sub(r"questions = \[[^\]]*\]", "", text), encoding="utf-8")
    curves = calibration.read_measured_curves(calibration.load_campaign(tmp_path / "c.toml"))
    peaks = [[float(curve.force.max()) for curve in several] for several in curves.values()]
    assert imported.problem is None and peaks[0][0] == peaks[0][1] and peaks[1][0] == pytest.approx(2 * peaks[0][0])


def test_replicates_with_and_without_separators_stay_replicates(tmp_path):
    for number, largest in ((1, 999.0), (2, 1100.0)):
        rows = "".join(f"{way:.3f}\t{in_style(largest * way / 2.5, 0, '.', ',')}\n" for way in SMALL_MM)
        put(tmp_path, "Extension (mm)\tLoad (mN)\n" + rows, f"gel_{number}.txt")
    imported = calibration.import_files(sorted(tmp_path.glob("*.txt")), wishes=ImportOptions(
        InterpretationOverrides(kind="lubricated_compression"), {"radius_mm": 10.0, "height_mm": 12.0}))
    test, = imported.tests
    assert len(test.parts) == 2 and imported.is_complete


def test_sizes_that_no_word_names_are_shown_and_asked_for(tmp_path):
    path = put(tmp_path, "Size: 20 x 12 mm\n" + compression())
    imported = calibration.import_files([path],
                                        wishes=ImportOptions(InterpretationOverrides(kind="lubricated_compression")))
    assert len(imported.missing) == 2 and "no file states" not in imported.text
    assert all("'Size: 20 x 12 mm', which does not name the sizes" in each for each in imported.missing)


def test_a_machine_format_does_not_choose_between_two_decimal_marks(tmp_path):
    rows = "".join(f"{i}\t{in_style(2000 + 50 * i, 0, '.', ',')}\t{in_style(1500 + 90 * i, 0, '.', ',')}\n"
                   for i in range(30))
    path = put(tmp_path, "Time (s)\tExtension (um)\tLoad (mN)\n" + rows, "gel.txt")
    with pytest.raises(ts.InputError, match="decimal mark: a decimal comma: '2,000' is 2 "):
        ts.read_recordings(path, format="table")


def listed(loads, list_below=False):
    """A list of the sizes of three specimens, and three tables with a number each."""
    sizes = ["Specimen,Diameter (mm),Height (mm)", "1,50,30", "2,60,36", "3,42.5,25.5", ""]
    tables = [f"Specimen {i}\nTime (s),Displacement (mm),Force (mN)\n" + "\n".join(
        f"{k},{way:.4f},{load:.2f}" for k, (way, load) in enumerate(zip(WAY_MM, each, strict=True)))
        for i, each in enumerate(loads, 1)]
    return "Compression test\n" + "\n".join([*tables, "", *sizes] if list_below else [*sizes, *tables]) + "\n"


LISTED = ((25.0, 30.0), (30.0, 36.0), (21.25, 25.5))


@pytest.mark.slow
@pytest.mark.parametrize("list_below", [False, True])
def test_each_table_has_its_row_in_a_list_of_sizes(tmp_path, list_below):
    path = put(tmp_path, listed([load_mN(*sizes) for sizes in LISTED], list_below))
    assert fitted(tmp_path, path) == pytest.approx(MODULUS_PA, rel=2e-3)


@pytest.mark.slow
def test_tables_of_equal_forces_contradict_a_list_of_different_sizes(tmp_path):
    noise = np.random.default_rng(2).normal(0.0, 200.0, (3, WAY_MM.size))
    path = put(tmp_path, listed([load_mN() + each for each in noise]))
    imported = calibration.import_files([path], tmp_path / "c.toml")
    assert not imported.is_complete
    assert "the file contradicts itself" in imported.questions[0] and "--curve" in imported.questions[0]
    wishes = ImportOptions(specimen={"radius_mm": 25.0, "height_mm": 30.0})
    assert calibration.import_files([path], None, wishes).questions == ()


def test_titles_of_different_materials_are_a_question_also_where_the_units_differ(tmp_path):
    tables = [f"{title}\nTime (s),Displacement (mm),Force ({unit})\n" + "\n".join(
        f"{k},{way:.4f},{factor * load:.4f}" for k, (way, load) in enumerate(zip(WAY_MM, load_mN(), strict=True)))
        for title, unit, factor in (("liver", "mN", 1.0), ("kidney", "N", 3e-3))]
    path = put(tmp_path, "Compression test\nDiameter,50,mm\nHeight,30,mm\n\n" + "\n".join(tables) + "\n")
    imported = calibration.import_files([path], None)
    assert any("titles of the tables" in each and "--one-material" in each for each in imported.questions)
    assert calibration.import_files([path], None,
                                    ImportOptions(InterpretationOverrides(one_material=True))).questions == ()


def test_a_constant_column_of_a_size_is_no_motion(tmp_path):
    rows = "\n".join(f"{k},{load:.2f},50.00,30.00" for k, load in enumerate(load_mN()))
    path = put(tmp_path, f"Compression test\n\nTime (s),Force (mN),Diameter (mm),Height (mm)\n{rows}\n")
    with pytest.raises(ts.InputError, match=r"no column with a motion .* the constant speed \(--speed-mm-s\)"):
        calibration.import_files([path], None)


def test_a_gauge_length_without_a_unit_is_named(tmp_path):
    rows = "\n".join(f"{k},{way / 0.3:.4f},{load:.2f}"
                     for k, (way, load) in enumerate(zip(WAY_MM, load_mN(), strict=True)))
    path = put(tmp_path, f"Compression test\nHeight,30\n\nTime (s),Displacement (%),Force (mN)\n{rows}\n")
    with pytest.raises(ts.InputError, match="the file states 'Height: 30' without a known unit"):
        calibration.import_files([path], None)
