"""Native recordings: what is read, what is refused, and that nothing is lost on the way."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tissue_sim import InputError, Recording, read_recording, write_recording
from tissue_sim.recording.recording import CHANNELS

HEADER = "time [s],displacement [mm],force [N]"
ROWS = [f"{i},{0.5 * i},{0.1 * i}" for i in range(6)]


def write(folder: Path, *lines: str, name="test.csv", encoding="utf-8") -> Path:
    path = folder / name
    path.write_bytes("\n".join([*lines, ""]).encode(encoding))
    return path


def refusal(path, **options) -> InputError:
    with pytest.raises(InputError) as caught:
        read_recording(path, **options)
    assert "\n" not in str(caught.value)
    return caught.value


def test_reads_si(tmp_path):
    recording = read_recording(write(tmp_path, "# a comment", "", HEADER, *ROWS[:3], "# another", *ROWS[3:]))
    assert recording.time.tolist() == [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(recording.displacement, np.arange(6) * 0.5e-3, rtol=1e-15)
    np.testing.assert_allclose(recording.force, np.arange(6) * 0.1, rtol=1e-15)


@pytest.mark.parametrize(("header", "factors"), [
    ("time [ms],displacement [m],force [mN]", (1e-3, 1.0, 1e-3)),
    ("Time (s),Displacement (um),Force (kN)", (1.0, 1e-6, 1e3)),
    ("TIME [min], displacement [cm] ,\"force [N]\"", (60.0, 1e-2, 1.0)),
    ("time [us],displacement [µm],force [µN]", (1e-6, 1e-6, 1e-6)),
])
def test_units_of_the_header(tmp_path, header, factors):
    recording = read_recording(write(tmp_path, header, *ROWS))
    for values, factor, step in zip((recording.time, recording.displacement, recording.force), factors, (1, 0.5, 0.1),
                                    strict=True):
        np.testing.assert_allclose(values, factor * step * np.arange(6), rtol=1e-14)


def test_byte_order_mark_and_windows_line_ends(tmp_path):
    path = tmp_path / "test.csv"
    path.write_bytes(("\ufeff" + "\r\n".join([HEADER, *ROWS])).encode())
    assert len(read_recording(path)) == 6


def test_labels_and_other_axes(tmp_path):
    lines = [f"{i},{i},{i},ramp {i // 3},{i // 2},{20 + i},{-i},{0.5}" for i in range(6)]
    recording = read_recording(write(
        tmp_path, HEADER + ",segment,cycle,temperature [degC],fx [mN],Tz [Nmm]", *lines))
    assert recording.labels["segment"].tolist() == ["ramp 0"] * 3 + ["ramp 1"] * 3
    assert recording.labels["cycle"].tolist() == [0, 0, 1, 1, 2, 2]
    np.testing.assert_allclose(recording.channel("temperature"), 293.15 + np.arange(6))
    np.testing.assert_allclose(recording.channel("Fx"), -1e-3 * np.arange(6))
    np.testing.assert_allclose(recording.channel("Tz"), np.full(6, 0.5e-3))


def test_stress_and_stretch(tmp_path):
    path = write(tmp_path, "stretch [-],nominal_stress [kPa]", *[f"{1 + 0.1 * i},{i}" for i in range(6)])
    recording = read_recording(path, kind="uniaxial_tension")
    np.testing.assert_allclose(recording.channel("nominal stress"), 1e3 * np.arange(6))
    assert refusal(path, kind="simple_shear").file == path


def test_a_ratio_may_be_percent_or_bare(tmp_path):
    path = write(tmp_path, "shear strain [%],nominal stress [Pa]", *[f"{i},{i}" for i in range(6)])
    np.testing.assert_allclose(read_recording(path).channel("shear strain"), 0.01 * np.arange(6))
    bare = write(tmp_path, "stretch,nominal stress [Pa]", *[f"{i},{i}" for i in range(6)], name="bare.csv")
    assert read_recording(bare).channel("stretch").tolist() == [0, 1, 2, 3, 4, 5]


def test_speed_makes_the_time(tmp_path):
    depths = [0, 1, 2, 3, 2, 1]
    path = write(tmp_path, "displacement [mm],force [N]", *[f"{d},{d}" for d in depths])
    assert "time" not in read_recording(path)
    np.testing.assert_allclose(read_recording(path, speed=0.5e-3).time, [0, 2, 4, 6, 8, 10], rtol=1e-14)
    for speed in (0.0, -1.0, float("nan"), "fast"):
        assert refusal(path, speed=speed).field == "speed"
    timed = write(tmp_path, HEADER, *ROWS, name="timed.csv")
    assert read_recording(timed, speed=1.0).time[-1] == 5.0
    stretch = write(tmp_path, "stretch,nominal stress [Pa]", *[f"{i},{i}" for i in range(6)], name="stretch.csv")
    assert "displacement" in refusal(stretch, speed=1.0).problem


def test_metadata_of_a_bare_file(tmp_path):
    path = write(tmp_path, HEADER, *ROWS, name="needle 1.csv")
    assert dict(read_recording(path).metadata) == {
        "name": "needle 1", "source": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


BAD = {
    "unknown column": ([HEADER.replace("displacement", "displacment"), *ROWS], 1, "did you mean 'displacement'"),
    "unknown unit": ([HEADER.replace("mm", "ell"), *ROWS], 1, "unknown unit 'ell'"),
    "unit of another quantity": ([HEADER.replace("mm", "kPa"), *ROWS], 1, "expected a length"),
    "missing unit": ([HEADER.replace(" [N]", ""), *ROWS], 1, r"unit is missing, expected a force such as \[N\]"),
    "not a number": ([HEADER, *ROWS[:2], "2,abc,0.2", *ROWS[3:]], 4, r"'displacement \[mm\]' holds 'abc'"),
    "underscore": ([HEADER, *ROWS[:2], "2,1_0,0.2", *ROWS[3:]], 4, "holds '1_0'"),
    "empty cell": ([HEADER, *ROWS[:2], "2,,0.2", *ROWS[3:]], 4, "is empty"),
    "nan": ([HEADER, *ROWS[:4], "4,nan,0.2", *ROWS[5:]], 6, "holds 'nan', expected a finite number"),
    "infinite": ([HEADER, *ROWS[:4], "4,1e999,0.2", *ROWS[5:]], 6, "holds '1e999'"),
    "ragged": ([HEADER, *ROWS, "6,3"], 8, "2 cells, expected 3"),
    "too many cells": ([HEADER, *ROWS, "6,3,0.6,7"], 8, "4 cells, expected 3"),
    "duplicate": ([HEADER + ",Force [mN]", *[row + ",1" for row in ROWS]], 1, "'force' appears twice"),
    "time backwards": ([HEADER, "# c", *ROWS[:3], "1.5,1,1", *ROWS[3:]], 6, "time runs backwards from 2 to 1.5"),
    "four points": ([HEADER, *ROWS[:4]], None, "4 points .* expected at least 5"),
    "header only": ([HEADER], None, "0 points"),
    "only comments": (["# nothing"], None, "only comments"),
    "semicolons": ([HEADER.replace(",", ";"), *ROWS], 1, "separated by semicolons, expected commas"),
    "tabs": ([HEADER.replace(",", "\t"), *ROWS], 1, "separated by tabs, expected commas"),
    "no header": (ROWS, 1, "the header is missing"),
    "prose": (["This is not a table.", *ROWS], 1, "the header of a recording is missing"),
    "open quote": ([HEADER, *ROWS, '6,"3,1', "7,3,1"], 8, "close its quotation mark"),
    "no load": (["time [s],displacement [mm]", *[row.rpartition(",")[0] for row in ROWS]], None,
                "force, nominal stress or torque"),
    "no motion": (["time [s],force [N]", *[row.rpartition(",")[0] for row in ROWS]], None, "a motion is missing"),
    "cycle": ([HEADER + ",cycle", *[row + ",1.5" for row in ROWS]], 2, "'cycle' holds '1.5', expected a whole number"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_with_file_and_line(tmp_path, case):
    lines, line, message = BAD[case]
    path = write(tmp_path, *lines)
    error = refusal(path)
    assert (error.file, error.line) == (path, line)
    with pytest.raises(InputError, match=message):
        raise error


def test_files_that_are_no_text(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.csv").problem
    assert "is a folder" in refusal(tmp_path).problem
    path = write(tmp_path, "")
    assert "is empty" in refusal(path).problem
    path.write_bytes(b"\xef\xbb\xbf")
    assert "is empty" in refusal(path).problem
    path.write_bytes(b"PK\x03\x04\x00\x00")
    assert "binary" in refusal(path).problem
    error = refusal(write(tmp_path, HEADER, *ROWS[:2], "# 5 µm", encoding="latin-1"))
    assert "not UTF-8" in error.problem and error.line == 4
    error = refusal(write(tmp_path, HEADER, *ROWS, encoding="utf-16"))
    assert "UTF-16" in error.problem


def test_kind_names_what_it_needs(tmp_path):
    path = write(tmp_path, HEADER, *ROWS)
    assert len(read_recording(path, kind="bonded_compression")) == 6
    assert "did you mean 'uniaxial_tension'" in refusal(path, kind="uniaxial_tensoin").problem
    stretch = write(tmp_path, "stretch,nominal stress [Pa]", *[f"{i},{i}" for i in range(6)])
    assert "needs columns 'displacement' and 'force'" in refusal(stretch, kind="bonded_compression").problem


def value(channel):
    if channel == "temperature":
        return st.floats(200.0, 400.0)
    # Numbers that mm and N can hold with all their digits.
    size = st.floats(1e-200, 1e200)
    return st.one_of(st.just(0.0), size, size.map(lambda x: -x))


@st.composite
def recordings(draw):
    n = draw(st.integers(5, 12))
    names = draw(st.sets(st.sampled_from(sorted(CHANNELS))).map(lambda names: names | {"displacement", "force"}))
    channels = {name: draw(arrays(float, n, elements=value(name))) for name in names}
    if "time" in channels:
        channels["time"] = np.sort(channels["time"])
    words = st.text(st.characters(categories=["L", "N", "P", "S"]), max_size=8)
    labels = draw(st.fixed_dictionaries({}, optional={
        "segment": st.lists(words, min_size=n, max_size=n),
        "cycle": st.lists(st.integers(-10**9, 10**9), min_size=n, max_size=n)}))
    metadata = draw(st.dictionaries(st.sampled_from(["device", "tool", "stopped_by"]), st.recursive(
        st.none() | st.booleans() | st.integers(-2**53, 2**53)
        | st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)
        | st.text(st.characters(exclude_categories=["Cs"])),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abc", max_size=3), inner, max_size=3),
        max_leaves=4)))
    return Recording(channels, labels, metadata)


@pytest.mark.slow
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(recordings())
def test_round_trip_keeps_every_digit(tmp_path, recording):
    path = tmp_path / "trip.csv"
    write_recording(recording, path)
    again = read_recording(path)
    assert set(again.channels) == set(recording.channels)
    for name, values in recording.channels.items():
        np.testing.assert_allclose(again.channel(name), values, rtol=1e-15, atol=0.0)
    assert {name: values.tolist() for name, values in again.labels.items()} == {
        name: values.tolist() for name, values in recording.labels.items()}
    assert {key: again.metadata[key] for key in recording.metadata} == dict(recording.metadata)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=200) | st.text(alphabet=HEADER + '0123456789.,;-#"\n\r\t', max_size=300).map(str.encode))
def test_any_bytes_give_a_recording_or_one_sentence(tmp_path, data):
    path = tmp_path / "any.csv"
    path.write_bytes(data)
    for options in ({}, {"columns": {"displacement": "displacement", "force": "force"}}, {"format": "instron"}):
        try:
            assert len(read_recording(path, **options)) >= 5
        except InputError as error:
            assert path.name in str(error)  # a long path is shortened in the middle


def test_metadata_of_numpy_becomes_json(tmp_path):
    recording = Recording({"displacement": np.arange(5.0), "force": np.arange(5.0)}, metadata={
        "gain": np.float32(0.5), "counts": np.int64(3), "axes": np.eye(2), "place": Path("a"), "on": np.bool_(True),
        "pair": (1, 2), "source": "elsewhere.csv", "name": "first"})
    write_recording(recording, tmp_path / "out" / "r.csv")
    sidecar = json.loads((tmp_path / "out" / "r.json").read_text(encoding="utf-8"))
    digest = hashlib.sha256((tmp_path / "out" / "r.csv").read_bytes()).hexdigest()
    assert sidecar == {"gain": 0.5, "counts": 3, "axes": [[1.0, 0.0], [0.0, 1.0]], "place": "a", "on": True,
                       "pair": [1, 2], "name": "first", "sha256": digest}
    again = read_recording(tmp_path / "out" / "r.csv")
    assert again.name == "first" and again.metadata["source"] == str(tmp_path / "out" / "r.csv")


def test_header_of_a_written_file(tmp_path):
    write_recording(Recording({"force": [0.0] * 5, "displacement": [1e-3] * 5, "time": np.arange(5.0)},
                              {"cycle": [1] * 5}), tmp_path / "r.csv")
    assert (tmp_path / "r.csv").read_text(encoding="utf-8").splitlines()[:2] == [HEADER + ",cycle", "0.0,1.0,0.0,1"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.csv", "r.json"]


@pytest.mark.parametrize(("labels", "metadata", "name", "message"), [
    ({}, {}, "r.txt", "must end in .csv"),
    ({}, {"scores": [1.0, float("nan")]}, "r.csv", r"metadata\.scores\[1\]: number must be finite; got nan"),
    ({}, {"device": "\ud800"}, "r.csv", r"metadata\.device: .* surrogate"),
    ({}, {"object": object()}, "r.csv", "no equivalent in JSON"),
    ({"segment": ["a\nb"] * 5}, {}, "r.csv", "line breaks"),
    ({"segment": [" a"] * 5}, {}, "r.csv", "blanks"),
    ({}, {}, "folder.csv", "cannot be written"),
])
def test_what_cannot_be_written_leaves_nothing(tmp_path, labels, metadata, name, message):
    (tmp_path / "folder.csv").mkdir()
    recording = Recording({"displacement": np.arange(5.0), "force": np.arange(5.0)}, labels, metadata)
    with pytest.raises(InputError, match=message):
        write_recording(recording, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.csv"]


def test_a_number_too_large_for_mm_is_refused(tmp_path):
    with pytest.raises(InputError, match="must be finite in mm"), np.errstate(over="ignore"):
        write_recording(Recording({"displacement": [1e308] * 5, "force": [0.0] * 5}), tmp_path / "r.csv")
    assert not list(tmp_path.iterdir())


def test_a_changed_csv_is_noticed(tmp_path):
    path = tmp_path / "r.csv"
    channels = {"displacement": np.arange(5.0), "force": np.arange(5.0)}
    write_recording(Recording(channels, metadata={"tool": "flat"}), path)
    path.write_text(path.read_text(encoding="utf-8").replace("4.0", "4.5"), encoding="utf-8")
    error = refusal(path)
    assert error.file == tmp_path / "r.json" and error.field == "sha256" and "r.csv was changed" in error.problem
    (tmp_path / "r.json").write_text('{"tool": "flat"}', encoding="utf-8")
    assert read_recording(path).metadata["tool"] == "flat"


@pytest.mark.parametrize("content", ['{"schema": "tissue_sim/material/1"}', "[1]", "no JSON", '{"tool": "flat"}'])
def test_a_json_file_that_is_no_sidecar_is_not_replaced(tmp_path, content):
    (tmp_path / "m.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=r"m\.json: is not the sidecar of a recording"):
        write_recording(Recording({"displacement": np.arange(5.0), "force": np.arange(5.0)}), tmp_path / "m.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["m.json"]
    assert (tmp_path / "m.json").read_text(encoding="utf-8") == content


@pytest.mark.parametrize(("text", "line", "message"), [
    ('{"tool": \n', 2, "damaged JSON"),
    ("[1]", None, "expected an object {...} with the metadata of test.csv"),
    ('{"a": 1, "a": 2}', None, "key must appear once in an object; got 'a' twice"),
])
def test_a_damaged_sidecar_is_refused(tmp_path, text, line, message):
    path = write(tmp_path, HEADER, *ROWS)
    path.with_suffix(".json").write_text(text, encoding="utf-8")
    error = refusal(path)
    assert error.file == path.with_suffix(".json") and error.line == line and message in error.problem
