"""Signals with two explanations, and columns that a test does not need: what an import asks, keeps and leaves aside."""

import numpy as np
import pytest

import calibration
from tissue_sim.recording.contact import Contact

STRIP = "Tensile test\nWidth,20,mm\nThickness,2,mm\nGauge length,20,mm\n\n"
CYLINDER = "Compression test\nDiameter,20,mm\nHeight,12,mm\n\n"
HEADER = "Time (s),Displacement (mm),Force (N)\n"
MODULUS_PA = 20e3
RNG = np.random.default_rng(5)


def pull(way_mm, gauge_mm=20.0, area_mm2=40.0):
    """Force of a strip, N."""
    stretch = 1.0 + np.asarray(way_mm) / gauge_mm
    return 1e-6 * area_mm2 * MODULUS_PA * (stretch - stretch**-2)


def press(way_mm, height_mm=12.0):
    """Force of a cylinder of 20 mm diameter, N."""
    stretch = 1.0 - np.clip(way_mm, 0.0, None) / height_mm
    return 1e-4 * np.pi * MODULUS_PA * (stretch**-2 - stretch)


def imported(folder, head, columns, **wishes):
    rows = "".join(",".join(f"{value:.5f}" for value in row) + "\n" for row in zip(*columns, strict=True))
    (folder / "test.csv").write_text(head + rows)
    return calibration.import_files([folder / "test.csv"], folder / "c.toml",
                                    calibration.ImportOptions(laws=("neo_hooke",), **wishes), overwrite=True)


def fit(folder):
    result, = calibration.calibrate([folder / "c.toml"], folder / "r", figures=False, overwrite=True)
    return result.best


def creeping(noise):
    """A dead weight after a loading of 15 samples; the noise of the load is that of every sample, or of the loading."""
    time = np.arange(0.0, 100.0)
    load = np.minimum(0.03 * time, 0.4)
    way = np.interp(load, pull(np.linspace(0, 40, 4001)), np.linspace(0, 40, 4001))
    way = np.where(time > 14, way * (1 + 0.4 * (1 - np.exp(-(time - 14) / 20))), way)
    return time, way, load + np.where((time < 14) | (noise == "everywhere"), RNG.normal(0.0, 3e-4, time.size), 0.0)


def test_creep_under_a_measured_force_is_no_question(tmp_path):
    assert imported(tmp_path, STRIP + HEADER, creeping("everywhere")).questions == ()


def test_noise_that_ends_with_the_loading_shows_a_saturated_load_cell(tmp_path):
    found = imported(tmp_path, STRIP + HEADER, creeping("loading"))
    assert found.questions == () and any("a saturated sensor" in warning for warning in found.warnings)
    assert fit(tmp_path).mu0 == pytest.approx(MODULUS_PA, rel=0.01)


@pytest.mark.parametrize("control", [None, "force", "displacement"])
def test_a_held_force_without_noise_has_two_explanations(tmp_path, control):
    time, way, load = creeping("loading")
    # Few samples before the hold do not show the noise.
    columns = [np.append(values[:14:3], values[14:]) for values in (time, way, load)]
    found = imported(tmp_path, STRIP + HEADER, columns, test={} if control is None else {"control": control})
    if control is None:
        assert ["--control force" in each and "--control displacement" in each for each in found.questions] == [True]
        return
    assert found.is_complete and f'control = "{control}"' in found.text
    assert any("a saturated sensor" in warning for warning in found.warnings) == (control == "displacement")
    best = fit(tmp_path)
    assert best.unusable is None
    assert control == "force" or best.mu0 == pytest.approx(MODULUS_PA, rel=0.01)


def test_a_campaign_without_an_answer_is_not_usable(tmp_path):
    time, way, load = creeping("loading")
    columns = [np.append(values[:14:3], values[14:]) for values in (time, way, load)]
    found = imported(tmp_path, STRIP + HEADER, columns, test={"control": "force"})
    (tmp_path / "c.toml").write_text("\n".join(line for line in found.text.splitlines()
                                               if not line.startswith("control")))
    assert "the load cell is saturated" in (fit(tmp_path).unusable or "")


