"""Exports of the named machines, mutated as laboratories have them: read by name, and imported to a campaign."""

import sys
from pathlib import Path

import numpy as np
import pytest

import calibration
import tissue_sim as ts

sys.path.insert(0, str(Path(__file__).parent))
from machine_exports import EXPORTS

SIZES = calibration.ImportOptions(specimen={"radius_mm": 10.0, "height_mm": 12.0})


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_is_read_and_imported(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    export = EXPORTS[name]()
    path = tmp_path / export.name
    path.write_bytes(export.content)
    imported = calibration.import_files([path], wishes=SIZES)
    understood, = imported.files
    assert understood.format == export.machine
    assert {test.kind for test in imported.tests} == {export.kind}
    assert imported.is_complete == (export.kind is not None), (imported.missing, imported.problem)
    if export.kind is None:
        assert imported.missing == ("the kind of test (--kind)",)
        stated = calibration.ImportOptions(calibration.InterpretationOverrides(kind="lubricated_compression"),
                                           SIZES.specimen)
        imported = calibration.import_files([path], wishes=stated)
        assert imported.is_complete, imported.problem
    Path("campaign.toml").write_text(imported.text, encoding="utf-8")
    campaign = calibration.load_campaign("campaign.toml")
    read = [recording for test in campaign.tests for file in test.recordings
            for recording in ts.read_recordings(file, kind=test.kind.name, **test.reading)]
    by_name = ts.read_recordings(path, format=export.machine)
    for recordings in (read, by_name):
        assert len(recordings) == len(export.curves)
        for recording, (time, way, force) in zip(recordings, export.curves, strict=True):
            # Seven digits in the file, of numbers up to 12 mm.
            np.testing.assert_allclose(recording.time, time, rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(recording.displacement, way - way[0], rtol=1e-6, atol=2e-9)
            np.testing.assert_allclose(recording.force, force, rtol=1e-6, atol=2e-6)
    # Loading, then a return or a hold.
    names = [segment.name for segment in imported.tests[0].parts[0].motions[0].segments]
    assert names == ["ramp", "hold" if export.machine in ("mts", "trios") else "unload"]


def test_there_are_thirty_of_seven_machines():
    assert len(EXPORTS) == 30
    assert {make().machine for make in EXPORTS.values()} == {
        "bluehill", "mts", "zwick", "exponent", "mach1", "mecmesin", "trios"}
