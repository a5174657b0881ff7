"""Long texts, whose plain end is read at once: always the recording, or the sentence, of the way cell by cell."""

from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.recording.formats import long_text
from tissue_sim.recording.formats.columns import read_recordings_from_columns
from tissue_sim.recording.formats.long_text import try_splitting_off_trailing_numbers
from tissue_sim.recording.formats.machines import read_table
from tissue_sim.recording.formats.native import read_native

COLUMNS = {"time": "Time", "displacement": {"name": "Displacement", "unit": "mm"}, "force": "Load"}
PLACES = {"time": {"column": 1, "unit": "s"}, "displacement": {"column": 2, "unit": "mm"},
          "force": {"column": 3, "unit": "N"}}
READERS = {"native": read_native, "table": read_table,
           "columns": lambda path: read_recordings_from_columns(path, COLUMNS),
           "places": lambda path: read_recordings_from_columns(path, PLACES)}
ROWS = [f"{0.5 * i},{0.25 * i:.3f},{0.1 * i**2:.5f}" for i in range(16)]
ROWS_OF_DECIMALS = [row.replace(f"{0.5 * i},", f"{0.5 * i:.1f},", 1) for i, row in enumerate(ROWS)]
#: The cells are separated by semicolons, the thousands by commas.
OF_THOUSANDS = "\n".join(["Time [s];Displacement [mm];Load [N]", *(
    f"{0.5 * i:.1f};{250 * i:,.3f};{1e5 * i**2 + 0.5:,.2f}" for i in range(16))]) + "\n"


#: Every cell is quoted.
QUOTED = [",".join(f'"{cell}"' for cell in row.split(",")) for row in ROWS]
#: Every number has a unit.
WITH_UNITS = [" s,".join(row.split(",", 1)).replace(",", " mm,").replace(" s mm,", " s,") + " N" for row in ROWS]


def foreign(rows, sign=",", header="Time [s],Displacement [mm],Load [N]"):
    return "\n".join([header, *rows]).replace(",", sign) + "\n"


def outcome(reader, path):
    """Return the result of reading: channels and labels, or line and message of the error."""
    try:
        found = READERS[reader](path)
    except ts.InputError as error:
        return error.line, error.field, error.problem
    return [({name: values.tolist() for name, values in each.channels.items()},
             {name: values.tolist() for name, values in each.labels.items()})
            for each in (found if isinstance(found, tuple) else (found,))]


def both(reader, text, folder, beginning=8):
    """The outcomes with a plain end below so few lines, and without one."""
    path = Path(folder) / "long.csv"
    path.write_bytes(text.encode())
    with mock.patch.object(long_text, "_SETTINGS", replace(long_text._SETTINGS, beginning=beginning)):
        at_once = outcome(reader, path)
    return at_once, outcome(reader, path)


@pytest.mark.parametrize("text", [
    foreign(ROWS), foreign(ROWS, ";"), foreign(ROWS, "\t"), foreign(ROWS).replace("\n", "\r\n"),
    foreign(ROWS).rstrip(), foreign(ROWS) + "\n\n",
    foreign(ROWS, ", "),
    foreign([row.replace(",", ";").replace(".", ",") for row in ROWS], ",", "Time [s];Displacement [mm];Load [N]"),
    foreign(["s,mm,N", *ROWS]),
    foreign([f"{row},7" for row in ROWS], header="Time [s],Displacement [mm],Load [N],Note"),
    "made by hand\n" + foreign(ROWS), foreign([row.upper() for row in ROWS]),
    *(OF_THOUSANDS.replace(",", "M").replace(".", decimal).replace("M", separator)
      for decimal, separator in ((".", ","), (",", "."), (",", " "), (",", "\u00a0"), (".", "'"), (".", "\u2019"))),
    foreign([row.replace(",", "D+00,") + "D-01" for row in ROWS_OF_DECIMALS]),
    foreign([row.replace(",", ",\u2212") for row in ROWS]),
    foreign(QUOTED), foreign(QUOTED, ";"), foreign(QUOTED, "\t"), foreign(QUOTED).replace("\n", "\r\n"),
    foreign(QUOTED)[:-1],
    foreign([row.replace(",", ',"', 1).replace(",", '",', 2).replace('",', ",", 1) for row in ROWS]),
    foreign([row.replace('"', '" ') for row in QUOTED]).replace('" ,', '",').replace('" \n', '"\n'),
    "\n".join([foreign([]).strip(), *(row.replace(".", "D").replace('","', "M").replace("D", ",").replace("M", '","')
                                      for row in QUOTED)]) + "\n",
    foreign(WITH_UNITS, header="Time,Displacement,Load"), foreign(WITH_UNITS, "; ", header="Time,Displacement,Load"),
    foreign([row.replace(" mm", "\u00b5m").replace("N", "(N)") for row in WITH_UNITS], header="Time,Displacement,Load"),
    foreign([f'"{row}"'.replace(",", '","') for row in WITH_UNITS], header="Time,Displacement,Load"),
])
@pytest.mark.parametrize("reader", ["columns", "places", "table"])
def test_a_plain_end_gives_the_same_recording(reader, text, tmp_path):
    numbers = long_text.TrailingNumberLines.parse_columns_or_none
    with mock.patch.object(long_text.TrailingNumberLines, "parse_columns_or_none", autospec=True,
                           side_effect=numbers) as read:
        at_once, cell_by_cell = both(reader, text, tmp_path)
    assert at_once == cell_by_cell and read.called and len(at_once[0][0]["force"]) == len(ROWS)