def with_air(noise, air=14, loading=100, drift=0.0, seed=0):
    """A plate that moves through air first, with the noise in N and the drift in N/s."""
    way = np.arange(-air, loading) * 0.05
    time = 0.1 * np.arange(way.size)
    return time, way + air * 0.05, press(way) + np.random.default_rng(seed).normal(0.0, noise, way.size) + drift * time


@pytest.mark.slow
@pytest.mark.parametrize("number", range(5))
def test_a_drift_that_the_air_does_not_show_is_not_extrapolated(tmp_path, number):
    found = imported(tmp_path, CYLINDER + HEADER, with_air(0.06, seed=number))
    assert 'contact = "find"' in found.text
    best = fit(tmp_path)
    assert best.unusable is None and best.mu0 == pytest.approx(MODULUS_PA, rel=0.02)


def test_a_drift_that_the_air_shows_is_taken_off(tmp_path):
    imported(tmp_path, CYLINDER + HEADER, with_air(0.003, air=60, drift=0.05))
    assert fit(tmp_path).mu0 == pytest.approx(MODULUS_PA, rel=0.02)


@pytest.mark.slow
def test_a_contact_that_is_not_known_well_enough_is_fitted_or_refused(tmp_path):
    found = imported(tmp_path, CYLINDER + HEADER, with_air(0.2, air=30, loading=60))
    assert 'offset = "fit"' in found.text
    best = fit(tmp_path)
    assert best.unusable is None and best.mu0 == pytest.approx(MODULUS_PA, rel=0.05)
    (tmp_path / "c.toml").write_text("\n".join(line for line in found.text.splitlines()
                                               if not line.startswith("offset")))
    assert "contact is known to be at" in (fit(tmp_path).unusable or "")


def test_a_contact_that_is_not_found_makes_a_misfit_unusable(tmp_path, monkeypatch):
    """The tool is in the air for a third of the motion; without this clause the modulus was half of the true one."""
    unclear = Contact("unclear", np.nan, (-np.inf, 3e-3))
    monkeypatch.setattr("tissue_sim.recording.segments.find_contact", lambda *arguments: unclear)
    found = imported(tmp_path, CYLINDER + HEADER, with_air(0.003, air=60))
    assert "contact" not in found.text.split("[[test]]")[1]
    assert "the force does not rise clearly before" in (fit(tmp_path).unusable or "")
    # The recorded displacement is measured from contact: the residuals are noise, which confirms it.
    imported(tmp_path, CYLINDER + HEADER, with_air(0.003, air=0))
    assert fit(tmp_path).unusable is None


@pytest.mark.parametrize("header", ["Time (s),Displacement (mm),Force (N),Temperature (quux)\n",
                                    "Time,Displacement,Force,Temperature\ns,mm,N,quux\n",
                                    "Temperature (quux),Time (s),Displacement (mm),Force (N)\n"])
def test_a_temperature_with_an_unknown_unit_is_left_aside(tmp_path, header):
    way = np.linspace(0.0, 3.0, 40)
    columns = [np.arange(40.0), way, press(way), 21 + RNG.random(40)]
    found = imported(tmp_path, CYLINDER + header, columns[-1:] + columns[:-1] if header[:4] == "Temp" else columns)
    assert found.is_complete and "Temperature" in found.files[0].readings[0].unused[0]
    assert fit(tmp_path).mu0 == pytest.approx(MODULUS_PA, rel=1e-3)


def test_an_unknown_unit_of_a_column_that_is_needed_is_asked_for(tmp_path):
    way = np.linspace(0.0, 3.0, 40)
    found = imported(tmp_path, CYLINDER + "Time,Displacement,Force\ns,quux,N\n", [np.arange(40.0), way, press(way)])
    assert not found.is_complete and any("--unit displacement" in each for each in found.missing)
