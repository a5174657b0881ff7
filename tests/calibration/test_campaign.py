"""Campaign files: what is read, and one sentence with the field for everything that is wrong."""

import re
import subprocess
import sys

import numpy as np
import pytest
from child_environment import child_environment
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import calibration
import tissue_sim as ts

GOOD = """
[[specimen]]
name = "phantom"
radius_mm = 40.0
height_mm = 70.0

[[test]]
name = "plates"
specimen = "phantom"
kind = "lubricated_compression"
recordings = ["run_*.csv"]

[fit]
laws = ["neo_hooke", "reduced_polynomial_2"]
start = { C10 = 1400.0 }
bulk_ratio = 1000

[fit.bounds]
C10 = [1.0, 20000.0]

[noise]
force_N = 0.02
contact_jitter_mm = 0.03
"""


def write_run(folder, name, depth=10e-3, points=21, force=5.0, order=1):
    displacement = np.linspace(0.0, depth, points)[::order] if order else np.full(points, depth)
    recording = ts.Recording({"displacement": displacement, "force": force * displacement / depth})
    ts.write_recording(recording, folder / name)


@pytest.fixture
def folder(tmp_path):
    for name in ("run_2.csv", "run_1.csv"):
        write_run(tmp_path, name)
    return tmp_path


def load(folder, text):
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return calibration.load_campaign(path)


def test_si_inside_and_recordings_resolved(folder):
    campaign = load(folder, GOOD)
    assert campaign.name == "study"
    assert campaign.specimens["phantom"].radius == 0.04
    test, = campaign.tests
    assert [path.name for path in test.recordings] == ["run_1.csv", "run_2.csv"]
    assert test.specimen is campaign.specimens["phantom"]
    assert campaign.noise.contact_jitter == pytest.approx(3e-5)
    assert campaign.fit.offset_prior == pytest.approx(3e-5)
    assert campaign.fit.bulk == ts.Bulk("bulk_ratio", 1000.0)
    assert campaign.fit.bounds["C10"] == (1.0, 20000.0)
    with pytest.raises(TypeError):
        campaign.fit.start["C10"] = 1.0


def test_absolute_patterns_and_prisms(folder):
    text = GOOD.replace("run_*.csv", (folder / "run_?.csv").as_posix()).replace(
        "radius_mm = 40.0", 'shape = "prism"\narea_mm2 = 18.0')
    campaign = load(folder, text)
    assert len(campaign.tests[0].recordings) == 2
    assert campaign.tests[0].specimen.area == pytest.approx(18e-6)