@pytest.mark.parametrize("cell", ["12,34.5", "0,123.5", "1,234,56.5", "1234,567.5", "1,234.5,678", "1,2345", ",123.5"])
def test_separators_that_do_not_make_groups_of_three_are_refused_as_ever(cell, tmp_path):
    lines = OF_THOUSANDS.splitlines()
    lines[12] = f"5.5;{cell};1"
    at_once, cell_by_cell = both("columns", "\n".join(lines), tmp_path)
    assert at_once == cell_by_cell and at_once[0] == 13 and "expected a finite number" in at_once[2]


def test_the_plain_end_is_what_is_read(tmp_path):
    text = "# made by hand\n" + foreign(ROWS, header="time [s],displacement [mm],force [N]")
    with mock.patch.object(long_text, "_SETTINGS", long_text.LongTextSettings(beginning=4)):
        beginning, end = try_splitting_off_trailing_numbers(text)
        assert beginning.count("\n") == 4 and (end.cell_count_per_line, end.delimiter, end.marks) == (3, ",", ".")
        np.testing.assert_allclose(end.parse_columns_or_none([2, 0], "."),
                                   [[0.1 * i**2, 0.5 * i] for i in range(2, 16)], atol=1e-12)
    at_once, cell_by_cell = both("native", text, tmp_path)
    assert at_once == cell_by_cell
    np.testing.assert_allclose(cell_by_cell[0][0]["force"], [0.1 * i**2 for i in range(16)], atol=1e-12)


def test_a_cell_that_is_open_where_the_beginning_ends_is_refused_as_ever(tmp_path):
    rows = [f"{row},{i}" for i, row in enumerate(ROWS)]
    rows[6] = f'{ROWS[6]},"open'
    at_once, cell_by_cell = both("columns", foreign(rows, header="Time [s],Displacement [mm],Load [N],Note"), tmp_path)
    assert at_once == cell_by_cell and "quoted cell" in at_once[2]


def test_a_piece_ends_with_a_line(tmp_path):
    rows = [f"{i},{i},{i}" for i in range(1000)]
    with mock.patch.object(long_text, "_SETTINGS", long_text.LongTextSettings(chunk_characters=100)):
        at_once, cell_by_cell = both("columns", foreign(rows), tmp_path)
    assert at_once == cell_by_cell and len(at_once[0][0]["time"]) == 1000


@pytest.mark.parametrize(("row", "words"), [
    ("5,1,x", "expected a finite number"), ("5,1,1e999", "expected a finite number"), ("5,1,1.2.3", "finite number"),
    ("-5,1,1", "time runs backwards"), ("5,1,", "is empty"), ("5,1", "2 cells, expected 3"),
    ("5,1,1,1", "4 cells, expected 3"),
])
def test_what_is_wrong_in_the_end_is_named_with_its_line(row, words, tmp_path):
    at_once, cell_by_cell = both("columns", foreign([*ROWS[:10], row, *ROWS[11:]]), tmp_path)
    assert at_once == cell_by_cell
    assert at_once[0] == 12 and words in at_once[2]


