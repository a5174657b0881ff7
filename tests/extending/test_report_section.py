"""A section of reports from one file: its table on the page, its place, and its absence without content."""

import re

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.report.content import Column, Span, Table, get_terminal_text
from calibration.report.outputs import list_sections_in_page_order, render_page
from calibration.report.section import Section
from calibration.report.sections import SECTIONS

CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
name = "<plates>"
kind = "lubricated_compression"
recordings = ["*.csv"]

[fit]
laws = ["neo_hooke"]

[noise]
force_N = 0.001
"""
#: Cross-section, m2.
AREA = np.pi * 0.04**2
#: Height, m.
HEIGHT = 0.070
#: Parameter of the law, Pa.
C10 = 1500.0
#: Name of each recording -> its duration, s.
DURATIONS = {"fast": 10.0, "slow": 200.0}


@pytest.fixture
def make_report(tmp_path):
    """Function that calibrates two recordings to 10 mm, with or without times, and returns the page."""
    def make(*, timed=True):
        displacement = np.linspace(0.0, 0.010, 41)
        stretch = 1 - displacement / HEIGHT
        columns = {"displacement": displacement, "force": -2 * C10 * (stretch - stretch**-2) * AREA}
        for name, duration in DURATIONS.items():
            times = {"time": np.linspace(0.0, duration, 41)} if timed else {}
            ts.write_recording(ts.Recording({**columns, **times}), tmp_path / f"{name}.csv")
        (tmp_path / "study.toml").write_text(CAMPAIGN, encoding="utf-8")
        calibration.calibrate([tmp_path / "study.toml"], tmp_path / "out", figures=False)
        return (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    return make


def test_section_of_one_file(plugin, registers, make_report):
    registers(SECTIONS, plugin("loading_rates").LoadingRates)
    page = make_report()
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert titles.index("Loading rates") == titles.index("Ranking by BIC") - 1
    assert "<td>&lt;plates&gt;/fast</td><td>1</td>" in page, "names of users are escaped"
    assert '<td>&lt;plates&gt;/slow</td><td><span class="bad">0.05</span></td>' in page


def test_section_without_content_has_no_title(plugin, registers, make_report):
    registers(SECTIONS, plugin("loading_rates").LoadingRates)
    assert "Loading rates" not in make_report(timed=False)


def test_section_of_the_other_report_is_not_shown(registers, make_report):
    class NeverShown(Section):
        name = "never_shown"
        title = "Never shown"
        reports = ("diagnosis",)

        def iterate_blocks(self, report):
            raise AssertionError("a calibration does not have this section")

    registers(SECTIONS, NeverShown)
    assert "Never shown" not in make_report()


def test_name_that_is_taken_or_unknown_is_refused(plugin, registers):
    rates = plugin("loading_rates").LoadingRates
    with pytest.raises(ts.InputError, match="the name 'ranking' is taken by another report section"):
        SECTIONS.register(rates, "ranking")
    with pytest.raises(ts.InputError, match=r"give a class that derives from calibration\.report\.section\.Section"):
        SECTIONS.register(object, "nothing")
    with pytest.raises(ts.InputError, match="defines iterate_blocks"):
        SECTIONS.register(Section, "without_content")

    class Misplaced(Section):
        name = "misplaced"
        before = "rankin"

        def iterate_blocks(self, report):
            return ()

    registers(SECTIONS, Misplaced)
    with pytest.raises(ts.InputError, match="unknown report section 'rankin'; did you mean 'ranking'"):
        list_sections_in_page_order()


def test_page_and_terminal_show_the_same_table():
    """Minus signs and warnings are for pages; a cell may belong to one of both."""
    table = Table([Column("Law", "law"), Column("Change", "change"), Column("Note", text=True, optional=True)],
                  [["A", (Span("-1.5", "bad"), Span(" %", only="page")), ""], [None, "-2", ""]], best_row=0)
    page = render_page("x", [("", [table])], None)
    assert '<tr class="best"><td rowspan="2">A</td><td><span class="bad">−1.5</span> %</td></tr>' in page
    assert "<tr><td>−2</td></tr>" in page and "Note" not in page
    printed = table.select_terminal_columns()
    assert [column.terminal for column in printed.columns] == ["law", "change"]
    assert [[get_terminal_text(cell) for cell in row] for row in printed.rows] == [["A", "-1.5"], ["", "-2"]]
