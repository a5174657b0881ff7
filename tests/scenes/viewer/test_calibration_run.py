"""Calibration commands without a browser: uploads are read or refused, and a fit gives a material, gives a message, or
is cancelled."""

import hashlib
import json
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
import pytest

import tissue_sim as ts
from scenes.viewer.calibration_run import (
    CALIBRATED,
    CALIBRATION_COMMANDS,
    CalibrationState,
    SessionCalibrations,
    group_replicate_file_names,
    use_finished_calibration_in_scene,
)
from scenes.viewer.calibration_task import (
    PROGRESS_FILE,
    RECORDINGS,
    CalibrationResult,
    FitProgress,
    FittedParameter,
    calibrate_uploaded_files,
)
from scenes.viewer.measurement import read_uploaded_recordings_or_sidecar
from scenes.viewer.page.calibration_controls import calibration_html, recordings_html
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.parameters import with_values


@pytest.fixture
def pool(pool, monkeypatch):
    """Process pool without processes that each `SessionCalibrations` uses."""
    monkeypatch.setattr("scenes.viewer.calibration_run.ProcessPool", lambda count: pool)
    return pool


@pytest.fixture
def run(pool):
    run = SessionCalibrations()
    yield run
    run.close()


def csv(depth=4e-3, seconds=2.0, scale=1.0):
    place = depth * np.concatenate([np.linspace(0, 1, 21), np.linspace(1, 0, 21)[1:]])
    time = np.linspace(0, seconds, place.size)
    rows = [f"{t:.17g},{1e3 * x:.17g},{scale * 250 * x:.17g}" for t, x in zip(time, place, strict=True)]
    return "\n".join(["time [s],displacement [mm],force [N]", *rows, ""]).encode()


def sidecar(**said):
    return json.dumps({"kind": "needle_indentation", "tool": {"shape": "flat", "radius_mm": 8.0}, **said}).encode()


def upload(run, name="a.csv", content=None):
    run.add_uploads_atomically(read_uploaded_recordings_or_sidecar(name, csv() if content is None else content))


class MinimalSession:
    """Minimal session without processes."""

    def __init__(self, scene, run):
        self.scene, self.calibration, self.refuses = scene, run, ""

    def replace_material_restart_if_needed(self, material, source):
        if self.refuses:
            raise InputError(self.refuses)
        self.scene = replace(self.scene, material=material, source=source)

    def do(self, command, **values):
        CALIBRATION_COMMANDS[command](self, **values)


def result_for(scene):
    stiffer = with_values(scene.material, {"C10": 2000.0})
    fitted = {"C10": FittedParameter(2000.0, (1900.0, 2100.0), "Pa")}
    return CalibrationResult(stiffer, fitted, 0.02, (), 9, b'{"a": "file"}')


def test_an_uploaded_recording_is_described(run, needle):
    upload(run)
    each, = run.state.recordings
    assert each.max_displacement == pytest.approx(4e-3) and each.recording_duration_or_none == pytest.approx(2.0)
    assert each.first_loading_mean_speed_or_none == pytest.approx(4e-3, rel=0.05) and len(each.recording) == 41
    assert each.measured.stated_test_kind is None and each.stated_tool_text == ""
    assert each.list_scene_mismatches(needle) == ()


@pytest.mark.parametrize("first", ["a.csv", "a.json"])
def test_a_sidecar_may_be_uploaded_before_or_after_its_recording(run, needle, first):
    files = {"a.csv": csv(), "a.json": sidecar(kind="bonded_compression", tool={"shape": "cone", "radius_mm": 3.0})}
    for name in sorted(files, reverse=first == "a.json"):
        upload(run, name, files[name])
    each, = run.state.recordings
    assert each.stated_tool_text == "cone, radius 3 mm"
    kind, tool = each.list_scene_mismatches(needle)
    assert kind == "The recording is a bonded_compression; the scene is a needle_indentation."
    assert tool == "The recording was measured with a cone of 3 mm radius; the scene has another tool."


