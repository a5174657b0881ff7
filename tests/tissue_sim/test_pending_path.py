"""Ticks that came late are followed as they were, and merged only along one line."""

import math

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.pose import Pose
from tissue_sim.realtime.pending_path import MOST_TICKS, PendingPath

START = Pose.at_depth(0.0)
#: Time of a tick, s.
TICK = 1e-3
#: Radius of the contact, m.
RADIUS = 8e-3
#: Largest distance from a line, m.
TOLERANCE = 1e-6


def path(depths, times=None):
    made = PendingPath()
    for depth, dt in zip(depths, times or [TICK] * len(depths), strict=True):
        made.append_tick(Pose.at_depth(depth), dt)
    return made


def merged(made, tolerance=TOLERANCE, timed=True):
    made.merge_straight_or_excess_ticks(START, RADIUS, tolerance, 0.1, timed=timed)
    return [(round(1e3 * tick.pose.depth, 6), round(1e3 * tick.dt, 6)) for tick in made.ticks]


@pytest.mark.parametrize(("depths", "timed", "expected"), [
    ([1e-3, 2e-3, 3e-3], True, [(3.0, 3.0)]),
    ([1e-3, 2e-3, 1.5e-3], True, [(2.0, 2.0), (1.5, 1.0)]),
    ([1e-3, 1e-3, 1e-3], True, [(1.0, 1.0), (1.0, 1.0), (1.0, 1.0)]),
    ([1e-3, 3e-3], True, [(1.0, 1.0), (3.0, 1.0)]),
    ([1e-3, 3e-3], False, [(3.0, 2.0)]),
    ([1e-3, 1e-3, 1e-3], False, [(1.0, 3.0)]),
    ([1e-3, 2e-3, 1.5e-3], False, [(2.0, 2.0), (1.5, 1.0)]),
], ids=["even", "turn", "rest", "faster", "faster without time", "rest without time", "turn without time"])
def test_ticks_on_one_line_are_merged(depths, timed, expected):
    assert merged(path(depths), timed=timed) == expected


def test_tissue_without_a_past_needs_no_path():
    assert merged(path([1e-3, 2e-3, 1.5e-3]), math.inf) == [(1.5, 3.0)]


def test_too_many_ticks_are_merged_and_the_path_is_lost_for_a_time():
    made = path([1e-3 * (k % 2) for k in range(MOST_TICKS + 3)])
    total = made.elapsed_time
    merged(made)
    assert len(made.ticks) == MOST_TICKS and made.lost == 0.1 and made.elapsed_time == pytest.approx(total)
    made.append_tick(Pose.at_depth(0.0), 0.2)
    assert made.lost == 0.0


def test_poses_that_cannot_be_reached_leave_their_time():
    made = path([1e-3, 2e-3])
    made.discard_all_ticks_keeping_time()
    assert not made.is_empty and made.elapsed_time == pytest.approx(2e-3)
    made.append_tick(Pose.at_depth(5e-4), TICK)
    assert [tick.dt for tick in made.ticks] == [pytest.approx(3e-3)]


@pytest.mark.parametrize(("friction", "inertia", "solves"),
                         [(0.3, "on", 4), ("frictionless", "on", 4), (0.5, "off", 3)])
def test_after_a_late_turn_the_force_is_that_of_the_motion(friction, inertia, solves):
    """A turn at 40 mm/s with few solutions a step; a straight line in its place was 3 to 12 % off."""
    material = ts.Material("neo_hooke", {"C10": 800.0}, ts.Bulk("bulk_ratio", 1e3))
    experiment = ts.Experiment(ts.Specimen(0.035, 0.040), ts.Protocol.ramp(4e-3, 2), tool=ts.Tool("round", 8e-3),
                               friction=friction)
    down = np.arange(0.0, 2e-3, 4e-5)
    answers = []
    for most in (solves, None):
        one = ts.Simulator(ts.Model(experiment, material), resolution="realtime_20", inertia=inertia, max_solves=most)
        one.warm_up()
        answers.append([one.step(depth, TICK) for depth in (*down, *down[::-1])])
    bounded, free = answers
    peak = max(answer.force for answer in free)
    errors = [abs(one.force - other.force) / peak for one, other in zip(bounded, free, strict=True)
              if one.status is ts.ForceStatus.CONVERGED]
    late = [answer.status is ts.ForceStatus.LATE for answer in bounded]
    assert any(late) and len(errors) > 0.5 * len(free)
    assert max(errors) < 0.02
