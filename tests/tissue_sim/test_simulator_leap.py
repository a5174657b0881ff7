"""A step without time is a sudden one, however many ticks the budget makes of it: the tissue has no mass on the way."""

from types import SimpleNamespace

import numpy as np
import pytest

import tissue_sim as ts

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
#: Length of a tick, s.
TICK = 1e-3
#: Speed, m/s.
SPEED = 48e-3
ENGAGED = 3.1e-3
#: Linear solves of a part of a tick until the tool has arrived, and from then on.
FEW = 1
MANY = 50


def simulator(friction, few=None):
    model = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(8e-3, 2),
                                   tool=ts.Tool("flat", 8e-3, 0.5e-3), friction=friction), MATERIAL)
    made = ts.Simulator(model, resolution="realtime_20", budget=None if few is None else 60.0)
    made.warm_up()
    if few is not None:
        made._clock = SimpleNamespace(
            fixed=0.0,
            count_fitting_solves=lambda time, first=False: MANY if made._equilibrium.pose.depth > 0.0 else few,
            update_estimate=lambda *_: None, doubt=lambda: None, begin=lambda _: None)
    return made


def engaged(made):
    """Into the tissue at once, and on at `SPEED` for 100 ms."""
    answers = [made.step(ENGAGED, 0.0)]
    for k in range(1, 101):
        answers.append(made.step(min(ENGAGED + SPEED * TICK * k, 6e-3), TICK))
    return answers


@pytest.mark.parametrize("friction", ["stick", "bonded"])
def test_an_engagement_that_takes_many_ticks_sets_nothing_swinging(friction):
    expected, found = (engaged(simulator(friction, few)) for few in (None, FEW))
    late = [answer.status is ts.ForceStatus.LATE for answer in found]
    assert all(late[:3]) and not any(late[50:]), sum(late)
    # What swings from the sudden start of the motion is the same in both but for a few ticks.
    gaps = [abs(one.force - other.force) for one, other, waits in zip(found, expected, late, strict=True) if not waits]
    assert max(gaps[10:]) < 0.05 * expected[-1].force, np.round(gaps, 3)


def test_leaving_before_it_has_arrived_leaves_nothing_behind():
    made, fresh = simulator("stick", FEW), simulator("stick")
    assert made.step(6e-3, 0.0).status is ts.ForceStatus.LATE
    saved = made.save()
    for one in (made, fresh):
        for k in range(200):
            answer = one.step(1e-3 if k > 50 else -1e-3, TICK)
        one.last = answer.force
    assert made.last == pytest.approx(fresh.last, rel=0.01)
    made.restore(saved)
    while (answer := made.step(6e-3, TICK)).status is not ts.ForceStatus.CONVERGED:
        pass
    assert not answer.inertial and answer.force == pytest.approx(simulator("stick").step(6e-3, 0.0).force, rel=1e-3)
