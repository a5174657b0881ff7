"""A law from one file: calibrated, written, simulated and felt."""

import numpy as np
import pytest

import calibration
import tissue_sim as ts

TRUTH = {"mu": 2800.0, "Jm": 3.0, "C2": 600.0}
#: Radius, m.
RADIUS = 0.040
#: Height, m.
HEIGHT = 0.070
CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
kind = "lubricated_compression"
recordings = ["run.csv"]

[fit]
laws = ["pucci_saccomandi"]
bulk_ratio = 10000.0
start = { mu = 2000.0, Jm = 10.0, C2 = 100.0 }

[noise]
force_N = 0.001
"""


def force(displacement):
    """Uniaxial stress 2 (W1 + W2/l) (l - l^-2) written out: 2 W1 = mu Jm/(Jm - I1 + 3), 2 W2 = 2 C2/I2."""
    stretch = 1 - displacement / HEIGHT
    I1, I2 = stretch**2 + 2 / stretch, 2 * stretch + stretch**-2
    slopes = TRUTH["mu"] * TRUTH["Jm"] / (TRUTH["Jm"] - I1 + 3) + 2 * TRUTH["C2"] / I2 / stretch
    return -slopes * (stretch - stretch**-2) * np.pi * RADIUS**2


@pytest.mark.slow
def test_law_of_one_file(plugin, registers, tmp_path):
    registers(ts.LAWS, plugin("pucci_saccomandi").LAW)
    displacement = np.linspace(0.0, 0.030, 61)
    ts.write_recording(ts.Recording({"displacement": displacement, "force": force(displacement)}), tmp_path / "run.csv")
    (tmp_path / "study.toml").write_text(CAMPAIGN, encoding="utf-8")
    result, = calibration.calibrate([tmp_path / "study.toml"], tmp_path / "out", figures=False)
    assert result.best.parameters == pytest.approx(TRUTH, rel=1e-6)

    material = ts.load_material(tmp_path / "out" / "pucci_saccomandi.material.json")
    experiment = ts.KINDS["lubricated_compression"].experiment(
        specimen=ts.Specimen(RADIUS, HEIGHT), protocol=ts.Protocol.ramp(0.010, 6))
    model = ts.Model(experiment, material)
    recording = ts.simulate(model)
    np.testing.assert_allclose(recording.force[1:], force(recording.displacement[1:]), rtol=1e-3)
    simulator = ts.Simulator(model, inertia="off")
    for depth in recording.displacement[1:]:
        answer = simulator.step(float(depth), 1.0)
    assert answer.force == pytest.approx(recording.force[-1], rel=1e-6)


def test_a_name_that_is_taken_is_refused(plugin, registers):
    law = registers(ts.LAWS, plugin("pucci_saccomandi").LAW)
    assert ts.register_law(law) is law
    with pytest.raises(ts.InputError, match="the name 'pucci_saccomandi' is taken by another law"):
        ts.register_law(type(law)())
    with pytest.raises(ts.InputError, match="'neo_hooke' is taken"):
        ts.LAWS.register(law, "neo_hooke")
    with pytest.raises(ts.InputError, match="is not a valid law; give an object"):
        ts.LAWS.register(type(law), "class")


def test_a_law_that_is_taken_out_is_unknown_again(plugin):
    ts.register_law(plugin("pucci_saccomandi").LAW)
    ts.LAWS.unregister("pucci_saccomandi")
    with pytest.raises(ts.InputError, match="unknown law 'pucci_saccomandi'"):
        ts.find_law("pucci_saccomandi")
