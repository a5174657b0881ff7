"""Files of strangers: every reader answers each of them in one sentence, in bounded time and memory."""

import io
import os
import sys
import time
import zipfile
from pathlib import Path

import openpyxl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat

import calibration
import tissue_sim as ts
from calibration.campaign.campaign import load_campaign
from scenes.commands.record.protocol_file import read_protocol_file
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.decode import read_json_value, read_toml_dict
from tissue_sim.errors import MESSAGE_LIMITS, join_location_and_problem
from tissue_sim.files import read_bytes, read_text

HEADER = "time [s],displacement [mm],force [N]\n"
COLUMNS = {"displacement": {"column": 1, "unit": "mm"}, "force": {"column": 2, "unit": "N"}}
#: Reader -> (ending of its files, function of a path).
READERS = {
    "native": ("csv", ts.read_recording),
    "columns": ("csv", lambda path: ts.read_recording(path, columns=COLUMNS)),
    "table": ("txt", lambda path: ts.read_recordings(path, format="table")),
    "xlsx": ("xlsx", lambda path: ts.read_recording(path, format="xlsx")),
    "afm": ("ibw", lambda path: ts.read_recordings(path, format="afm")),
    "zip of afm": ("zip", lambda path: ts.read_recordings(path, format="afm")),
    "mat": ("mat", lambda path: ts.read_recording(path, columns=COLUMNS)),
    "import": ("csv", lambda path: calibration.import_files([path])),
    "material": ("json", ts.load_material),
    "rig": ("json", ts.load_rig),
    "profile": ("csv", lambda path: ts.Tool("profile", profile_file=path)),
    "campaign": ("toml", load_campaign),
    "protocol": ("toml", read_protocol_file),
}


def refused(read, path) -> str:
    with pytest.raises(ts.InputError) as caught:
        read(path)
    said = str(caught.value)
    assert len(said) <= MESSAGE_LIMITS.message and said.isprintable(), said
    return said


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file(tmp_path, name):
    ending, read = READERS[name]
    assert "is a folder" in refused(read, tmp_path)
    assert "no such file" in refused(read, tmp_path / f"none.{ending}")
    refused(read, tmp_path / f"{'n' * 5000}.{ending}")
    refused(read, tmp_path / f"half\ud800.{ending}")
    refused(read, tmp_path / f"nul\0.{ending}")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / f"pipe.{ending}")
        assert "is a pipe" in refused(read, tmp_path / f"pipe.{ending}")
        (tmp_path / f"zero.{ending}").symlink_to("/dev/zero")
        assert "device" in refused(read, tmp_path / f"zero.{ending}")


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("content", [
    b"", b"\0" * 100, b"\xff\xfe\xfd" * 100, b"9" * 5000, b"[" * 100_000, b'{"a":' * 100_000, b"x = " + b"[" * 100_000,
    b"a" * 1_000_000, b'"' + b"\n" * 1000, b"PK\x03\x04" + bytes(range(256)) * 4, b"\x1b]0;title\x07",
], ids=["empty", "nul", "no utf-8", "digits", "lists", "maps", "toml lists", "long line", "quote", "archive", "escape"])
def test_what_is_no_recording_and_no_setting(tmp_path, name, content):
    ending, read = READERS[name]
    path = tmp_path / f"strange.{ending}"
    path.write_bytes(content)
    refused(read, path)


@pytest.mark.parametrize("text", [
    '{"schema": %s}' % ("9" * 5000), '{"schema": "\\ud800"}', '{"\\udfff": 1}', '{"a": 1e999}', "[1, 2", "\ufeff{",
    '{"schema": "tissue_sim/rig/1", "compliance_mm_per_N": %s}' % ("9" * 400), '{"schema": "%s"}' % ("x" * 100_000)])
def test_json(tmp_path, text):
    path = tmp_path / "strange.json"
    path.write_text(text, encoding="utf-8")
    refused(ts.load_rig, path)
    refused(ts.load_material, path)


def test_json_that_is_too_large(tmp_path):
    path = tmp_path / "strange.json"
    path.write_bytes(b"[" + b"{}," * 3_000_000 + b"{}]")
    assert "of at most 8 MB" in refused(lambda path: read_json_value(path, "anything"), path)


@pytest.mark.slow
@pytest.mark.parametrize("text", [
    "x = " + "9" * 5000, "x = " + "[" * 5000 + "]" * 5000, ".".join("a" * 100_000) + " = 1", 'x = "\\ud800"',
    'test = "a"', "test = 3", "defaults = 1", "fit = [1]", "[[test]]\nkind = 1e999"],
    ids=["digits", "lists", "parts", "surrogate", "text", "number", "defaults", "fit", "infinite"])
