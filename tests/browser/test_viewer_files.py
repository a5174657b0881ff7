"""Files of the page in a browser: upload and save materials, save curves, pictures and replays."""

import json

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.material.file import MaterialFile

SUFFIX = ".material.json"
STIFF = ts.Material("neo_hooke", {"C10": 4000.0}, ts.Bulk("bulk_ratio", 1e4))


def upload(reader, path):
    with reader.page.expect_file_chooser() as chooser:
        reader.press("Upload material")
    chooser.value.set_files(path)


@pytest.mark.slow
def test_a_material_is_uploaded_and_an_invalid_one_is_refused(shown, reader, tmp_path):
    good, bad = tmp_path / f"stiff{SUFFIX}", tmp_path / f"bad{SUFFIX}"
    ts.write_material_file(MaterialFile.of(STIFF, provenance={"method": "written by hand"}), good)
    reader.tab("Material")
    reader.until(lambda: reader.number("rmse"), lambda rmse: rmse < 0.03)
    upload(reader, good)
    reader.answer(f"The material of {good.name} is in use.")
    reader.phase("running")
    reader.page.get_by_text(f", from {good.name}").wait_for()
    assert shown.session.scene.material.parameters == STIFF.parameters
    assert reader.field("C10 [kPa]").input_value() == "4"
    assert reader.page.get_by_text("C20 [kPa]").count() == 0
    reader.until(lambda: reader.number("rmse"), lambda rmse: rmse > 0.2)

    material, simulation = shown.session.scene.material, shown.session.simulation
    content = json.loads(good.read_text(encoding="utf-8"))
    content["parameters"]["C10"]["value"] = "soft"
    bad.write_text(json.dumps(content), encoding="utf-8")
    upload(reader, bad)
    reader.answer(f"{bad.name}: parameters.C10.value: expected")
    assert shown.session.scene.material is material and shown.session.simulation is simulation
    assert reader.field("C10 [kPa]").input_value() == "4"


@pytest.mark.slow
def test_a_material_is_chosen_edited_with_a_slider_and_saved(shown, reader):
    def end_of_model():
        return max(reader.curves()[0]["model load"], default=0.0)

    reader.enter("depth [mm]", "3")
    reader.wait_for("depth", "3.00")
    force, model = reader.until(lambda: reader.number("force"), lambda force: force > 0.4), end_of_model()
    simulation = shown.session.simulation
    reader.tab("Material")
    reader.choose("file", f"softer{SUFFIX}")
    reader.page.get_by_text(f", from softer{SUFFIX}").wait_for()
    assert reader.field("C10 [kPa]").input_value() == "1.2"
    softer = reader.until(lambda: reader.number("force"), lambda now: now < 0.95 * force)
    softer_model = reader.until(end_of_model, lambda now: now < 0.95 * model)
    rmse = reader.until(lambda: reader.number("rmse"), lambda rmse: rmse > 0.04)

    # Live force and model curve approach the measurement again.
    reader.slider("C10 [kPa]").press("ArrowRight")
    reader.until(lambda: shown.session.scene.material.parameters["C10"], lambda now: 1200.0 < now < 1300.0)
    reader.enter("C10 [kPa]", "1.4")
    reader.until(lambda: shown.session.scene.material.parameters["C10"], lambda now: now == pytest.approx(1400.0))
    reader.until(lambda: reader.number("rmse"), lambda now: now < 0.7 * rmse)
    reader.until(end_of_model, lambda now: now > 1.05 * softer_model)
    reader.until(lambda: reader.number("force"), lambda now: now > 1.05 * softer)
    assert shown.session.simulation is simulation, "the running simulation continues"
    assert reader.read("depth") == "3.00"

    reader.fill("name", "by hand")
    file = reader.download("Save material")
    reader.answer(f"Saved as by hand{SUFFIX}")
    saved = shown.folder / f"by hand{SUFFIX}"
    assert file.suggested_filename == saved.name and file.path().read_bytes() == saved.read_bytes()
    assert ts.load_material(saved).parameters == shown.session.scene.material.parameters
    reader.until(lambda: reader.field("file").input_value(), lambda name: name == saved.name)
    reader.press("Save material")
    reader.answer("exists already and is not overwritten. Choose another name.")
    assert file.path().read_bytes() == saved.read_bytes()


def at_its_end(trace):
    """Whether the tool has returned to 1 mm, where it stays."""
    return trace.depth.max(initial=0.0) > 2.99e-3 and abs(trace.depth[-1] - 1e-3) < 1e-6


@pytest.mark.slow
def test_the_live_curve_is_downloaded_as_a_recording(shown, reader, tmp_path):
    # Slow enough for equilibria in loading and unloading on a busy machine: late forces are not saved, and fading
    # forces are not in the trace.
    reader.fill("protocol", "ramp 3mm @1mm/s; hold 10s; unload 1mm @1mm/s; hold 600s")
    reader.press("Play")
    reader.until(lambda: shown.frame.curves.trace, at_its_end)
    reader.press("Pause")
    reader.phase("paused")
    reader.tab("Save")
    trace = shown.frame.curves.trace
    file, sidecar = reader.downloads("Save curve (CSV)", 2)
    assert file.suggested_filename == "needle_indentation.csv"
    assert sidecar.suggested_filename == "needle_indentation.json"
    file.save_as(tmp_path / "curve.csv")
    sidecar.save_as(tmp_path / "curve.json")
    felt = ts.read_recording(tmp_path / "curve.csv")
    assert felt.metadata["specimen"]["shape"] == "cylinder" and felt.metadata["tool"]["shape"] == "flat"
    found = ~trace.is_late
    # Equal up to the conversion from m to mm and back.
    for read, expected in ((felt.displacement, trace.depth[found]), (felt.force, trace.force[found]),
                           (felt.time, trace.time[found] - trace.time[found][0])):
        np.testing.assert_allclose(read, expected, rtol=1e-15)
    assert set(felt.labels["segment"]) == {"ramp", "hold", "unload"}
    assert felt.displacement.max() == pytest.approx(3e-3) and felt.force.max() > 0.4


def test_picture_is_downloaded_as_png(shown, reader, tmp_path):
    from matplotlib.image import imread

    reader.tab("Save")
    file = reader.download("Save picture (PNG)")
    assert file.suggested_filename == "needle_indentation.png"
    file.save_as(tmp_path / "picture.png")
    picture = imread(tmp_path / "picture.png")
    assert picture.shape[0] > 300 and picture.shape[1] > 600
    colours = np.unique((picture[..., :3] * 255).round().astype(np.uint8).reshape(-1, 3), axis=0)
    assert len(colours) > 100


@pytest.mark.slow
def test_replay_is_a_page_that_plays_without_a_server(shown, reader, stranger, tmp_path):
    reader.tab("Save")
    reader.press("Record replay")
    button = reader.page.get_by_role("button", name="Save replay")
    button.wait_for()
    shown.ask("aim", depth=2e-3)
    reader.wait_for("depth", "2.00")
    with reader.page.expect_download() as coming:
        button.click()
    path = tmp_path / coming.value.suggested_filename
    coming.value.save_as(path)
    assert path.name == "replay.html"
    with stranger() as page:
        asked, wrong = [], []
        page.on("request", lambda request: request.url.startswith(("blob:", "data:")) or asked.append(request.url))
        page.on("requestfailed", lambda request: wrong.append(request.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(path.as_uri())
        page.wait_for_function("window.__viserTestpoints?.rendererInfo.render.triangles > 100")
        assert (asked, wrong) == ([path.as_uri()], [])
