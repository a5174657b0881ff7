"""Score tests identify the effect that acts in virtual recordings, with its sign and approximate size."""

import numpy as np
import pytest
from virtual_campaign import TESTS, TRUTH, fitted, measured_campaign

from calibration.diagnosis.proposals import add_effect_to_problem_and_campaign
from calibration.effects.effect import CATALOGUE, NotTestableError

#: Effects whose scores need no or few simulations.
CHEAP = ("session_scale", "partial_slip", "contact_offset", "backlash", "zero_offset", "sensor_drift", "sensor_gain",
         "latency", "guide_friction", "rate_damping", "softening")


def scores(study, names):
    """Return name of the candidate -> largest score over its trial values."""
    found = {}
    for name in names:
        try:
            candidates = CATALOGUE[name]().candidates(study.situation)
        except NotTestableError:
            continue
        for candidate in candidates:
            found[candidate.name] = max(found.get(candidate.name, -np.inf), study.score(candidate))
    return found


@pytest.mark.slow
def test_scores_are_small_without_effects(plain):
    found = scores(plain, CHEAP)
    assert len(found) > 15 and max(map(abs, found.values())) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "values", "where", "found_as"), [
    ("session_scale", {"effects.stiffness_scale.ratio": 1.06}, "needle", "session_scale@needle"),
    ("backlash", {"rig.backlash": 5e-5}, None, "backlash"),
    ("softening", {"softening.loss": 0.03, "softening.share": 0.7}, None, "softening")])
def test_acting_effect_has_the_highest_score(tmp_path, name, values, where, found_as):
    effect = CATALOGUE[name]()
    study = fitted(measured_campaign(
        tmp_path, lambda test, model: effect.apply(model, values) if where in (None, test) else model))
    found = scores(study, CHEAP)
    assert found[found_as] > 5.0, found
    # The stiffness factor of one test and slip of its bonded faces are twins.
    others = {other: score for other, score in found.items() if other.partition("@")[0] != name}
    assert max(others.values()) < 1.02 * found[found_as], others


@pytest.mark.slow
def test_stiffer_specimen_is_identified(tmp_path):
    """Two specimens, one 5 % stiffer: the population effect has the highest score."""
    two = {name: TESTS[name] for name in ("plates", "needle")}
    scale = CATALOGUE["population"]()
    study = fitted(measured_campaign(
        tmp_path, lambda name, model: scale.apply(model, {"effects.stiffness_scale.ratio": 1.05})
        if name.endswith("two") else model, tests=two, specimens=("one", "two")))
    found = scores(study, ("population", *CHEAP))
    assert found["population"] == max(found.values()) > 20.0, found


@pytest.mark.slow
def test_adhesion_is_identified_beyond_first_contact(tmp_path, monkeypatch):
    """A plate that retracts past the first contact adheres with 0.1 N over 0.3 mm."""
    monkeypatch.setattr("virtual_campaign.PROTOCOL",
                        "ramp 4mm @0.5mm/s; unload @0.5mm/s; retract 0.5mm @0.5mm/s")
    values = {"experiment.adhesion.force": 0.1, "experiment.adhesion.length": 0.3e-3}
    adhesion = CATALOGUE["adhesion"]()
    study = fitted(measured_campaign(tmp_path, lambda name, model: adhesion.apply(model, values),
                                     tests={"plates": TESTS["plates"]}))
    found = scores(study, ("adhesion", "zero_offset", "backlash", "guide_friction", "sensor_drift"))
    assert found["adhesion"] == max(found.values()) > 5.0, found


@pytest.mark.slow
def test_inertia_is_identified_at_high_speed(tmp_path, monkeypatch):
    """A tool of 0.3 kg starts at 60 mm/s; the force step at the end of the ramp is inertia and not tissue failure."""
    monkeypatch.setattr("virtual_campaign.PROTOCOL",
                        "ramp 8mm @60mm/s; hold 0.2s; unload 0.2mm @60mm/s")
    inertia = CATALOGUE["inertia"]()
    path = measured_campaign(tmp_path, lambda name, model: inertia.apply(model, {"rig.faults.inertia.mass": 0.3}))
    path.write_text(path.read_text(encoding="utf-8").replace("recordings", 'failure = "keep"\nrecordings'),
                    encoding="utf-8")
    found = scores(fitted(path), ("inertia", "latency", "rate_damping", "backlash", "zero_offset"))
    assert found["inertia"] == max(found.values()) > 5.0, found


def test_puncture_is_a_jump_at_a_sample(plain):
    """The force drops by a fraction from the first sample beyond the depth on, without smearing between knots."""
    candidate = CATALOGUE["puncture"]().candidates(plain.situation)[4]
    (drop,), (depth,) = candidate.sizes.values(), candidate.shape.values()
    problem, _ = add_effect_to_problem_and_campaign(plain.problem, plain.campaign, candidate, free=True)
    theta = np.array([TRUTH.get(each.name, {**candidate.sizes, **candidate.shape}.get(each.path))
                      for each in problem.space.free_parameters])
    base = np.array([TRUTH[name] for name in plain.problem.space.free])
    for test, before in zip(problem.tests, plain.problem.tests, strict=True):
        force, rates, _ = test.evaluate_force_and_derivatives(test.solve(problem.space, theta, problem.solves), 0, 0.0)
        whole, whole_rates, _ = before.evaluate_force_and_derivatives(before.solve(plain.problem.space, base,
                                                                                   problem.solves), 0, 0.0)
        left = np.where((test.name == "needle") & (np.maximum.accumulate(test.measured[0].displacement) > depth),
                        1.0 - drop, 1.0)
        np.testing.assert_allclose(force, left * whole, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(rates[:, :2], left[:, None] * whole_rates, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(rates[:, 2], np.where(left < 1.0, -whole, 0.0), rtol=1e-5, atol=1e-6)
