"""Air before contact and failure in the recordings of a campaign: warned of, found, stated, cut."""

import base64
import re

import numpy as np
import pytest

import calibration
import tissue_sim as ts

#: Parameter of the law, Pa.
C10 = 2000.0
AIR = 0.55e-3
#: Height, m.
HEIGHT = 10e-3
#: Radius, m.
RADIUS = 12.5e-3
TEXT = """
[[specimen]]
shape = "cylinder"
radius_mm = 12.5
height_mm = 10.0

[[test]]
kind = "lubricated_compression"
recordings = ["air_*.csv"]
max_strain = 0.1
{keys}

[fit]
laws = ["neo_hooke"]
"""


def compress(folder, *, fails=False, cycles=0):
    """Two compressions of a Neo-Hooke cylinder that begin in 0.55 mm of air."""
    way = np.concatenate([np.concatenate([np.linspace(0, 1e-3, 60), np.linspace(1e-3, 0, 60)])] * cycles
                         + [np.linspace(0.0, 2.5e-3, 250)])
    time = 0.1 * np.arange(way.size)
    depth = np.clip(way - AIR, 0.0, None)
    force = -ts.find_law("neo_hooke").nominal_stress(1 - depth / HEIGHT, {"C10": C10}) * np.pi * RADIUS**2
    if fails:
        force = np.where(time > time[-1] - 5, 0.3 * force, force)
    for number in (1, 2):
        read = force + 0.01 + np.random.default_rng(number).normal(0.0, 3e-3, time.size)
        ts.write_recording(ts.Recording({"time": time, "displacement": way, "force": read}),
                           folder / f"air_{number}.csv")


def fitted(folder, keys="", **options):
    path = folder / "study.toml"
    path.write_text(TEXT.format(keys=keys), encoding="utf-8")
    result, = calibration.calibrate([path], folder / "out", overwrite=True, **options)
    return result


@pytest.mark.slow
def test_a_fit_that_begins_in_air_is_warned_of(tmp_path):
    compress(tmp_path)
    result = fitted(tmp_path)
    assert result.best.E0 < 0.4 * 6 * C10
    assert re.search(r"the fit begins 0\.5[3-7]\d* mm before contact", result.message)
    assert 'contact = "find"' in result.message
    assert "1 more recording of this test" in result.message
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    section = page[page.index("<h2>Segments"):page.index("<h2>Assumptions")]
    assert "found: approach, ramp" in section and "moduli are too small" in section
    picture, = re.findall(r'base64,([^"]+)"', section)
    assert base64.b64decode(picture).startswith(b"\x89PNG")


@pytest.mark.parametrize(("keys", "share"), [('contact = "find"', 0.02), ("contact = 0.55", 0.04)])
def test_a_contact_that_is_found_or_stated_gives_the_modulus(tmp_path, keys, share):
    compress(tmp_path)
    result = fitted(tmp_path, keys, figures=False)
    assert pytest.approx(6 * C10, rel=share) == result.best.E0
    assert "before contact" not in result.message


def test_a_failure_is_cut_kept_or_refused(tmp_path):
    compress(tmp_path, fails=True)
    everything = 'contact = "find"\n'
    path = tmp_path / "study.toml"
    path.write_text(TEXT.format(keys=everything).replace("max_strain = 0.1\n", ""), encoding="utf-8")
    cut, = calibration.calibrate([path], tmp_path / "cut", figures=False)
    assert "the specimen ruptures" in cut.message and "fitted up to this sample" in cut.message
    assert pytest.approx(6 * C10, rel=0.02) == cut.best.E0
    for curve in calibration.read_measured_curves(calibration.load_campaign(path))["lubricated_compression"]:
        assert curve.displacement.max() == pytest.approx(2.5e-3 * (1 - 50 / 250) - AIR, abs=0.05e-3)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(everything, everything + 'failure = "keep"\n'), encoding="utf-8")
    kept, = calibration.calibrate([path], tmp_path / "kept", figures=False)
    assert "failure = 'keep'" in kept.message and kept.best.E0 < 0.9 * 6 * C10
    path.write_text(text.replace(everything, everything + 'failure = "refuse"\n'), encoding="utf-8")
    with pytest.raises(ts.InputError, match="ruptures") as caught:
        calibration.calibrate([path], tmp_path / "refused")
    assert caught.value.field == "test[0].failure" and not (tmp_path / "refused").exists()


def test_preconditioning_is_left_out_of_an_elastic_fit(tmp_path):
    compress(tmp_path, cycles=3)
    result = fitted(tmp_path, 'contact = "find"', figures=False)
    assert "preconditioning of cycle 4" in result.message and "left out" in result.message
    assert pytest.approx(6 * C10, rel=0.02) == result.best.E0
    campaign = calibration.load_campaign(tmp_path / "study.toml")
    curve = calibration.read_measured_curves(campaign)["lubricated_compression"][0]
    assert np.all(np.diff(curve.displacement) > 0) and curve.displacement[0] >= 0
    assert "before contact" not in result.message


@pytest.mark.parametrize(("keys", "problem"), [
    ('contact = "found"', "did you mean 'find'"), ("contact = nan", "must be a displacement"),
    ('failure = "cutt"', "did you mean 'cut'"), ("contact = 3.0", "ends before its contact")])
def test_keys_that_make_no_sense_are_refused(tmp_path, keys, problem):
    compress(tmp_path)
    with pytest.raises(ts.InputError, match=problem) as caught:
        fitted(tmp_path, keys)
    assert caught.value.field == f"test[0].{keys.split()[0]}" and not (tmp_path / "out").exists()


@pytest.mark.parametrize(("said", "warned"), [
    ({"kind": "bonded_compression"}, "the file states the kind bonded_compression; the fit uses "
                                     "lubricated_compression"),
    ({"tool": {"shape": "flat", "radius_mm": 6}}, "the file states a flat of 6 mm radius"),
    ({"kind": "lubricated_compression"}, None), ({"tool": "a nail"}, None)])
def test_a_recording_of_another_test_is_named(tmp_path, said, warned):
    compress(tmp_path)
    for path in tmp_path.glob("air_*.csv"):
        recording = ts.read_recording(path)
        ts.write_recording(recording.with_metadata(**said), path)
    result = fitted(tmp_path, 'contact = "find"', figures=False)
    assert (warned in result.message) if warned else ("the file states" not in result.message)
    assert pytest.approx(6 * C10, rel=0.02) == result.best.E0
