"""Foreign files: named columns, named formats, and the measured data that the project is checked against."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tissue_sim import InputError, read_recording, read_recordings
from tissue_sim.recording.formats import FORMATS

COLUMNS = {"displacement": "Compression (mm)", "force": "Load (N)"}


def write(folder, text, name="foreign.csv"):
    path = folder / name
    path.write_bytes(text.encode())
    return path


def table(delimiter=",", point=".", header=("Time (s)", "Compression (mm)", "Load (N)"), before="", after=""):
    lines = [before + delimiter.join(header)]
    for i in range(6):
        lines.append(delimiter.join(f"{step * i:.2f}".replace(".", point) for step in (0.1, 0.5, 0.25)))
    return "\n".join([*lines, after])


def refusal(path, **options):
    with pytest.raises(InputError) as caught:
        read_recording(path, **options)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("text", [
    table(),
    table(";"),
    table("\t"),
    table(";", ","),
    table("\t", ","),
    table(before="Machine: frame\nOperator; J. Doe\n\nResults, table\n"),
    table(header=(" time  (s)", "COMPRESSION (mm)", '"Load (N)"')),
    table(";", ",", header=("Time (s)", "Compression (mm)", "Load (N)", "", "")),
    table().replace("\n", ",\n"),
    "\ufeff" + table().replace("\n", "\r\n"),
], ids=["comma", "semicolon", "tab", "decimal comma", "tab and decimal comma", "lines above", "case and blanks",
        "empty columns", "delimiter at the end", "Windows"])
def test_header_row_and_delimiter_are_found(tmp_path, text):
    recording = read_recording(write(tmp_path, text), columns=COLUMNS)
    np.testing.assert_allclose(recording.displacement, 0.5e-3 * np.arange(6), atol=1e-17)
    np.testing.assert_allclose(recording.force, 0.25 * np.arange(6), atol=1e-17)
    assert "time" not in recording


def test_a_file_of_numpy_savetxt_with_a_remark_below(tmp_path):
    path = tmp_path / "savetxt.csv"
    np.savetxt(path, np.arange(12.0).reshape(6, 2), delimiter=",", header="Compression (mm),Load (N)", footer="the end")
    recording = read_recording(path, columns=COLUMNS)
    np.testing.assert_allclose(recording.force, np.arange(1.0, 12.0, 2.0))


def test_unit_and_sign_of_a_column(tmp_path):
    path = write(tmp_path, table(header=("t", "Way", "Load")))
    recording = read_recording(path, columns={
        "time": {"name": "t", "unit": "min"}, "displacement": {"name": "Way", "unit": "cm", "sign": -1},
        "force": {"name": "Load", "unit": "mN"}})
    np.testing.assert_allclose(recording.time, 6.0 * np.arange(6))
    np.testing.assert_allclose(recording.displacement, -0.5e-2 * np.arange(6))
    np.testing.assert_allclose(recording.force, 0.25e-3 * np.arange(6))


def test_a_stated_unit_wins_over_the_header(tmp_path):
    path = write(tmp_path, table())
    recording = read_recording(path, columns={"displacement": {"name": "Compression", "unit": "m"}, "force": "Load"})
    assert recording.displacement[-1] == 2.5


def test_skipped_lines_are_not_looked_at(tmp_path):
    # A summary table with the same header stands above the data: it has too few points to be a test.
    path = write(tmp_path, "Compression (mm),Load (N),Name\n1,mean,A\n" + table())
    assert len(read_recording(path, columns=COLUMNS)) == 6
    # Another test that stands above the data.
    path = write(tmp_path, "Compression (mm),Load (N)\n" + "1,2\n" * 7 + table())
    assert [len(each) for each in read_recordings(path, columns=COLUMNS)] == [7, 6]
    recording = read_recording(path, columns=COLUMNS, skip_lines=8)
    assert len(recording) == 6
    error = refusal(write(tmp_path, "Compression (mm),Load (N)\n" + table().replace("0.50", "x")), columns=COLUMNS,
                    skip_lines=1)
    assert error.line == 4, "line numbers are those of the file"
    assert refusal(path, columns=COLUMNS, skip_lines=-1).field == "skip_lines"
    assert "skip fewer" in refusal(path, columns=COLUMNS, skip_lines=99).problem
    assert refusal(path, skip_lines=2).field == "skip_lines"


def test_labels_by_name(tmp_path):
    path = write(tmp_path, "a (mm);b (N);Phase;No\n" + "".join(f"{i};{i};load {i};{i}\n" for i in range(5)))
    recording = read_recording(path, columns={"displacement": "a", "force": "b", "segment": "Phase", "cycle": "No"})
    assert recording.labels["segment"].tolist() == [f"load {i}" for i in range(5)]
    assert recording.labels["cycle"].tolist() == list(range(5))


@pytest.mark.parametrize(("text", "delimiter", "columns"), [
    (table("|"), "|", COLUMNS), (table("|", ","), "|", COLUMNS), (table(";"), ";", COLUMNS),
    (table(" ", header=("t", "way", "load")).replace(" ", "   "), " ", {
        "displacement": {"name": "way", "unit": "mm"}, "force": {"name": "load", "unit": "N"}}),
    ("  " + table(" ", header=("t", '"Compression (mm)"', '"Load (N)"')).replace("\n", "  \n "), " ", COLUMNS)])
def test_a_stated_delimiter(tmp_path, text, delimiter, columns):
    recording = read_recording(write(tmp_path, text), columns=columns, delimiter=delimiter)
    np.testing.assert_allclose(recording.force, 0.25 * np.arange(6), atol=1e-17)


@pytest.mark.parametrize("delimiter", ["", "ab", "3", ".", '"', "\n", 5])
def test_what_is_no_delimiter(tmp_path, delimiter):
    assert refusal(write(tmp_path, table()), columns=COLUMNS, delimiter=delimiter).field == "delimiter"


def test_a_delimiter_is_for_named_columns_and_binds(tmp_path):
    path = write(tmp_path, table())
    assert refusal(path, delimiter=";").field == "delimiter"
    assert "cells separated by ';'" in refusal(path, columns=COLUMNS, delimiter=";").problem


def test_a_table_without_names_says_so(tmp_path):
    path = write(tmp_path, "0,0\n" * 6)
    problem = refusal(path, columns={"displacement": {"name": "1", "unit": "mm"}, "force": {"name": "2", "unit": "N"}},
                      ).problem
    assert "known:" not in problem and "header" in problem


@pytest.mark.parametrize(("text", "line", "message"), [
    (table(header=("Time (s)", "Compresion (mm)", "Load (N)")), 1, "did you mean 'Compresion (mm)'"),
    (table(before="x\n", header=("Time (s)", "Compression (mm)", "Force (N)")), 2, "no column 'Load (N)'"),
    (table(header=("Load (N)", "Compression (mm)", "Load (N)")), 1, "'Load (N)' appears twice"),
    (table("|"), None, "commas, semicolons or tabs"),
    (table(" "), None, "commas, semicolons or tabs"),
    (table(after="Mean,1,2\n0,0,oops\n").replace("Mean,1,2\n", ""), 8, "'Load (N)' holds 'oops'"),
    (table(after="\n\n0,1\n"), 10, "2 cells, expected 3"),
    (table(";", ",", after="1;1.5;2\n"), 8, "mixes decimal points and decimal commas"),
    (table(after='1,"1,23",2\n'), 8, "holds '1,23'"),
    (table(";", after="1;1,23.5;2\n"), 8, "holds '1,23.5'"),
    (table(header=("t", "Compression (mm)", "Load (N)")).replace("2.50", "inf"), 7, "holds 'inf'"),
])
def test_bad_tables_are_refused(tmp_path, text, line, message):
    error = refusal(write(tmp_path, text), columns=COLUMNS)
    assert message in error.problem
    assert error.line == line


@pytest.mark.parametrize(("columns", "field", "message"), [
    ({}, "columns", "expected a map"),
    ({"displacment": "a"}, "columns.displacment", "did you mean 'displacement'"),
    ({"force": 3}, "columns.force", "must be a column name"),
    ({"force": ""}, "columns.force.name", "missing"),
    ({"force": {"unit": "N"}}, "columns.force.name", "missing"),
    ({"force": {"name": "Load", "untis": "N"}}, "columns.force.untis", "did you mean 'unit'"),
    ({"force": {"name": "Load", "sign": 2}}, "columns.force.sign", "1 or -1"),
    ({"force": {"name": "Load", "sign": True}}, "columns.force.sign", "1 or -1"),
    ({"force": {"name": "Load", "unit": 3}}, "columns.force.unit", "must be text"),
    ({"force": {"name": "Load", "scale": -2.0}}, "columns.force.scale", "State the direction with sign"),
    ({"force": {"name": "Load", "scale": 10**400}}, "columns.force.scale", "must be a positive number"),
    ({"force": {"name": "Load", "offset": 10**400}}, "columns.force.offset", "must be a finite number"),
    ({"force": {"column": 10**400}}, "columns.force.column", "must be a number from 1"),
    ({"force": {"name": "Load", "offset": "1"}}, "columns.force.offset", "must be a finite number"),
    ({"force": {"name": "Load", "unit": "V"}}, "columns.force", "give scale, the N in 1 V"),
    ({"cycle": {"name": "Load", "unit": "N"}}, "columns.cycle", "a label has no unit, sign"),
    ({"force": {"name": "Load", "unit": "lbx"}}, "columns.force", "unknown unit 'lbx'"),
    ({"force": "Load", "displacement": {"name": "Load", "unit": "mm"}}, "columns.displacement", "two channels"),
])
def test_bad_maps_are_refused_by_field(tmp_path, columns, field, message):
    error = refusal(write(tmp_path, table()), columns=columns)
    assert error.field == field and message in error.problem


def test_a_unit_that_nobody_stated_is_asked_for(tmp_path):
    path = write(tmp_path, table(header=("t", "Compression (mm)", "Load")))
    error = refusal(path, columns={"displacement": "Compression", "force": "Load"})
    assert error.field == "columns.force" and error.line == 1 and 'unit = "..."' in error.problem


def test_all_faults_of_the_columns_are_said_at_once(tmp_path):
    path = write(tmp_path, table(header=("t", "Way", "Load")))
    error = refusal(path, columns={"time": "t", "displacement": "Way", "force": {"name": "Load", "unit": "V"}})
    assert error.field == "columns" and error.line == 1
    assert all(part in error.problem for part in ("column 't'", "column 'Way'", "column 'Load'", "give scale"))
    error = refusal(path, columns={"displacement": "Weg", "force": "Kraft"})
    assert "no column 'Weg' (nor 'Kraft')" in error.problem


def test_format_names(tmp_path):
    path = write(tmp_path, table())
    error = refusal(path, format="instrom")
    assert error.field == "format" and "did you mean 'instron'" in error.problem
    assert refusal(path, format="instron", columns=COLUMNS).field == "columns"


# No subnormal numbers: loading Taichi makes the processor take them for zero.
numbers = st.floats(-1e6, 1e6, allow_subnormal=False)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=st.lists(st.tuples(numbers, numbers), min_size=5, max_size=9),
       delimiter=st.sampled_from(",;\t"), comma=st.booleans(), above=st.integers(0, 4))
def test_any_table_is_read_back(tmp_path, values, delimiter, comma, above):
    comma = comma and delimiter != ","
    lines = ["remark"] * above + [delimiter.join(("Way (m)", "Note", "Load (N)"))]
    for way, load in values:
        cells = (repr(way), "ok", repr(load))
        lines.append(delimiter.join(cell.replace(".", ",") if comma else cell for cell in cells))
    recording = read_recording(write(tmp_path, "\n".join(lines)), columns={"displacement": "Way", "force": "Load"})
    assert recording.displacement.tolist() == [way for way, _ in values]
    assert recording.force.tolist() == [load for _, load in values]


INSTRON = """Phantom_A_sample_1
Compression test;
Cylinder Diameter: 5cm;
Cylinder Height: 30mm;
Speed (mm/min): 15;
Machine: INSTRON 5900;
Load cell: 1kN;
Time (s),Compression (mm),Load (N),Engineering Strain [-],Engineering Stress (kPa)
""" + "".join(f"{0.1 * i:.6f},{0.5 * i:.6f},{0.25 * i:.6f},-0.1,-0.2\n" for i in range(6))


def test_instron(tmp_path):
    recording = read_recording(write(tmp_path, INSTRON), format="instron", kind="lubricated_compression")
    assert list(recording.channels) == ["time", "displacement", "force"]
    np.testing.assert_allclose(recording.displacement, 0.5e-3 * np.arange(6), atol=1e-17)
    assert recording.metadata["specimen"] == {"shape": "cylinder", "radius_mm": 25.0, "height_mm": 30.0}
    assert recording.metadata["speed_mm_s"] == 0.25
    assert recording.metadata["machine"] == "INSTRON 5900" and recording.metadata["load_cell"] == "1kN"
    assert recording.metadata["title"] == "Phantom_A_sample_1"


def test_instron_with_fewer_lines_above_and_a_bad_cell(tmp_path):
    short = INSTRON.split("Machine")[0] + INSTRON[INSTRON.index("Time (s)"):]
    recording = read_recording(write(tmp_path, short), format="instron")
    assert len(recording) == 6 and "machine" not in recording.metadata
    error = refusal(write(tmp_path, INSTRON.replace("1.500000", "bad")), format="instron")
    assert error.line == 12 and "holds 'bad'" in error.problem
    error = refusal(write(tmp_path, INSTRON.replace("Load (N)", "Lod (N)")), format="instron")
    assert "no column 'Load'; did you mean 'Lod (N)'" in error.problem


@pytest.mark.slow
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, len(INSTRON) - 1), text=st.text(max_size=5), cut=st.integers(0, 30))
def test_a_damaged_instron_file_is_read_or_refused(tmp_path, position, text, cut):
    damaged = INSTRON[:position] + text + INSTRON[position + cut:]
    path = tmp_path / "any.csv"
    path.write_bytes(damaged.encode("utf-8", "surrogatepass"))
    try:
        recording = read_recording(path, format="instron")
        assert len(recording) >= 5 and {"time", "displacement", "force"} == set(recording.channels)
    except InputError as error:
        # A long sentence is shortened in its middle.
        assert path.name in str(error) and len(str(error)) <= 300


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=st.lists(st.tuples(numbers, numbers), min_size=5, max_size=9),
       diameter=st.integers(1, 500), height=st.integers(1, 500), above=st.text("abc :;,", max_size=20))
def test_any_instron_table_is_read_back(tmp_path, values, diameter, height, above):
    rows = "".join(f"{i},{way!r},{load!r}\n" for i, (way, load) in enumerate(values))
    head = f"{above}\nCylinder Diameter: {diameter}mm;\nCylinder Height: {height}mm;\n"
    recording = read_recording(write(tmp_path, head + "Time (s),Compression (mm),Load (N)\n" + rows), format="instron")
    assert recording.force.tolist() == [load for _, load in values]
    np.testing.assert_allclose(recording.displacement, [1e-3 * way for way, _ in values], rtol=1e-15)
    assert recording.metadata["specimen"] == {"shape": "cylinder", "radius_mm": diameter / 2, "height_mm": height}


SOFT_ROBOTICS = ("PARAMETER;INFO;URL;;\nMaterial;Gel;;;\n;;;;\n"
                 "Time (s);True Strain;True Stress (MPa);Engineering Strain;Engineering Stress (MPa)\n"
                 + "".join(f"{i};0;0;{0.1 * i:.1f};{0.2 * i:.1f}\n" for i in range(7)))


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, len(SOFT_ROBOTICS) - 1), text=st.text(max_size=5), cut=st.integers(0, 30))
def test_a_damaged_soft_robotics_file_is_read_or_refused(tmp_path, position, text, cut):
    path = tmp_path / "any.csv"
    damaged = SOFT_ROBOTICS[:position] + text + SOFT_ROBOTICS[position + cut:]
    path.write_bytes(damaged.encode("utf-8", "surrogatepass"))
    try:
        recording = read_recording(path, format="soft_robotics")
        assert len(recording) >= 5 and {"stretch", "nominal stress"} <= set(recording.channels)
    except InputError as error:
        assert path.name in str(error) and len(str(error)) <= 300


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=st.lists(st.tuples(numbers, numbers), min_size=5, max_size=9))
def test_any_soft_robotics_table_is_read_back(tmp_path, values):
    head = SOFT_ROBOTICS.split("0;0;0;")[0]
    rows = "".join(f"{i};0;0;{strain!r};{stress!r}\n" for i, (strain, stress) in enumerate(values))
    recording = read_recording(write(tmp_path, head + rows), format="soft_robotics")
    np.testing.assert_allclose(recording.channel("stretch"), [1.0 + strain for strain, _ in values], rtol=1e-15)
    np.testing.assert_allclose(recording.channel("nominal stress"), [1e6 * stress for _, stress in values], rtol=1e-15)


@pytest.mark.parametrize(("times", "kept"), [
    ((0, 1, 2, 3, 4, 5), True), (("40.8", "40.9", "40.10", "40.11", "40.12", "40.13"), False)])
def test_soft_robotics_leaves_a_broken_clock_out(tmp_path, times, kept):
    rows = "".join(f"{t};0;0;{0.1 * i};{0.2 * i}\n" for i, t in enumerate(times))
    header = "Time (s);True Strain;True Stress (MPa);Engineering Strain;Engineering Stress (MPa)\n"
    path = write(tmp_path, "PARAMETER;INFO;URL;;\nMaterial;Gel;;;\n;;;;\n" + header + rows)
    recording = read_recording(path, format="soft_robotics", kind="uniaxial_tension")
    np.testing.assert_allclose(recording.channel("stretch"), 1 + 0.1 * np.arange(6))
    np.testing.assert_allclose(recording.channel("nominal stress"), 0.2e6 * np.arange(6))
    assert recording.metadata["parameters"] == {"Material": "Gel"}
    assert ("time" in recording) == kept and ("time" in recording.metadata) != kept


def test_every_format_refuses_a_file_of_another_kind(tmp_path):
    path = write(tmp_path, "a poem\nwithout numbers\n")
    for name in FORMATS:
        assert refusal(path, format=name).file == path


@pytest.mark.slow
def test_ecoflex_compression(data_folder):
    files = sorted((data_folder / "ecoflex_compression").glob("EF*.csv"))
    assert len(files) == 32
    for file in files:
        recording = read_recording(file, format="instron", kind="lubricated_compression")
        assert 1200 <= len(recording) <= 1210
        assert recording.metadata["specimen"] == {"shape": "cylinder", "radius_mm": 25.0, "height_mm": 30.0}
        assert recording.metadata["speed_mm_s"] == pytest.approx(1 / 6)
        assert recording.displacement[-1] == pytest.approx(20e-3, abs=1e-5)
        raw = np.loadtxt(file, delimiter=",", skiprows=8)
        np.testing.assert_allclose(recording.force, raw[:, 2], rtol=1e-15)
        # Column 5 is force over undeformed area in kPa: unit and diameter are read right.
        area = np.pi * 25e-3**2
        np.testing.assert_allclose(-recording.force / area * 1e-3, raw[:, 4], atol=1e-5)


def test_soro_tensile(data_folder):
    lasts = {}
    for file in sorted((data_folder / "soro_tensile").glob("*.csv")):
        recording = read_recording(file, format="soft_robotics", kind="uniaxial_tension")
        last = (recording.channel(name)[-1] for name in ("stretch", "nominal stress"))
        lasts[file.stem] = (*last, "time" in recording)
    assert len(lasts) == 6
    assert lasts["RTV615"] == (pytest.approx(2.93182), pytest.approx(2.50748e6), True)
    assert lasts["Ecoflex 00-30"] == (pytest.approx(17.06818), pytest.approx(1.35949e6), False)
    assert [name for name, (_, _, timed) in lasts.items() if not timed] == ["Ecoflex 00-30", "Ecoflex 00-50"]


@pytest.mark.parametrize(("file", "abscissa", "columns", "points", "last"), [
    ("rubber_treloar_kawabata/treloar1944_uniaxial.csv", "stretch",
     ("Stretch", "Stress", "MPa"), 21, (7.512, 5.5639e6)),
    ("rubber_treloar_kawabata/kawabata1981_biaxial.csv", "stretch", ("lambda1", "s1", "MPa"), 117, (3.7, 1.136e6)),
    ("brain_tension_damage/brain_gm1.csv", "stretch", ("Stretch", "Nominal Stress", "kPa"), 42, (2.774, 2550.0)),
    ("brain_tension_damage/brain_wm_p.csv", "stretch", ("Stretch", "Stress", "kPa"), 61, (2.8241, 1811.7)),
    ("foam_compressible/foam_leap__foam_UT.csv", "stretch", ("lambda", "P_MPa", "MPa"), 101, (1.3, 298587.325)),
    ("foam_compressible/foam_turbo__foam_UC.csv", "stretch", ("lambda", "P_MPa", "MPa"), 101, (1.0, 0.0)),
    ("foam_compressible/foam_leap__foam_SS.csv", "shear strain", ("lambda", "P_MPa", "MPa"), 201, (0.15, 19136.316)),
])
def test_stress_stretch_sets(data_folder, file, abscissa, columns, points, last):
    name, stress, unit = columns
    kind = "simple_shear" if abscissa == "shear strain" else "uniaxial_tension"
    recording = read_recording(data_folder / file, kind=kind, columns={
        abscissa: name, "nominal stress": {"name": stress, "unit": unit}})
    assert len(recording) == points
    assert recording.channel(abscissa)[-1] == pytest.approx(last[0])
    assert recording.channel("nominal stress")[-1] == pytest.approx(last[1])
