"""Faults of a rig from one file: rig file, simulation with and without a solve; and an unknown one is refused."""

import json

import numpy as np
import pytest

import tissue_sim as ts
from scenes import SCENES
from scenes.cli import main
from tissue_sim.parameters import parameters
from tissue_sim.rig.fault import FAULTS


@pytest.fixture
def worn(plugin, registers):
    module = plugin("worn_sensor")
    registers(FAULTS, module.SoftSensor)
    registers(FAULTS, module.WanderingPitch)
    return module


def model(*faults, **fields):
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = SCENES["needle_indentation"].experiment(specimen=ts.Specimen(0.04, 0.07),
                                                         protocol=ts.Protocol.ramp(6e-3, 13))
    return ts.Model(experiment, material, ts.Rig(**fields, faults=faults))


def test_it_goes_through_a_rig_file(worn, tmp_path):
    rig = ts.Rig(compliance=2e-5, faults=[worn.SoftSensor(0.05), worn.WanderingPitch(2e-5, 1e-3)])
    ts.write_rig(rig, tmp_path / "r.rig.json")
    data = json.loads((tmp_path / "r.rig.json").read_text(encoding="utf-8"))
    assert data["faults"] == {"soft_sensor": {"softness_per_N": 0.05},
                              "wandering_pitch": {"amplitude_mm": 0.02, "pitch_mm": 1.0}}
    assert ts.load_rig(tmp_path / "r.rig.json") == rig


@pytest.mark.parametrize(("faults", "field", "words"), [
    ({"soft_sensr": {"softness_per_N": 0.1}}, "faults.soft_sensr", "did you mean 'soft_sensor'"),
    ({"soft_sensor": {"softness": 0.1}}, "faults.soft_sensor.softness", "did you mean 'softness_per_N'"),
    ({"wandering_pitch": {"pitch_mm": 1.0}}, "faults.wandering_pitch", "needs amplitude_mm")])
def test_what_is_wrong_in_the_file_is_said(worn, tmp_path, faults, field, words):
    path = tmp_path / "r.rig.json"
    path.write_text(json.dumps({"schema": "tissue_sim/rig/1", "faults": faults}), encoding="utf-8")
    with pytest.raises(ts.InputError, match=words) as caught:
        ts.load_rig(path)
    assert caught.value.field == field


def test_an_unknown_fault_is_refused_and_not_dropped(tmp_path, capsys):
    (tmp_path / "r.rig.json").write_text(json.dumps({"schema": "tissue_sim/rig/1", "faults": {"gremlins": {"n": 3}}}),
                                         encoding="utf-8")
    ts.write_material_file(ts.MaterialFile.of(model().material), tmp_path / "m.material.json")
    assert main(["simulate", "needle_indentation", "--material", str(tmp_path / "m.material.json"), "--rig",
                 str(tmp_path / "r.rig.json")]) == 2
    assert "unknown fault of a rig 'gremlins'" in capsys.readouterr().err


def test_what_it_does_to_the_reading(worn):
    plain, read = ts.simulate(model()), ts.simulate(model(worn.SoftSensor(0.05)))
    np.testing.assert_allclose(read.force, plain.force / (1 + 0.05 * plain.force), rtol=1e-12)


def test_what_it_does_to_the_motion(worn):
    pitch = worn.WanderingPitch(5e-5, 2.6e-3)
    rig = ts.Rig(faults=[pitch])
    solved, plain = ts.simulate(model(pitch)), ts.simulate(model())
    elsewhere = ts.Protocol(plain.time, pitch.tool_motion(plain.displacement))
    there = ts.simulate(ts.Model(SCENES["needle_indentation"].experiment(specimen=ts.Specimen(0.04, 0.07),
                                                                         protocol=elsewhere), model().material))
    np.testing.assert_allclose(solved.force, there.force, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rig.apply_motion_effects(plain).force, solved.force, atol=2e-3 * plain.force.max())


def test_parts_of_the_rig_keep_what_is_theirs(worn):
    rig = ts.Rig(sensor_gain=0.1, compliance=1e-5, force_noise=0.1,
                 faults=[worn.SoftSensor(0.05), worn.WanderingPitch(2e-5, 1e-3)])
    moving, reading, exact = rig.with_motion_effects_only, rig.with_reading_effects_only, rig.without_sampling_effects
    assert set(moving.faults) == {"wandering_pitch"} and moving.compliance == 1e-5
    assert set(reading.faults) == {"soft_sensor"} and reading.sensor_gain == 0.1
    assert set(exact.faults) == set(rig.faults) and exact.force_noise == 0.0


def test_its_parameters_are_those_of_the_model(worn):
    found = parameters(model(worn.WanderingPitch(2e-5, 1e-3)))["rig.faults.wandering_pitch.amplitude"]
    assert (found.value, found.symbol, found.declaration.absent) == (2e-5, "w", 0.0)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_campaign_fits_it_beside_the_material(worn, tmp_path):
    """The plates, read by a good sensor, tell the modulus; the tool how far its sensor gives way."""
    depth, rng = np.linspace(0.0, 6e-3, 61), np.random.default_rng(5)
    for kind, faults in (("bonded_compression", ()), ("needle_indentation", [worn.SoftSensor(0.05)])):
        experiment = SCENES[kind].experiment(specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(6e-3, 31))
        curve = ts.simulate(ts.Model(experiment, model().material, ts.Rig(faults=faults)))
        ts.write_recording(ts.Recording({
            "displacement": depth, "force": np.interp(depth, curve.displacement, curve.force)
            + rng.normal(0.0, 1e-3, depth.size)}), tmp_path / f"{kind}.csv")
    ts.write_rig(ts.Rig(faults=[worn.SoftSensor(0.01)]), tmp_path / "tool.rig.json")
    (tmp_path / "c.toml").write_text("""
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "bonded_compression"
recordings = ["bonded_compression.csv"]
[[test]]
kind = "needle_indentation"
recordings = ["needle_indentation.csv"]
tool = "flat"
tool_radius_mm = 8.0
rig = "tool.rig.json"
[fit]
method = "inverse_fem"
laws = ["reduced_polynomial_2"]
starts = 1
start = { C10 = 1300.0, C20 = 600.0, "rig.faults.soft_sensor.softness_per_N" = 0.02 }
scope = { "rig.faults.soft_sensor.softness_per_N" = ["needle_indentation"] }
[noise]
force_N = 0.001
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
""", encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "c.toml"), "-o", str(tmp_path / "out")]) == 0
    fit, = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]
    name, = (each for each in fit["parameters"] if each.startswith("rig."))
    assert fit["parameters"][name] == pytest.approx(0.05, abs=0.003) and fit["parameters"]["C10"] == pytest.approx(
        1404.9, rel=0.01)
    assert fit["derivatives"][name] == "difference" and fit["derivatives"]["C10"] == "exact"


def test_a_name_that_is_taken_is_refused(worn):
    class Other(worn.SoftSensor):
        pass

    with pytest.raises(ts.InputError, match="'soft_sensor' is taken"):
        FAULTS.register(Other)
