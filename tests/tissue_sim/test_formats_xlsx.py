"""Spreadsheets as recordings: sheets, headers, columns by place, and the measured sets that come as xlsx."""

import datetime
import sys
import zipfile

import numpy as np
import openpyxl
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tissue_sim import InputError, read_recording
from tissue_sim.recording.formats.columns import parse_column_number_or_letters, read_recordings_from_columns
from tissue_sim.recording.formats.xlsx import read_xlsx

NATIVE = ("time [s]", "displacement [mm]", "force [N]")
NUMBERS = [(0.1 * i, 0.5 * i, 0.25 * i) for i in range(6)]
BY_PLACE = {"displacement": {"column": "B", "unit": "mm"}, "force": {"column": 3, "unit": "N"}}


def write(folder, *sheets, name="run.xlsx"):
    """A workbook of (title, rows)."""
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, rows in sheets:
        sheet = book.create_sheet(title)
        for row in rows:
            sheet.append(row)
    path = folder / name
    book.save(path)
    return path


def refusal(read, path, **options):
    with pytest.raises(InputError) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value)
    return caught.value


def test_native_header(tmp_path):
    path = write(tmp_path, ("Data", [["# phantom 3"], NATIVE, *NUMBERS]))
    recording = read_recording(path, format="xlsx", kind="lubricated_compression")
    np.testing.assert_allclose(recording.displacement, 0.5e-3 * np.arange(6), atol=1e-17)
    np.testing.assert_allclose(recording.force, 0.25 * np.arange(6), atol=1e-17)
    np.testing.assert_allclose(recording.time, 0.1 * np.arange(6), atol=1e-17)
    assert recording.metadata["name"] == "run"


def test_named_columns_below_other_things_and_beside_them(tmp_path):
    rows = [["Machine", "frame 7"], [], ["t", "Way (mm)", "Load\n(N)", None, "Note"]]
    rows += [[t, d, f, None, "ok" if t < 0.2 else None] for t, d, f in NUMBERS]
    rows += [[None, None, None, None, "the end"]] * 2
    path = write(tmp_path, ("Data", rows), ("Empty", []))
    recording = read_recording(path, columns={"displacement": "Way", "force": {"name": "Load (N)", "sign": -1}})
    np.testing.assert_allclose(recording.force, -0.25 * np.arange(6), atol=1e-17)
    assert read_xlsx(path, columns={"displacement": "Way", "force": "Load"}).force[-1] == 1.25


def test_columns_by_place_without_a_header(tmp_path):
    path = write(tmp_path, ("Data", NUMBERS))
    recording = read_xlsx(path, columns=BY_PLACE)
    np.testing.assert_allclose(recording.displacement, 0.5e-3 * np.arange(6), atol=1e-17)
    np.testing.assert_allclose(recording.force, 0.25 * np.arange(6), atol=1e-17)
    # Rows of words above the numbers do not matter, and neither does a table above it that is skipped.
    path = write(tmp_path, ("Data", [[1, 2, 3], ["t", "way", "load"], *NUMBERS]))
    assert len(read_xlsx(path, columns=BY_PLACE, skip_lines=1)) == 6


@pytest.mark.parametrize("text", ["0,5;1,5;2,5\n", "0.5,1.5,2.5\n", "0,5\t1,5\t2,5\n"])
def test_columns_by_place_of_a_text_file(tmp_path, text):
    path = tmp_path / "numbers.csv"
    path.write_text("no header, words\n" + 6 * text, encoding="utf-8")
    recording = read_recording(path, columns=BY_PLACE)
    assert recording.displacement.tolist() == [1.5e-3] * 6 and recording.force.tolist() == [2.5] * 6
    error = refusal(read_recording, path, columns={**BY_PLACE, "force": {"column": 9, "unit": "N"}})
    assert "columns 2, 9" in error.problem


