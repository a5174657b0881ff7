"""Two effects at once, jumps whose depth is sought, and what is named only with its rivals."""

from types import SimpleNamespace

import numpy as np
import pytest
from virtual_campaign import diagnosed_plates

import tissue_sim as ts
from calibration.diagnosis.refits import _are_both_required_and_dissimilar
from calibration.diagnosis.settings import DecisionLimits
from calibration.effects.rig import DisplacementGain, SensorDrift, StepLoss
from calibration.effects.tissue import Viscoelasticity
from calibration.statistics.adequacy import EffectDirection


@pytest.fixture(autouse=True)
def four_effects(monkeypatch):
    """The whole catalogue takes longer than all that is asked here."""
    monkeypatch.setattr("calibration.diagnosis.proposals.CATALOGUE", {
        "viscoelasticity": Viscoelasticity, "step_loss": StepLoss, "sensor_drift": SensorDrift,
        "displacement_gain": DisplacementGain})


def numbers(found):
    return {number.path: number.value for effect in found.diagnosis.effects for number in effect.parameters}


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0.08e-3, 0.3e-3])
def test_the_depth_of_lost_steps_is_found_to_a_sample(tmp_path, lost):
    """Between the depths that are tried first, and no descent moves a jump; a large one, after which a calibration
    would read no further, is no failure here."""
    found = diagnosed_plates(tmp_path, rig=ts.Rig(step_loss=lost, step_loss_depth=1.28e-3), samples=241, seed=4)
    assert found.diagnosis.verdict == "NAMED" and found.diagnosis.indistinguishable == ["step_loss@plates"]
    values = numbers(found)
    assert values["rig.step_loss"] == pytest.approx(lost, rel=0.1)
    assert values["rig.step_loss_depth"] == pytest.approx(1.28e-3, abs=0.06e-3)
    assert "rig.step_loss_depth" not in found.after.problem.space.free


@pytest.mark.slow
def test_two_that_act_in_different_places_are_both_named(tmp_path):
    """A jump and a relaxation: either alone leaves a gap, and both numbers are right."""
    found = diagnosed_plates(tmp_path, rig=ts.Rig(step_loss=0.08e-3, step_loss_depth=1.28e-3), terms=[(0.12, 6.0)],
                             samples=241, seed=4)
    assert found.diagnosis.verdict == "NAMED"
    assert {effect.name for effect in found.diagnosis.effects} == {"viscoelasticity", "step_loss"}
    values = numbers(found)
    assert values["viscoelastic.terms[0].g"] == pytest.approx(0.12, rel=0.1)
    assert values["rig.step_loss"] == pytest.approx(0.08e-3, rel=0.2)
    assert values["rig.step_loss_depth"] == pytest.approx(1.28e-3, abs=0.1e-3)
    assert found.after.has_adequate_region_residuals and not found.before.has_adequate_region_residuals


def fitted(name, axis, strength, gain=50.0):
    """A fit whose effect changes the data along an axis."""
    direction = EffectDirection(np.asarray(axis, dtype=float)[:, None], 1.0, 1.0, False)
    candidate = SimpleNamespace(name=name)
    proposal = SimpleNamespace(candidate=candidate, direction=direction, signed_score=strength)
    return SimpleNamespace(candidate_name=name, gain=gain, proposal=proposal)


@pytest.mark.parametrize(("axis", "alone", "second_alone", "rival", "needed"), [
    ([0, 1, 0], 6.0, 6.2, None, True),
    ([0.8, 0.6, 0], 6.0, 6.2, None, False),  # alike
    ([0.2, np.sqrt(0.96), 0], 0.4, 6.2, None, False),  # nothing alone: the difference of two
    ([0.2, np.sqrt(0.96), 0], -4.0, 6.2, None, False),  # the other sign
    ([0, 1, 0], 6.0, 6.2, 95.0, False),  # the second explains as much alone
])
def test_two_need_each_other(axis, alone, second_alone, rival, needed, monkeypatch):
    first, second = fitted("first", [1, 0, 0], 8.0), fitted("second", axis, second_alone)
    plain = fitted("second", axis, alone).proposal
    monkeypatch.setattr("calibration.diagnosis.refits.recompute_candidate_score_in_other_fit", lambda proposal,
                        evidence: plain)
    good = [first] if rival is None else [first, fitted("second", axis, alone, gain=rival)]
    assert _are_both_required_and_dissimilar(first, second, good, SimpleNamespace(limits=DecisionLimits())) is needed
