"""Lines of Grbl 1.1: examples of its documentation, and arbitrary text."""

import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.protocols import grbl
from haptics.protocols.grbl import JogCommand, StatusReport

CASES = int(os.environ.get("TISSUE_SIM_FUZZ_CASES", "500"))

thousandths = st.integers(-999_999, 999_999).map(lambda number: number / 1000)
triples = st.tuples(thousandths, thousandths, thousandths)


@pytest.mark.parametrize(("line", "report"), [
    # Grbl 1.1, doc/markdown/interface.md, "Real-time Status Reports": fields and their values.
    ("<Idle|MPos:0.000,0.000,0.000|FS:0,0>", StatusReport("Idle", machine=(0.0, 0.0, 0.0), feed=0.0)),
    ("<Jog|MPos:0.000,-10.000,5.000|F:500>", StatusReport("Jog", machine=(0.0, -10.0, 5.0), feed=500.0)),
    ("<Run|WPos:-2.500,0.000,11.000|Bf:15,128|Ln:99999|FS:500,8000>",
     StatusReport("Run", work=(-2.5, 0.0, 11.0), feed=500.0)),
    ("<Hold:1|MPos:1.000,2.000,3.000|FS:0,0|WCO:0.000,1.551,5.664>",
     StatusReport("Hold", 1, (1.0, 2.0, 3.0), offset=(0.0, 1.551, 5.664), feed=0.0)),
    ("<Alarm|MPos:0.000,0.000,0.000|FS:0,0|Pn:XYZPDHRS>",
     StatusReport("Alarm", machine=(0.0, 0.0, 0.0), feed=0.0, pins="XYZPDHRS")),
    ("<Idle|MPos:0.000,0.000,0.000|FS:0,0|Ov:100,100,100|A:S>",
     StatusReport("Idle", machine=(0.0, 0.0, 0.0), feed=0.0)),
])
def test_reports_of_the_documentation_are_read(line, report):
    assert grbl.parse_report_or_none(line) == report


def test_other_lines_of_the_documentation_are_read():
    # interface.md: response messages, "$" settings, "$I", start up message.
    assert grbl.parse_answer_kind_and_number_or_none("ok") == ("ok", 0)
    assert grbl.parse_answer_kind_and_number_or_none("error:15") == ("error", 15) \
        and grbl.parse_answer_kind_and_number_or_none("ALARM:9") == ("ALARM", 9)
    assert grbl.parse_setting_or_none("$112=500.000") == (112, 500.0) and grbl.parse_setting_or_none("$22=0") \
        == (22, 0.0)
    assert grbl.parse_version_and_date_or_none("[VER:v1.1d.20161014:Some string]") == ("1.1", "20161014")
    assert grbl.parse_version_and_date_or_none("[VER:1.1h.20190825:]") == ("1.1", "20190825")
    assert grbl.parse_banner_version_or_none("Grbl 1.1e ['$' for help]") == "1.1"
    for line in ("[MSG:'$H'|'$X' to unlock]", ">G54G20:ok", "$N0=G54", "[OPT:VL]", ""):
        assert (grbl.parse_answer_kind_and_number_or_none(line), grbl.parse_setting_or_none(line),
                grbl.parse_report_or_none(line)) == (None, None, None)


def test_jogs_of_the_documentation_are_read():
    # jogging.md: the three examples, with the feed that each needs.
    assert grbl.parse_jog_or_none("$J=X10.0 Y-1.5 F100") == JogCommand(100.0, {"X": 10.0, "Y": -1.5})
    inches = grbl.parse_jog_or_none("$J=G91 G20 X0.5 F10")
    assert inches.relative and inches.targets == {"X": pytest.approx(12.7)} and inches.feed == pytest.approx(254)
    assert grbl.parse_jog_or_none("$J=G53 Y5.0 F100") == JogCommand(100.0, {"Y": 5.0}, machine=True)
    for line in ("$J=X1", "$J=F100", "$J=X1F0", "$J=M3X1F1", "$J", "G1X1F100", "$J=X1X2F1", "$J=G2X1F1"):
        assert grbl.parse_jog_or_none(line) is None


def test_all_errors_and_alarms_have_a_text():
    # doc/csv/error_codes_en_US.csv and alarm_codes_en_US.csv.
    assert set(grbl.ALARMS) == set(range(1, 10)) and set(range(1, 17)) <= set(grbl.ERRORS)
    assert "home it" in grbl.describe_alarm(1) and "tables" in grbl.describe_alarm(77) and grbl.describe_alarm(None)
    assert "G-code" in grbl.describe_error(33)


@given(st.sampled_from("XYZ"), thousandths, st.integers(1, 10**6).map(lambda number: number / 100))
@settings(max_examples=CASES, deadline=None)
def test_a_jog_line_is_parsed_to_the_same_jog(axis, target, feed):
    jog = grbl.parse_jog_or_none(grbl.encode_jog_in_machine_coordinates(axis, target, feed).decode().strip())
    assert jog == JogCommand(pytest.approx(feed, abs=1e-3), {axis: pytest.approx(target, abs=1e-4)}, machine=True)


reports = st.builds(
    lambda state, substate, place, by_machine, offset, pins, feed: StatusReport(
        state, substate, place if by_machine else None, None if by_machine else place, offset, pins, feed),
    st.sampled_from(grbl.STATES), st.none() | st.integers(0, 3), triples, st.booleans(), st.none() | triples,
    st.sampled_from(["", "Z", "XYZ", "PH"]), st.none() | st.integers(0, 5000).map(float))


@pytest.mark.slow
@given(reports)
@settings(max_examples=CASES, deadline=None)
def test_a_formatted_report_is_parsed_to_the_same_report(report):
    assert grbl.parse_report_or_none(grbl.format_report(report)) == report


@pytest.mark.slow
@given(reports, st.data())
@settings(max_examples=CASES, deadline=None)
def test_a_garbled_report_is_read_literally_or_refused(report, data):
    """Text without a checksum can only be read literally and completely."""
    line = grbl.format_report(report)
    at = data.draw(st.integers(0, len(line) - 1))
    garbled = line[:at] + chr(data.draw(st.integers(0, 255))) + line[at + 1:]
    for text in (garbled, line[:at], line[at + 1:]):
        read = grbl.parse_report_or_none(text)
        if read is not None:
            assert text.startswith("<" + read.state) and text.endswith(">") and len(text) == len(line)
            numbers = read.machine or read.work
            assert text.partition("Pos:")[2].startswith(",".join(f"{number:.3f}" for number in numbers).replace(
                "-0.000", "0.000")) or "-0.000" in text


@given(st.text(max_size=80))
@settings(max_examples=CASES, deadline=None)
def test_any_text_is_accepted_by_the_parsers(text):
    for parse in (grbl.parse_report_or_none, grbl.parse_answer_kind_and_number_or_none, grbl.parse_setting_or_none,
                  grbl.parse_version_and_date_or_none, grbl.parse_banner_version_or_none, grbl.parse_jog_or_none):
        parse(text)
