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
    return [curve for curves in calibration.read_measured(calibration.load_campaign(path)).values() for curve in curves]


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
