"""Numbers with a unit in their cell, and unusual exponents and minus signs."""

import math

import numpy as np
import openpyxl
import pytest

import tissue_sim as ts
from tissue_sim.recording.formats.guesses import InterpretationOverrides
from tissue_sim.recording.formats.number_text import (
    is_number_with_either_mark,
    parse_number_or_nan,
    split_number_and_unit,
)
from tissue_sim.recording.formats.sizes import parse_number_and_optional_unit_or_none
from tissue_sim.recording.formats.table import TableRow, UnitRowExtractedFromCells, move_cell_units_to_unit_row
from tissue_sim.recording.formats.understanding import interpret_file

WAY = np.linspace(0.0, 4.0, 17)
FORCE = 2.5 * WAY + 0.25 * WAY**2


def text(cells, header="Time;Displacement;Load", title="Compression test"):
    return "\n".join([title, header, *(";".join(row) for row in cells)]) + "\n"


def quantities(units=("s", "mm", "N"), decimal="."):
    return [[f"{value:.4f} {unit}".replace(".", decimal) for value, unit in zip(row, units, strict=True)]
            for row in zip(WAY / 0.1, WAY, FORCE, strict=True)]


def understood(tmp_path, content, **stated):
    path = tmp_path / "gel.csv"
    path.write_text(content, encoding="utf-8")
    found = interpret_file(path, InterpretationOverrides(**stated))
    return found.readings[0], path


@pytest.mark.parametrize(("cell", "expected"), [
    ("12.3 N", ("12.3", "N")), ("-1,5mm", ("-1,5", "mm")), ("1.2e-3 kN", ("1.2e-3", "kN")), ("5 %", ("5", "%")),
    ("1'234.5 mN", ("1'234.5", "mN")), ("2 N/mm2", ("2", "N/mm2")), ("3 \u00b5m", ("3", "um")), ("12.3", None),
    ("1E", None), ("specimen 2", None), ("10:30:00", None), ("3 apples", None), ("2 mm high", None)])
def test_a_number_and_its_unit(cell, expected):
    assert split_number_and_unit(cell) == expected


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("header", ["Time;Displacement;Load", "Time (s);Displacement (mm);Load (N)"])
def test_units_in_the_cells_are_read_and_named(tmp_path, decimal, header):
    reading, path = understood(tmp_path, text(quantities(decimal=decimal), header))
    recording, = reading.recordings
    np.testing.assert_allclose(recording.displacement, 1e-3 * WAY, atol=1e-12)
    np.testing.assert_allclose(recording.force, FORCE, atol=1e-4)
    unit = next(each for each in reading.assumptions if each.subject == "unit of force")
    assert unit.value == "N" and unit.evidence[0] in ("after each number of the column", "in the header 'Load (N)'")
    again = ts.read_recording(path, **reading.options)
    np.testing.assert_array_equal(again.force, recording.force)


def test_units_in_the_cells_of_a_spreadsheet(tmp_path):
    book = openpyxl.Workbook()
    for row in ("Time", "Displacement", "Load"), *quantities(("s", "um", "mN")):
        book.active.append(row)
    book.save(tmp_path / "gel.xlsx")
    recording, = interpret_file(tmp_path / "gel.xlsx").readings[0].recordings
    np.testing.assert_allclose(recording.force, 1e-3 * FORCE, atol=1e-7)


def test_a_unit_in_the_cells_that_contradicts_the_header_is_a_question(tmp_path):
    reading, _ = understood(tmp_path, text(quantities(("s", "mm", "mN")), "Time (s);Displacement (mm);Load (N)"))
    unit = next(each for each in reading.assumptions if each.subject == "unit of force")
    assert unit.needs_user_decision and "the cells have mN" in unit.against


@pytest.mark.parametrize("odd", ["9.9 mN", "9.9"])
def test_different_units_in_one_column_are_refused_with_the_line(tmp_path, odd):
    cells = quantities()
    cells[7][2] = odd
    with pytest.raises(ts.InputError, match=r"line 3: 'Load' holds '0.0000 N', and other cells have another unit"):
        understood(tmp_path, text(cells))


def test_rows_without_units_stay_as_they_are():
    rows = [TableRow(i, (str(i), "2.5", "note 3")) for i in range(1, 9)]
    assert move_cell_units_to_unit_row(rows, "note 3\n") is not None and move_cell_units_to_unit_row(rows) == rows
    few = [TableRow(i, (f"{i} mm", f"{i} N")) for i in range(1, 5)]
    assert move_cell_units_to_unit_row(few) == few
    assert isinstance(move_cell_units_to_unit_row([*few, TableRow(5, ("5 mm", "5 N"))])[0], UnitRowExtractedFromCells)


@pytest.mark.parametrize(("cell", "decimal", "value"), [
    ("1.25D-03", ".", 1.25e-3), ("-1,25d+02", ",", -125.0), ("1.25D+00", ",", math.nan), ("1.25 x 10^-3", ".", 1.25e-3),
    ("1,25\u00d710^3", ",", 1250.0), ("3D10", ".", math.nan), ("\u22120,0125", ",", -0.0125),
    ("\u22121.5E\u221203", ".", -1.5e-3), ("1.2.3D1", ".", math.nan)])
def test_exponents_and_minus_signs(cell, decimal, value):
    assert parse_number_or_nan(cell, decimal) == pytest.approx(value, nan_ok=True)
    assert is_number_with_either_mark(cell) or math.isnan(value)


@pytest.mark.parametrize("style", ["{:.6e}", "{:.6E}", "D"])
@pytest.mark.parametrize("decimal", [".", ","])
def test_a_table_of_exponents(tmp_path, style, decimal):
    cells = [[(f"{value:.6E}".replace("E", "D") if style == "D" else style.format(value)).replace(".", decimal)
              for value in row] for row in zip(WAY / 0.1, WAY, FORCE, strict=True)]
    reading, _ = understood(tmp_path, text(cells, "Time (s);Displacement (mm);Load (N)"))
    np.testing.assert_allclose(reading.recordings[0].force, FORCE, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("quantity", "expected"), [("1.25D+01 mm", (12.5, "mm")), ("1,25E+01 mm", (12.5, "mm"))])
def test_sizes_with_exponents(quantity, expected):
    assert parse_number_and_optional_unit_or_none(quantity) == expected