BAD = [
    ("radius_mm", "raduis_mm", "specimen[0].raduis_mm", "radius_mm"),
    ("specimen = \"phantom\"", "tool_radius = 8.0", "test[0].tool_radius", "tool_radius_mm"),
    ("[noise]", "[niose]", "niose", "noise"),
    ("bulk_ratio = 1000", "bulk_ratoi = 1000", "fit.bulk_ratoi", "bulk_ratio"),
    ("bulk_ratio = 1000", "bulk_ratio = \"stiff\"", "fit.bulk_ratio", "expected"),
    ("bulk_ratio = 1000", "bulk_ratio = -1", "fit.bulk_ratio", "positive"),
    ("bulk_ratio = 1000", "bulk_ratio = 1", "fit.bulk_ratio", "must be 2 to 1e+06"),
    ("bulk_ratio = 1000", "bulk_ratio = 1e9", "fit.bulk_ratio", "must be 2 to 1e+06"),
    ("radius_mm = 40.0", "radius_mm = \"40\"", "specimen[0].radius_mm", "expected a number, got text"),
    ("C10 = [1.0, 20000.0]", "C10 = 3.0", "fit.bounds.C10", "C10 must be [low, high]; got 3.0"),
    ("C10 = [1.0, 20000.0]", "C10 = [1.0, 2.0, 3.0]", "fit.bounds.C10", "C10 must be [low, high]; got [1.0, 2.0, 3.0]"),
    ("C10 = 1400.0", "C10 = \"soft\"", "fit.start.C10", "C10 must be a number; got 'soft'"),
    ("radius_mm = 40.0", "radius_mm = -40.0", "specimen[0].radius_mm", "positive"),
    ("height_mm = 70.0", "height_mm = 0", "specimen[0].height_mm", "positive"),
    ("height_mm = 70.0", "", "specimen[0].height_mm", "missing"),
    ("radius_mm = 40.0", "", "specimen[0].radius_mm", "requires radius_mm"),
    ("radius_mm = 40.0", "radius_mm = nan", "specimen[0].radius_mm", "positive"),
    ("radius_mm = 40.0", "radius_mm = 40.0\narea_mm2 = 3", "specimen[0].area_mm2", "leave area_mm2 out"),
    ("height_mm = 70.0", "height_mm = 70.0\ngravity = true", "specimen[0].density_kg_m3", "add density_kg_m3"),
    ("height_mm = 70.0", "height_mm = 70.0\ndensity_kg_m3 = 0", "specimen[0].density_kg_m3", "positive"),
    ("height_mm = 70.0", "height_mm = 70.0\ngravity = 9.81", "specimen[0].gravity", "expected"),
    ("height_mm = 70.0", "height_mm = 70.0\nheight_is = \"cast\"", "specimen[0].height_is", "moulded"),
    ("C10 = 1400.0", "C10 = 30000.0", "fit.start.C10", "must be within its bounds"),
    ("C10 = 1400.0", "C11 = 1400.0", "fit.start.C11", "C10"),
    ("C10 = [1.0, 20000.0]", "C10 = [5.0, 1.0]", "fit.bounds.C10", "low < high"),
    ("C10 = [1.0, 20000.0]", "mu1 = [5.0, 10.0]", "fit.bounds.mu1", "parameter"),
    ("bulk_ratio = 1000", "prior = { C10 = [1400.0, 0.0] }", "fit.prior.C10", "with a positive standard"),
    ("bulk_ratio = 1000", "fixed = { C10 = 1400.0 }", "fit.start.C10", "fixed"),
    ("bulk_ratio = 1000", "method = \"inverse_fem\"\nstrain_points = 9", "fit.strain_points",
     "does not interpolate the samples"),
    ("bulk_ratio = 1000", "method = \"inverse_fem\"\nstarts = 0", "fit.starts", "must be 1 to"),
    ("bulk_ratio = 1000", "method = \"guess\"", "fit.method", "analytical"),
    ("bulk_ratio = 1000", "strain_points = 3", "fit.strain_points", "at least 5"),
    ("\"neo_hooke\"", "\"neo_hook\"", "fit.laws[0]", "neo_hooke"),
    ("\"neo_hooke\"", "\"reduced_polynomial_2\"", "fit.laws[1]", "twice"),
    ("laws = [\"neo_hooke\", \"reduced_polynomial_2\"]", "laws = []", "fit.laws", "at least one"),
    ("laws = [\"neo_hooke\", \"reduced_polynomial_2\"]", "", "fit.laws", "missing"),
    ("specimen = \"phantom\"", "specimen = \"fantom\"", "test[0].specimen", "phantom"),
    ("lubricated_compression", "lubricated_compresion", "test[0].kind", "lubricated_compression"),
    ("lubricated_compression", "needle_indentation", "test[0].kind", "'inverse_fem'"),
    ("run_*.csv", "walk_*.csv", "test[0].recordings[0]", "no file matches"),
    ("[\"run_*.csv\"]", "[]", "test[0].recordings", "at least one"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\", \"run_1.csv\"]", "test[0].recordings[1]", "twice"),
    ("[\"run_*.csv\"]", "\"run_1.csv\"", "test[0].recordings", "expected"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ntool = \"flat\"", "test[0].tool", "must be a plate"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ntool_radius_mm = 8", "test[0].tool_radius_mm", "leave it out"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nrig = \"a.json\"", "test[0].rig", "does not use rig"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nprotocol = \"ramp\"", "test[0].protocol", "does not use protocol"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nfriction = 0.7", "test[0].friction", "frictionless"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nfriction = \"bondde\"", "test[0].friction", "did you mean 'bonded'?"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nfriction_base = \"bonded\"", "test[0].friction_base",
     "must have friction_base = 'frictionless'; got 'bonded'. Leave friction_base out, or use kind = "),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ntool = \"plaet\"", "test[0].tool", "did you mean 'plate'?"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ntool = \"tip.csv\"", "test[0].tool", "must be a plate"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ndelimiter = \"|\"", "test[0].delimiter", "state the columns too"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nskip_lines = 2", "test[0].skip_lines", "state the columns too"),
    ("[\"run_*.csv\"]",
     "[\"run_*.csv\"]\ndelimiter = \"ab\"\ncolumns = { force = \"a\", displacement = \"b\" }",
     "test[0].delimiter", "one character"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nspeed_mm_s = 0", "test[0].speed_mm_s", "positive"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nmax_strain = 1.5", "test[0].max_strain", "below 1"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\nhold_out = true", "test[0].hold_out", "at least one test must be fitted"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ncolumns = { stretch = \"a\" }", "test[0].columns", "nominal stress"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ncolumns = { streth = \"a\" }", "test[0].columns.streth", "stretch"),
    ("[\"run_*.csv\"]", "[\"run_*.csv\"]\ncolumns = { force = { nme = \"a\" } }", "test[0].columns.force.nme", "name"),
    ("force_N = 0.02", "force_N = 0", "noise.force_N", "positive"),
    ("force_N = 0.02", "force_N = \"guess\"", "noise.force_N", "estimate"),
    ("contact_jitter_mm = 0.03", "contact_jitter_mm = \"estimate\"", "noise.contact_jitter_mm", "requires fit.method"),
    ("[[test]]", "[test]", "test", "[[test]]"),
]


@pytest.mark.parametrize(("old", "new", "field", "hint"), BAD,
                         ids=[f"{field}:{i}" for i, (*_, field, _) in enumerate(BAD)])
def test_bad_campaigns_name_the_field(folder, old, new, field, hint):
    assert GOOD.count(old) >= 1
    with pytest.raises(ts.InputError) as error:
        load(folder, GOOD.replace(old, new, 1))
    assert error.value.field == field
    assert hint in str(error.value)
    assert "study.toml" in str(error.value)
    assert "\n" not in str(error.value)


def test_names_are_unique(folder):
    specimen = '[[specimen]]\nname = "phantom"\nradius_mm = 1.0\nheight_mm = 1.0\n'
    with pytest.raises(ts.InputError, match=r"specimen\[1\]\.name: .*unique; got 'phantom' twice"):
        load(folder, GOOD + specimen)
    test = '[[test]]\nname = "plates"\nkind = "lubricated_compression"\nrecordings = ["run_1.csv"]\n'
    with pytest.raises(ts.InputError, match=r"test\[1\]\.name: .*unique; got "):
        load(folder, GOOD + test)
    with pytest.raises(ts.InputError, match=r"test\[1\]\.specimen: specimen must name one of"):
        load(folder, GOOD + specimen.replace("phantom", "other") + test.replace("plates", "again"))


@pytest.mark.parametrize(("content", "hint"), [
    (b"[fit\nlaws = 1\n", r"study\.toml:1: .*TOML"), (b"\xff\xfe", "UTF-8"), (b"", "is empty"),
    (b"noise = {}", "missing"), (b"fit = 3", "expected a table"),
])
def test_damaged_files(folder, content, hint):
    (folder / "study.toml").write_bytes(content)
    with pytest.raises(ts.InputError, match=hint):
        calibration.load_campaign(folder / "study.toml")


def test_a_byte_order_mark_is_no_error(folder):
    (folder / "study.toml").write_bytes(GOOD.encode("utf-8-sig"))
    assert calibration.load_campaign(folder / "study.toml").tests


def test_a_stated_delimiter_reaches_the_reader(folder):
    lines = ["way load", *(f"{0.5 * i:.1f}  {0.1 * i * (1 + i):.2f}" for i in range(8))]
    (folder / "blanks.txt").write_text("\n".join(lines), encoding="utf-8")
    columns = 'columns = { displacement = { name = "way", unit = "mm" }, force = { name = "load", unit = "N" } }'
    path = folder / "study.toml"
    path.write_text(GOOD.replace('["run_*.csv"]', f'["blanks.txt"]\n{columns}\ndelimiter = " "'), encoding="utf-8")
    (replicate,), = calibration.read_measured_curves(calibration.load_campaign(path)).values()
    assert replicate.force == pytest.approx([0.1 * i * (1 + i) for i in range(8)])


@pytest.mark.parametrize(("size", "field"), [
    ({"radius_mm": 25.0, "height_mm": 70.0}, "specimen[0].radius_mm"), ({"height_mm": 30}, "specimen[0].height_mm")])
def test_a_recording_of_another_specimen_is_refused(folder, size, field):
    recording = ts.read_recording(folder / "run_1.csv")
    ts.write_recording(recording.with_metadata(specimen=size), folder / "run_1.csv")
    path = folder / "study.toml"
    path.write_text(GOOD, encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"and run_1\.csv states") as error:
        calibration.read_measured_curves(calibration.load_campaign(path))
    assert error.value.field == field and error.value.file == path


def test_no_more_strain_points_than_samples(folder):
    path = folder / "study.toml"
    path.write_text(GOOD.replace("bulk_ratio = 1000", "strain_points = 22"), encoding="utf-8")
    with pytest.raises(ts.InputError, match="must be at most 21") as error:
        calibration.read_measured_curves(calibration.load_campaign(path))
    assert error.value.field == "fit.strain_points"


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(ts.InputError, match="no such file"):
        calibration.load_campaign(tmp_path / "none.toml")
    with pytest.raises(ts.InputError, match=r"folder|cannot be read"):
        calibration.load_campaign(tmp_path)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, len(GOOD) - 1), text=st.text(max_size=6))
