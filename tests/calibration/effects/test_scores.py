"""What is hidden in a campaign is what the scores point to, with the right sign and about the right size."""

import numpy as np
import pytest
from virtual_campaign import TESTS, TRUTH, fitted, measured_campaign

from calibration.diagnosis.extended import extend
from calibration.effects.catalogue import CATALOGUE
from calibration.effects.effect import NotTestableError

#: Effects that cost next to nothing to score, and one candidate each of some others.
CHEAP = ("session_scale", "partial_slip", "contact_offset", "backlash", "zero_offset", "sensor_drift", "sensor_gain",
         "latency", "guide_friction", "rate_damping", "softening")


def scores(study, names):
    """Name of the candidate -> its score and how far that is in trial sizes, the largest of a grid."""
    found = {}
    for name in names:
        try:
            candidates = CATALOGUE[name]().candidates(study.situation)
        except NotTestableError:
            continue
        for candidate in candidates:
            found[candidate.name] = max(found.get(candidate.name, -np.inf), study.score(candidate))
    return found


def test_nothing_hidden_gives_nothing(plain):
    found = scores(plain, CHEAP)
    assert len(found) > 15 and max(map(abs, found.values())) < 4.0


@pytest.mark.parametrize(("name", "values", "where", "found_as"), [
    ("session_scale", {"effects.stiffness_scale.ratio": 1.06}, "needle", "session_scale@needle"),
    ("backlash", {"rig.backlash": 5e-5}, None, "backlash"),
    ("softening", {"softening.loss": 0.03, "softening.share": 0.7}, None, "softening")])
def test_the_hidden_effect_has_the_best_score(tmp_path, name, values, where, found_as):
    effect = CATALOGUE[name]()
    study = fitted(measured_campaign(
        tmp_path, lambda test, model: effect.apply(model, values) if where in (None, test) else model))
    found = scores(study, CHEAP)
    assert found[found_as] > 5.0, found
    # A scale of one test and a slip in it are twins where its faces are bonded.
    others = {other: score for other, score in found.items() if other.partition("@")[0] != name}
    assert max(others.values()) < 1.02 * found[found_as], others


def test_specimens_that_differ(tmp_path):
    """Two specimens, one 5 % stiffer: the number of its own says so, and nothing else says more."""
    two = {name: TESTS[name] for name in ("plates", "needle")}
    scale = CATALOGUE["population"]()
    study = fitted(measured_campaign(
        tmp_path, lambda name, model: scale.apply(model, {"effects.stiffness_scale.ratio": 1.05})
        if name.endswith("two") else model, tests=two, specimens=("one", "two")))
    found = scores(study, ("population", *CHEAP))
    assert found["population"] == max(found.values()) > 20.0, found


def test_adhesion_shows_past_the_contact(tmp_path, monkeypatch):
    """A plate that is drawn back past the touch holds on by 0.1 N over 0.3 mm."""
    monkeypatch.setattr("virtual_campaign.PROTOCOL",
                        "ramp 4mm @0.5mm/s; unload @0.5mm/s; retract 0.5mm @0.5mm/s")
    values = {"experiment.adhesion.force": 0.1, "experiment.adhesion.length": 0.3e-3}
    adhesion = CATALOGUE["adhesion"]()
    study = fitted(measured_campaign(tmp_path, lambda name, model: adhesion.apply(model, values),
                                     tests={"plates": TESTS["plates"]}))
    found = scores(study, ("adhesion", "zero_offset", "backlash", "guide_friction", "sensor_drift"))
    assert found["adhesion"] == max(found.values()) > 5.0, found


def test_inertia_shows_at_speed(tmp_path, monkeypatch):
    """A tool of 0.3 kg that is at 60 mm/s at once; the jolt at the end of the ramp is no failure of the tissue."""
    monkeypatch.setattr("virtual_campaign.PROTOCOL",
                        "ramp 8mm @60mm/s; hold 0.2s; unload 0.2mm @60mm/s")
    inertia = CATALOGUE["inertia"]()
    path = measured_campaign(tmp_path, lambda name, model: inertia.apply(model, {"rig.faults.inertia.mass": 0.3}))
    path.write_text(path.read_text(encoding="utf-8").replace("recordings", 'failure = "keep"\nrecordings'),
                    encoding="utf-8")
    found = scores(fitted(path), ("inertia", "latency", "rate_damping", "backlash", "zero_offset"))
    assert found["inertia"] == max(found.values()) > 5.0, found


def test_a_puncture_is_a_jump_at_a_sample(plain):
    """And not one that the knots of a simulation smear: a share less from the first sample beyond its depth on."""
    candidate = CATALOGUE["puncture"]().candidates(plain.situation)[4]
    (drop,), (depth,) = candidate.sizes.values(), candidate.shape.values()
    problem, _ = extend(plain.problem, plain.campaign, candidate, free=True)
    theta = np.array([TRUTH.get(each.name, {**candidate.sizes, **candidate.shape}.get(each.path))
                      for each in problem.space.varied])
    base = np.array([TRUTH[name] for name in plain.problem.space.free])
    for test, before in zip(problem.tests, plain.problem.tests, strict=True):
        force, rates, _ = test.evaluate(test.solve(problem.space, theta, problem.solves), 0, 0.0)
        whole, whole_rates, _ = before.evaluate(before.solve(plain.problem.space, base, problem.solves), 0, 0.0)
        left = np.where((test.name == "needle") & (np.maximum.accumulate(test.measured[0].displacement) > depth),
                        1.0 - drop, 1.0)
        np.testing.assert_allclose(force, left * whole, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(rates[:, :2], left[:, None] * whole_rates, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(rates[:, 2], np.where(left < 1.0, -whole, 0.0), rtol=1e-5, atol=1e-6)
