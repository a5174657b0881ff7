"""`StagePath`: the interpolated position of a stage lies within its bound, and late answers are left out."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from virtual_bench import STIFFNESS, SURFACE

from haptics.recorder.guarded_motion import StoppedError
from haptics.recorder.motion_record import StagePath, StagePoll, compute_position_tolerance_for_depth
from tissue_sim import read_recording


def seconds(least, most):
    return st.floats(least, most, allow_nan=False)


@st.composite
def motions(draw):
    """Draw legs of a motion, with a rest at the end of each, and polls with random latencies."""
    starts, knots, positions, speeds = [], [0.0], [0.0], [0.0]
    for _ in range(draw(st.integers(1, 5))):
        length, speed = draw(seconds(-5e-3, 5e-3)), draw(st.sampled_from([1e-3, 4e-3]))
        starts.append(knots[-1] + draw(seconds(0.0, 0.2)))
        speeds.append(speed)
        knots += [starts[-1], starts[-1] + abs(length) / speed + 1e-9]
        positions += [positions[-1], positions[-1] + length]
    polls, now = [], 0.0
    while now < knots[-1]:
        asked = now + draw(seconds(1e-3, 0.1))
        read, received = asked + draw(seconds(0.0, 0.2)), asked + 0.2
        polls.append(StagePoll(asked, received, float(np.interp(read, knots, positions))))
        now = received
    return polls, starts, speeds, knots, positions


@given(motions())
def test_the_true_position_lies_within_the_bound(motion):
    polls, starts, speeds, knots, positions = motion
    path, times = StagePath(polls, starts, speeds), np.linspace(0.0, knots[-1], 300)
    error = np.abs(path.interpolate_position(times) - np.interp(times, knots, positions))
    assert np.all(error <= path.compute_position_error_bound(times) + 1e-9)


def test_the_bound_is_zero_in_uniform_motion():
    polls = [StagePoll(at, at, 2e-3 * at) for at in (1.0, 1.3, 1.9)]
    times = np.linspace(1.0, 1.9, 50)
    assert StagePath(polls, [0.0], [0.0, 2e-3]).compute_position_error_bound(times) == pytest.approx(0.0, abs=1e-12)


def test_the_bound_contains_a_reversal_between_two_polls():
    # 0.4 s at 2 mm/s between two equal positions: the stage can be 0.4 mm away in the middle.
    polls = [StagePoll(1.0, 1.0, 1e-3), StagePoll(1.4, 1.4, 1e-3)]
    path = StagePath(polls, [0.0, 1.2], [0.0, 2e-3, 2e-3])
    assert path.compute_position_error_bound(np.array([1.0, 1.2, 1.5])) == pytest.approx([0.0, 0.4e-3, np.inf])


def test_the_position_is_known_in_a_hold_at_any_interval_of_the_polls():
    polls = [StagePoll(0.0, 0.0, 1e-3), StagePoll(5.0, 5.0, 1e-3)]
    assert StagePath(polls, [0.0], [2e-3, 0.0]).find_known_position_mask(np.linspace(0.0, 5.0, 20), 1e-3).all()


def delay_answers(bench, rig, delay, is_late):
    """Let the stage answer late: the position is read at the request, and received `delay` s later."""
    answer = rig.stage.position

    def position():
        sample = answer()
        if not is_late(sample):
            return sample
        bench.clock.sleep(delay)
        return replace(sample, received=bench.clock(), requested=sample.received)

    rig.stage.position = position


def test_samples_without_a_known_position_are_left_out_of_the_recording(bench):
    # Late answers around the reversal: by the time of receipt the tool seems to rest while the force falls.
    rig = bench.rig()
    delay_answers(bench, rig, 0.15, lambda sample: 4.6e-3 < sample.position < 4.99e-3)
    bench.run(rig=rig, plan=bench.plan("ramp 3mm @2mm/s; unload", replicates=1))
    recording = read_recording(bench.folder / "spring_1.csv")
    assert recording.metadata["left_out"]["samples"] > 50
    assert bench.run_folder.state["left_out"] == {"spring_1": recording.metadata["left_out"]}
    assert "answers of the stage were late" in recording.metadata["left_out"]["reason"]
    depth = np.maximum(recording.displacement + recording.metadata["touch_mm"] * 1e-3 - SURFACE, 0.0)
    tolerance = STIFFNESS * compute_position_tolerance_for_depth(3e-3) + 1e-3
    np.testing.assert_allclose(recording.force, STIFFNESS * depth, atol=tolerance)


def test_a_recording_is_refused_where_the_position_is_unknown_most_of_the_time(bench):
    rig = bench.rig()
    delay_answers(bench, rig, 0.15, lambda sample: sample.moving and sample.position > 2.2e-3)
    with pytest.raises(StoppedError, match=r"answers of the stage were late.*close other programs"):
        bench.run(rig=rig, plan=bench.plan("ramp 3mm @2mm/s; unload", replicates=1))