def test_a_name_and_a_place_together(tmp_path):
    path = write(tmp_path, ("Data", [["Load (N)", "Way (mm)", "Load (N)"], *NUMBERS]))
    assert "give its number as column" in refusal(read_xlsx, path, columns={"displacement": "Way",
                                                                            "force": "Load (N)"}).problem
    recording = read_xlsx(path, columns={"displacement": "Way", "force": {"column": "C"}})
    assert recording.force[-1] == 1.25, "the unit stands in the header of column C"
    error = refusal(read_xlsx, path, columns={"displacement": "Way", "force": {"column": 8}})
    assert "no column 8" in error.problem and error.field == "columns.force"


def test_which_sheet(tmp_path):
    path = write(tmp_path, ("First", [NATIVE, *NUMBERS]), ("Second", [NATIVE, *[(t, d, 2 * f) for t, d, f in NUMBERS]]))
    error = refusal(read_xlsx, path)
    assert error.field == "sheet" and "'First' or 'Second'" in error.problem
    assert read_xlsx(path, sheet="Second").force[-1] == 2.5
    assert read_recording(path, format="xlsx", sheet=2).force[-1] == 2.5
    columns = {"displacement": "displacement", "force": "force"}
    assert read_recording(path, columns=columns, sheet=2).force[-1] == 2.5
    with pytest.raises(InputError, match="files of format 'xlsx' have no curve") as caught:
        read_recording(path, format="xlsx", curve=2)
    assert caught.value.field == "curve"
    assert read_xlsx(path, sheet=1, columns={"displacement": "displacement", "force": "force"}).force[-1] == 1.25
    assert "did you mean 'Second'" in refusal(read_xlsx, path, sheet="Secnd").problem
    assert "must be from 1 to 2, the number of sheets in the file; got 3" in refusal(read_xlsx, path, sheet=3).problem
    assert refusal(read_xlsx, path, sheet=1.5).field == "sheet"
    assert refusal(read_xlsx, write(tmp_path, ("Empty", []))).problem.startswith("is empty")


@pytest.mark.parametrize(("cell", "message"), [
    ("bad", "sheet 'Data': column 'force [N]' holds 'bad', expected a finite number"),
    (None, "column 'force [N]' is empty"),
    (True, "holds 'True'"),
    # A formula that was never calculated, and one that failed, have no value.
    ("=1+1", "column 'force [N]' is empty"),
    ("#DIV/0!", "column 'force [N]' is empty"),
    (datetime.time(0, 0, 1), "holds '00:00:01'"),
])
def test_a_bad_cell_is_named_by_sheet_column_and_row(tmp_path, cell, message):
    rows = [list(row) for row in NUMBERS]
    rows[3][2] = cell
    path = write(tmp_path, ("Notes", [["remarks"]]), ("Data", [NATIVE, *rows]))
    error = refusal(read_xlsx, path, sheet="Data")
    assert message in error.problem
    assert error.line == 5 and error.file == path


def test_stored_values_of_formulas_are_read(tmp_path):
    """As a spreadsheet program saves them: openpyxl itself writes no values."""
    path = write(tmp_path, ("Data", [NATIVE, *NUMBERS]))
    parts = {}
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    assert parts[sheet].count(b"<v>1.25</v>") == 1
    parts[sheet] = parts[sheet].replace(b"<v>1.25</v>", b"<f>5*0.25</f><v>1.25</v>")
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    assert read_xlsx(path).force[-1] == 1.25


@pytest.mark.parametrize(("columns", "message"), [
    ({"displacement": "Weg", "force": "Load"}, "no row with the column 'Weg'"),
    ({"displacement": "Way", "force": "Laod"}, "did you mean 'Load (N)'"),
])
def test_missing_columns(tmp_path, columns, message):
    path = write(tmp_path, ("Data", [["t", "Way (mm)", "Load (N)"], *NUMBERS]))
    problem = refusal(read_xlsx, path, columns=columns).problem
    assert "sheet 'Data'" in problem and ("no column 'Weg'" in problem or message in problem)


@pytest.mark.parametrize(("column", "expected"), [("A", 1), ("z", 26), ("AA", 27), ("XFD", 16384), (7, 7)])
def test_letters_of_columns(column, expected):
    assert parse_column_number_or_letters(column) == expected


