"""Material files: the round trip, and every refusal with the path of its field."""

import copy
import json
import math
from datetime import UTC, datetime, timedelta
from types import MappingProxyType

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.material.file import make_material_file_from_json_data
from tissue_sim.material.schema import Provenance, SourceRecording, ValidRange

YEOH = ts.Material("reduced_polynomial_3", {"C10": 7702.0, "C20": -63.0, "C30": 248.0}, ts.Bulk("bulk_ratio", 1e3),
                   density=1040.0, name="EF10_0T")
DIGEST = "0123456789abcdef" * 4


def full_file():
    covariance = np.array([[4.0, -1.0, 0.5], [-1.0, 9.0, 0.0], [0.5, 0.0, 16.0]])
    return ts.MaterialFile.of(
        YEOH, covariance=covariance, valid_range={"stretch": [0.34, 1.0], "strain_rate_per_s": (0.001, 0.01)},
        provenance={"recordings": [{"file": "a.csv", "sha256": DIGEST}], "method": "analytical",
                    "residual": {"RMSE_Pa": np.float64(12.5)}, "settings": {"starts": np.int64(3)},
                    "date": "2026-01-31T12:00:00+00:00"})


@pytest.fixture
def data(tmp_path):
    """A valid file as decoded JSON, to be damaged."""
    ts.write_material_file(full_file(), tmp_path / "good.material.json")
    return json.loads((tmp_path / "good.material.json").read_text(encoding="utf-8"))


def refusal(path) -> ts.InputError:
    with pytest.raises(ts.InputError) as caught:
        ts.read_material_file(path)
    assert caught.value.file == path and "\n" not in str(caught.value)
    return caught.value


def test_everything_comes_back(tmp_path):
    path = tmp_path / "new" / "m.material.json"
    ts.write_material_file(full_file(), path)
    again = ts.read_material_file(path)
    assert again == full_file()
    assert again.material == ts.load_material(path) == YEOH
    assert [entry.standard_error for entry in again.parameters.values()] == [2.0, 3.0, 4.0]
    assert again.covariance.matrix[0] == (4.0, -1.0, 0.5) and again.covariance.order == ("C10", "C20", "C30")
    assert again.valid_range == ValidRange(stretch=(0.34, 1.0), strain_rate_per_s=(0.001, 0.01))
    assert again.provenance.recordings == (SourceRecording(file="a.csv", sha256=DIGEST),)
    assert again.provenance.residual == {"RMSE_Pa": 12.5} and again.provenance.settings == {"starts": 3}
    assert again.provenance.software == "tissue-sim" and again.provenance.version == ts.__version__
    assert [file.name for file in path.parent.iterdir()] == ["m.material.json"]


def test_stability_is_that_of_the_law():
    softening = ts.Material("reduced_polynomial_2", {"C10": 1000.0, "C20": -200.0})
    stability = ts.find_stability_range(softening.energy_law, softening.values)
    entry = ts.MaterialFile.of(softening).stability
    assert (entry.stable_from, entry.stable_to) == (stability.stable_from, stability.stable_to)
    assert entry.stable_to < entry.stretch_range[1] and "unstable" in entry.text


def test_the_date_is_now():
    age = datetime.now(UTC) - datetime.fromisoformat(ts.MaterialFile.of(YEOH).provenance.date)
    assert timedelta(0) <= age < timedelta(minutes=1)


def test_the_file_is_for_people(data, tmp_path):
    text = (tmp_path / "good.material.json").read_text(encoding="utf-8")
    assert '      "unit": "Pa",\n' in text and '      [4.0, -1.0, 0.5],\n' in text and '"stretch": [0.34, 1.0]' in text
    assert list(data) == ["schema", "name", "law", "parameters", "covariance", "bulk", "density_kg_m3", "valid_range",
                          "stability", "provenance"]
    assert data["schema"] == "tissue_sim/material/2"


def test_text_that_looks_like_a_list_is_kept(tmp_path):
    material = ts.Material("neo_hooke", {"C10": 1.0}, name="[\n 1,\n 2\n]")
    ts.write_material_file(ts.MaterialFile.of(material), tmp_path / "m.json")
    assert ts.load_material(tmp_path / "m.json").name == material.name


