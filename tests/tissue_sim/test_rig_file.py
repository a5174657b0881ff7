"""Rig files: round trip, units, and what a damaged one says."""

import json
from dataclasses import fields

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.parameters import list_field_declarations
from tissue_sim.rig.file import load_rig, write_rig
from tissue_sim.rig.rig import Rig

NOT_NEGATIVE = st.floats(1e-12, 1e6)
ANY = st.floats(-1e6, 1e6).filter(lambda value: abs(value) > 1e-12)
RELATIVE = st.floats(-0.99, 10.0).filter(lambda value: abs(value) > 1e-12)
SIGNED = ("contact_offset", "step_loss", "step_loss_depth", "zero_offset", "sensor_drift")
VALUES = {name: ANY if name in SIGNED else RELATIVE if name.endswith("gain") else NOT_NEGATIVE
          for name in list_field_declarations(Rig)}


def test_every_field_has_a_key():
    assert [*list_field_declarations(Rig), "seed", "faults"] == [entry.name for entry in fields(Rig)]


@given(st.fixed_dictionaries({}, optional={**VALUES, "seed": st.integers(0, 2**32)}))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip(tmp_path, values):
    rig, path = Rig(**values), tmp_path / "a.rig.json"
    write_rig(rig, path)
    text = path.read_text(encoding="utf-8")
    again = load_rig(path)
    for entry in fields(Rig):
        found, expected = getattr(again, entry.name), getattr(rig, entry.name)
        assert found == expected if expected is None else found == pytest.approx(expected, rel=1e-14, abs=0)
    write_rig(again, path)
    assert path.read_text(encoding="utf-8") == text


def test_units_and_spelling(tmp_path):
    path = tmp_path / "a.rig.json"
    rig = Rig(compliance=3e-5, backlash=2e-5, rate_damping=50.0, sampling_rate=100.0, sensor_gain=-0.01, seed=4)
    write_rig(rig, path)
    assert json.loads(path.read_text(encoding="utf-8")) == {
        "schema": "tissue_sim/rig/1", "backlash_mm": 0.02, "compliance_mm_per_N": 0.03,
        "rate_damping_N_s_per_mm": 0.05, "sensor_gain": -0.01, "sampling_rate_Hz": 100.0, "seed": 4}
    path.write_text('{"schema": "tissue_sim/rig/1", "latency_s": 0.05, "contact_offset_mm": 1, "zero_offset_N": null}',
                    encoding="utf-8")
    assert load_rig(path) == Rig(latency=0.05, contact_offset=1e-3)
    path.write_text('{"schema": "tissue_sim/rig/1"}', encoding="utf-8")
    assert load_rig(path).is_ideal


@pytest.mark.parametrize(("text", "field", "words"), [
    ('{"schema": "tissue_sim/rig/1", "compliance_mm": 1}', "compliance_mm", "did you mean 'compliance_mm_per_N'?"),
    ('{"schema": "tissue_sim/rig/1", "backlash_mm": "much"}', "backlash_mm", "a number"),
    ('{"schema": "tissue_sim/rig/1", "backlash_mm": -1}', "backlash_mm", "must be 0 (absent) or positive"),
    ('{"schema": "tissue_sim/rig/1", "sampling_rate_Hz": 0}', "sampling_rate_Hz",
     "must be positive, or None; got 0 Hz"),
    ('{"schema": "tissue_sim/rig/1", "latency_s": 1e999}', "latency_s", "finite"),
    ('{"schema": "tissue_sim/rig/1", "seed": 1.5}', "seed", "whole number"),
    ('{"schema": "tissue_sim/rig/1", "seed": -1}', "seed", "must be an integer of 0 or more; got -1"),
    ('{"schema": "tissue_sim/rig/2"}', "schema", "newer version"),
    ('{"schema": "tissue_sim/material/1"}', "schema", "not a rig schema"),
    ('{"backlash_mm": 1}', "schema", "is missing"),
    ("[1]", None, "file must contain an object"),
    ('{"schema": "tissue_sim/rig/1",\n "backlash_mm": }', None, "damaged JSON"),
    ('{"schema": "tissue_sim/rig/1", "seed": 1, "seed": 2}', None, "key must appear once in an object; got 'seed'"),
])
def test_what_a_bad_file_says(tmp_path, text, field, words):
    path = tmp_path / "bad.rig.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ts.InputError) as caught:
        load_rig(path)
    assert caught.value.field == field and caught.value.file == path
    assert words in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(ts.InputError, match=r"none\.rig\.json"):
        load_rig(tmp_path / "none.rig.json")


def test_value_that_does_not_fit_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.rig.json"
    write_rig(Rig(backlash=1e-5), path)
    before = path.read_bytes()
    with pytest.raises(ts.InputError) as caught:
        write_rig(Rig(contact_offset=1e308), path)
    assert caught.value.field == "contact_offset_mm"
    assert path.read_bytes() == before and [entry.name for entry in tmp_path.iterdir()] == ["a.rig.json"]