@pytest.mark.parametrize("column", [0, -1, True, "", "ABCD", "A1", 1.0, None])
def test_what_is_no_place(column):
    assert refusal(parse_column_number_or_letters, column).field == "column"


def test_a_place_needs_a_unit_and_stands_alone(tmp_path):
    path = write(tmp_path, ("Data", NUMBERS))
    error = refusal(read_xlsx, path, columns={**BY_PLACE, "force": {"column": "C"}})
    assert error.field == "columns.force" and "{ column = 3, unit" in error.problem
    error = refusal(read_xlsx, path, columns={**BY_PLACE, "force": {"column": "C", "name": "Load"}})
    assert error.field == "columns.force.column"
    error = refusal(read_xlsx, path, columns={**BY_PLACE, "force": {"column": "B", "unit": "N"}})
    assert "two channels" in error.problem


def test_no_spreadsheet(tmp_path):
    path = tmp_path / "run.xlsx"
    assert "no such file" in refusal(read_xlsx, path).problem
    path.write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1")
    assert "cannot be read as a spreadsheet" in refusal(read_xlsx, path).problem
    path.write_bytes(b"time [s],force [N]\n")
    assert "cannot be read as a spreadsheet" in refusal(read_xlsx, path).problem
    assert "cannot be read as a spreadsheet" in refusal(read_recording, path, columns=BY_PLACE).problem
    good = write(tmp_path, ("Data", NUMBERS), name="good.xlsx")
    assert "format = 'xlsx'" in refusal(read_recording, good).problem
    assert refusal(read_recording, good, columns=BY_PLACE, delimiter=";").field == "delimiter"


def test_without_the_extra_the_answer_names_it(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert "pip install 'tissue-sim[formats]'" in refusal(read_recordings_from_columns, path, columns=BY_PLACE).problem


numbers = st.floats(-1e6, 1e6, allow_subnormal=False)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=st.lists(st.tuples(numbers, numbers), min_size=5, max_size=9), above=st.integers(0, 3),
       left=st.integers(0, 3))
def test_any_table_is_read_back(tmp_path, values, above, left):
    rows = [["words"]] * above + [[None] * left + list(row) for row in values]
    columns = {"displacement": {"column": left + 1, "unit": "m"}, "force": {"column": left + 2, "unit": "N"}}
    recording = read_xlsx(write(tmp_path, ("Data", rows)), columns=columns)
    # openpyxl writes 16 digits; where Taichi runs in the same process the smallest numbers are zero.
    np.testing.assert_allclose(recording.displacement, [way for way, _ in values], rtol=1e-15, atol=1e-300)
    np.testing.assert_allclose(recording.force, [load for _, load in values], rtol=1e-15, atol=1e-300)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.floats(0, 1), data=st.binary(max_size=6), cut=st.integers(0, 60))
@example(position=0.4227867497508596, data=b"\x00\x01", cut=2)
def test_a_damaged_spreadsheet_is_read_or_refused(tmp_path, position, data, cut):
    path = tmp_path / "good.xlsx"
    if not path.exists():
        write(tmp_path, ("Data", [NATIVE, *NUMBERS]), name="good.xlsx")
    content = path.read_bytes()
    at = int(position * len(content))
    damaged = tmp_path / "damaged.xlsx"
    damaged.write_bytes(content[:at] + data + content[at + cut:])
    try:
        assert len(read_xlsx(damaged)) >= 5
    except InputError as error:
        assert str(damaged) in str(error) and "\n" not in str(error)


def shear(order):
    """Columns of the shear tests: channel names from A on, None for a column that is left."""
    units = {"time": "s", "displacement": "mm", "force": "N", "nominal stress": "kPa", "shear strain": "-"}
    return {name: {"column": i + 1, "unit": units[name]} for i, name in enumerate(order) if name}


CYCLIC = ("time", "force", "displacement", "nominal stress", "shear strain")
#: In this one file displacement and force change places.
SWAPPED = ("time", "displacement", "force", "nominal stress", "shear strain")


