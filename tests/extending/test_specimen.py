"""A shape of specimen from one file: simulated in space, by flags, and refused where no solid in space is taken."""

import json
import pickle

import pytest

import calibration
import tissue_sim as ts
from scenes.cli import main

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
SIZES = {"length": 0.02, "base_length": 0.03, "width": 0.02, "height": 0.02}
WORDS = ["simulate", "bonded_compression", "--solid", "--shape", "wedge", "--length-mm", "20", "--base-length-mm", "30",
         "--width-mm", "20", "--height-mm", "20", "--depth-mm", "1", "--points", "2", "--json"]


@pytest.fixture
def wedge(plugin, registers):
    return registers(ts.SPECIMENS, plugin("wedge").Wedge, "wedge")


def model(specimen):
    return ts.Model(ts.KINDS["bonded_compression"].experiment(specimen=specimen, protocol=ts.Protocol.ramp(1e-3, 2)),
                    MATERIAL)


def pressed(specimen, resolution="realtime"):
    return ts.simulate(model(specimen), solver="solid", resolution=resolution).force[-1]


@pytest.mark.slow
def test_shape_of_one_file(wedge, tmp_path, capsys):
    specimen = ts.Specimen(shape="wedge", **SIZES)
    assert isinstance(specimen, wedge) and pickle.loads(pickle.dumps(specimen)) == specimen
    force = pressed(specimen)
    # Between the blocks of its top and of its base.
    assert 1.02 * pressed(ts.Block(0.02, 0.02, 0.02)) < force < 0.98 * pressed(ts.Block(0.03, 0.02, 0.02))
    path = tmp_path / "m.material.json"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), path)
    assert main([*WORDS, "--material", str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["force_N"][-1] == pytest.approx(pressed(specimen, "fast"), rel=1e-9)
    assert main([*WORDS[:3], *WORDS[5:], "--material", str(path)]) == 2
    assert "a cylinder has no length; leave it out" in capsys.readouterr().err
    longer = ts.with_values(model(specimen), {"experiment.specimen.base_length": 0.04}).experiment.specimen
    assert longer == wedge(0.02, 0.04, 0.02, 0.02)


def test_no_closed_form_and_no_axis(wedge, tmp_path):
    with pytest.raises(ts.InputError, match=r"requires a cylinder; the specimen is a wedge; .*--solid"):
        ts.simulate(model(ts.Specimen(shape="wedge", **SIZES)))
    (tmp_path / "run.csv").write_text("displacement [mm],force [N]\n0,0\n1,1\n2,2\n", encoding="utf-8")
    path = tmp_path / "study.toml"
    path.write_text("""
[[specimen]]
shape = "wedge"
length_mm = 20.0
base_length_mm = 30.0
width_mm = 20.0
height_mm = 20.0

[[test]]
kind = "lubricated_compression"
recordings = ["run.csv"]

[fit]
laws = ["neo_hooke"]
""", encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"test\[0\]\.specimen.*'specimen' is a wedge.* no closed form"):
        calibration.load_campaign(path)
    text = path.read_text(encoding="utf-8").replace("[fit]", '[fit]\nmethod = "inverse_fem"')
    path.write_text(text, encoding="utf-8")
    test, = calibration.load_campaign(path).tests
    assert test.solver == "solid" and test.specimen == wedge(**SIZES)


def test_a_name_that_is_taken_is_refused(wedge):
    with pytest.raises(ts.InputError, match="the name 'block' is taken by another specimen shape"):
        ts.SPECIMENS.register(wedge, "block")
    with pytest.raises(ts.InputError, match="give a frozen dataclass derived from Specimen"):
        ts.SPECIMENS.register(object, "thing")