@pytest.mark.parametrize(("name", "content", "said"), [
    ("a.txt", b"", "a.txt: "),
    ("a.csv", b"\x00\x01", "a.csv"),
    ("b.csv", b"time [s],force [N]\n0,1\n1,1\n2,1\n3,1\n4,1\n5,1\n", "b.csv: the column with a motion is missing"),
    ("b.json", b"[1]", "b.json: must be a JSON object"),
    ("b.json", b"{", "b.json:1"),
    ("a.csv", csv(), "a.csv: A recording of this name was uploaded before."),
    ("a.json", sidecar(sha256="0" * 64), "a.json: sha256: must be the SHA-256 of a.csv."),
])
def test_an_invalid_file_gives_one_sentence_and_changes_nothing(run, name, content, said):
    upload(run)
    before = run.state
    with pytest.raises(InputError) as refused:
        upload(run, name, content)
    assert str(refused.value).startswith(said) and "\n" not in str(refused.value)
    assert "tissue_sim_" not in str(refused.value) and run.state is before


def machine_file(head="Zeit (s);Extension (mm);Load (N)"):
    """The same numbers in the format of a test machine, with compression negative."""
    rows = [line.split(",") for line in csv().decode().splitlines()[1:]]
    lines = [";".join([time, f"-{place}", f"-{force}"]).replace(".", ",") for time, place, force in rows]
    return "\r\n".join(["Specimen: gel 3", "", head, *lines, ""]).encode("cp1252")


@pytest.mark.parametrize("name", ["gel 3.csv", "gel 3.TXT"])
def test_a_test_machine_file_is_read_and_its_interpretation_is_displayed(run, needle, name):
    uploaded, = read_uploaded_recordings_or_sidecar(name, machine_file())
    run.add_uploads_atomically([uploaded])
    each, = run.state.recordings
    own, = read_uploaded_recordings_or_sidecar("own.csv", csv())
    for channel in ("time", "displacement", "force"):
        np.testing.assert_allclose(each.recording.channel(channel), own.measured.recordings[0].channel(channel),
                                   rtol=1e-12)
    said, *_ = uploaded.understood
    assert "displacement from 'Extension (mm)' in mm, its sign changed" in said and "force from 'Load (N)' in N" in said
    assert escape(said) in recordings_html(run.state, needle)
    again, = read_uploaded_recordings_or_sidecar(uploaded.name, uploaded.content)
    np.testing.assert_array_equal(again.measured.recordings[0].force, each.recording.force)


@pytest.mark.parametrize(("head", "said"), [
    ("Zeit (s);Extension (mm);Load", "gel.txt: does not state the unit of column 'Load' (force). Write the unit into"),
    ("Zeit (s);Strain (%);Stress (kPa)", "must contain displacement and force; got"),
    ("red;green;blue", "gel.txt: "),
])
def test_a_file_with_missing_information_gives_one_sentence(head, said):
    with pytest.raises(InputError) as refused:
        read_uploaded_recordings_or_sidecar("gel.txt", machine_file(head))
    assert said in str(refused.value) and "\n" not in str(refused.value) and "tissue_sim_" not in str(refused.value)


def test_several_recordings_are_added_together_or_not_at_all(run):
    first, = read_uploaded_recordings_or_sidecar("a.csv", csv())
    second, = read_uploaded_recordings_or_sidecar("b.csv", csv())
    with pytest.raises(InputError, match="A recording of this name was uploaded before"):
        run.add_uploads_atomically([first, second, first])
    assert run.state.recordings == ()


def test_progress_and_result_have_the_same_units():
    status = FitProgress("fitting", 3, 0.02, {"C10": 1404.9, "bulk.bulk_ratio": 1e4},
                         {"C10": "Pa", "bulk.bulk_ratio": "1"})
    assert "C10 1.4049 kPa, bulk.bulk_ratio 10000<" in calibration_html(CalibrationState(status=status))


