"""`MotionGuard`: each cause of a stop, the retraction after it, and the check before a motion."""

import math
from dataclasses import replace

import pytest

from haptics.devices.contracts import ForceSample, SampleStatus, StageSample
from haptics.safety.motion_guard import (
    CommandedMotion,
    MotionGuard,
    MotionGuardSettings,
    MotionLimits,
    StopReason,
    require_stop_within_force_margin,
)
from tissue_sim.errors import InputError

CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
LIMITS = MotionLimits(force=5.0, lowest=-5e-3, highest=10e-3, speed=2e-3, duration=100.0, stiffness=1e3,
                      force_margin=1.0)


def sample(fz=0.0, fx=0.0, status=0):
    return ForceSample((0,) * 6, (fx, 0.0, fz, 0.0, 0.0, 0.0), 0, status, 0.0)


def stage_at(position=0.0, at=0.0, moving=False, status=0, homed=True):
    return StageSample(0, position, moving, homed, 0, status, at)


def make_guard(measures=True, ready=True, **settings):
    guard = MotionGuard(LIMITS, 1000.0, CHANNELS, measures, 0.0, MotionGuardSettings(**settings))
    guard.is_stage_homed = guard.is_sensor_zeroed = ready
    return guard


def check(guard, samples=None, stage=None, command=None, now=0.0):
    samples = [sample()] if samples is None else samples
    return guard.find_stop_reason(now, samples, [each.values[2] for each in samples], stage or stage_at(at=now),
                                  command)


INWARDS = CommandedMotion(0.0, 5e-3, 1e-3, 0.0)


@pytest.mark.parametrize(("cause", "arguments"), [
    ("force", {"samples": [sample(5.1)]}), ("force", {"samples": [sample(-5.1)]}),
    ("force", {"samples": [sample(), sample(0.0, fx=6.0)]}), ("force", {"samples": [sample(4.0, fx=4.0)]}),
    ("force", {"samples": [sample(1.0), sample(math.nan)]}), ("force", {"samples": [sample(math.nan), sample(1.0)]}),
    ("sensor saturated", {"samples": [sample(status=SampleStatus.SATURATED)]}),
    ("sensor fault", {"samples": [sample(status=SampleStatus.FAULT)]}),
    ("sensor lost", {"samples": [], "now": 0.06}), ("duration", {"now": 101.0, "samples": [sample()]}),
    ("stage fault", {"stage": stage_at(status=SampleStatus.FAULT)}),
    ("limit switch", {"stage": stage_at(status=SampleStatus.LIMIT)}),
    ("travel", {"stage": stage_at(10.2e-3)}), ("travel", {"stage": stage_at(-5.2e-3)}),
    ("stage astray", {"stage": stage_at(-0.5e-3), "command": INWARDS}),
    ("stage astray", {"stage": stage_at(5.5e-3), "command": INWARDS}),
    ("stage astray", {"stage": stage_at(0.2e-3), "command": CommandedMotion(0.0, 0.0, 0.0, 0.0)}),
    ("stage stalled", {"stage": stage_at(0.5e-3, at=1.0), "command": INWARDS, "now": 0.01}),
])
def test_each_fault_stops_the_motion(cause, arguments):
    reason = check(make_guard(), **arguments)
    assert reason is not None and reason.cause == cause and reason.message


@pytest.mark.parametrize(("settings", "arguments"), [
    ({"silent_periods": 100}, {"samples": [], "now": 0.06}),
    ({"stall_distance": 0.3e-3}, {"stage": stage_at(10.2e-3)}),
    ({"path_tolerance": 1e-3}, {"stage": stage_at(-0.5e-3), "command": INWARDS}),
    ({"stall_time": 0.6}, {"stage": stage_at(0.5e-3, at=1.0), "command": INWARDS, "now": 0.01}),
])
def test_a_guard_with_larger_tolerances_lets_the_motion_continue(settings, arguments):
    assert check(make_guard(), **arguments) is not None
    assert check(make_guard(**settings), **arguments) is None


