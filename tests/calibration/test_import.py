"""`import_files` and `tissue-sim import`: from raw files to a campaign that runs, or a sentence on what is missing."""

import json
import random
import sys
import time
from pathlib import Path

import numpy as np
import openpyxl
import pytest

import calibration
import tissue_sim as ts
from calibration import ImportOptions, InterpretationOverrides
from calibration.importing.imported import make_json_dictionary_of_import
from scenes.cli import main
from tissue_sim.recording.screening import estimate_load_at_zero_displacement

sys.path.insert(0, str(Path(__file__).parent))
import machine_exports
from machine_exports import EXPORTS, bluehill, exponent, mach1, mts


def put(folder, *exports):
    paths = [folder / export.name for export in exports]
    for path, export in zip(paths, exports, strict=True):
        path.write_bytes(export.content)
    return paths


def wishes(laws=("neo_hooke",), radius=10.0, height=12.0, test=None, **stated):
    return ImportOptions(InterpretationOverrides(**stated), {"radius_mm": radius, "height_mm": height}, test or {},
                         laws)


def text(folder, name, content):
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return path


def numbers(*columns, delimiter=","):
    return "".join(delimiter.join(f"{value:.6g}" for value in row) + "\n" for row in zip(*columns, strict=True))


WAY = np.linspace(0.0, 3.0, 31)


@pytest.mark.slow
def test_replicates_become_one_test_and_its_fit_is_that_of_a_campaign_by_hand(tmp_path):
    paths = put(tmp_path, *(bluehill(seed) for seed in (1, 2, 3)))
    imported = calibration.import_files(paths, tmp_path / "gel.toml", wishes())
    test, = imported.tests
    assert test.name == "Specimen_RawData" and len(test.parts) == 3
    assert "names differ in their number only" in test.reason
    (tmp_path / "hand.toml").write_text("""
[[specimen]]
radius_mm = 10.0
height_mm = 12.0

[[test]]
kind = "lubricated_compression"
recordings = ["Specimen_RawData_?.csv"]
[test.columns]
time = { name = "Time", unit = "s" }
displacement = { name = "Extension", unit = "mm", sign = -1 }
force = { name = "Load", unit = "N", sign = -1 }

[fit]
laws = ["neo_hooke"]
""", encoding="utf-8")
    found = [calibration.calibrate([tmp_path / f"{name}.toml"], tmp_path / name, figures=False)[0].best.parameters
             for name in ("gel", "hand")]
    assert found[0] == found[1]
    assert imported.picture.read_bytes().startswith(b"\x89PNG")


def test_tests_are_told_apart_by_name_speed_and_travel(tmp_path):
    slow = machine_exports.Export("table", "run_2.csv", b"", None, ())
    for name, speed, deepest in (("run_1", 1.0, 3.0), ("run_2", 1.1, 3.1), ("run_3", 0.1, 3.0), ("run_4", 1.0, 1.5),
                                 ("gel_10", 1.0, 3.0), ("gel_50", 1.0, 3.0)):
        way = WAY * deepest / 3.0
        text(tmp_path, f"{name}.csv", "Time (s),Compression (mm),Load (N)\n" + numbers(way / speed, way, way))
    assert slow.name == "run_2.csv"
    imported = calibration.import_files(sorted(tmp_path.glob("*.csv")), wishes=wishes())
    assert {tuple(part.file.stem for part in test.parts) for test in imported.tests} == {
        ("run_1", "run_2"), ("run_3",), ("run_4",), ("gel_10",), ("gel_50",)}
    assert imported.is_complete and imported.text.count("[test.columns]") == 0, "columns stand once, in [defaults]"
    assert "fitted as one material" in imported.warnings[0]


def test_the_same_test_under_another_name_is_of_another_specimen(tmp_path):
    for name, deepest in (("A_1", 3.0), ("A_2", 3.0), ("B_1", 3.0), ("B_slow", 1.5)):
        way = WAY * deepest / 3.0
        text(tmp_path, f"{name}.csv", "Time (s),Compression (mm),Load (N)\n" + numbers(way, way, way))
    imported = calibration.import_files(sorted(tmp_path.glob("*.csv")), wishes=wishes())
    assert imported.is_complete, imported.problem
    assert {test.name: test.specimen for test in imported.tests} == {"A": "A", "B_1": "B_1", "B_slow": "A"}