def test_any_slip_is_an_input_error_or_still_a_campaign(folder, position, text):
    path = folder / "slip.toml"
    path.write_bytes((GOOD[:position] + text + GOOD[position + 1:]).encode("utf-8", "surrogatepass"))
    try:
        assert calibration.load_campaign(path).tests
    except ts.InputError as error:
        assert re.search("slip.toml", str(error))


BAD_RECORDINGS = [
    ({"depth": 80e-3}, "", "must be smaller than the height"),
    ({"force": -5.0}, "", "of the wrong sign"),
    ({}, "max_strain = 0.001", "at least 5"),
    ({"depth": -10e-3}, "", "largest strain"),
    ({"order": -1}, "", "largest strain is in sample 1, .*Sort the file by time"),
    ({"order": 0}, "", "constant displacement"),
]


@pytest.mark.parametrize(("change", "key", "hint"), BAD_RECORDINGS)
def test_bad_recordings_write_nothing(folder, change, key, hint):
    write_run(folder, "run_2.csv", **change)
    path = folder / "study.toml"
    path.write_text(GOOD.replace('"phantom"\nkind', f'"phantom"\n{key}\nkind'), encoding="utf-8")
    with pytest.raises(ts.InputError, match=hint) as error:
        calibration.calibrate([path], folder / "out")
    assert error.value.field.startswith("test[0].")
    assert not (folder / "out").exists()