@pytest.mark.parametrize(("name", "value", "message"), [
    ("stall_time", 0.0, "stall_time must be positive; got 0"),
    ("path_tolerance", math.inf, "path_tolerance must be finite; got inf"),
    ("speed_tolerance", math.nan, "speed_tolerance must be positive; got nan"),
    ("silent_periods", 2.5, "silent_periods must be a whole number; got 2.5"),
])
def test_no_check_of_the_guard_can_be_switched_off(name, value, message):
    with pytest.raises(InputError, match=message) as failure:
        MotionGuardSettings(**{name: value})
    assert failure.value.field == name


@pytest.mark.parametrize("arguments", [
    {}, {"samples": [sample(4.9), sample(-4.9)]}, {"samples": [sample(status=SampleStatus.GAP)]},
    {"samples": [], "now": 0.04}, {"stage": stage_at(9.9e-3)}, {"stage": stage_at(1e-3, at=1.0), "command": INWARDS},
    {"stage": stage_at(status=SampleStatus.LIMIT, moving=True)},
    {"stage": stage_at(0.05e-3), "command": CommandedMotion(0, 0, 0, 0)},
])
def test_a_motion_within_the_limits_continues(arguments):
    assert check(make_guard(), **arguments) is None


def test_the_speed_is_measured_over_a_tenth_of_a_second():
    guard = make_guard()
    for step in range(30):
        at = 0.01 * step
        assert check(guard, stage=stage_at(1.9e-3 * at, at=at), now=at) is None
    stops = [check(guard, stage=stage_at(0.57e-3 + 4e-3 * 0.01 * step, at=0.3 + 0.01 * step), now=0.3 + 0.01 * step)
             for step in range(30)]
    assert [stop.cause for stop in stops if stop][:1] == ["speed"]


def test_a_late_reply_is_not_mistaken_for_speed():
    # 1.9 mm/s, below the limit of 2 mm/s; one reply takes 0.3 s, the next comes at once.
    guard = make_guard()
    replies = [(0.01 * step, 0.01 * step) for step in range(10)] + [(0.1, 0.4), (0.4, 0.41), (0.45, 0.46)]
    for requested, received in replies:
        stage = replace(stage_at(1.9e-3 * requested, at=received), requested=requested)
        assert check(guard, stage=stage, now=received) is None


def test_the_speed_is_measured_on_a_slow_line():
    # 4 mm/s, twice the limit; each reply takes 20 ms.
    guard, stops = make_guard(), []
    for step in range(40):
        requested = 0.02 * step
        stage = replace(stage_at(4e-3 * requested, at=requested + 0.02), requested=requested)
        stops.append(check(guard, stage=stage, now=requested + 0.02))
    assert [stop.cause for stop in stops if stop][:1] == ["speed"]


def test_a_stall_is_detected_only_with_an_encoder():
    behind = {"stage": stage_at(0.5e-3, at=1.0), "command": INWARDS, "now": 0.01}
    assert check(make_guard(measures=False), **behind) is None


def test_position_and_force_are_checked_only_after_homing_and_tare():
    guard = make_guard(ready=False)
    assert check(guard, samples=[sample(50.0)], stage=stage_at(0.5, status=SampleStatus.LIMIT)) is None
    assert check(guard, stage=stage_at(status=SampleStatus.FAULT)).cause == "stage fault"


@pytest.mark.parametrize(("cause", "allowed"), [
    ("force", True), ("sensor lost", True), ("asked", True), ("zero", True), ("program late", True),
    ("stage fault", False), ("limit switch", False), ("stage stalled", False), ("stage astray", False),
    ("device", False), ("speed", False), ("travel", False),
])
def test_a_faulty_stage_does_not_retract(cause, allowed):
    assert StopReason(cause, "").allows_retraction is allowed


def test_a_motion_with_a_force_increase_above_the_margin_is_refused():
    require_stop_within_force_margin(LIMITS, 1e-3, 0.9)
    with pytest.raises(InputError, match=r"got 1.1 N: .* on a specimen of 1 N/mm.*at most 0.91 mm/s"):
        require_stop_within_force_margin(LIMITS, 1e-3, 1.1)
    with pytest.raises(InputError, match="Use a stage that stops when the program ends"):
        require_stop_within_force_margin(LIMITS, 1e-3, math.inf)


def test_the_old_name_stop_warns():
    from haptics.safety import motion_guard

    with pytest.warns(DeprecationWarning, match="motion_guard.Stop is renamed to .*motion_guard.StopReason"):
        assert motion_guard.Stop is StopReason