def test_unsafe_file_names_are_sanitised():
    for name, safe in (("../../a*.csv", "a_.csv"), ("c:\\x\\b[1].csv", "b_1_.csv")):
        assert read_uploaded_recordings_or_sidecar(name, csv())[0].name == safe


def test_recordings_with_other_depth_or_speed_are_separate_tests(run):
    for name, depth, seconds in (("a", 4e-3, 2.0), ("b", 4.2e-3, 2.0), ("c", 6e-3, 3.0), ("d", 4e-3, 20.0)):
        upload(run, f"{name}.csv", csv(depth, seconds))
    assert group_replicate_file_names(run.state.recordings) == (("a.csv", "b.csv"), ("c.csv",), ("d.csv",))


def test_progress_is_reported_and_the_fitted_material_is_used(run, pool, needle):
    session = MinimalSession(needle, run)
    upload(run)
    upload(run, "a.json", sidecar())
    session.do("calibrate")
    (folder, wanted), future = pool.tasks[-1]
    assert (wanted.kind, wanted.tests, wanted.material) == (needle.kind.name, (("a.csv",),), needle.material)
    assert sorted(path.name for path in (Path(folder) / RECORDINGS).iterdir()) == ["a.csv", "a.json"]
    use_finished_calibration_in_scene(session)
    assert run.state.status.sentence == "starting"
    for command, values in (("calibrate", {}), ("remove_recordings", {})):
        with pytest.raises(InputError, match="A calibration is running"):
            session.do(command, **values)
    content = {"sentence": "3 starts", "solves": 2, "rmse": 0.1, "parameters": {"C10": 1800.0}}
    (Path(folder) / PROGRESS_FILE).write_text(json.dumps(content), encoding="utf-8")
    use_finished_calibration_in_scene(session)
    assert (run.state.status.solves, run.state.status.parameters) == (2, {"C10": 1800.0}) and session.scene is needle

    future.set_result(found := result_for(needle))
    use_finished_calibration_in_scene(session)
    assert run.state.result is found and run.state.status is None and run.state.problem == ""
    assert session.scene.material == found.material and session.scene.source == CALIBRATED
    assert session.scene.measurement.recordings[0].metadata["kind"] == needle.kind.name
    assert not Path(folder).exists()
    session.do("remove_recordings")
    assert run.state.recordings == () and run.state.result is found


@pytest.mark.parametrize(("error", "said"), [
    (ConvergenceError("no start of any law gets through"), "no start of any law gets through"),
    (InputError("needs at least 5 samples", file="a.csv"), "a.csv: needs at least 5 samples"),
    (BrokenProcessPool("terminated abruptly"), "The calibration process has died"),
    (np.linalg.LinAlgError("Singular matrix"), "The calibration failed with an internal error (LinAlgError: "),
])
def test_a_failed_fit_gives_a_message_and_changes_nothing(run, pool, needle, error, said):
    session = MinimalSession(needle, run)
    upload(run)
    session.do("calibrate")
    (folder, _), future = pool.tasks[-1]
    future.set_exception(error)
    use_finished_calibration_in_scene(session)
    assert run.state.problem.startswith(said) and run.state.status is None and run.state.result is None
    assert session.scene is needle and not Path(folder).exists()
    session.do("calibrate")
    assert run.state.problem == "" and run.state.status is not None


def test_an_unusable_fit_is_displayed_but_not_used(run, pool, needle):
    session = MinimalSession(needle, run)
    upload(run)
    session.do("calibrate")
    why = "does not describe the data: its residuals are 2.8e+03 % of the largest force"
    found = replace(result_for(needle), unusable=why, warnings=(why,))
    pool.tasks[-1][1].set_result(found)
    use_finished_calibration_in_scene(session)
    assert session.scene is needle and run.state.result is found and "The fit is unusable" in run.state.problem
    assert why in calibration_html(run.state)