def test_specimens_of_other_sizes_are_other_tests(tmp_path):
    for number, diameter in ((1, 20), (2, 20), (3, 22)):
        text(tmp_path, f"gel_{number}.csv", f"Compression\nDiameter (mm),{diameter}\nHeight (mm),12\n"
             "Time (s),Way (mm),Load (N)\n" + numbers(WAY, WAY, WAY))
    book = machine_exports.zwick_book((1, 2))
    (tmp_path / book.name).write_bytes(book.content)
    sheets = openpyxl.load_workbook(tmp_path / book.name)
    for name, diameter in (("Probe 1", 20), ("Probe 2", 22)):
        sheets[name]["A1"], sheets[name]["B1"] = "Durchmesser (mm)", diameter
    sheets.save(tmp_path / book.name)
    for files in (sorted(tmp_path.glob("*.csv")), [tmp_path / book.name]):
        imported = calibration.import_files(files, wishes=ImportOptions(specimen={"height_mm": 12.0}))
        assert imported.is_complete, (imported.missing, imported.problem)
        assert [lines[1].value for lines in imported.specimens.values()] == [10.0, 11.0]


def test_everything_that_is_missing_is_said_at_once_and_has_a_line(tmp_path, capsys):
    path = text(tmp_path, "run.csv", "Time (s),Channel 1 position,Load cell (V)\n" + numbers(WAY, WAY, WAY))
    campaign = tmp_path / "c.toml"
    assert main(["import", str(path), "-o", str(campaign)]) == 1
    said = " ".join(capsys.readouterr().out.split())
    for what in ("the radius of the specimen", "the height of the specimen", "the kind of test",
                 "the unit of column 'Channel 1 position' (displacement) (--unit displacement=...)",
                 "the scale of column 'Load cell (V)' (force), SI units in 1 V (--scale force=...)"):
        assert what in said
    content = campaign.read_text(encoding="utf-8")
    assert content.count("FILL IN") == 5
    with pytest.raises(ts.InputError) as caught:
        calibration.load_campaign(campaign)
    assert "missing" in caught.value.problem
    assert main(["import", str(path), "-o", str(campaign), "--overwrite", "--kind", "lubricated_compression",
                 "--radius-mm", "10", "--height-mm", "12", "--unit", "displacement=mm", "--scale", "force=2.5"]) == 0
    curve, = calibration.read_measured_curves(calibration.load_campaign(campaign))["run"]
    np.testing.assert_allclose(curve.force, 2.5 * WAY, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("unit", "scale", "newtons"), [
    ("g", None, 9.80665e-3), ("kgf", None, 9.80665), ("lbf", None, 4.4482216152605), ("V", 0.5, 0.5),
    ("counts", 1e-3, 1e-3), ("mN", 2.0, 2e-3)])