@pytest.mark.parametrize(("name", "order", "points", "rate"), [
    ("", CYCLIC, 590, 1 / 30), ("_0d1", SWAPPED, 432, 0.1), ("_1", CYCLIC, 370, 1 / 60), ("_2", CYCLIC, 370, 1 / 30),
    ("_5", CYCLIC, 370, 1 / 12)])
def test_shear_relaxation_set(data_folder, name, order, points, rate):
    """Ramp rates from sample to sample; the area is 100 mm2 and the layer 0.13 mm thick in every file."""
    path = data_folder / "oca_vhb_viscoelastic" / f"cyclic-shear-relaxation-test__shear_relaxation{name}.xlsx"
    recording = read_recording(path, columns=shear(order), kind="simple_shear")
    assert len(recording) == points
    strain = recording.channel("shear strain")
    steps = np.diff(strain) / np.diff(recording.time)
    assert np.median(steps[steps > 0.5 * steps.max()]) == pytest.approx(rate, rel=0.03)
    # One file's stress is tared by the first force, 0.7 mN.
    np.testing.assert_allclose(recording.force, 100e-6 * recording.channel("nominal stress"), rtol=1e-5, atol=0.72e-3)
    np.testing.assert_allclose(recording.displacement, 0.13e-3 * strain, rtol=1e-5, atol=1e-8)
    assert strain.max() == pytest.approx(10.0, rel=0.003)


@pytest.mark.parametrize(("name", "order", "points", "last"), [
    ("0d01", ("time", None, "nominal stress", "shear strain"), 199, (9.9943104, 73394.8)),
    ("0d05", ("time", "displacement", "force", "shear strain", "nominal stress"), 149, (9.96692307692308, 70808.0)),
    ("0d1", ("time", None, "nominal stress", "shear strain"), 100, (9.85, 148717.0)),
    ("1", ("time", None, "nominal stress", "shear strain"), 61, (6.0370493, 199577.0))])
def test_monotonic_shear_set(data_folder, name, order, points, last):
    path = data_folder / "oca_vhb_viscoelastic" / f"monotonic-shear-test__monotonic_shear_{name}.xlsx"
    recording = read_recording(path, columns=shear(order), kind="simple_shear")
    assert len(recording) == points
    assert recording.channel("shear strain")[-1] == last[0]
    assert recording.channel("nominal stress")[-1] == pytest.approx(last[1], rel=1e-12)


def test_loading_unloading_set(data_folder):
    """Rates and largest stretches are those in the names of the files."""
    files = sorted((data_folder / "oca_vhb_viscoelastic").glob("uniaxial*.xlsx"))
    assert len(files) == 11
    for path in files:
        _, largest, _, rate = path.stem.split("__")[1].split("_")
        recording = read_recording(path, kind="uniaxial_tension", columns={
            "time": {"column": "A", "unit": "s"}, "stretch": {"column": "B"},
            "nominal stress": {"column": "C", "unit": "kPa"}})
        stretch = recording.channel("stretch")
        assert stretch.max() == pytest.approx(float(largest.replace("d", ".")), rel=0.01)
        steps = np.diff(stretch) / np.diff(recording.time)
        np.testing.assert_allclose(abs(steps), float(rate.replace("d", ".")), rtol=0.02)


def test_foam_set_by_name(data_folder):
    recording = read_recording(data_folder / "foam_compressible" / "foam_leap__Foam.xlsx", kind="uniaxial_tension",
                               columns={"stretch": "leap-comten-stretch", "nominal stress": "leap-comten-stress"})
    assert len(recording) == 201
    assert recording.channel("nominal stress")[0] == pytest.approx(-241599.6066768916)


def test_a_cell_far_away_is_refused(tmp_path):
    """A single distant cell would need the memory of the whole rectangle."""
    book = openpyxl.Workbook()
    for row in NUMBERS:
        book.active.append(row)
    book.active["XFD1048576"] = 3
    book.save(tmp_path / "far.xlsx")
    assert "reaches to cell XFD1048576" in refusal(read_xlsx, tmp_path / "far.xlsx", columns=BY_PLACE).problem
