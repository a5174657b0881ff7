"""A format from one file: a campaign's recordings."""

import json

import numpy as np
import pytest

import calibration
import tissue_sim as ts

CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
kind = "lubricated_compression"
recordings = ["book.json"]
format = "lab_book"

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


@pytest.fixture
def book(plugin, registers, tmp_path):
    """A lab book with two runs of the same test."""
    registers(ts.FORMATS, plugin("lab_book").read_lab_book, "lab_book")
    displacement = np.linspace(0.0, 0.010, 41)
    stretch = 1 - displacement / HEIGHT
    force = -2 * C10 * (stretch - stretch**-2) * AREA
    run = {"mm": (1e3 * displacement).tolist(), "g": (force / 9.80665e-3).tolist()}
    path = tmp_path / "book.json"
    path.write_text(json.dumps({"runs": [run, run]}), encoding="utf-8")
    return path


def test_format_of_one_file(book):
    path = book.with_name("study.toml")
    path.write_text(CAMPAIGN, encoding="utf-8")
    result, = calibration.calibrate([path], book.with_name("out"), figures=False)
    assert result.best.parameters["C10"] == pytest.approx(C10, rel=1e-9)
    one, two = ts.read_recordings(book, format="lab_book", kind="lubricated_compression", speed=1e-3)
    assert (one.name, two.name) == ("book_1", "book_2")
    assert one.time[-1] == pytest.approx(10.0)


def test_one_recording_of_several_is_chosen(book):
    with pytest.raises(ts.InputError, match="holds 2 curves; choose one with curve = 1 to 2"):
        ts.read_recording(book, format="lab_book")
    assert ts.read_recording(book, format="lab_book", curve=2).name == "book"
    with pytest.raises(ts.InputError, match="files of format 'lab_book' have no sheet"):
        ts.read_recording(book, format="lab_book", sheet=1)
    with pytest.raises(ts.InputError, match="give either format = 'lab_book' or columns, not both"):
        ts.read_recording(book, format="lab_book", columns={"force": "g"})


def test_a_name_that_is_taken_is_refused(book):
    with pytest.raises(ts.InputError, match="the name 'native' is taken by another format"):
        ts.FORMATS.register(ts.FORMATS["lab_book"], "native")
    with pytest.raises(ts.InputError, match="unknown format 'lab_bok'; did you mean 'lab_book'"):
        ts.read_recording(book, format="lab_bok")
