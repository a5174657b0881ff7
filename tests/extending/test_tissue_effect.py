"""An effect of the tissue in reduced form from one file: material file, simulation, campaign, simulator."""

import json
import math

import numpy as np
import pytest

import tissue_sim as ts
from scenes import SCENES
from scenes.cli import main
from tissue_sim.material.effect import EFFECTS
from tissue_sim.parameters import parameters

LOST = 0.3
TIME = 4.0


@pytest.fixture
def seepage(plugin, registers):
    return registers(EFFECTS, plugin("seepage").Seepage)


def material(*effects):
    return ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4),
                       effects=effects)


def model(tissue, scene="needle_indentation", points=5):
    protocol = ts.Protocol.parse("ramp 4mm @1mm/s; hold 10s", points=points)
    experiment = SCENES[scene].experiment(specimen=ts.Specimen(0.04, 0.07), protocol=protocol)
    return ts.Model(experiment, tissue)


def test_it_goes_through_a_material_file(seepage, tmp_path):
    path = tmp_path / "m.material.json"
    tissue = material(seepage(LOST, TIME))
    file = ts.MaterialFile.of(tissue, standard_errors={"effects.seepage.time": 0.5})
    ts.write_material_file(file, path)
    data = json.loads(path.read_text(encoding="utf-8"))
    assert data["effects"] == {"seepage": {"share_lost": LOST, "time_s": TIME, "standard_errors": {"time_s": 0.5}}}
    again = ts.read_material_file(path)
    assert again.material == tissue and again.standard_errors == {"effects.seepage.time": 0.5}
    assert main(["material", "show", str(path), "--json"]) == 0


def test_a_file_with_an_effect_that_nobody_knows_is_refused(plugin, tmp_path):
    path = tmp_path / "m.material.json"
    kind = plugin("seepage").Seepage
    EFFECTS.register(kind)
    ts.write_material_file(ts.MaterialFile.of(material(kind(LOST, TIME))), path)
    EFFECTS.unregister("seepage")
    with pytest.raises(ts.InputError, match=r"effects\.seepage: must be the name of a registered effect"):
        ts.load_material(path)


def test_the_force_is_what_it_leaves(seepage):
    plain, seeping = (ts.simulate(model(material(*effects))) for effects in ((), (seepage(LOST, TIME),)))
    left = 1.0 - LOST * -np.expm1(-plain.time / TIME)
    np.testing.assert_allclose(seeping.force, left * plain.force, rtol=1e-12)
    plates = [ts.simulate(model(material(*effects), "bonded_compression")).force
              for effects in ((), (seepage(LOST, TIME),))]
    np.testing.assert_array_equal(*plates)


def test_its_parameters_are_those_of_the_model(seepage):
    tissue = model(material(seepage(LOST, TIME)))
    found = parameters(tissue)["material.effects.seepage.time"]
    assert (found.value, found.symbol, found.path_in_file) == (TIME, "tau_s", "material.effects.seepage.time_s")
    answer = ts.sensitivities(tissue, ["effects.seepage.share_lost", "C10"])
    assert answer.exact.tolist() == [False, True]
    plain = ts.simulate(model(material()))
    np.testing.assert_allclose(answer.values[:, 0], np.expm1(-plain.time / TIME) * plain.force, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_campaign_fits_it(seepage, tmp_path):
    recording = ts.simulate(model(material(seepage(LOST, TIME)), points=81))
    time = np.linspace(0.0, recording.time[-1], 141)
    noise = np.random.default_rng(2).normal(0.0, 2e-3, time.size)
    dense = ts.Recording({"time": time, "displacement": np.interp(time, recording.time, recording.displacement),
                          "force": np.interp(time, recording.time, recording.force) + noise})
    ts.write_recording(dense, tmp_path / "needle.csv")
    (tmp_path / "c.toml").write_text("""
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "needle_indentation"
recordings = ["needle.csv"]
tool = "flat"
tool_radius_mm = 8.0
[fit]
method = "inverse_fem"
laws = ["reduced_polynomial_2"]
starts = 1
start = { "effects.seepage.share_lost" = 0.1, "effects.seepage.time_s" = 8.0 }
[noise]
force_N = 0.002
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
""", encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "c.toml"), "-o", str(tmp_path / "out")]) == 0
    fit, = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]
    assert fit["parameters"]["effects.seepage.share_lost"] == pytest.approx(LOST, abs=0.02)
    assert fit["parameters"]["effects.seepage.time"] == pytest.approx(TIME, rel=0.1)
    calibrated = ts.load_material(tmp_path / "out" / fit["material_file"])
    assert calibrated.effects["seepage"].time == fit["parameters"]["effects.seepage.time"]


def test_the_simulator_lets_it_act(seepage):
    simulators = [ts.Simulator(model(material(*effects)), inertia="off") for effects in ((), (seepage(LOST, TIME),))]
    for _ in range(20):
        plain, seeping = (simulator.step(2e-3, 0.1) for simulator in simulators)
    assert seeping.force == pytest.approx((1.0 - LOST * -math.expm1(-2.0 / TIME)) * plain.force, rel=1e-12)
    saved = simulators[1].save()
    later = simulators[1].step(2e-3, 1.0).force
    simulators[1].restore(saved)
    assert simulators[1].step(2e-3, 1.0).force == later
    simulators[1].set_parameters(**{"effects.seepage.share_lost": 0.0})
    assert simulators[1].step(2e-3, 0.1).force == pytest.approx(plain.force, rel=1e-9)


def test_a_name_that_is_taken_is_refused(seepage, plugin):
    class Other(seepage):
        pass

    with pytest.raises(ts.InputError, match="'seepage' is taken"):
        EFFECTS.register(Other)
