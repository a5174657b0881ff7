"""Calibration tab in a browser: upload recordings, fit the material, use and save the result."""

import json
from dataclasses import replace

import pytest

import tissue_sim as ts
from tissue_sim.parameters import with_values

SUFFIX = ".material.json"
STIFFER = {"C10": 2200.0, "C20": 900.0}


@pytest.fixture
def recordings(shown, tmp_path):
    """Two noisy recordings of a stiffer material with sidecars, one also as a test-machine file, and a bad file."""
    scene = shown.scene
    true = ts.simulate(replace(scene.model, material=with_values(scene.material, STIFFER)), resolution="fast")
    said = {"kind": scene.kind.name, "tool": {"shape": "flat", "radius_mm": 8.0}}
    for seed in range(2):
        ts.write_recording(ts.Rig(force_noise=0.01, seed=seed).measure(true).with_metadata(**said),
                           tmp_path / f"stiff_{seed}.csv")
    # The second recording in the format of a test machine.
    second = ts.read_recording(tmp_path / "stiff_1.csv")
    rows = zip(second.time, -1e3 * second.displacement, -second.force, strict=True)
    (tmp_path / "stiff 1.txt").write_text("Time (s)\tExtension (mm)\tLoad (N)\n" + "".join(
        "\t".join(f"{value!r}" for value in map(float, row)) + "\n" for row in rows), encoding="utf-8")
    (tmp_path / "bad.csv").write_text("time [s],force [N]\n" + "".join(f"{i},1\n" for i in range(9)), encoding="utf-8")
    return tmp_path


@pytest.fixture
def calibrating(shown, reader):
    """Reader of the calibration tab; the teardown removes all recordings and restores the measurement."""
    reader.tab("Calibrate")
    yield reader
    if shown.session.calibration.state.status is not None:
        shown.ask("cancel_calibration")
    shown.ask("remove_recordings")
    shown.session.scene = replace(shown.session.scene, measurements=shown.scene.measurements)


def upload(reader, path):
    with reader.page.expect_file_chooser() as chooser:
        reader.press("Upload recording")
    chooser.value.set_files(path)


@pytest.mark.slow
def test_uploaded_recordings_are_calibrated_and_the_material_is_used_and_saved(
        shown, calibrating, recordings):
    reader = calibrating
    for name, read in (("stiff_0.csv", "stiff_0.csv"), ("stiff_0.json", "stiff_0.json"),
                       ("stiff 1.txt", "stiff 1.csv")):
        upload(reader, recordings / name)
        reader.answer(f"Read {read}.")
    upload(reader, recordings / "bad.csv")
    reader.answer("bad.csv: the column with a motion is missing")
    reader.until(lambda: reader.read("recordings"), lambda text: "flat, radius 8 mm" in text
                 and "force from 'Load (N)' in N, its sign changed" in text)
    assert "bad" not in reader.read("recordings")

    reader.press("Calibrate")
    reader.page.get_by_test_id("calibrating").wait_for()
    reader.page.get_by_test_id("calibrated").wait_for()
    found = shown.session.calibration.state.result
    low, high = found.values["C10"].interval
    assert low < STIFFER["C10"] < high and "95 % interval" in reader.read("calibrated")
    assert shown.session.scene.material == found.material
    reader.until(lambda: reader.number("rmse"), lambda rmse: rmse < 0.03)
    force = float(shown.session.scene.measurement.recordings[0].force.max())
    reader.until(lambda: max(reader.curves()[0]["model load"], default=0.0),
                 lambda top: top == pytest.approx(force, rel=0.05))

    reader.fill("new name", "from the page")
    file = reader.download("Save calibrated material")
    reader.answer(f"Saved as from the page{SUFFIX}")
    saved = shown.folder / f"from the page{SUFFIX}"
    assert file.path().read_bytes() == saved.read_bytes()
    content = json.loads(saved.read_text(encoding="utf-8"))
    assert content["parameters"]["C10"]["standard_error"] > 0
    assert {each["file"] for each in content["provenance"]["recordings"]} == {"stiff_0.csv", "stiff 1.csv"}
    reader.press("Save calibrated material")
    reader.answer("exists already and is not overwritten. Choose another name.")


@pytest.mark.slow
def test_a_cancelled_calibration_keeps_the_material(shown, calibrating, recordings):
    reader, material = calibrating, shown.session.scene.material
    upload(reader, recordings / "stiff_0.csv")
    reader.answer("Read stiff_0.csv.")
    reader.press("Calibrate")
    reader.press("Cancel calibration")
    reader.page.get_by_text("The calibration was cancelled").wait_for()
    assert shown.session.scene.material is material
    reader.press("Remove all recordings")
    reader.until(lambda: reader.read("recordings"), lambda text: "stiff_0" not in text)