def test_campaigns_and_protocols(tmp_path, text):
    path = tmp_path / "strange.toml"
    path.write_text(text, encoding="utf-8")
    refused(load_campaign, path)
    refused(read_protocol_file, path)


CAMPAIGN = """[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "needle_indentation"
tool = "flat"
tool_radius_mm = 8.0
{line}
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
"""


@pytest.mark.parametrize("pattern", [
    "a**b", "**", "[", "*/" * 200 + "*", "n" * 5000 + "*", "\\u0000*", "/proc/*/task/*/fd/**/**/**/*", "?" * 300])
def test_patterns_of_recordings(tmp_path, pattern):
    path = tmp_path / "strange.toml"
    path.write_text(CAMPAIGN.format(line=f'recordings = ["{pattern.replace(chr(92), chr(92))}"]'), encoding="utf-8")
    assert "recordings" in refused(load_campaign, path)


@pytest.mark.parametrize("line", ['tool = "%s.csv"' % ("n" * 5000), 'rig = "%s"' % ("n" * 5000), 'rig = "a\\u0000b"',
                                  'recordings = ["%s"]' % ("n" * 5000), 'recordings = ["/dev/zero"]\nfriction = "%s"'
                                  % ("s" * 5000)])
def test_names_in_campaigns(tmp_path, line):
    path = tmp_path / "strange.toml"
    text = CAMPAIGN.format(line=line)
    path.write_text(text.replace('tool = "flat"\n', "") if line.startswith("tool") else text, encoding="utf-8")
    refused(load_campaign, path)


def book(**parts: str) -> bytes:
    """A spreadsheet with some of its parts replaced, by the ends of their names."""
    plain, changed = io.BytesIO(), io.BytesIO()
    workbook = openpyxl.Workbook()
    for row in (["displacement [mm]", "force [N]"], *([0.1 * i, 0.2 * i] for i in range(9))):
        workbook.active.append(row)
    workbook.save(plain)
    with zipfile.ZipFile(plain) as archive, zipfile.ZipFile(changed, "w", zipfile.ZIP_DEFLATED) as other:
        for name in archive.namelist():
            other.writestr(name, parts.get(Path(name).stem, archive.read(name)))
    return changed.getvalue()


def sheet(rows: str) -> str:
    return ('<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"><dimension ref="A1:B9"/>'
            f"<sheetData>{rows}</sheetData></worksheet>")


@pytest.mark.parametrize("rows", [
    '<row r="1e308"><c r="A1e308"><v>1</v></c></row>', '<row r="999999999999"><c r="A1"><v>1</v></c></row>',
    '<row r="1"><c r="A1"><v>1</v></c></row><row r="1048576"><c r="XFD1048576"><v>1</v></c></row>',
    '<row r="1"><c r="ZZZZZZZZZ9"><v>1</v></c></row>', "<row>" * 50_000,
    '<row r="1"><c r="A1"><v>%s</v></c></row>' % ("9" * 5000)])
def test_rows_and_columns_of_spreadsheets(tmp_path, rows):
    path = tmp_path / "strange.xlsx"
    path.write_bytes(book(sheet1=sheet(rows)))
    refused(lambda path: ts.read_recording(path, columns=COLUMNS), path)
    refused(lambda path: calibration.import_files([path]), path)


@pytest.mark.slow
@pytest.mark.parametrize(("ending", "name"), [("xlsx", "xl/worksheets/sheet2.xml"), ("zip", "curve.ibw")])
def test_archives_that_unpack_to_more_than_the_memory(tmp_path, ending, name):
    path = tmp_path / f"bomb.{ending}"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, \
            archive.open(name, "w", force_zip64=True) as member:
        for _ in range(30):
            member.write(bytes(10_000_000))
    # And one that says that it is small.
    data = path.read_bytes()
    lying = tmp_path / f"lying.{ending}"
    lying.write_bytes(data.replace((300_000_000).to_bytes(8, "little"), (3000).to_bytes(8, "little"))
                      .replace((300_000_000).to_bytes(4, "little"), (3000).to_bytes(4, "little")))
    for each in (path, lying):
        assert "unpacks to more than 200 MB" in refused(READERS["xlsx" if ending == "xlsx" else "zip of afm"][1], each)
        assert "unpacks to more than 200 MB" in refused(READERS["import"][1], each)


# What a reader of a plugin may do with a file; each by name, as a plugin's travels to the process for reading.
def _for_ever(path):
    while True:
        pass


def _all_memory(path):
    return bytes(2_000_000_000)


def _a_crash(path):
    os.abort()


def _an_exit(path):
    sys.exit(3)


def _a_fault(path):
    return {}["no such key"]


def _too_deep(path):
    return _too_deep(path)


def _printing(path):
    print("noise")
    os.write(1, b"noise")
    return ts.Recording({"displacement": range(5), "force": range(5)})


