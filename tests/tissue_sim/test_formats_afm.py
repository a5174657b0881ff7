"""Force curves of AFMs: sign, zero, segments, several curves, and every measured file of the set."""

import sys
import zipfile
from pathlib import Path

import afmformats
import numpy as np
import pytest

from tissue_sim import InputError, read_recording
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.formats.afm import build_curve_recording, read_afm

#: Stiffness, N/m.
STIFFNESS = 0.05
#: Depth, m.
DEPTH = 3e-6
AIR = 4e-6
DRIFT = 2.5e-9


def hertz(depth):
    """Force of a stiff sphere, N; zero in air."""
    return 4e-9 * (np.clip(depth, 0.0, None) / DEPTH) ** 1.5


def made_curve(path, enum=0, points=400, spring_constant=STIFFNESS):
    """A curve of afmformats whose tip goes from `AIR` above the tissue to `DEPTH` and back, with a baseline."""
    depth = np.concatenate([np.linspace(-AIR, DEPTH, points), np.linspace(DEPTH, -AIR, points)])
    force = hertz(depth)
    height = 50e-6 - depth - force / STIFFNESS
    metadata = {"path": path, "enum": enum, "imaging mode": "force-distance", "speed approach": 5e-6,
                "instrument": "made"}
    if spring_constant:
        metadata["spring constant"] = spring_constant
    noise = np.random.default_rng(enum).uniform(-2e-12, 2e-12, depth.size)
    return afmformats.AFMForceDistance(
        {"force": force + DRIFT + noise, "height (measured)": height, "time": 1e-3 * np.arange(depth.size),
         "segment": np.repeat([0, 1], points)}, metadata)


def read_only(path, **options):
    """The curve of a file that holds one."""
    curve, = read_afm(path, **options)
    return curve


def write(folder, name="curve.tab", **options):
    path = folder / name
    made_curve(path, **options).export_data(path, fmt="tab")
    return path


def refusal(read, path, **options):
    with pytest.raises(InputError) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value) and caught.value.file == path
    return caught.value


def test_tip_motion_force_and_segments_of_a_known_curve(tmp_path):
    recording = read_recording(write(tmp_path), format="afm", kind="needle_indentation")
    segment = recording.labels["segment"]
    assert segment.tolist() == ["approach"] * 400 + ["retract"] * 400
    # The force leaves a baseline of +-2 pN where it has grown by that: 25 nm after the touch, or a sample before.
    assert recording.displacement.max() == pytest.approx(DEPTH, abs=60e-9)
    assert recording.displacement.min() == pytest.approx(-AIR, abs=60e-9)
    assert recording.force.max() == pytest.approx(hertz(DEPTH), abs=5e-12)
    assert abs(recording.force[:100]).max() < 5e-12
    assert recording.time[-1] == pytest.approx(0.799)
    assert recording.metadata["spring_constant_N_per_m"] == STIFFNESS
    assert recording.metadata["approach_speed_mm_s"] == 5e-3
    assert recording.metadata["displacement"] == "tip"


def test_the_raw_values_can_be_had_back(tmp_path):
    recording = read_only(write(tmp_path))
    zeroing = recording.metadata["zeroing"]
    assert zeroing["force_N"] == pytest.approx(DRIFT, abs=1e-12)
    raw = made_curve(tmp_path / "raw.tab")
    np.testing.assert_allclose(recording.force + zeroing["force_N"], raw["force"], atol=1e-16)
    height = zeroing["height_m"] - recording.displacement - (recording.force + zeroing["force_N"]) / STIFFNESS
    np.testing.assert_allclose(height, raw["height (measured)"], atol=1e-12)
    assert recording.displacement[zeroing["contact_sample"]] == 0.0


