"""`tissue-sim design`: predicted accuracy of planned experiments as tables, as JSON and from Python."""

import json

import pytest

from calibration import Design, evaluate_planned_experiments
from calibration.campaign.parameters import OFFSET_DEFAULTS
from calibration.diagnosis.settings import LIMITS
from calibration.effects.backlash import Backlash
from calibration.effects.machine_compliance import MachineCompliance
from calibration.effects.population import Population
from calibration.effects.viscoelasticity import Viscoelasticity
from scenes.cli import main
from tissue_sim.errors import InputError

PLAN = """
[[specimen]]
radius_mm = 20.0
height_mm = 30.0
[[test]]
name = "plates"
kind = "lubricated_compression"
protocol = "ramp 3mm @0.2mm/s; hold 30s; unload"
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 10000.0
start = { C10 = 1500.0 }
[noise]
force_N = 0.01
contact_jitter_mm = 0.02
zero_jitter_N = 0.005
"""
RAMP = PLAN.replace("; hold 30s; unload", "")
EFFECTS = {"viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance, "backlash": Backlash,
           "population": Population}


@pytest.fixture(autouse=True)
def few_effects(monkeypatch):
    """Use few effects; the whole catalogue takes longer than all tests of this file."""
    monkeypatch.setattr("calibration.diagnosis.proposals.CATALOGUE", EFFECTS)


def write(folder, text=PLAN, name="plan.toml"):
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def test_json_contains_detectable_sizes(tmp_path, capsys):
    assert main(["design", str(write(tmp_path)), "--samples", "60", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["law"] == "neo_hooke" and found["parameters"] == {"C10": 1500.0} and found["units"] == {"C10": "Pa"}
    (test,) = found["tests"]
    assert (test["name"], test["recordings"], test["samples"], test["depth_mm"], test["duration_s"]) == (
        "plates", 3, 60, 3.0, 60.0)
    rows = {each["name"]: each for each in found["candidates"]}
    assert rows["population"]["reason"] == "all tests use one specimen, so variation between specimens is not tested"
    assert not rows["population"]["testable"]
    assert rows["population"]["separated_by"] == Population.separated_by
    # Lower bound of the detectable size: the effect changes every sample and the fit absorbs none of it.
    share, play = (rows[name]["seen_from"][path] for name, path in (
        ("viscoelasticity", "viscoelastic.terms[0].g"), ("backlash", "rig.backlash")))
    least = LIMITS.detectable_score * 0.01 / (test["force_N"] * (3 * 60) ** 0.5)
    assert least < share < 20 * least
    steepest = 2 * test["force_N"] / 3e-3
    least = LIMITS.detectable_score * 0.01 / (steepest * (3 * 15) ** 0.5)
    assert least < play < 20 * least
    assert [path.name for path in tmp_path.iterdir()] == ["plan.toml"], "nothing is written"


def test_more_recordings_and_a_hold_improve_the_design(tmp_path):
    path = write(tmp_path)
    one, four = (evaluate_planned_experiments(path, replicates=n, samples=60) for n in (1, 4))
    assert isinstance(four, Design) and [test.recordings for test in four.tests] == [4]
    # Noise, contact and zero of the recordings are independent.
    assert one.standard_errors["C10"] == pytest.approx(2.0 * four.standard_errors["C10"], rel=0.05)
    ramp = evaluate_planned_experiments(write(tmp_path, RAMP, "ramp.toml"), replicates=4, samples=60)
    held, ramped = ({each.name: each for each in design.candidates} for design in (four, ramp))
    assert held["backlash"].testable and not ramped["backlash"].testable
    assert "has an unloading" in ramped["backlash"].reason
    relaxing = [rows["viscoelasticity"].seen_from["viscoelastic.terms[0].g"] for rows in (held, ramped)]
    assert relaxing[1] > 5 * relaxing[0]


def test_tables_use_display_units(tmp_path, capsys):
    assert main(["design", str(write(tmp_path)), "--samples", "60", "--replicates", "2"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("plan: Neo-Hooke, sensor noise 10 mN")
    for word in ("plates", "3 mm", "60 s", "C10", "1.500 ±", "kPa", "mm/N", "backlash", "scatter between specimens",
                 "all tests use one specimen", Population.separated_by):
        assert word in text, word


def test_default_scatter_is_proportional_to_the_force(tmp_path):
    unstated = evaluate_planned_experiments(write(tmp_path, PLAN.replace("zero_jitter_N = 0.005\n", "")), samples=60)
    share = OFFSET_DEFAULTS.first_zero * unstated.tests[0].force_N
    stated = evaluate_planned_experiments(write(tmp_path,
                                                PLAN.replace("zero_jitter_N = 0.005", f"zero_jitter_N = {share}")),
                                          samples=60)
    assert unstated.standard_errors["C10"] == pytest.approx(stated.standard_errors["C10"], rel=1e-3)


@pytest.mark.parametrize(("old", "new", "expected"), [
    ("force_N = 0.01\n", "", "state the standard deviation of the force sensor"),
    ("; hold 30s; unload", "; hold 30", "'30'"),
    ("ramp 3mm", "ramp 30mm", "plan.toml: test[0].protocol"),
    ("start = { C10 = 1500.0 }\n", "", "fit.start must give the material of a design; state C10"),
    ('"inverse_fem"', '"analytical"', "inverse_fem"),
    ("protocol =", "protokol =", "protokol"),
], ids=["noise", "protocol", "depth", "start", "method", "key"])
def test_bad_input_is_one_sentence(old, new, expected, tmp_path, capsys):
    assert main(["design", str(write(tmp_path, PLAN.replace(old, new)))]) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr.count("\n") == 1 and expected in stderr and "plan.toml" in stderr


def test_too_few_samples_or_replicates_are_refused(tmp_path):
    for wrong, words in (({"samples": 3}, "samples must be at least 20; got 3"),
                         ({"replicates": 0}, "replicates must be at least 1; got 0")):
        with pytest.raises(InputError, match=words):
            evaluate_planned_experiments(write(tmp_path), **wrong)