def test_offset_needs_displacement_and_specimen_needs_naming(folder):
    stretch = np.linspace(1.0, 1.5, 20)
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": 1e3 * (stretch - 1)}), folder / "pull.csv")
    path = folder / "pull.toml"
    text = ('[[test]]\nkind = "uniaxial_tension"\nrecordings = ["pull.csv"]\n'
            '[fit]\nlaws = ["neo_hooke"]\noffset = "fit"\n')
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"fit\.offset: .*displacement"):
        calibration.calibrate([path], folder / "out")
    path.write_text(text.replace("pull.csv", "run_1.csv").replace("fit\"", "none\""), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"require a \[\[specimen\]\]"):
        calibration.calibrate([path], folder / "out")
    path.write_text(text.replace("uniaxial_tension", "simple_shear"), encoding="utf-8")
    with pytest.raises(ts.InputError, match="simple_shear needs"):
        calibration.calibrate([path], folder / "out")
    assert not (folder / "out").exists()


def test_campaigns_load_without_scipy_taichi_or_matplotlib(folder):
    (folder / "study.toml").write_text(GOOD, encoding="utf-8")
    code = ("import sys, calibration; calibration.load_campaign('study.toml');"
            "print([m for m in ('scipy', 'taichi', 'matplotlib', 'viser') if m in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True,
                          env=child_environment())
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("method", ["analytical", "inverse_fem"])
def test_grips_are_bonded_and_nothing_else(folder, method):
    stretch = np.linspace(1.0, 1.5, 20)
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": 1e3 * (stretch - 1)}), folder / "pull.csv")
    text = ('[[test]]\nkind = "uniaxial_tension"\nrecordings = ["pull.csv"]\nfriction = "bonded"\n'
            f'[fit]\nmethod = "{method}"\nlaws = ["neo_hooke"]\n')
    test, = load(folder, text).tests
    assert test.experiment is None and test.kind is ts.KINDS["uniaxial_tension"]
    with pytest.raises(ts.InputError, match=r"test\[0\]\.friction: .*leave friction out"):
        load(folder, text.replace('"bonded"', "0.3"))