def test_without_a_spring_constant_the_piezo_moves(tmp_path):
    path = write(tmp_path, spring_constant=None)
    recording = read_only(path)
    assert recording.metadata["displacement"].startswith("piezo")
    assert recording.displacement.max() == pytest.approx(DEPTH + hertz(DEPTH) / STIFFNESS, abs=60e-9)
    stated = read_only(path, spring_constant=STIFFNESS)
    assert stated.displacement.max() == pytest.approx(DEPTH, abs=60e-9)
    assert stated.metadata["spring_constant_N_per_m"] == STIFFNESS
    problem = refusal(read_afm, write(tmp_path), spring_constant=2 * STIFFNESS).problem
    assert "spring constant must be 0.05 as in the file; got 0.1" in problem


def test_a_file_of_several_curves(tmp_path):
    path = tmp_path / "curves.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for enum, name in enumerate(("b.tab", "sub/a.tab", "c.tab", "notes.md")):
            archive.write(write(tmp_path, enum=enum), name)
    found = read_afm(path)
    assert [recording.metadata["member"] for recording in found] == ["b.tab", "c.tab", "a.tab"]
    assert [recording.metadata["curve"] for recording in found] == [1, 2, 3]
    chosen = read_only(path, curve=3)
    np.testing.assert_array_equal(chosen.force, found[2].force)
    named = read_recordings(path, format="afm", kind="needle_indentation")
    assert [recording.name for recording in named] == ["curves_1", "curves_2", "curves_3"]
    assert read_recording(path, format="afm", curve=3).name == "curves"
    single = read_recordings(write(tmp_path), format="afm")
    assert [recording.name for recording in single] == ["curve"]
    error = refusal(read_recording, path, format="afm")
    assert error.field == "curve" and "choose one with curve = 1 to 3" in error.problem
    assert "must be from 1 to 3, the number of curves in the file; got 4" in refusal(read_afm, path, curve=4).problem
    for curve in (0, -1, 1.0, True, "2"):
        assert refusal(read_afm, path, curve=curve).field == "curve"


def test_refusals(tmp_path, capfd):
    path = tmp_path / "curve.tab"
    assert "no such file" in refusal(read_afm, path).problem
    path.write_text("a poem\nwithout numbers\n", encoding="utf-8")
    assert "cannot be read as force curves" in refusal(read_afm, path).problem
    other = tmp_path / "curve.csv2"
    other.write_text("1,2\n", encoding="utf-8")
    assert "ends in '.csv2', expected" in refusal(read_afm, other).problem
    empty = tmp_path / "empty.zip"
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("readme.md", "nothing")
    assert "has no file that ends in" in refusal(read_afm, empty).problem
    empty.write_bytes(b"PK\x03\x04")
    assert "cannot be unpacked" in refusal(read_afm, empty).problem
    assert refusal(read_afm, path, spring_constant=-1.0).field == "spring_constant"
    assert capfd.readouterr().err == "", "tracebacks of afmformats stay off the screen"


@pytest.mark.parametrize(("change", "message"), [
    ({"force": np.full(800, np.nan)}, "force of sample 1 is nan"),
    ({"segment": np.full(800, 1)}, None),
    ({"segment": np.repeat([0, 5], 400)}, "has 6 segments, expected 2"),
])
def test_odd_curves(tmp_path, change, message):
    curve = made_curve(tmp_path / "odd.tab")
    for name, values in change.items():
        curve[name] = values
    if message is None:
        # A file that does not tell the segments apart turns where the tip is deepest.
        segment = build_curve_recording(curve, 1).labels["segment"]
        # The two samples in the middle are equally deep.
        assert segment.tolist() in (["approach"] * n + ["retract"] * (800 - n) for n in (400, 401))
    else:
        with pytest.raises(InputError, match=message):
            build_curve_recording(curve, 1)


def test_without_the_extra_the_answer_names_it(tmp_path, monkeypatch):
    path = write(tmp_path)
    monkeypatch.setitem(sys.modules, "afmformats", None)
    assert "pip install 'tissue-sim[formats]'" in refusal(read_afm, path).problem


def afm(folder: Path, start: str) -> Path:
    """The file of the set whose name begins so."""
    found, = (folder / "afm_formats").glob(f"{start}*")
    return found