def test_units_and_scales_of_a_headerless_file(tmp_path, unit, scale, newtons):
    path = text(tmp_path, "run.txt", numbers(WAY, WAY, WAY, delimiter=" "))
    stated = InterpretationOverrides({"time": "1", "displacement": "B", "force": 3},
                                     {"time": "s", "displacement": "mm", "force": unit},
                                     {} if scale is None else {"force": scale},
                                     kind="lubricated_compression")
    imported = calibration.import_files([path], tmp_path / "c.toml", ImportOptions(
        stated, {"radius_mm": 10.0, "height_mm": 12.0}))
    assert imported.is_complete, (imported.missing, imported.problem)
    curve, = calibration.read_measured_curves(calibration.load_campaign(imported.output))["run"]
    np.testing.assert_allclose(curve.force, newtons * WAY, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(curve.displacement, 1e-3 * WAY, rtol=1e-5, atol=1e-12)


def test_stress_and_strain_are_taken_where_the_size_of_the_specimen_is_not_known(tmp_path):
    path = text(tmp_path, "pull.csv", "Tensile test\nTime (s),Extension (mm),Load (N),Tensile strain (%),Stress (kPa)\n"
                + numbers(WAY, WAY, WAY, 10 * WAY, 20 * WAY))
    imported = calibration.import_files([path], wishes=ImportOptions())
    assert imported.is_complete and set(imported.files[0].readings[0].recordings[0].channels) == {
        "time", "stretch", "nominal stress"}
    np.testing.assert_allclose(imported.files[0].readings[0].recordings[0].channel("stretch"), 1 + 0.1 * WAY)
    with_size = calibration.import_files([path], wishes=wishes())
    assert "displacement" in with_size.files[0].readings[0].recordings[0]


@pytest.mark.parametrize(("sign", "smallest"), [({}, 0.7), ({"strain": 1}, 1.0)])
def test_a_stated_sign_is_not_turned(tmp_path, sign, smallest):
    """A strain that is positive in compression becomes a stretch below 1, unless a person says that it is not."""
    path = text(tmp_path, "c.csv", "Compressive strain (%),Stress (kPa)\n" + numbers(10 * WAY, 20 * WAY))
    reading, = calibration.import_files([path],
                                        wishes=ImportOptions(InterpretationOverrides(signs=sign))).files[0].readings
    assert reading.kind.kind == "lubricated_compression"
    assert reading.recordings[0].channel("stretch").min() == pytest.approx(smallest)


def test_sizes_and_speed_above_the_numbers(tmp_path):
    path = text(tmp_path, "gel.csv", "Druckversuch\nProbendurchmesser;20,0;mm\nProbenhöhe (mm);12,5\nSonde: 5 mm\n"
                "Geschwindigkeit: 30 mm/min\n\nWeg (mm);Kraft (N)\n"
                + numbers(WAY, WAY, delimiter=";").replace(".", ","))
    imported = calibration.import_files([path])
    assert imported.is_complete, imported.missing
    campaign = text(tmp_path, "c.toml", imported.text.replace(
        imported.text.split('recordings = ["')[1].split('"')[0], "gel.csv"))
    specimen, = calibration.load_campaign(campaign).specimens.values()
    assert (specimen.radius, specimen.height) == (0.010, 0.0125)
    assert "speed_mm_s = 0.5" in imported.text


def test_json_has_the_keys_that_are_promised(tmp_path, capsys):
    path, = put(tmp_path, mts(1, parts=2))
    assert main(["import", str(path), "--json", "--radius-mm", "10", "--height-mm", "12"]) == 0
    answer = json.loads(capsys.readouterr().out)
    file, = answer["files"]
    assert {"format", "delimiter", "units", "kind", "contact_mm", "contact_interval_mm", "segments", "cycles",
            "failure", "warnings"} <= set(file)
    assert file["format"] == "mts" and file["delimiter"] == "\t" and file["units"]["force"] == "N"
    assert [each["name"] for each in file["segments"]] == ["ramp", "hold"] and file["cycles"] == 1
    assert answer["missing"] == [] and answer["problem"] is None


def test_cycles_are_counted(tmp_path):
    way = np.concatenate([np.linspace(0, 3, 21), np.linspace(3, 0, 21)[1:]] * 3)
    path = text(tmp_path, "c.csv", "Time (s),Compression (mm),Load (N)\n"
                + numbers(0.1 * np.arange(way.size), way, way))
    assert make_json_dictionary_of_import(calibration.import_files([path]))["files"][0]["cycles"] == 3


@pytest.mark.parametrize(("content", "words"), [
    ("", "is empty"), ("just words\n", "holds no table of numbers"), ("\x00\x01\x02\x03", "binary"),
    ("lambda1,lambda2,s1\n" + "1.1,1.0,0.2\n" * 9, "without a motion or a load of one axis"),
    ("Time (s),Temperature (degC)\n" + "1,20\n" * 9, "a motion (displacement, stretch, strain) and a load"),
    ("1,2,3\n" * 9, "its 3 columns of numbers have no names; name the columns"),
    ("Time (s),Compression (mm),Load (N)\n" + "1,2,3\n" * 4, "holds no table of numbers"),
    ("Time (s),Compression (mm),Load (N)\n" + "1,2,3\n" * 9 + "2,3,1e300\n", "which no machine measures"),
])
def test_a_file_that_is_none_gets_one_sentence_and_nothing_is_written(tmp_path, capsys, content, words):
    path = text(tmp_path, "bad.csv", content)
    began = time.process_time()
    assert main(["import", str(path), "-o", str(tmp_path / "c.toml")]) == 2
    assert time.process_time() - began < 1.5
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and "bad.csv" in said
    assert [each.name for each in tmp_path.iterdir()] == ["bad.csv"]


def test_all_bad_files_are_named(tmp_path):
    paths = [text(tmp_path, name, "words\n") for name in ("a.csv", "b.csv")]
    paths += put(tmp_path, bluehill(1))
    with pytest.raises(ts.InputError, match=r"2 of 3 files cannot be imported: .*a\.csv.*; .*b\.csv"):
        calibration.import_files(paths)


@pytest.mark.parametrize(("flags", "words"), [
    (["--column", "force"], "CHANNEL=VALUE"), (["--column", "farce=3"], "did you mean 'force'"),
    (["--unit", "force=ell"], "unknown unit 'ell'"), (["--scale", "force=-1"], "--sign"),
    (["--sign", "force=2"], "must be 1 or -1"), (["--format", "zwik"], "did you mean 'zwick'"),
    (["--laws", "neo_hook"], "did you mean 'neo_hooke'"), (["--radius-mm", "1", "--area-mm2", "2"], "one of"),
    (["--column", "force=Nothing"], "has no column force = Nothing"), (["--delimiter", "ab"], "delimiter"),
    (["-o", "campaign.txt"], "output must end in .toml"), (["--unit", "force=N", "--unit", "force=mN"], "given twice")])
def test_flags_that_make_no_sense(tmp_path, monkeypatch, capsys, flags, words):
    monkeypatch.chdir(tmp_path)
    path, = put(tmp_path, bluehill(1))
    assert main(["import", path.name, *flags]) == 2
    assert words in capsys.readouterr().err
    assert len(list(tmp_path.iterdir())) == 1


def test_what_is_there_is_not_replaced(tmp_path, capsys):
    path, = put(tmp_path, bluehill(1))
    campaign = tmp_path / "c.toml"
    campaign.write_text("mine", encoding="utf-8")
    assert main(["import", str(path), "-o", str(campaign)]) == 2
    assert "exists already" in capsys.readouterr().err and campaign.read_text(encoding="utf-8") == "mine"
    with pytest.raises(ts.InputError, match="given twice"):
        calibration.import_files([path, tmp_path / "." / path.name])


def test_a_campaign_that_cannot_run_says_why(tmp_path, capsys):
    path, = put(tmp_path, bluehill(1))
    assert main(["import", str(path), "-o", str(tmp_path / "c.toml"), "--radius-mm", "10", "--height-mm", "2"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "the campaign cannot be calibrated yet" in said and "must be smaller than the height" in said
    assert sorted(each.suffix for each in tmp_path.iterdir()) == [".csv", ".png", ".toml"]


def mutated(content: bytes, chance: random.Random) -> bytes:
    """Bytes with a few pieces lost, doubled, replaced or moved, as editors, cables and people do."""
    data = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 3, 8))):
        at, length = chance.randrange(len(data) + 1), chance.choice((1, 1, 2, 5, 40))
        piece = bytes(data[at:at + length])
        data[at:at + length] = chance.choice((
            b"", piece * 2, bytes(chance.randrange(256) for _ in range(length)), b";", b",", b"\t", b"\n", b'"', b"-",
            b"nan", b"1e999", b"\xff\xfe", "µ".encode(), b"0" * length, piece[::-1]))
    return bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bluehill", "mts", "zwick", "zwick, xls", "exponent", "mach1", "mecmesin", "trios"])