@pytest.mark.parametrize("lines", [
    ["", ""], ["Time [s],Displacement [mm],Load [N]"], ["# a remark"], ["5.25,1.3,\"2,5\""],
    ["5,1,1", "5.5,2,2,"], ["5,1,nan"], ["5;1;1"], ["5,1,1_0"], ["5,1,\N{ARABIC-INDIC DIGIT ONE}"],
    ["5 5,1,1"], ["5,1,1\r5,1,1"], [" , , "], ['"5.25","1.3","2.5"'], ['5"5,1,1'], ['"5,1",1'], ['5.25,"1.3,2.5'],
    ['"5.25"x,1.3,2.5'], ['"5.25","1.3","2""5"'], ['5.25,"",2.5'], ["5.25,1.3 mm,2.5"], ["5.25 s,1.3 mm,2.5 N"],
])
@pytest.mark.parametrize("reader", ["columns", "places", "table", "native"])
def test_what_is_not_plain_is_looked_at_cell_by_cell(reader, lines, tmp_path):
    header = {"header": "time [s],displacement [mm],force [N]"} if reader == "native" else {}
    at_once, cell_by_cell = both(reader, foreign([*ROWS[:11], *lines, *ROWS[11:]], **header), tmp_path)
    assert at_once == cell_by_cell


@pytest.mark.parametrize("row", [
    "5.5 s,3 mm,2.5 N", "5.5 s,3 mm,2.5 kN", "5.5,3 mm,2.5 N", "5.5 s,3mm,2.5 N", "5.5 s,3 mm,N", "5.5 s,3 mm",
    '"5.5 s",3 mm,2.5 N', "5.5,3,2.5", "5.5 s,3 mm,2.5 N,1",
])
@pytest.mark.parametrize("reader", ["columns", "places", "table"])
def test_units_of_cells_in_the_end_agree_with_the_beginning_or_all_cells_are_read(reader, row, tmp_path):
    lines = [*WITH_UNITS[:11], row, *WITH_UNITS[12:]]
    at_once, cell_by_cell = both(reader, foreign(lines, header="Time,Displacement,Load"), tmp_path)
    assert at_once == cell_by_cell


def test_other_units_in_the_whole_end_are_not_read_with_the_units_of_the_beginning(tmp_path):
    lines = [*WITH_UNITS[:7], *(row.replace(" N", " kN") for row in WITH_UNITS[7:])]
    at_once, cell_by_cell = both("table", foreign(lines, header="Time,Displacement,Load"), tmp_path)
    assert at_once == cell_by_cell and "another unit than N" in at_once[2]


@pytest.mark.slow
def test_a_blank_in_a_number_between_tabs_is_refused_with_its_line(tmp_path):
    text = foreign(ROWS, "\t").replace("4.0\t", "4 0\t").replace("Time", "ime")
    at_once, cell_by_cell = both("table", text, tmp_path, beginning=6)
    assert at_once == cell_by_cell and at_once[0] == 10 and "'4 0'" in at_once[2]


@pytest.mark.slow
@settings(max_examples=250, deadline=None)
@given(data=st.data())
def test_damage_anywhere_changes_neither_recording_nor_sentence(data, tmp_path_factory):
    sign = data.draw(st.sampled_from([",", ";", "\t"]))
    rows, header = data.draw(st.sampled_from([
        (ROWS, "Time [s],Displacement [mm],Load [N]"), (QUOTED, "Time [s],Displacement [mm],Load [N]"),
        (WITH_UNITS, "Time,Displacement,Load")]))
    text = list(foreign(rows, sign, header))
    for _ in range(data.draw(st.integers(0, 3))):
        place = data.draw(st.integers(0, len(text) - 1))
        text[place] = data.draw(st.sampled_from(["", "\n", ",", ";", ".", "0", "-", "e9", "x", " ", "\"", "#", "\r\n"]))
    reader = data.draw(st.sampled_from(["columns", "places", "table"]))
    at_once, cell_by_cell = both(reader, "".join(text), tmp_path_factory.getbasetemp(),
                                 beginning=data.draw(st.integers(6, 12)))
    assert at_once == cell_by_cell


def test_a_short_text_is_whole():
    assert try_splitting_off_trailing_numbers(foreign(ROWS)) == (foreign(ROWS), None)