@pytest.mark.slow
@pytest.mark.parametrize(("reader", "words"), [
    (_for_ever, "exceeds the CPU time"), (_all_memory, "exceeds the memory"), (_a_crash, "ends the process"),
    (_an_exit, "cannot be read"), (_a_fault, "its reader has an error"), (_too_deep, "nested too deep")])
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere only the time is bounded, by the wall clock")
def test_a_reader_of_a_plugin(tmp_path, reader, words):
    path = tmp_path / "run.csv"
    path.write_text(HEADER + "".join(f"{i},{i},{i}\n" for i in range(9)), encoding="utf-8")
    ts.FORMATS.register(reader, "strange")
    try:
        began = time.process_time()
        assert words in refused(lambda path: ts.read_recording(path, format="strange"), path)
        # The next file is read as ever, by a new process where that one has ended.
        assert len(ts.read_recording(path)) == 9 and time.process_time() - began < 10.0
    finally:
        ts.FORMATS.unregister("strange")


def test_what_a_reader_prints_goes_nowhere(tmp_path, capfd):
    path = tmp_path / "run.csv"
    path.write_text("1", encoding="utf-8")
    ts.FORMATS.register(_printing, "printing")
    try:
        assert len(ts.read_recording(path, format="printing")) == 5
    finally:
        ts.FORMATS.unregister("printing")
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere memory is not known")
def test_a_process_that_keeps_memory_is_replaced(tmp_path):
    def keep():
        sys.kept = [*getattr(sys, "kept", []), bytes(90_000_000)]
        return os.getpid()

    (path := tmp_path / "run.csv").write_text("1", encoding="utf-8")
    processes = [run_in_sandbox(keep, file=path) for _ in range(9)]
    assert processes[-1] != processes[0] and len(set(processes)) <= 5


def test_what_cannot_travel_is_refused(tmp_path):
    lock = __import__("threading").Lock()
    assert "cannot be sent to the process" in refused(lambda path: run_in_sandbox(lock.acquire, file=path),
                                                      tmp_path / "a")


def test_a_module_beside_the_file_is_not_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scipy.py").write_text("raise SystemExit('taken')", encoding="utf-8")
    savemat(tmp_path / "run.mat", {"run": {"displacement": [0.0, 1.0, 2.0, 3.0, 4.0], "force": [0.0, 1, 2, 3, 4]}})
    named = {name: {"name": name, "unit": unit} for name, unit in (("displacement", "mm"), ("force", "N"))}
    assert len(ts.read_recording("run.mat", columns=named)) == 5


def test_files_of_the_system_that_say_that_they_are_empty():
    if not Path("/proc/self/maps").exists():
        pytest.skip("reads /proc, which only Linux has")
    assert "grows while it is read" in refused(lambda path: read_bytes(path, "anything"), Path("/proc/self/maps"))


def test_a_file_that_another_program_is_writing(tmp_path, monkeypatch):
    (path := tmp_path / "test.dat").write_text("first\n", encoding="utf-8")

    def add_a_line_and_state_the_earlier_size(number, state=os.fstat):
        earlier = state(number)
        with path.open("a", encoding="utf-8") as file:
            file.write("second\n")
        return earlier

    monkeypatch.setattr(os, "fstat", add_a_line_and_state_the_earlier_size)
    assert read_bytes(path, "an output", is_growing=True).splitlines()[0] == b"first"
    assert "grows while it is read" in refused(lambda path: read_bytes(path, "an output"), path)


@given(problem=st.text(max_size=2000), file=st.text(max_size=600), field=st.text(max_size=600),
       line=st.none() | st.integers(0, 10**9))
def test_every_error_is_one_short_printable_line(problem, file, field, line):
    error = ts.InputError(problem, file=file, field=field, line=line)
    for each in (error, error.with_location(file="other", field="outer", part="part")):
        said = str(each)
        assert len(said) <= MESSAGE_LIMITS.message and said.isprintable()
    assert (error.problem, error.file, error.field, error.line) == (problem, file, field, line)


def test_what_is_quoted_is_shortened_and_what_to_do_is_kept():
    said = str(ts.InputError(f"unknown law {'x' * 5000!r}; did you mean 'neo_hooke'?", file="/a/" * 200 + "c.toml",
                             field="fit.laws"))
    assert said.endswith("'; did you mean 'neo_hooke'?") and "c.toml" in said and "fit.laws" in said
    assert join_location_and_problem("short", ["file"]) == "file: short"


def test_text_of_a_device_file_is_refused(tmp_path):
    assert "no such file" in refused(lambda path: read_text(path, "anything"), tmp_path / "none")
    assert "not valid TOML" in refused(lambda path: read_toml_dict(path, "anything"),
                                       _written(tmp_path / "a.toml", "a ="))


def _written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path
