"""Decimal marks and thousands separators: numbers are read back as they were written, or the reader asks."""

import math
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from tissue_sim import InputError, read_recordings
from tissue_sim.recording.formats import long_text
from tissue_sim.recording.formats.decimal_mark import detect_decimal_and_thousands_marks
from tissue_sim.recording.formats.number_text import TextOfNumericCell, is_number_with_either_mark, parse_number_or_nan

#: Decimal mark and thousands separator of English, German, French (three blanks), Swiss and plain numbers.
STYLES = [(".", ","), (",", "."), (",", " "), (",", "\u00a0"), (",", "\u202f"), (".", "'"), (".", "\u2019"), (".", " "),
          (".", ""), (",", "")]
COLUMNS = {"time": {"name": "Time", "unit": "s"}, "displacement": {"name": "Way", "unit": "um"},
           "force": {"name": "Load", "unit": "mN"}}


def written(value, style, places):
    decimal, separator = style
    text = f"{value:,.{places}f}"
    return text.replace(",", "\x00").replace(".", decimal).replace("\x00", separator)


@given(st.integers(-10**12, 10**12), st.integers(0, 6), st.sampled_from(STYLES))
def test_a_number_with_separators_is_read_back(number, places, style):
    value = number / 10**places
    text = written(value, style, places)
    assert parse_number_or_nan(text, style[0]) == float(f"{value:.{places}f}")
    assert is_number_with_either_mark(text)


@pytest.mark.parametrize(("cell", "decimal"), [
    ("0,021", "."), ("1,46", "."), ("1,4666", "."), ("12,34,567", "."), ("1.466", ","), ("1,466.5", ","), ("1 46", "."),
    ("1 466'000", "."), ("1,466 000", "."), ("1,466e3", "."), ("1_000", "."), ("", "."), ("x", ","), (",466", "."),
    ("\N{ARABIC-INDIC DIGIT ONE}", ".")])
def test_groups_that_are_not_of_three_digits_are_no_thousands(cell, decimal):
    value = parse_number_or_nan(cell, decimal)
    assert math.isnan(value) if (cell, decimal) != ("1.466", ",") else value == 1466.0


def test_a_number_stored_as_a_number_has_a_decimal_point():
    assert parse_number_or_nan(TextOfNumericCell("1.466"), ",") == 1.466
    assert detect_decimal_and_thousands_marks([[TextOfNumericCell("1.466"), TextOfNumericCell("2.5")]]).example == ""


#: A smooth ramp in micrometres and millinewtons, so that integers pass 1000.
RAMP = np.linspace(0.0, 1.0, 41)
ROWS = list(zip(np.arange(41.0), 7000 * RAMP, 120_000 * RAMP * (1 + 0.3 * RAMP), strict=True))


def table(rows, style, places=(0, 0, 0), delimiter="\t"):
    lines = [delimiter.join(("Time", "Way", "Load"))]
    lines += [delimiter.join(written(value, style, digits) for value, digits in zip(row, places, strict=True))
              for row in rows]
    return "\n".join(lines) + "\n"


def read(folder, text, **options):
    path = folder / "table.txt"
    path.write_text(text, encoding="utf-8")
    return read_recordings(path, columns=COLUMNS, **options)[0]


@pytest.mark.parametrize("places", [(0, 0, 0), (2, 3, 1), (2, 0, 1), (0, 0, 3)])
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("delimiter", ["\t", ";", "|"])
def test_a_table_with_separators_gives_the_numbers_that_were_written(tmp_path, style, places, delimiter):
    options = {"delimiter": "|"} if delimiter == "|" else {}
    recording = read(tmp_path, table(ROWS, style, places, delimiter), **options)
    np.testing.assert_allclose(recording.displacement, 1e-6 * np.round([row[1] for row in ROWS], places[1]), rtol=1e-12)
    np.testing.assert_allclose(recording.force, 1e-3 * np.round([row[2] for row in ROWS], places[2]), rtol=1e-12)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(style=st.sampled_from(STYLES), places=st.tuples(*[st.integers(0, 4)] * 3), size=st.integers(6, 60),
       largest=st.floats(1.0, 1e6), seed=st.integers(0, 99), noise=st.floats(0.0, 0.02), start=st.floats(0.0, 2.0))
def test_any_table_is_read_as_written_or_not_at_all(tmp_path, style, places, size, largest, seed, noise, start):
    ramp = start + np.linspace(0.0, 1.0, size)
    load = largest * (ramp + noise * np.random.default_rng(seed).normal(size=size))
    rows = list(zip(np.arange(size) * 0.25, 1500 * ramp, load, strict=True))
    assume(np.ptp(load) > 10.0 ** -places[2])
    try:
        recording = read(tmp_path, table(rows, style, places))
    except InputError as error:
        assert "decimal" in str(error)
        return
    shown = [float(f"{value:.{places[2]}f}") for value in load]
    np.testing.assert_allclose(recording.force, 1e-3 * np.array(shown), rtol=1e-12, atol=1e-300)