def test_mutated_exports_are_understood_or_refused_in_one_sentence(tmp_path, monkeypatch, name):
    monkeypatch.setattr(machine_exports, "curve",
                        lambda seed, hold=False, points=8, _curve=machine_exports.curve: _curve(seed, hold, points))
    export, chance = EXPORTS[name](), random.Random(name)
    path = tmp_path / export.name
    for number in range(25):
        path.write_bytes(mutated(export.content, chance))
        try:
            imported = calibration.import_files([path], wishes=wishes())
            assert all(len(recording) >= 5 for each in imported.files for reading in each.readings
                       for recording in reading.recordings), number
        except ts.InputError as error:
            assert "\n" not in str(error) and path.name in str(error) and error.file == path, number


def test_blocks_side_by_side_of_different_length(tmp_path):
    first, second = exponent((1,)), exponent((2,))
    rows = [a.rstrip("\n") + "\t" + (b.rstrip("\n") if i < 60 else "\t\t")
            for i, (a, b) in enumerate(zip(first.content.decode().splitlines(), second.content.decode().splitlines(),
                                           strict=True))]
    path = text(tmp_path, "batch.txt", "\n".join(rows))
    imported = calibration.import_files([path], wishes=wishes(kind="lubricated_compression"))
    assert [len(each) for each in imported.files[0].readings[0].recordings] == [121, 57]


