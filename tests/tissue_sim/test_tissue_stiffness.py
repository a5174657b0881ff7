"""Stiffness of the tissue compared with that of a step: the one that a hand feels, with mass and without."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.realtime import path_following

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
CASES = {
    "needle": {"tool": ts.Tool("flat", 8e-3)},
    "needle with friction": {"tool": ts.Tool("flat", 8e-3, 0.25e-3), "friction": 0.7},
    "ball on which tissue slips": {"tool": ts.Tool("sphere", 8e-3), "friction": 0.3},
    "bonded plates": {},
    "plates with friction": {"friction": 0.3},
}
DEPTH = 2e-3


def settled(options, inertia, material=MATERIAL) -> tuple[ts.Simulator, ts.ToolForce]:
    """A tool that comes to a depth so gently that no waves arise, and what it feels there."""
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(4e-3, 2), **options)
    sim = ts.Simulator(ts.Model(experiment, material), inertia=inertia)
    for k in range(1, 801):
        answer = sim.step(DEPTH * (1.0 - math.cos(0.5 * math.pi * k / 800)), 1e-3)
    assert answer.status is ts.ForceStatus.CONVERGED
    return sim, answer


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_with_mass_it_is_that_of_the_slow_test(case):
    _, slow = settled(CASES[case], "off")
    _, swift = settled(CASES[case], "on")
    assert not slow.inertial and slow.step_stiffness == slow.stiffness and slow.step_stiffness_matrix is None
    assert swift.inertial and swift.force == pytest.approx(slow.force, rel=0.01)
    assert swift.stiffness == pytest.approx(slow.stiffness, rel=0.01)
    assert swift.step_stiffness > 5 * swift.stiffness


def test_that_of_the_step_is_the_slope_within_it():
    sim, answer = settled(CASES["needle"], "on")
    saved, width = sim.save(), 1e-6
    slopes = []
    for way in (1, -1):
        sim.restore(saved)
        slopes.append(sim.step(DEPTH + way * width, 1e-3).force)
    assert answer.step_stiffness == pytest.approx((slopes[0] - slopes[1]) / (2 * width), rel=5e-3)
    assert np.array(answer.step_stiffness_matrix)[2, 2] == answer.step_stiffness


@pytest.mark.slow
def test_it_is_found_again_every_few_ticks():
    sim, _ = settled(CASES["needle"], "on")
    found = [sim.step(DEPTH + 5e-5 * k, 1e-3).stiffness for k in range(1, 21)]
    changes = [k for k, (one, next_) in enumerate(pairwise(found)) if one != next_]
    assert np.diff(changes).tolist() == [path_following._STIFFNESS_LASTS] * (len(changes) - 1) and len(changes) >= 3


@pytest.mark.slow
def test_what_relaxes_within_the_step_is_part_of_it():
    relaxing = replace(MATERIAL, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
    _, slow = settled(CASES["needle"], "off", relaxing)
    _, swift = settled(CASES["needle"], "on", relaxing)
    assert swift.stiffness == pytest.approx(slow.stiffness, rel=0.01)


@pytest.mark.slow
def test_the_question_changes_nothing():
    """Asked for the own stiffness or not, the forces are the same but for rounding; a replay is, bit for bit."""
    sim, _ = settled(CASES["needle with friction"], "on")
    saved = sim.save()
    path = [DEPTH + 1e-3 * np.sin(0.2 * k) for k in range(60)]

    def forces():
        sim.restore(saved)
        return [(answer.force, answer.step_stiffness) for answer in (sim.step(depth, 1e-3) for depth in path)]

    often = forces()
    assert forces() == often
    sim._stiffness_lasts = 10**6
    np.testing.assert_allclose(forces(), often, rtol=1e-9)
