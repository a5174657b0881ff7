"""Moduli from raw files with outliers, saturation, preloads, creep, relaxation or oscillation."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

import calibration
from calibration.importing.imported import make_json_dictionary_of_import
from calibration.importing.motion import list_signal_based_assumptions
from tissue_sim.errors import InputError
from tissue_sim.recording.curve_units import FORCE_UNITS, TORQUE_UNITS

HEAD = "Compression test\nDiameter,20,mm\nHeight,12,mm\n\nTime (s),Displacement (mm),Force (N)\n"
TIME = np.arange(66) * 0.08
WAY = 0.5 * TIME


def force(way, height=12.0, area=np.pi * 100):
    stretch = 1 - np.clip(way, 0, None) / height
    return area * 0.02 * (stretch**-2 - stretch)


def relaxed(time, load, fraction, constant):
    """The force of a material with one Prony term."""
    found, memory = load.copy(), load[0]
    for i in range(1, load.size):
        ratio = (time[i] - time[i - 1]) / constant
        memory = np.exp(-ratio) * memory + (1 - np.exp(-ratio)) / ratio * (load[i] - load[i - 1])
        found[i] = (1 - fraction) * load[i] + fraction * memory
    return found


def noise(size, deviation=0.01):
    return np.random.default_rng(7).normal(0.0, deviation, size)


def write(folder, way, load, time=TIME, head=HEAD, name="gel.csv"):
    path = folder / name
    path.write_text(head + "".join(f"{t:.3f},{w:.4f},{f:.4f}\n" for t, w, f in zip(time, way, load, strict=True)))
    return path


def wishes(**stated):
    return calibration.ImportOptions(laws=("neo_hooke",), **stated)


def imported_and_fitted(folder, path, **stated):
    imported = calibration.import_files([path], folder / "gel.toml", wishes(**stated))
    result, = calibration.calibrate([folder / "gel.toml"], folder / "out", figures=False)
    return imported, result.fits[0]


def changed(values, samples, value):
    values = values.copy()
    values[samples] = value
    return values


@pytest.mark.slow
@pytest.mark.parametrize(("way", "load", "samples"), [
    (changed(WAY, 0, -0.7), force(WAY), [1]), (WAY, changed(force(WAY), 0, 5.0), [1]),
    (WAY, changed(force(WAY), [30, 65], [0.0, 0.0]), [31, 66]), (changed(WAY, 30, 9.0), force(WAY), [31])])
def test_outliers_are_listed_in_the_campaign_and_do_not_move_the_modulus(tmp_path, way, load, samples):
    imported, fit = imported_and_fitted(tmp_path, write(tmp_path, way, load + noise(TIME.size)))
    assert f"leave_out = {samples}" in imported.text and imported.is_complete
    assert f"sample {samples[0]} left out" in imported.warnings[0]
    assert fit.mu0 == pytest.approx(20e3, rel=0.01)
    columns = {column.channel: column for column in imported.files[0].readings[0].columns}
    assert columns["displacement"].sign == columns["force"].sign == 1 and columns["displacement"].offset is None


def test_a_campaign_by_hand_leaves_out_the_same_samples(tmp_path):
    path = write(tmp_path, WAY, changed(force(WAY), 30, 50.0) + noise(TIME.size))
    imported, fit = imported_and_fitted(tmp_path, path)
    text = "\n".join(line for line in imported.text.splitlines() if "leave_out" not in line)
    (tmp_path / "hand.toml").write_text(text)
    result, = calibration.calibrate([tmp_path / "hand.toml"], tmp_path / "hand", figures=False)
    assert result.fits[0].parameters == fit.parameters
    assert "sample 31 left out" in result.message


def test_leave_out_names_recordings_and_samples_that_exist(tmp_path):
    paths = [write(tmp_path, WAY, changed(force(WAY), k, 50.0) + noise(TIME.size), name=f"gel_{k}.csv") for k in (1, 2)]
    imported = calibration.import_files(paths, tmp_path / "gel.toml", wishes())
    assert "leave_out = { gel_1 = [2], gel_2 = [3] }" in imported.text
    for wrong, message in (("{ gel_9 = [2] }", "must name a recording"), ("[2]", "must name the recording"),
                           ("{ gel_1 = [99] }", "from 1 to 66"), ("{ gel_1 = [0] }", "at least 1")):
        (tmp_path / "wrong.toml").write_text(imported.text.replace("{ gel_1 = [2], gel_2 = [3] }", wrong))
        with pytest.raises(InputError, match=message):
            calibration.calibrate([tmp_path / "wrong.toml"], tmp_path / "wrong")


def test_a_saturated_load_cell_is_cut_off(tmp_path):
    imported, fit = imported_and_fitted(tmp_path, write(tmp_path, WAY, np.minimum(force(WAY) + noise(TIME.size), 4.0)))
    assert any("stays at 4 N" in warning for warning in imported.warnings)
    assert fit.mu0 == pytest.approx(20e3, rel=0.01)


@pytest.mark.parametrize("shift", [0.2, 0.4, 0.8])
def test_a_displacement_zeroed_at_a_preload(tmp_path, shift):
    imported, fit = imported_and_fitted(tmp_path, write(tmp_path, WAY, force(WAY + shift) + noise(TIME.size)))
    assert imported.is_complete and 'offset = "fit"' in imported.text
    assert fit.mu0 == pytest.approx(20e3, rel=0.02)
    assert abs(fit.parameters["C10"] - 10e3) < 3 * fit.standard_errors["C10"]


@pytest.mark.parametrize("offset", [-0.2, -0.65])
def test_a_force_against_the_load_is_the_zero_of_the_load_cell(tmp_path, offset):
    imported, fit = imported_and_fitted(tmp_path, write(tmp_path, WAY, force(WAY) + offset + noise(TIME.size)))
    assert imported.is_complete and not imported.questions and "offset = 0." in imported.text
    assert any(each.subject == "zero of displacement and force" for _, each in imported.assumptions)
    assert fit.mu0 == pytest.approx(20e3, rel=0.01)


@pytest.mark.parametrize("offset", [-0.65, 0.65])
def test_a_campaign_by_hand_with_a_load_cell_that_was_not_zeroed_is_not_usable(tmp_path, offset):
    path = write(tmp_path, WAY, force(WAY) + offset + noise(TIME.size))
    imported = calibration.import_files([path], tmp_path / "gel.toml", wishes())
    text = re.sub(r", offset = -?[0-9.]+", "", imported.text)
    (tmp_path / "hand.toml").write_text(text)
    result, = calibration.calibrate([tmp_path / "hand.toml"], tmp_path / "hand", figures=False)
    assert "the load cell was not zeroed" in result.message
    assert result.fits[0].unusable is not None


@pytest.mark.slow
def test_a_load_cell_that_was_not_zeroed(tmp_path):
    imported, fit = imported_and_fitted(tmp_path, write(tmp_path, WAY, force(WAY) + 0.65 + noise(TIME.size)))
    assert imported.is_complete and "offset = -0.6" in imported.text
    assert fit.mu0 == pytest.approx(20e3, rel=0.01)


def test_a_load_that_may_jump_from_zero_is_a_question(tmp_path):
    load = force(WAY) + 20.0 + noise(TIME.size)
    path = write(tmp_path, WAY, changed(load, 0, -0.01))
    imported = calibration.import_files([path], tmp_path / "gel.toml", wishes())
    assert not imported.is_complete and "--zero sensor" in imported.questions[0]
    against, = (each.against for _, each in imported.assumptions if each.subject == "zero of displacement and force")
    assert "the load cell was zeroed and the force jumps" in against[0]


@pytest.mark.slow
def test_a_load_at_zero_that_the_curve_does_not_explain_is_a_question(tmp_path):
    path = write(tmp_path, WAY, force(WAY + 0.4) + noise(TIME.size, 0.05))
    imported = calibration.import_files([path], tmp_path / "gel.toml", wishes())
    assert not imported.is_complete and "--zero preload" in imported.questions[0]
    (tmp_path / "stated").mkdir()
    imported, fit = imported_and_fitted(tmp_path / "stated", path, zero="preload")
    assert imported.is_complete and fit.mu0 == pytest.approx(20e3, rel=0.05)


@pytest.mark.slow
def test_a_campaign_by_hand_names_the_preload_and_widens_the_prior_of_the_offset(tmp_path):
    path = write(tmp_path, WAY, force(WAY + 0.4) + noise(TIME.size))
    imported = calibration.import_files([path], tmp_path / "gel.toml", wishes())
    lines = [line for line in imported.text.splitlines() if "offset" not in line]
    (tmp_path / "none.toml").write_text("\n".join(lines))
    result, = calibration.calibrate([tmp_path / "none.toml"], tmp_path / "none", figures=False)
    assert 'set offset = "fit" and offset_prior_mm' in result.message
    (tmp_path / "fit.toml").write_text("\n".join([*lines, 'offset = "fit"']))
    result, = calibration.calibrate([tmp_path / "fit.toml"], tmp_path / "fit", figures=False)
    assert result.fits[0].mu0 == pytest.approx(20e3, rel=0.02)


def test_a_relaxing_staircase_gets_a_prony_term(tmp_path):
    time = np.arange(0.0, 180.0)
    way = 0.6 * (np.floor(time / 60) + np.clip((time % 60) / 5, 0, 1))
    imported, fit = imported_and_fitted(tmp_path, write(
        tmp_path, way, relaxed(time, force(way), 0.5, 15.0) + noise(time.size, 0.005), time))
    assert "viscoelastic.terms[0].g" in imported.text
    assert any("relaxes in holds" in warning for warning in imported.warnings)
    assert fit.mu0 == pytest.approx(20e3, rel=0.02)


def test_creep_is_not_fitted_by_an_elastic_law(tmp_path):
    head = "Tensile creep\nWidth,20,mm\nThickness,2,mm\nGauge length,20,mm\n\nTime (s),Displacement (mm),Force (N)\n"
    time = np.arange(0.0, 200.0)
    way = np.where(time > 0, 2.8 * (1 + 0.6 * (1 - np.exp(-time / 20))), 0.0)
    path = write(tmp_path, way, np.where(time > 0, 0.3, 0.0) + noise(time.size, 0.001), time, head)
    imported = calibration.import_files([path], tmp_path / "gel.toml", wishes())
    assert any("the force is held and the displacement creeps" in warning for warning in imported.warnings)
    assert "viscoelastic.terms[0].g" in imported.text
    elastic = "\n".join(line for line in imported.text.splitlines() if not line.startswith("start"))
    (tmp_path / "elastic.toml").write_text(elastic)
    with pytest.raises(InputError, match="an elastic law cannot describe it"):
        calibration.calibrate([tmp_path / "elastic.toml"], tmp_path / "elastic")


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("ramp", [False, True])
def test_elastic_oscillations_give_the_modulus(tmp_path, ramp, sign):
    time = np.arange(0.0, 10.0 if ramp else 5.0, 0.05)
    way = 1.0 + 0.2 * np.sin(2 * np.pi * time)
    way = np.where(time < 5, 0.2 * time, way) if ramp else way
    imported, fit = imported_and_fitted(tmp_path, write(tmp_path, sign * way, sign * (force(way) + noise(time.size)),
                                                        time))
    assert fit.mu0 == pytest.approx(20e3, rel=0.015)
    assert any("oscillation" in each.value for _, each in imported.assumptions)


def test_an_oscillation_out_of_phase_is_refused(tmp_path):
    time = np.arange(0.0, 5.0, 0.02)
    way, load = 1.0 + 0.2 * np.sin(2 * np.pi * time), 2.0 + 0.4 * np.sin(2 * np.pi * time + 0.2)
    imported = calibration.import_files([write(tmp_path, way, load, time)], tmp_path / "gel.toml", wishes())
    assert not imported.is_complete and "oscillation" in imported.problem
    assert "oscillation" in make_json_dictionary_of_import(imported)["problem"]


def test_a_wrong_first_displacement_before_a_sudden_load_leaves_the_zero_open(tmp_path):
    time = np.arange(0.0, 160.0)
    level = 1.0 + np.floor(time / 40)
    way = np.where(time > 0, 0.6 * level * (1 + 0.2 * (1 - np.exp(-(time % 40) / 8))), -5.0)
    load = np.where(time > 0, force(0.6 * level), 0.0) + noise(time.size, 0.001)
    imported = calibration.import_files([write(tmp_path, way, load, time)], tmp_path / "gel.toml", wishes())
    assert not imported.is_complete and "the zero of the displacement is not known" in imported.problem


def test_the_verdict_names_columns_that_are_not_used_and_a_preload_that_the_contact_covers(tmp_path):
    head = HEAD.replace("Force (N)", "Force (N),Room (degC),LVDT 3 (V)")
    path = tmp_path / "gel.csv"
    load = force(WAY + 0.1) + noise(WAY.size, 0.002)
    path.write_text(head + "".join(f"{t:.3f},{w:.4f},{f:.4f},20.5,{0.3 * t:.3f}\n"
                                   for t, w, f in zip(TIME, WAY, load, strict=True)))
    calibration.import_files([path], tmp_path / "gel.toml", wishes())
    result, = calibration.calibrate([tmp_path / "gel.toml"], tmp_path / "out", figures=False)
    assert "columns that are not used: 'LVDT 3 (V)'" in result.message
    assert re.search(r"zeroed at a preload of [\d.]+ N; the fitted contact offset of -0\.\d+ mm covers it",
                     result.message)
    assert "the moduli are wrong" not in result.message and "or the load cell was not zeroed" not in result.message


@pytest.mark.parametrize("channel", ["displacement", "force"])
def test_a_wrong_first_sample_keeps_the_zero_of_a_position(tmp_path, channel):
    position, load = 15.0 - WAY, force(WAY) + noise(TIME.size)
    values = (changed(position, 0, 9999.0), load) if channel == "displacement" else (position, changed(load, 0, 9999.0))
    imported, fit = imported_and_fitted(tmp_path, write(tmp_path, *values))
    assert "leave_out = [1]" in imported.text and 'offset = "start"' in imported.text
    assert fit.mu0 == pytest.approx(20e3, rel=0.01)


def test_a_lost_loading_of_a_creeping_material_is_not_fitted(tmp_path):
    time = np.arange(0.0, 60.0, 0.5)
    way = np.where(time > 0, 1.2 * (1 + 0.4 * (1 - np.exp(-time / 12))), 0.0)
    load = np.where(time > 0, force(1.2), 9999.0) + noise(time.size, 0.01)
    imported = calibration.import_files([write(tmp_path, way, load, time)], tmp_path / "gel.toml", wishes())
    assert not imported.is_complete and "the loading from rest must be recorded" in imported.problem


@pytest.mark.parametrize(("units", "quantity", "evidence"), [
    (TORQUE_UNITS, "angle (ramp and hold)", "the angle is constant in a hold under load"),
    (FORCE_UNITS, "displacement (ramp and hold)", "the displacement is constant in a hold under load")])
def test_the_controlled_quantity_has_the_name_of_the_motion(units, quantity, evidence):
    control = SimpleNamespace(equal_samples=0, quantity="displacement", pattern="ramp and hold")
    screening = SimpleNamespace(control=control, left_out_sample_numbers=())
    found, = list_signal_based_assumptions(screening, None, has_air=None, units=units)
    assert found.subject == "controlled quantity" and found.value == quantity and found.evidence == (evidence,)
