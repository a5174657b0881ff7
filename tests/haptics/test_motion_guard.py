"""The guard of a motor: each cause, what may retract, and that limits are limits."""

import math
from dataclasses import replace

import pytest

from haptics.devices.contracts import ForceSample, SampleStatus, StageSample
from haptics.safety.motion_guard import CommandedMotion, MotionGuard, MotionLimits, StopReason, require_stoppable
from tissue_sim.errors import InputError

CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
LIMITS = MotionLimits(force=5.0, lowest=-5e-3, highest=10e-3, speed=2e-3, duration=100.0, stiffness=1e3,
                      force_margin=1.0)


def sample(fz=0.0, fx=0.0, status=0):
    return ForceSample((0,) * 6, (fx, 0.0, fz, 0.0, 0.0, 0.0), 0, status, 0.0)


def place(position=0.0, at=0.0, moving=False, status=0, homed=True):
    return StageSample(0, position, moving, homed, 0, status, at)


def guard(measures=True, knows=True):
    made = MotionGuard(LIMITS, 1000.0, CHANNELS, measures, 0.0)
    made.is_stage_homed = made.is_sensor_zeroed = knows
    return made


def check(made, samples=None, stage=None, drive=None, now=0.0):
    samples = [sample()] if samples is None else samples
    return made.check(now, samples, [each.values[2] for each in samples], stage or place(at=now), drive)


FORTH = CommandedMotion(0.0, 5e-3, 1e-3, 0.0)


@pytest.mark.parametrize(("cause", "asked"), [
    ("force", {"samples": [sample(5.1)]}), ("force", {"samples": [sample(-5.1)]}),
    ("force", {"samples": [sample(), sample(0.0, fx=6.0)]}), ("force", {"samples": [sample(4.0, fx=4.0)]}),
    ("force", {"samples": [sample(1.0), sample(math.nan)]}), ("force", {"samples": [sample(math.nan), sample(1.0)]}),
    ("sensor saturated", {"samples": [sample(status=SampleStatus.SATURATED)]}),
    ("sensor fault", {"samples": [sample(status=SampleStatus.FAULT)]}),
    ("sensor lost", {"samples": [], "now": 0.06}), ("duration", {"now": 101.0, "samples": [sample()]}),
    ("stage fault", {"stage": place(status=SampleStatus.FAULT)}),
    ("limit switch", {"stage": place(status=SampleStatus.LIMIT)}),
    ("travel", {"stage": place(10.2e-3)}), ("travel", {"stage": place(-5.2e-3)}),
    ("stage astray", {"stage": place(-0.5e-3), "drive": FORTH}),
    ("stage astray", {"stage": place(5.5e-3), "drive": FORTH}),
    ("stage astray", {"stage": place(0.2e-3), "drive": CommandedMotion(0.0, 0.0, 0.0, 0.0)}),
    ("stage stalled", {"stage": place(0.5e-3, at=1.0), "drive": FORTH, "now": 0.01}),
])
def test_what_passes_a_limit_ends_the_motion(cause, asked):
    stop = check(guard(), **asked)
    assert stop is not None and stop.cause == cause and stop.message


@pytest.mark.parametrize("asked", [
    {}, {"samples": [sample(4.9), sample(-4.9)]}, {"samples": [sample(status=SampleStatus.GAP)]},
    {"samples": [], "now": 0.04}, {"stage": place(9.9e-3)}, {"stage": place(1e-3, at=1.0), "drive": FORTH},
    {"stage": place(status=SampleStatus.LIMIT, moving=True)},
    {"stage": place(0.05e-3), "drive": CommandedMotion(0, 0, 0, 0)},
])
def test_what_passes_none_goes_on(asked):
    assert check(guard(), **asked) is None


def test_speed_is_seen_over_a_tenth_of_a_second():
    made = guard()
    for step in range(30):
        at = 0.01 * step
        assert check(made, stage=place(1.9e-3 * at, at=at), now=at) is None
    stops = [check(made, stage=place(0.57e-3 + 4e-3 * 0.01 * step, at=0.3 + 0.01 * step), now=0.3 + 0.01 * step)
             for step in range(30)]
    assert [stop.cause for stop in stops if stop][:1] == ["speed"]


def test_a_late_reply_is_not_taken_for_speed():
    # 1.9 mm/s, below the limit of 2 mm/s; one reply takes 0.3 s, the next comes at once.
    made = guard()
    replies = [(0.01 * step, 0.01 * step) for step in range(10)] + [(0.1, 0.4), (0.4, 0.41), (0.45, 0.46)]
    for requested, received in replies:
        stage = replace(place(1.9e-3 * requested, at=received), requested=requested)
        assert check(made, stage=stage, now=received) is None


def test_speed_is_seen_on_a_slow_line():
    # 4 mm/s, twice the limit; each reply takes 20 ms.
    made, stops = guard(), []
    for step in range(40):
        requested = 0.02 * step
        stage = replace(place(4e-3 * requested, at=requested + 0.02), requested=requested)
        stops.append(check(made, stage=stage, now=requested + 0.02))
    assert [stop.cause for stop in stops if stop][:1] == ["speed"]


def test_a_stall_is_seen_by_an_encoder_alone():
    behind = {"stage": place(0.5e-3, at=1.0), "drive": FORTH, "now": 0.01}
    assert check(guard(measures=False), **behind) is None


def test_before_homing_and_tare_nothing_is_said_of_place_and_force():
    made = guard(knows=False)
    assert check(made, samples=[sample(50.0)], stage=place(0.5, status=SampleStatus.LIMIT)) is None
    assert check(made, stage=place(status=SampleStatus.FAULT)).cause == "stage fault"


@pytest.mark.parametrize(("cause", "may"), [
    ("force", True), ("sensor lost", True), ("asked", True), ("zero", True), ("program late", True),
    ("stage fault", False), ("limit switch", False), ("stage stalled", False), ("stage astray", False),
    ("device", False), ("speed", False), ("travel", False),
])
def test_only_a_stage_that_is_believed_goes_back(cause, may):
    assert StopReason(cause, "").allows_retraction is may


def test_a_motion_that_costs_more_than_the_margin_is_refused():
    require_stoppable(LIMITS, 1e-3, 0.9)
    with pytest.raises(InputError, match=r"got 1.1 N: .* on a specimen of 1 N/mm.*at most 0.91 mm/s"):
        require_stoppable(LIMITS, 1e-3, 1.1)
    with pytest.raises(InputError, match="Use a stage that stops when the program ends"):
        require_stoppable(LIMITS, 1e-3, math.inf)
