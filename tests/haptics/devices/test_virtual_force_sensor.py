"""The virtual force sensor: the contract, quantisation, range and buffer."""

import math

import pytest
from device_contracts import ForceSensorContract

from haptics.devices.back_ends import FORCE_SENSORS, make_sensor
from haptics.devices.contracts import SAMPLE_BUFFER, SampleStatus
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from tissue_sim.errors import InputError


class Clock:
    """Clock in s, advanced by the test."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def six(time):
    return (0.1, -0.2, 3.0, 0.01, 0.02, -0.03)


def sine(time):
    return (2.0 * math.sin(2 * math.pi * 5.0 * time),)


class TestVirtualForceSensor(ForceSensorContract):
    load = six(0.0)
    tolerance = 0.5e-3

    @pytest.fixture
    def sensor(self):
        self.clock = Clock()
        return VirtualForceSensor(six, ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), rate=500.0, clock=self.clock)

    def pass_time(self, seconds):
        self.clock.now += seconds

    def now(self):
        return self.clock.now


class TestByName(ForceSensorContract):
    """A sensor made by its name."""

    load = (3.0,)
    tolerance = 1e-9

    @pytest.fixture
    def sensor(self):
        sensor = make_sensor("virtual:load_N=3,rate_hz=2000,resolution_N=0.01")
        self.clock = sensor._clock = Clock()
        return sensor

    def pass_time(self, seconds):
        self.clock.now += seconds

    def now(self):
        return self.clock.now


@pytest.fixture
def clock():
    return Clock()


def test_values_are_rounded_loads_at_the_sampling_times(clock):
    sensor = VirtualForceSensor(sine, resolution=0.01, clock=clock)
    sensor.start()
    clock.now += 0.4
    for sample in sensor.read():
        true, = sine(100.0 + (sample.sequence + 1) / sensor.rate)
        assert sample.values[0] == pytest.approx(true, abs=0.5001 * 0.01)
        assert sample.values[0] == pytest.approx(0.01 * sample.counts[0], rel=1e-12)


def test_loads_beyond_the_range_are_clipped_and_saturated(clock):
    sensor = VirtualForceSensor(sine, reach=1.5, clock=clock)
    sensor.start()
    clock.now += 0.2
    samples = sensor.read()
    marked = [bool(sample.status & SampleStatus.SATURATED) for sample in samples]
    assert marked == [abs(sine(100.0 + (sample.sequence + 1) / 1000.0)[0]) > 1.5005 for sample in samples]
    assert max(sample.values[0] for sample in samples) == pytest.approx(1.5) and any(marked)


def test_unread_samples_are_lost_and_marked_as_a_gap(clock):
    sensor = VirtualForceSensor(sine, clock=clock)
    sensor.start()
    clock.now += 1.0
    assert sensor.read()[0].status == SampleStatus.GOOD
    clock.now += 10.0
    samples = sensor.read()
    assert len(samples) == SAMPLE_BUFFER and samples[0].sequence == 11_000 - SAMPLE_BUFFER
    assert [sample.status for sample in samples[:2]] == [SampleStatus.GAP, SampleStatus.GOOD]


@pytest.mark.parametrize(("wrong", "field"), [({"rate": 0.0}, "rate"), ({"resolution": math.nan}, "resolution"),
                                              ({"reach": math.inf}, "reach"), ({"channels": ()}, "channels")])
def test_invalid_sensors_are_refused(wrong, field):
    with pytest.raises(InputError) as caught:
        VirtualForceSensor(sine, **wrong)
    assert caught.value.field == field


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(InputError, match=r"unknown force sensor 'virtul'; did you mean 'virtual'\?"):
        make_sensor("virtul:")
    with pytest.raises(InputError, match=r"virtual\.rate: unknown setting; did you mean 'rate_hz'\?"):
        make_sensor("virtual:rate=3")
    assert "virtual" in FORCE_SENSORS