@pytest.mark.parametrize(("start", "setpoint", "segments", "timed", "largest"), [
    ("fmt-jpk-cc_pr14-brain", 10e-9, (3000, 3000, 3000), True, 15.11e-6),
    ("fmt-jpk-cc_pr14-polymergel", 10e-9, (3000, 3000, 3000), True, 3.103e-6),
    ("fmt-jpk-fd_spot3", 4e-9, (2000, 0, 2000), True, 0.1494e-6),
    ("fmt-tab-fd", 6e-9, (3146, 0, 882), False, 2.906e-6),
    ("fmt-igor", 180e-9, (5064, 0, 5033), False, 4.719e-6),
    ("fmt-chiaro", 50e-9, (12664, 0, 1163), True, 14.59e-6),
])
def test_the_tared_force_reaches_the_setpoint_of_the_machine(data_folder, start, setpoint, segments, timed, largest):
    """The machines stop at their setpoint above the baseline: a check of unit, sign and zero that is not ours."""
    recording = read_recording(afm(data_folder, start), format="afm", kind="needle_indentation")
    assert recording.metadata["setpoint_N"] == pytest.approx(setpoint)
    approach = recording.labels["segment"] == "approach"
    assert recording.force[approach].max() == pytest.approx(setpoint, rel=0.06)
    assert tuple(np.sum(recording.labels["segment"] == name) for name in ("approach", "hold", "retract")) == segments
    assert ("time" in recording) == timed
    assert recording.displacement.max() == pytest.approx(largest, rel=1e-3)


@pytest.mark.slow
def test_stress_relaxation_of_fifteen_cells(data_folder):
    """30 s of hold at 20 um: the force falls, the piezo stands, and the single file is the eighth of the zip."""
    found = read_afm(afm(data_folder, "10.1002"))
    assert [recording.metadata["member"] for recording in found] == [f"cell1-{i:04d}.jpk-force" for i in range(1, 16)]
    for recording in found:
        hold = recording.labels["segment"] == "hold"
        assert np.ptp(recording.time[hold]) == pytest.approx(30.0, abs=0.02)
        force = recording.force[hold]
        assert 0.27e-6 < force[0] < 0.35e-6 and 0.3 < force[-100:].mean() / force[0] < 0.6
        piezo = recording.displacement + recording.force / recording.metadata["spring_constant_N_per_m"]
        assert np.ptp(piezo[hold]) < 0.1e-6
    single = read_only(afm(data_folder, "fmt-jpk-sr"))
    np.testing.assert_array_equal(single.force, found[7].force)
    assert single.metadata["measurement"] == "stress-relaxation"


def test_chiaro_says_its_tip(data_folder):
    metadata = read_only(afm(data_folder, "fmt-chiaro")).metadata
    assert (metadata["tool"], metadata["tool_radius_mm"]) == ("sphere", 0.0275)
    assert metadata["spring_constant_N_per_m"] == 0.019 and metadata["approach_speed_mm_s"] == 7e-3


def test_a_map_of_four_curves(data_folder):
    path = afm(data_folder, "fmt-jpk-fd_2020")
    assert [len(recording) for recording in read_afm(path)] == [600, 600, 597, 600]
    assert read_only(path, curve=4).metadata["curve"] == 4


def test_an_export_without_units_needs_the_cantilever(data_folder):
    """NT-MDT writes nA of the detector; AFM Workshop writes N, but no spring constant."""
    path = afm(data_folder, "fmt-ntmdt")
    assert "give spring_constant (N/m) and sensitivity (m/V)" in refusal(read_afm, path).problem
    recording = read_only(path, spring_constant=0.05, sensitivity=100.0)
    assert len(recording) == 1644 and recording.displacement.max() > 1e-6
    recording = read_only(afm(data_folder, "fmt-afm-workshop"))
    assert len(recording) == 2030 and recording.metadata["displacement"].startswith("piezo")
    assert recording.force[0] == pytest.approx(1.2764373e-06 - recording.metadata["zeroing"]["force_N"], rel=1e-9)