@st.composite
def materials(draw):
    law = ts.find_law(draw(st.sampled_from(sorted(ts.LAWS))))
    ratio = st.floats(-0.5, 0.45)  # Poisson's ratios of compressible laws
    # No subnormal numbers: loading Taichi makes the processor take them for zero.
    small = st.floats(-1e9, 1e9, allow_subnormal=False)
    positive = st.floats(0.1, 20.0)
    parameters = {name: draw(st.floats(1e-3, 1e9) if unit == "Pa" else ratio if name.startswith("nu")
                             else positive if name in law.parameter_bounds
                             else positive | st.floats(-20.0, -0.1)) for name, unit in law.units.items()}
    if law.name.startswith("reduced_polynomial"):
        parameters |= {name: draw(small) for name in list(parameters)[1:]}
    kind = draw(st.sampled_from(["of_law"] if law.is_compressible
                                else ["K_Pa", "D1_per_Pa", "bulk_ratio", "incompressible"]))
    bulk = ts.Bulk(kind, None if kind in ("incompressible", "of_law") else draw(st.floats(1e-12, 1e12)))
    return ts.Material(law.name, parameters, bulk, draw(st.none() | st.floats(1.0, 1e4)),
                       draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=20)))


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(material=materials(), data=st.data())
def test_round_trip_of_every_law(tmp_path, material, data):
    m = len(material.parameters)
    entries = st.integers(-8000, 8000).map(lambda eighths: eighths / 8)  # products without underflow
    root = data.draw(st.lists(st.lists(entries, min_size=m, max_size=m), min_size=m, max_size=m))
    covariance = np.array(root) @ np.array(root).T
    file = ts.MaterialFile.of(material, covariance=covariance)
    path = tmp_path / "m.material.json"
    ts.write_material_file(file, path)
    again = ts.read_material_file(path)
    assert again == file
    assert again.material == material
    assert np.array_equal(again.covariance.matrix, covariance)


@pytest.mark.slow
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
        st.sampled_from(["schema", "law", "parameters", "bulk", "C10", "unit", "value", "K_Pa"]), inner, max_size=6),
).map(json.dumps) | st.text(max_size=50))
def test_any_text_is_refused_in_one_sentence(tmp_path, text):
    path = tmp_path / "any.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    refusal(path)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(draw=st.data())
def test_any_value_in_any_place_is_accepted_or_refused(draw):
    data = json.loads(json.dumps(msgspec.to_builtins(full_file())))
    node = data
    while True:
        key = draw.draw(st.sampled_from(sorted(node)) if isinstance(node, dict) else st.integers(0, len(node) - 1))
        if not (isinstance(node[key], dict | list) and node[key]) or draw.draw(st.booleans()):
            break
        node = node[key]
    node[key] = draw.draw(
        st.none() | st.floats() | st.integers() | st.text(max_size=3) | st.lists(st.floats(), max_size=3)
        | st.dictionaries(st.text(max_size=3), st.floats(), max_size=2))
    try:
        file = make_material_file_from_json_data(data)
    except ts.InputError as error:
        assert error.problem
    else:
        assert math.isfinite(file.material.mu0) and file.material.mu0 > 0


def test_other_units_of_stress_become_pascal(data, tmp_path):
    for name, unit, factor in (("C10", "kPa", 1e3), ("C20", "MPa", 1e6)):
        entry = data["parameters"][name]
        entry.update(value=entry["value"] / factor, unit=unit, standard_error=entry["standard_error"] / factor)
    # The covariance is stated in the product of the same units.
    scale = np.array([1e-3, 1e-6, 1.0])
    data["covariance"]["matrix"] = (np.outer(scale, scale) * np.array(data["covariance"]["matrix"])).tolist()
    path = tmp_path / "units.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    file = ts.read_material_file(path)
    assert {entry.unit for entry in file.parameters.values()} == {"Pa"}
    np.testing.assert_allclose(file.material.values, YEOH.values, rtol=1e-15)
    errors = [entry.standard_error for entry in file.parameters.values()]
    np.testing.assert_allclose(errors, [2.0, 3.0, 4.0], rtol=1e-15)
    np.testing.assert_allclose(file.covariance.matrix, full_file().covariance.matrix, rtol=1e-14)


def put(*keys_and_value):
    """A change of decoded JSON: the last argument goes where the keys before it lead."""
    *keys, last, value = keys_and_value

    def change(data):
        for key in keys:
            data = data[key]
        data[last] = value
    return change


def drop(*keys):
    def change(data):
        for key in keys[:-1]:
            data = data[key]
        del data[keys[-1]]
    return change