def test_a_test_carries_its_experiment_and_its_rig(folder):
    """Everything but the motion and the noise; of either method."""
    ts.write_rig(ts.Rig(compliance=2e-5, sensor_gain=0.01, force_noise=0.02, force_resolution=0.01),
                 folder / "frame.rig.json")
    text = GOOD.replace('laws = ["neo_hooke", "reduced_polynomial_2"]', 'laws = ["neo_hooke"]\nmethod = "inverse_fem"')
    test, = load(folder, text.replace('["run_*.csv"]', '["run_*.csv"]\nrig = "frame.rig.json"')).tests
    assert test.experiment.specimen == test.specimen
    assert (test.experiment.friction, test.experiment.friction_base, test.experiment.tool) == (
        "frictionless", "frictionless", ts.Tool())
    assert test.rig == ts.Rig(compliance=2e-5, sensor_gain=0.01)


NEEDLE = """[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "needle_indentation"
tool = "flat"
tool_radius_mm = 8.0
edge_radius_mm = 1.0
friction = "stick"
friction_wall = {wall}
recordings = ["run_1.csv"]
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
"""


@pytest.mark.parametrize(("wall", "means"), [('"stick"', "stick"), ('"frictionless"', "frictionless"), ("0.3", 0.3)])
def test_the_shaft_of_a_needle_is_held_as_the_face_is(folder, wall, means):
    test, = load(folder, NEEDLE.format(wall=wall)).tests
    assert test.experiment.friction_wall == means


@pytest.mark.parametrize(("wall", "words"), [('"bonded"', "must not be 'bonded'"), ('"stik"', "did you mean 'stick'")])
def test_what_a_shaft_cannot_do(folder, wall, words):
    with pytest.raises(ts.InputError, match=words) as caught:
        load(folder, NEEDLE.format(wall=wall))
    assert caught.value.field == "test[0].friction_wall"
