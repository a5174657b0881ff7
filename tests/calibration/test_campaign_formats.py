"""Campaigns whose recordings are spreadsheets and AFM files."""

import zipfile

import afmformats
import numpy as np
import openpyxl
import pytest

import calibration
import tissue_sim as ts

CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
kind = "lubricated_compression"
recordings = ["run_*.xlsx"]
{reading}

[fit]
laws = ["neo_hooke"]
"""
COLUMNS = 'columns = { displacement = { column = "B", unit = "mm" }, force = { column = 3, unit = "N" } }'


@pytest.fixture
def folder(tmp_path):
    """Two spreadsheets without a header: time, displacement in mm, force in N."""
    for number in (1, 2):
        book = openpyxl.Workbook()
        for depth in np.linspace(0.0, 10.0, 21):
            book.active.append([depth / 0.248, depth, 0.5 * number * depth])
        book.save(tmp_path / f"run_{number}.xlsx")
    return tmp_path


def read(path):
    """All recordings of a campaign, in order."""
    return [curve for curves in calibration.read_measured_curves(calibration.load_campaign(path)).values()
            for curve in curves]


def replicates(folder, reading):
    path = folder / "study.toml"
    path.write_text(CAMPAIGN.format(reading=reading), encoding="utf-8")
    return read(path)


def test_columns_by_place(folder):
    found = replicates(folder, COLUMNS)
    assert [replicate.name for replicate in found] == [f"lubricated_compression/run_{i}" for i in (1, 2)]
    assert found[1].force[-1] == pytest.approx(10.0) and found[1].displacement[-1] / 0.07 == pytest.approx(1 / 7)


def test_a_bad_place_is_named_by_its_field(folder):
    with pytest.raises(ts.InputError) as caught:
        replicates(folder, COLUMNS.replace('"B"', "0"))
    assert caught.value.field == "test[0].columns.displacement.column"
    with pytest.raises(ts.InputError, match=r"run_1.xlsx: sheet 'Sheet': no row has a number in each of the columns"):
        replicates(folder, COLUMNS.replace('"B"', '"K"'))


def test_which_sheet(folder):
    book = openpyxl.load_workbook(folder / "run_1.xlsx")
    book.create_sheet("Notes").append(["second day"])
    book.save(folder / "run_1.xlsx")
    with pytest.raises(ts.InputError, match="choose one with sheet = 'Sheet' or 'Notes'"):
        replicates(folder, COLUMNS)
    assert len(replicates(folder, COLUMNS + '\nsheet = "Sheet"')) == 2
    with pytest.raises(ts.InputError, match="have no sheet; leave it out"):
        replicates(folder, 'format = "instron"\nsheet = 1')


def test_every_curve_of_an_afm_file_is_a_replicate(folder):
    depth = np.linspace(-4e-6, 3e-6, 200)
    force = 4e-9 * (np.clip(depth, 0.0, None) / 3e-6) ** 1.5
    with zipfile.ZipFile(folder / "cells.zip", "w") as archive:
        for enum in range(3):
            metadata = {"path": folder, "enum": enum, "imaging mode": "force-distance", "spring constant": 0.05}
            data = {"force": force, "height (measured)": 50e-6 - depth - force / 0.05, "segment": np.zeros(200)}
            path = folder / f"cell_{enum}.tab"
            afmformats.AFMForceDistance(data, metadata).export_data(path)
            archive.write(path, path.name)
    path = folder / "afm.toml"
    for reading, names in (("", ["cells_1", "cells_2", "cells_3"]), ("curve = 2", ["cells"])):
        path.write_text(CAMPAIGN.format(reading=f'format = "afm"\n{reading}').replace("run_*.xlsx", "cells.zip"),
                        encoding="utf-8")
        found = read(path)
        assert [replicate.name for replicate in found] == [f"lubricated_compression/{name}" for name in names]


DEFAULTS = """
[defaults]
kind = "lubricated_compression"
{reading}

[[test]]
name = "first"
recordings = ["run_1.xlsx"]

[[test]]
name = "second"
recordings = ["run_2.xlsx"]
max_strain = 0.1
"""


def test_defaults_are_shared_by_all_tests(folder):
    def write(defaults, before="[[specimen]]\nradius_mm = 40.0\nheight_mm = 70.0\n"):
        path = folder / "study.toml"
        path.write_text(before + defaults + '\n[fit]\nlaws = ["neo_hooke"]\n', encoding="utf-8")
        return path

    found = read(write(DEFAULTS.format(reading=COLUMNS)))
    assert [replicate.name for replicate in found] == ["first/run_1", "second/run_2"]
    tests = calibration.load_campaign(write(DEFAULTS.format(reading=f"max_strain = 0.2\n{COLUMNS}"))).tests
    assert [test.max_strain for test in tests] == [0.2, 0.1], "what a test states itself wins"
    # A fault in the defaults is named there, one in a test there.
    for text, field in ((DEFAULTS.format(reading=COLUMNS.replace("mm", "ell").replace("columns", "column")),
                         "defaults.column"),
                        (DEFAULTS.format(reading="columns = { force = 3 }"), "defaults.columns.force"),
                        (DEFAULTS.format(reading="max_strain = -1.0"), "defaults.max_strain"),
                        (DEFAULTS.format(reading=COLUMNS).replace("0.1\n", "-0.1\n"), "test[1].max_strain"),
                        (DEFAULTS.format(reading=COLUMNS).replace("max_strain", "max_strian"), "test[1].max_strian"),
                        ("defaults = 3\n", "defaults")):
        with pytest.raises(ts.InputError) as caught:
            calibration.load_campaign(write(text, "") if text.startswith("defaults") else write(text))
        assert caught.value.field == field and caught.value.file == folder / "study.toml"


def test_a_test_with_columns_takes_no_default_format(folder):
    path = folder / "study.toml"
    path.write_text('[defaults]\nformat = "instron"\n' + CAMPAIGN.format(reading=COLUMNS), encoding="utf-8")
    assert len(read(path)) == 2


def test_a_list_of_sheets_is_replicates(folder):
    book = openpyxl.load_workbook(folder / "run_1.xlsx")
    copy = book.copy_worksheet(book.active)
    copy.title = "again"
    book.save(folder / "run_1.xlsx")
    (folder / "run_2.xlsx").unlink()
    found = replicates(folder, COLUMNS + '\nsheet = ["Sheet", "again"]')
    assert [curve.name for curve in found] == ["lubricated_compression/run_1_1", "lubricated_compression/run_1_2"]