REFUSED = {
    "newer": (put("schema", "tissue_sim/material/3"), "schema", "newer version.*update tissue-sim"),
    "no schema": (drop("schema"), "schema", "missing"),
    "other schema": (put("schema", "tissue_sim/rig/1"), "schema", "not a material schema"),
    "schema of another type": (put("schema", 1), "schema", "not a material schema"),
    "no unit": (drop("parameters", "C10", "unit"), "parameters.C10.unit", "is missing; give a unit"),
    "unknown unit": (put("parameters", "C10", "unit", "bars"), "parameters.C10.unit", "unknown unit 'bars'"),
    "unit of another quantity": (put("parameters", "C10", "unit", "mm"), "parameters.C10.unit", "expected a stress"),
    "unknown key": (put("paramters", {}), "paramters", "did you mean 'parameters'"),
    "unknown key of a parameter": (put("parameters", "C20", "error", 1), "parameters.C20.error", "standard_error"),
    "unknown key in a list": (put("provenance", "recordings", 0, "sha", ""), "provenance.recordings[0].sha", "sha256"),
    "unknown key in an option": (put("valid_range", "strech", 1), "valid_range.strech", "did you mean 'stretch'"),
    "text for a number": (put("parameters", "C10", "value", "7"), "parameters.C10.value", "expected a number"),
    "number for an entry": (put("parameters", "C10", 7702.0), "parameters.C10", "expected an object"),
    "nan": (put("parameters", "C10", "value", math.nan), "parameters.C10.value", "number must be finite; got nan"),
    "infinite setting": (put("provenance", "settings", "x", [1, math.inf]), "provenance.settings.x[1]", "inf"),
    "huge": (put("parameters", "C10", "value", 10**400), "parameters.C10.value", "out of range"),
    "too large in Pa": (put("parameters", "C30", {"value": 1e308, "unit": "MPa"}), "parameters.C30", "inf"),
    "error too large in Pa": (put("parameters", "C30", {"value": 1.0, "unit": "MPa", "standard_error": 1e308}),
                              "parameters.C30.standard_error", "number must be finite; got inf"),
    "negative error": (put("parameters", "C10", "standard_error", -1.0), "parameters.C10.standard_error",
                       "must be a standard deviation of 0 or more; got -1"),
    "parameter missing": (drop("parameters", "C10"), "parameters.C10", "C10 is missing"),
    "parameter of another law": (put("parameters", "C1", {"value": 1, "unit": "Pa"}), "parameters.C1", "no parameter"),
    "law missing": (drop("law"), "law", "is missing"),
    "unknown law": (put("law", "reduced_polynomal_3"), "law", "did you mean 'reduced_polynomial_3'"),
    "soft as nothing": (put("parameters", "C10", "value", 0.0), "parameters",
                        "must give a positive shear modulus"),
    "covariance not square": (put("covariance", "matrix", [[1, 0, 0], [0, 1, 0]]), "covariance.matrix", "3 rows of 3"),
    "covariance ragged": (put("covariance", "matrix", 1, [1]), "covariance.matrix", "3 rows of 3"),
    "covariance not symmetric": (put("covariance", "matrix", 0, 1, 2.0), "covariance.matrix", "must be symmetric"),
    "covariance not definite": (put("covariance", "matrix", [[1, 2, 0], [2, 1, 0], [0, 0, 1]]), "covariance.matrix",
                                "semi-definite"),
    "negative variance": (put("covariance", "matrix", 1, 1, -9.0), "covariance.matrix",
                          "must have a diagonal of 0 or more; got -9"),
    "covariance of a fixed parameter": (put("covariance", "matrix", 1, 1, 0.0), "covariance.matrix", "semi-definite"),
    "wrong order": (put("covariance", "order", ["C20", "C10", "C30"]), "covariance.order", "C10, C20, C30"),
    "no bulk": (drop("bulk"), "bulk", "is missing"),
    "empty bulk": (put("bulk", {}), "bulk", "exactly one"),
    "two bulks": (put("bulk", "K_Pa", 1e6), "bulk", "exactly one"),
    "not incompressible": (put("bulk", {"incompressible": False}), "bulk", "exactly one"),
    "negative bulk": (put("bulk", "bulk_ratio", -1.0), "bulk.bulk_ratio", "must be positive and finite"),
    "negative density": (put("density_kg_m3", -1.0), "density_kg_m3", "must be positive and finite"),
    "range backwards": (put("valid_range", "stretch", [1.0, 0.5]), "valid_range.stretch",
                        r"must be \[lowest, highest\]; got 1 to 0.5"),
    "range of one": (put("valid_range", "stretch", [1.0]), "valid_range.stretch", "length 2, got 1"),
    "negative stretch": (put("valid_range", "stretch", [-0.1, 1.0]), "valid_range.stretch", "above 0"),
    "half a character": (put("name", "\ud800"), "name", "surrogate"),
    "digest": (put("provenance", "recordings", 0, "sha256", "abc"), "provenance.recordings[0].sha256", "regex"),
    "date": (put("provenance", "date", "yesterday"), "provenance.date", "ISO 8601"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_the_path_of_the_field(data, tmp_path, case):
    change, field, message = REFUSED[case]
    changed = copy.deepcopy(data)
    change(changed)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(changed), encoding="utf-8")
    error = refusal(path)
    assert error.field == field
    with pytest.raises(ts.InputError, match=message):
        raise error


@pytest.mark.parametrize("change", [
    put("viscoelastic", None), put("layers", None), drop("covariance"), drop("stability"), drop("provenance"),
    drop("name"), drop("density_kg_m3"), put("parameters", "C10", "value", 7702),
    put("bulk", {"incompressible": True}),
])
def test_what_may_be_absent(data, change):
    change(data)
    assert make_material_file_from_json_data(data).material.parameters == YEOH.parameters


def test_a_fixed_parameter_has_a_row_of_zeros():
    file = ts.MaterialFile.of(YEOH, covariance=np.diag([1.0, 0.0, 4.0]))
    assert [entry.standard_error for entry in file.parameters.values()] == [1.0, 0.0, 2.0]


def test_damaged_files(tmp_path):
    path = tmp_path / "m.json"
    path.write_text('{"schema": "tissue_sim/material/2",\n "law": neo}', encoding="utf-8")
    error = refusal(path)
    assert error.line == 2 and "damaged JSON at column 9" in error.problem
    path.write_text('{"law": "a", "law": "b"}', encoding="utf-8")
    assert "key must appear once in an object; got 'law' twice" in refusal(path).problem
    path.write_text("[" * 100_000, encoding="utf-8")
    assert "damaged JSON" in refusal(path).problem
    path.write_text("[]", encoding="utf-8")
    assert "file must contain an object" in refusal(path).problem
    path.write_bytes(b"\x00\x01")
    assert "binary" in refusal(path).problem
    assert "no such file" in refusal(tmp_path / "none.json").problem
    assert "is a folder" in refusal(tmp_path).problem


@pytest.mark.parametrize(("options", "field"), [
    ({"standard_errors": {"C11": 1.0}}, "standard_errors.C11"),
    ({"standard_errors": {"C10": -1.0}}, "parameters.C10.standard_error"),
    ({"standard_errors": {"C10": math.inf}}, "parameters.C10.standard_error"),
    ({"covariance": np.eye(2)}, "covariance.matrix"),
    ({"covariance": np.ones(3)}, "covariance.matrix"),
    ({"covariance": np.full((3, 3), math.nan)}, "covariance.matrix"),
    ({"valid_range": {"stretches": [0.5, 1]}}, "valid_range.stretches"),
    ({"provenance": {"methd": "a"}}, "provenance.methd"),
    ({"provenance": {"residual": {"RMSE_N": math.nan}}}, "provenance.residual.RMSE_N"),
])
def test_of_refuses_what_the_file_would(options, field):
    with pytest.raises(ts.InputError) as caught:
        ts.MaterialFile.of(YEOH, **options)
    assert caught.value.field == field


def test_of_takes_structs_and_read_only_maps():
    file = ts.MaterialFile.of(YEOH, valid_range=ValidRange(stretch=(0.5, 1.0)),
                              provenance=Provenance(method="by hand"),
                              standard_errors=MappingProxyType({"C10": np.float64(3.0)}))
    assert file.valid_range.stretch == (0.5, 1.0) and file.provenance.method == "by hand"
    assert file.parameters["C10"].standard_error == 3.0 and file.parameters["C20"].standard_error is None


def test_what_cannot_be_written_leaves_the_old_file(tmp_path):
    path = tmp_path / "m.material.json"
    ts.write_material_file(full_file(), path)
    before = path.read_bytes()
    bad = msgspec.structs.replace(full_file(), density_kg_m3=math.nan)
    with pytest.raises(ts.InputError) as caught:
        ts.write_material_file(bad, path)
    assert (caught.value.file, caught.value.field) == (path, "density_kg_m3")
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == [path.name]
    with pytest.raises(ts.InputError, match="cannot be written"):
        ts.write_material_file(full_file(), tmp_path)
