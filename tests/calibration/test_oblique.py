"""Campaigns of needles that are off the axis or at an angle: how they are stated, and that the solid fits them."""

import math

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.forward.meshes import MESHES, SolverFitResolutions
from tissue_sim.fem.solid.discretisation import RESOLUTIONS, Resolution
from tissue_sim.mesh.solid_element import HEX8P0

TRUE = {"C10": 1404.9, "C20": 699.4}
CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 50.0

[[test]]
kind = "needle_indentation"
recordings = ["needle.csv"]
tool = "flat"
tool_radius_mm = 8.0
{way}

[fit]
method = "inverse_fem"
laws = ["reduced_polynomial_2"]
bulk_ratio = 1000.0
starts = 1

[noise]
force_N = 0.001
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
"""
OBLIQUE = 'solver = "solid"\noffset_mm = 5.0\ntilt_deg = 20.0'


@pytest.fixture
def coarse(monkeypatch):
    """One mesh of 600 freedoms for everything."""
    monkeypatch.setitem(RESOLUTIONS, "coarse", Resolution(HEX8P0, 0.5, 2.5, 3.8, 2))
    monkeypatch.setitem(MESHES, "solid", SolverFitResolutions("coarse", "coarse"))


def load(folder, way):
    (folder / "study.toml").write_text(CAMPAIGN.format(way=way), encoding="utf-8")
    return calibration.load_campaign(folder / "study.toml")


def experiment(depth=8e-3):
    return ts.Experiment(ts.Specimen(0.04, 0.05), ts.Protocol.ramp(depth, 9), tool=ts.Tool("flat", radius=8e-3),
                         approach=ts.Approach(5e-3, math.radians(20.0)))


@pytest.fixture
def folder(tmp_path):
    ts.write_recording(ts.Recording({"displacement": np.linspace(0.0, 8e-3, 21), "force": np.linspace(0.0, 1.0, 21)}),
                       tmp_path / "needle.csv")
    return tmp_path


def test_a_campaign_states_how_the_needle_comes(folder):
    test, = load(folder, OBLIQUE).tests
    assert test.solver == "solid" and test.experiment is not None
    assert test.experiment.approach.offset == pytest.approx(5e-3)
    assert test.experiment.approach.angle == pytest.approx(math.radians(20.0))
    test, = load(folder, "").tests
    assert test.solver == "axisymmetric" and test.experiment.approach is None


@pytest.mark.parametrize(("way", "field", "words"), [
    ("offset_mm = 5.0", "test[0].offset_mm", "requires solver = 'solid'"),
    ('solver = "solud"', "test[0].solver", "did you mean 'solid'"),
    ('solver = "solid"\noffset_mm = 35.0', "test[0].offset_mm", "reaches beyond the specimen"),
    ('solver = "solid"\ntilt_deg = 85.0', "test[0].tilt_deg", "85 degrees"),
    ("friction = 0.3", "test[0].edge_radius_mm", "Give edge_radius_mm"),
    ('solver = "solid"\nfriction = "bonded"\nslide_mm = 1.0', "test[0].slide_mm", "unknown")])
def test_what_does_not_fit_is_refused_with_its_field(folder, way, field, words):
    with pytest.raises(ts.InputError) as caught:
        load(folder, way)
    assert caught.value.field == field and words in str(caught.value)


@pytest.mark.slow
def test_the_solid_finds_the_moduli(tmp_path, coarse):
    """What is measured is the force against the way of the needle; that along z is 6 % larger or smaller."""
    material = ts.Material("reduced_polynomial_2", TRUE, ts.Bulk("bulk_ratio", 1e3))
    true = ts.simulate(ts.Model(experiment(), material), solver="solid", resolution="coarse")
    curve = np.polynomial.Polynomial.fit(true.displacement, true.force, 6)
    displacement = np.linspace(0.0, 8e-3, 81)
    noise = 0.001 * np.random.default_rng(3).normal(size=81)
    ts.write_recording(ts.Recording({"time": displacement / 0.25e-3, "displacement": displacement,
                                     "force": curve(displacement) + noise}), tmp_path / "needle.csv")
    load(tmp_path, OBLIQUE)
    result, = calibration.calibrate([tmp_path / "study.toml"], tmp_path / "out", figures=False)
    for name, value in TRUE.items():
        assert result.best.parameters[name] == pytest.approx(value, abs=4.0 * result.best.standard_errors[name])
    assert result.best.parameters["C10"] == pytest.approx(TRUE["C10"], rel=0.01)