def test_a_cancelled_fit_changes_nothing(run, pool, needle):
    session = MinimalSession(needle, run)
    with pytest.raises(InputError, match="No calibration is running"):
        session.do("cancel_calibration")
    with pytest.raises(InputError, match="Upload a recording first"):
        session.do("calibrate")
    upload(run)
    session.do("calibrate")
    session.do("cancel_calibration")
    assert pool.stopped and "was cancelled" in run.state.problem and run.state.status is None
    pool.tasks[-1][1].set_result(result_for(needle))
    use_finished_calibration_in_scene(session)
    assert session.scene is needle and run.state.result is None


def test_a_result_for_another_scene_is_kept_but_not_used(run, pool, needle):
    session = MinimalSession(needle, run)
    upload(run)
    session.do("calibrate")
    session.scene = other = needle.with_test_and_tool("bonded_compression")
    pool.tasks[-1][1].set_result(found := result_for(needle))
    use_finished_calibration_in_scene(session)
    assert session.scene is other and run.state.result is found
    assert "The scene changed during the calibration" in run.state.problem


def test_a_material_that_the_scene_refuses_changes_nothing(run, pool, needle):
    session = MinimalSession(needle, run)
    session.refuses = "is too stiff."
    upload(run)
    session.do("calibrate")
    pool.tasks[-1][1].set_result(result_for(needle))
    use_finished_calibration_in_scene(session)
    assert session.scene is needle and run.state.problem == "is too stiff. The material is unchanged."


def test_the_material_file_is_saved_without_overwriting(run, pool, needle, tmp_path):
    session = MinimalSession(needle, run)
    with pytest.raises(InputError, match="There is no calibrated material yet"):
        session.do("save_calibration", folder=tmp_path, name="mine")
    upload(run)
    session.do("calibrate")
    pool.tasks[-1][1].set_result(found := result_for(needle))
    use_finished_calibration_in_scene(session)
    session.do("save_calibration", folder=tmp_path, name="mine")
    path = tmp_path / "mine.material.json"
    assert path.read_bytes() == found.file and session.scene.source == path.name
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        session.do("save_calibration", folder=tmp_path, name="mine")


@pytest.mark.slow
def test_the_process_fits_like_the_calibrate_command(run, pool, needle, tmp_path):
    """Fit two noisy replicates of a stiffer material with the calibration function in this process."""
    stiffer = with_values(needle.material, {"C10": 2200.0, "C20": 900.0})
    true = ts.simulate(replace(needle.model, material=stiffer), resolution="fast")
    for seed in range(2):
        ts.write_recording(ts.Rig(force_noise=0.005, seed=seed).measure(true), tmp_path / f"r{seed}.csv")
    upload(run, "r0.csv", (tmp_path / "r0.csv").read_bytes())
    # The second replicate in the format of a test machine.
    machine = (tmp_path / "r1.csv").read_bytes().split(b"\n", 1)[1].replace(b",", b"\t")
    machine = b"Time (s)\tExtension (mm)\tLoad (N)\n" + machine
    upload(run, "r1.txt", machine)
    run.start_fit(needle)
    (folder, request), _ = pool.tasks[-1]
    found = calibrate_uploaded_files(folder, request)
    low, high = found.values["C10"].interval
    assert low < 2200.0 < high and found.rmse == pytest.approx(0.005, rel=0.3)
    assert json.loads((Path(folder) / PROGRESS_FILE).read_text(encoding="utf-8"))["solves"] > 1
    said = json.loads(found.file)
    assert {each["file"] for each in said["provenance"]["recordings"]} == {"r0.csv", "r1.csv"}
    assert said["provenance"]["settings"]["made_from"] == {
        "r1.csv": {"file": "r1.txt", "sha256": hashlib.sha256(machine).hexdigest()}}
    assert said["parameters"]["C10"]["standard_error"] > 0 and found.material.density == needle.material.density
    with pytest.raises(InputError) as refused:
        calibrate_uploaded_files(folder, replace(request, tests=(("missing.csv",),)))
    assert folder not in str(refused.value)