def test_positions_count_from_the_first_sample_of_each_recording(tmp_path):
    paths = put(tmp_path, mach1(1, start=12.3), mach1(2, start=-4.0))
    imported = calibration.import_files(paths, wishes=wishes(kind="lubricated_compression"))
    assert imported.is_complete and len(imported.tests) == 1
    for part in imported.tests[0].parts:
        assert part.reading.recordings[0].displacement[0] == 0.0


@pytest.mark.slow
def test_air_before_the_contact_is_found_and_left_out(tmp_path, capsys):
    """A cylinder of neo-Hookean gel with 0.4 to 0.7 mm of air and a sensor that shows 0.05 N: E0 is that of the gel."""
    for number, air in enumerate((0.4, 0.55, 0.7), start=1):
        way = np.linspace(0.0, 2.0, 201)
        pressed = np.clip(way - air, 0.0, None)
        load = -ts.find_law("neo_hooke").nominal_stress(1 - pressed / 12.0, {"C10": 1500.0}) * np.pi * 0.01**2
        noise = np.random.default_rng(number).normal(0.0, 2e-3, way.size)
        text(tmp_path, f"gel_{number}.csv", "Time (s),Compression (mm),Load (N)\n"
             + numbers(way / 0.2, way, load + 0.05 + noise))
    paths = sorted(tmp_path.glob("gel_*.csv"))
    imported = calibration.import_files(paths, tmp_path / "c.toml", wishes())
    assert imported.text.count('contact = "find"') == 1
    for file, air in zip(make_json_dictionary_of_import(imported)["files"], (0.4, 0.55, 0.7), strict=True):
        low, high = file["contact_interval_mm"]
        assert low < air < high and high - low < 0.04
        assert [each["name"] for each in file["segments"]] == ["approach", "ramp"]
    result, = calibration.calibrate([imported.output], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(1500.0, rel=0.03)
    # Counted as in the file it would be far too soft.
    campaign = text(tmp_path, "as_they_are.toml", imported.text.replace('contact = "find"', ""))
    result, = calibration.calibrate([campaign], tmp_path / "out_2", figures=False)
    assert result.best.parameters["C10"] < 1200.0
    assert main(["import", *map(str, paths)]) == 1
    assert "contact at 0." in (said := " ".join(capsys.readouterr().out.split())) and "0.4 (0.39" in said


def test_a_rupture_ends_what_is_fitted(tmp_path):
    """A neo-Hookean strip of 1.2 kPa that ruptures at a strain of 0.8."""
    strain = np.linspace(0.0, 1.0, 201)
    stress = ts.find_law("neo_hooke").nominal_stress(1 + strain, {"C10": 200.0}) / 1e3
    stress = np.where(strain <= 0.8, stress, 0.03 * stress) + np.random.default_rng(0).normal(0, 1e-3, strain.size)
    path = text(tmp_path, "strip.csv", "Time (s),Stretch,Nominal stress (kPa)\n"
                + numbers(10 * strain, 1 + strain, stress))
    imported = calibration.import_files([path], tmp_path / "c.toml", ImportOptions(laws=("neo_hooke",)))
    file, = make_json_dictionary_of_import(imported)["files"]
    assert file["failure"]["mode"] == "rupture" and file["failure"]["at_strain"] == pytest.approx(0.8, abs=0.006)
    assert 'failure = "cut"' in imported.text and "ruptures" in imported.warnings[0]
    result, = calibration.calibrate([imported.output], tmp_path / "out", figures=False)
    assert result.best.parameters["C10"] == pytest.approx(200.0, rel=0.01)


def test_a_contact_that_cannot_be_told_is_said(tmp_path):
    noise = np.random.default_rng(0).normal(0.0, 1.0, 101)
    path = text(tmp_path, "gel.csv", "Time (s),Compression (mm),Load (N)\n"
                + numbers(np.arange(101.0), np.linspace(0, 3, 101), noise))
    imported = calibration.import_files([path], wishes=wishes())
    assert any("the force never leaves its zero" in warning for warning in imported.warnings)
    assert "contact =" not in imported.text


# Every set of measurements that the project is checked against: folder, files, what only a person knows.
TABLE = {"time": "A", "stretch": "B", "nominal stress": "C"}
UNITS = {"time": "s", "nominal stress": "kPa"}
SETS = {
    # Of this mixture one recording of each sample, of the others one.
    "ecoflex EF10_0T": ("ecoflex_compression", "EF10_0T_?1.csv", {}),
    **{f"ecoflex {name}": ("ecoflex_compression", f"{name}_B1.csv", {}) for name in (
        "EF10_50T", "EF10_100T", "EF30_0T", "EF50_0T")},
    **{f"soro {name}": ("soro_tensile", f"{name}.csv", {}) for name in (
        "Dragon Skin 10 MEDIUM", "Dragon Skin 20", "RTV615", "Ecoflex 00-10", "Ecoflex 00-30", "Ecoflex 00-50")},
    **{f"brain {name}": ("brain_tension_damage", f"brain_{name}*.csv", {"units": {"nominal stress": "kPa"}})
       for name in ("gm", "wm")},
    **{f"foam {name}": ("foam_compressible", f"foam_{name}__*.csv", {}) for name in ("leap", "turbo")},
    "foam workbook": ("foam_compressible", "foam_leap__Foam.xlsx", {"units": {"nominal stress": "kPa"}}),
    "treloar": ("rubber_treloar_kawabata", "treloar1944_uniaxial.csv", {"units": {"nominal stress": "MPa"}}),
    "vhb": ("oca_vhb_viscoelastic", "uniaxial*.xlsx", {"columns": TABLE, "units": UNITS}),
    "oca cyclic": ("oca_vhb_viscoelastic", "cyclic*.xlsx", {
        "columns": {"time": "A", "shear strain": "E", "nominal stress": "D"}, "units": UNITS}),
    "oca monotonic": ("oca_vhb_viscoelastic", "monotonic*_0d05.xlsx", {
        "columns": {"time": "A", "shear strain": "D", "nominal stress": "E"}, "units": UNITS}),
    "oca monotonic, the others": ("oca_vhb_viscoelastic", "monotonic*_*1.xlsx", {
        "columns": {"time": "A", "shear strain": "D", "nominal stress": "C"}, "units": UNITS}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_every_measured_set_goes_from_raw_files_to_a_report(data_folder, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    folder, pattern, stated = SETS[name]
    files = sorted((data_folder.resolve() / folder).glob(pattern))
    assert files
    # Without the picture, which takes as long as all the rest.
    imported = calibration.import_files(files,
                                        wishes=ImportOptions(InterpretationOverrides(**stated),
                                                             laws=("neo_hooke",)))
    assert imported.is_complete, (imported.missing, imported.problem)
    text(tmp_path, "set.toml", imported.text)
    result, = calibration.calibrate(["set.toml"], tmp_path / "report", figures=False)
    assert (tmp_path / "report" / "report.html").is_file()
    assert result.best.parameters["C10"] > 0
    assert sum(len(part.motions) for test in imported.tests for part in test.parts) == len(files) + 3 * (
        name == "foam workbook")


@pytest.mark.parametrize(("folder", "pattern", "words"), [
    ("rubber_treloar_kawabata", "treloar1944_three*.csv", r"are of different tests \(uniaxial, planar, equibiaxial"),
    ("oca_vhb_viscoelastic", "cyclic*_1.xlsx", "have no names"), ("afm_formats", "*ntmdt*.txt", "have no names")])
def test_of_the_other_sets_one_sentence_says_what_is_missing(data_folder, folder, pattern, words):
    with pytest.raises(ts.InputError, match=words):
        calibration.import_files(sorted((data_folder / folder).glob(pattern)))


def test_imported_sets_are_read_as_by_their_own_formats(data_folder):
    for folder, name, form in (("ecoflex_compression", "EF10_0T_A1.csv", "instron"),
                               ("soro_tensile", "RTV615.csv", "soft_robotics")):
        path = data_folder / folder / name
        mine, = calibration.import_files([path]).files[0].readings[0].recordings
        theirs = ts.read_recording(path, format=form)
        assert set(mine.channels) == set(theirs.channels)
        for channel in theirs.channels:
            np.testing.assert_array_equal(mine.channel(channel), theirs.channel(channel))


@pytest.mark.slow
def test_afm_files_lack_the_specimen_and_the_tip(data_folder, tmp_path):
    folder = data_folder / "afm_formats"
    assert len(calibration.import_files([*folder.glob("fmt-jpk-sr*.jpk-force")]).missing) == 4
    chiaro, = folder.glob("*chiaro*.zip")
    imported = calibration.import_files([chiaro], wishes=ImportOptions(
        specimen={"radius_mm": 0.3, "height_mm": 0.2}))
    assert imported.is_complete and "tool_radius_mm = 0.0275" in imported.text


def test_a_file_without_names_shows_its_last_row(data_folder):
    path, = (data_folder / "oca_vhb_viscoelastic").glob("cyclic*_1.xlsx")
    with pytest.raises(ts.InputError, match="5 columns of numbers have no names; name the columns.*"
                       r"the last row is 1320\.1, 4\.3413, 1\.2972, 43\.413, 9\.9784"):
        calibration.import_files([path])


def test_two_close_samples_are_not_read_as_a_hold(data_folder):
    imported = calibration.import_files([data_folder / "brain_tension_damage" / "brain_gm2.csv"])
    motion, = imported.tests[0].parts[0].motions
    assert [segment.name for segment in motion.segments] == ["ramp", "failure"]
    warning, = imported.warnings
    # The header states no unit of the stress.
    assert "at strain 1.207 and 4.897 (unit not stated)" in warning and "kPa" not in warning


def test_the_campaign_that_fits_a_relaxation_does_not_ask_for_it(data_folder):
    path, = (data_folder / "oca_vhb_viscoelastic").glob("cyclic*_1.xlsx")
    stated = InterpretationOverrides({"time": 1, "nominal stress": 4, "shear strain": 5},
                                     {"time": "s", "nominal stress": "kPa"})
    imported = calibration.import_files([path], wishes=ImportOptions(stated))
    warning, = imported.warnings
    assert "the load relaxes in holds by up to 49 %" in warning and "the campaign fits one relaxation term" in warning
    assert "start = {" in imported.text


def test_two_materials_in_one_sheet_are_named_with_the_flag(data_folder):
    stated = InterpretationOverrides(units={"nominal stress": "kPa"})
    imported = calibration.import_files([data_folder / "foam_compressible" / "foam_leap__Foam.xlsx"],
                                        wishes=ImportOptions(stated))
    assert [test.kind for test in imported.tests] == ["uniaxial_tension", "simple_shear"] * 2
    assert all("--column" in warning for warning in imported.warnings) and len(imported.warnings) == 2


def test_a_curve_whose_slope_falls_quickly_begins_without_load(data_folder):
    """The shear at 0.01 1/s is proportional to the strain at its start (0.0097, 0.431 kPa; 0.0195, 0.856 kPa)."""
    path, = (data_folder / "oca_vhb_viscoelastic").glob("monotonic*_0d01.xlsx")
    stated = InterpretationOverrides({"time": 1, "nominal stress": 3, "shear strain": 4},
                                     {"time": "s", "nominal stress": "kPa"})
    recording, = calibration.import_files([path], wishes=ImportOptions(stated)).files[0].readings[0].recordings
    assert estimate_load_at_zero_displacement(recording.channel("shear strain"),
                                              recording.channel("nominal stress")) is None
