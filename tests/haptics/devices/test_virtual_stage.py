"""The virtual stage: the contract, and its encoder."""

import math

import pytest
from device_contracts import StageContract

from haptics.devices.back_ends import STAGES, make_stage
from haptics.devices.contracts import StageLimits
from haptics.devices.virtual.stage import VirtualStage
from tissue_sim.errors import InputError


class Clock:
    """Clock in s, advanced by the test."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class TestVirtualStage(StageContract):
    tolerance = 0.5e-6

    @pytest.fixture
    def stage(self):
        self.clock = Clock()
        return VirtualStage(StageLimits(-0.01, 0.03, 0.02), start_at=-0.007, clock=self.clock)

    def pass_time(self, seconds):
        self.clock.now += seconds


class TestByName(StageContract):
    """A stage made by its name."""

    tolerance = 5e-6

    @pytest.fixture
    def stage(self):
        stage = make_stage("virtual:lowest_mm=-5,highest_mm=20,top_speed_mm_s=10,resolution_mm=0.01")
        self.clock = stage._clock = Clock()
        return stage

    def pass_time(self, seconds):
        self.clock.now += seconds


def test_homing_takes_its_time_and_counts_are_encoder_steps():
    clock = Clock()
    stage = VirtualStage(StageLimits(-0.01, 0.03, 0.02), resolution=1e-5, start_at=-0.01, clock=clock)
    stage.start()
    stage.home()
    clock.now += 0.25
    sample = stage.position()
    assert (sample.position, sample.counts, sample.moving, sample.homed) == (pytest.approx(-0.005), -500, True, False)
    clock.now += 0.25
    sample = stage.position()
    assert (sample.counts, sample.moving, sample.homed) == (0, False, True)
    stage.move(0.0123456, 0.02)
    clock.now += 1.0
    assert stage.position().position == pytest.approx(0.01235, abs=1e-12)


def test_a_halt_while_homing_leaves_the_zero_unknown():
    clock = Clock()
    stage = VirtualStage(StageLimits(-0.01, 0.03, 0.02), start_at=-0.01, clock=clock)
    stage.start()
    stage.home()
    clock.now += 0.1
    stage.halt()
    clock.now += 1.0
    sample = stage.position()
    assert not sample.homed and not sample.moving and sample.position == pytest.approx(-0.008)


@pytest.mark.parametrize(("limits", "options", "field"), [
    ((0.01, 0.03, 0.02), {}, "limits"), ((-0.01, math.inf, 0.02), {}, "limits"),
    ((-0.01, 0.03, 0.0), {}, "limits.speed"), ((-0.01, 0.03, 0.02), {"resolution": 0.0}, "resolution"),
])
def test_invalid_stages_are_refused(limits, options, field):
    with pytest.raises(InputError) as caught:
        VirtualStage(StageLimits(*limits), **options)
    assert caught.value.field == field


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(InputError, match=r"unknown stage 'virtua'; did you mean 'virtual'\?"):
        make_stage("virtua:")
    assert "virtual" in STAGES