def test_values_that_fit_both_marks_are_a_question_that_an_option_answers(tmp_path):
    text = table([(t, 2000 + way, 1500 + load) for t, way, load in ROWS], (".", ","))
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert caught.value.field == "decimal" and "'2,000' is 2000 with a decimal point and 2" in caught.value.problem
    assert read(tmp_path, text, decimal=".").force[0] == pytest.approx(1.5)
    assert read(tmp_path, text, decimal=",").force[0] == pytest.approx(1.5e-3)
    with pytest.raises(InputError, match=r'must be "\." or ","; got ";"'.replace('";"', "';'")):
        read(tmp_path, text, decimal=";")


def test_a_damaged_cell_does_not_turn_thousands_into_decimals(tmp_path):
    lines = table(ROWS, (".", ",")).splitlines()
    lines[30] = lines[30].rpartition("\t")[0] + "\t12,34"
    for options in ({}, {"decimal": "."}):
        with pytest.raises(InputError) as caught:
            read(tmp_path, "\n".join(lines), **options)
        assert caught.value.line == 31 and "'12,34'" in caught.value.problem
    # Where no other column decides, one odd cell is no proof of a decimal comma.
    only_load = [f"{number}\t{line.rpartition(chr(9))[2]}" for number, line in enumerate(
        table([(0, 0, 2000 + row[2]) for row in ROWS], (".", ",")).splitlines()[1:])]
    only_load[20] = "20\t12,34"
    path = tmp_path / "one.txt"
    path.write_text("Way\tLoad\n" + "\n".join(only_load), encoding="utf-8")
    with pytest.raises(InputError, match="fit both"):
        read_recordings(path, columns=TWO)


def test_columns_that_contradict_each_other_are_a_question(tmp_path):
    rows = [f"{0.25 * t:.2f}\t{way:.2f}".replace(".", ",") + f"\t{load / 10:,.0f}" for t, way, load in ROWS]
    with pytest.raises(InputError, match="decimal point"):
        read(tmp_path, "\n".join(["Time\tWay\tLoad", *rows]))


@pytest.mark.parametrize("style", [(".", ","), (",", ".")])
@pytest.mark.parametrize("places", [(0, 0, 0), (1, 3, 0)])
def test_separators_below_the_beginning_of_a_long_text_count(tmp_path, style, places):
    """The first lines hold no value of 1000: only all lines together show what the mark means."""
    rows = [(0.5 * i, 0.4 * i, 2.5 * i) for i in range(1000)]
    with mock.patch.object(long_text, "_SETTINGS", long_text.LongTextSettings(beginning=50)):
        recording = read(tmp_path, table(rows, style, places))
    assert recording.force[-1] == pytest.approx(2.498, rel=1e-3)


def test_a_number_that_its_separator_cuts_gets_a_hint(tmp_path):
    path = tmp_path / "cut.csv"
    path.write_text("Time,Way,Load\n" + "".join(f"{i},{i},{1000 + i:,}.5\n" for i in range(9)), encoding="utf-8")
    with pytest.raises(InputError, match=r"4 cells, expected 3 .* quote the numbers"):
        read_recordings(path, columns=COLUMNS)


ABOVE = "Way;Load\n" + "".join(f"{i};{2 * i}\n" for i in range(8))
TWO = {"displacement": {"name": "Way", "unit": "mm"}, "force": {"name": "Load", "unit": "N"}}


@pytest.mark.parametrize("below", [
    "Diameter;25.0;mm\nHeight;12.5;mm\n", "\nResults\nSpecimen;Diameter (mm);Height (mm)\n1;25.0;12.5\n",
    "Mean;3.5;7\nSD;2.4;4.9\n", "End of test;\n", "Peak;14\n",
    "\nSummary\nName;Value\n" + "".join(f"{i};{i}\n" for i in range(6))])
def test_rows_of_text_below_a_table_end_it(tmp_path, below):
    path = tmp_path / "below.csv"
    path.write_text(ABOVE + below, encoding="utf-8")
    recording, = read_recordings(path, columns=TWO)
    np.testing.assert_allclose(recording.force, 2.0 * np.arange(8))


@pytest.mark.parametrize(("row", "words"), [
    ("4;oops", "'Load' holds 'oops'"), ("x;8", "'Way' holds 'x'"), ("oops;8", "'Way' holds 'oops'"),
    ("4;", "'Load' is empty"), ("Load step;", "'Way' holds 'Load step'"), ("New;name", "'Way' holds 'New'")])
def test_a_broken_cell_inside_a_table_stays_an_error(tmp_path, row, words):
    path = tmp_path / "broken.csv"
    path.write_text(ABOVE.replace("4;8", row), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_recordings(path, columns=TWO)
    assert words in caught.value.problem and caught.value.line == 6
