"""Tests that every back-end must pass. The test module of a back-end derives a class from the class of its contract,
with a fixture of the unstarted device: ``sensor``, ``stage`` or ``device``.

The method `pass_time` waits if the device has a real clock, and advances the clock of a virtual device.
"""

import math
import pickle
from abc import ABC, abstractmethod
from itertools import pairwise

import pytest

from haptics.devices.contracts import DeviceError, SampleStatus
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose


class ForceSensorContract(ABC):
    """Tests of a `ForceSensor` under constant load.

    Attributes:
        load: Load of each channel, N or N m.
        tolerance: Tolerance of a value, N or N m.
    """

    load = (0.0,)
    tolerance = 0.0

    @abstractmethod
    def pass_time(self, seconds):
        """Advance the clock of the device by a time, s, or wait for it, so that its samples arrive."""

    @abstractmethod
    def now(self):
        """Return the time of the device's clock, s."""

    def samples(self, sensor, seconds=0.05):
        self.pass_time(seconds)
        return sensor.read()

    def test_samples_come_at_the_rate_and_are_numbered(self, sensor):
        began = self.now()
        sensor.start()
        samples = self.samples(sensor, 0.1) + self.samples(sensor, 0.1)
        passed = self.now() - began
        sensor.stop()
        assert 0.18 * sensor.rate - 2 <= len(samples) <= 1.02 * passed * sensor.rate + 2
        assert [sample.sequence for sample in samples] == list(range(len(samples)))
        assert all(before.received <= after.received for before, after in pairwise(samples))

    def test_a_sample_has_count_and_value_of_every_channel(self, sensor):
        sensor.start()
        samples = self.samples(sensor)
        sensor.stop()
        assert samples
        for sample in samples:
            assert len(sample.counts) == len(sample.values) == len(sensor.channels)
            assert all(isinstance(count, int) for count in sample.counts)
            assert sample.values == pytest.approx(self.load, abs=self.tolerance)
            assert sample.status == SampleStatus.GOOD

    def test_a_sample_is_immutable(self, sensor):
        sensor.start()
        sample = self.samples(sensor)[0]
        sensor.stop()
        with pytest.raises(AttributeError):
            sample.values = (1.0,)

    def test_a_sample_is_read_once(self, sensor):
        sensor.start()
        first = self.samples(sensor)
        second = self.samples(sensor)
        sensor.stop()
        assert second[0].sequence == first[-1].sequence + 1

    def test_a_tare_moves_the_values_and_not_the_counts(self, sensor):
        sensor.start()
        before = self.samples(sensor)[-1]
        sensor.tare()
        after = self.samples(sensor)[-1]
        sensor.stop()
        assert after.values == pytest.approx([0.0] * len(self.load), abs=self.tolerance)
        assert after.counts == pytest.approx(before.counts, abs=2)

    def test_an_unstarted_sensor_raises(self, sensor):
        for ask in (sensor.read, sensor.tare):
            with pytest.raises(DeviceError, match="start"):
                ask()

    def test_restart_and_repeated_stop_work(self, sensor):
        for _ in range(2):
            sensor.start()
            sensor.start()
            assert self.samples(sensor)[0].sequence == 0
            sensor.stop()
            sensor.stop()

    def test_describe_returns_the_kind_of_device(self, sensor):
        sensor.start()
        described = sensor.describe()
        sensor.stop()
        assert described["sensor"] and all(isinstance(name, str) for name in described)

    def test_an_unstarted_device_can_be_pickled(self, sensor):
        assert pickle.loads(pickle.dumps(sensor)).channels == sensor.channels


class StageContract(ABC):
    """Tests of a `Stage` that can move freely within its limits."""

    #: Tolerance of positions at rest, m.
    tolerance = 0.0

    @abstractmethod
    def pass_time(self, seconds):
        """Advance the clock of the device by a time, s, or wait for it."""

    def arrive(self, stage, seconds=60.0, step=0.01):
        """Wait for the end of the motion and return the last sample."""
        for _ in range(math.ceil(seconds / step)):
            sample = stage.position()
            if not sample.moving:
                return sample
            self.pass_time(step)
        raise AssertionError("it still moves")

    @pytest.fixture
    def homed(self, stage):
        stage.start()
        stage.home()
        assert self.arrive(stage).homed
        yield stage
        stage.stop()

    def test_home_is_zero(self, homed):
        assert self.arrive(homed).position == pytest.approx(0.0, abs=self.tolerance)

    def test_a_move_reaches_its_target_at_its_speed(self, homed):
        limits = homed.limits
        goal, speed = 0.5 * limits.highest, 0.5 * limits.speed
        homed.move(goal, speed)
        assert homed.position().moving
        self.pass_time(0.5 * goal / speed)
        assert homed.position().position == pytest.approx(0.5 * goal, rel=0.1, abs=self.tolerance)
        self.pass_time(0.6 * goal / speed)
        assert self.arrive(homed).position == pytest.approx(goal, abs=self.tolerance)

    def test_a_new_goal_replaces_the_old_one(self, homed):
        limits = homed.limits
        homed.move(limits.highest, limits.speed)
        self.pass_time(0.3 * limits.highest / limits.speed)
        homed.move(0.0, limits.speed)
        assert homed.position().position < 0.6 * limits.highest
        assert self.arrive(homed).position == pytest.approx(0.0, abs=self.tolerance)

    def test_halt_stops_the_stage_and_a_new_motion_works(self, homed):
        limits = homed.limits
        homed.move(limits.highest, 0.5 * limits.speed)
        self.pass_time(0.5 * limits.highest / limits.speed)
        homed.halt()
        stood = self.arrive(homed).position
        assert 0.0 < stood < limits.highest
        self.pass_time(0.2)
        assert homed.position().position == pytest.approx(stood, abs=self.tolerance)
        homed.move(0.0, limits.speed)
        assert self.arrive(homed).position == pytest.approx(0.0, abs=self.tolerance)

    def test_motions_outside_the_limits_are_refused_without_motion(self, homed):
        limits = homed.limits
        for position, speed, field in ((1.01 * limits.highest, limits.speed, "position"),
                                       (limits.lowest - 1e-3, limits.speed, "position"),
                                       (math.nan, limits.speed, "position"), (0.0, 0.0, "speed"),
                                       (0.0, 1.01 * limits.speed, "speed"), (0.0, math.nan, "speed")):
            with pytest.raises(InputError) as caught:
                homed.move(position, speed)
            assert caught.value.field == field and not homed.position().moving

    def test_a_move_before_homing_raises(self, stage):
        stage.start()
        with pytest.raises(DeviceError, match="home"):
            stage.move(0.0, stage.limits.speed)
        assert not stage.position().homed
        stage.stop()

    def test_samples_are_numbered_and_immutable(self, homed):
        first, second = homed.position(), homed.position()
        assert second.sequence == first.sequence + 1 and first.received <= second.received
        assert isinstance(first.counts, int) and first.status == SampleStatus.GOOD
        with pytest.raises(AttributeError):
            first.position = 1.0

    def test_an_unstarted_stage_raises_and_can_be_halted(self, stage):
        stage.halt()
        for ask in (stage.home, stage.position, lambda: stage.move(0.0, stage.limits.speed)):
            with pytest.raises(DeviceError, match="start"):
                ask()

    def test_describe_returns_the_kind_of_device(self, stage):
        stage.start()
        described = stage.describe()
        stage.stop()
        assert described["stage"] and all(isinstance(name, str) for name in described)

    def test_an_unstarted_device_can_be_pickled(self, stage):
        assert pickle.loads(pickle.dumps(stage)).limits == stage.limits


class HapticDeviceContract:
    """Tests of a `HapticDevice` that no hand pushes."""

    #: True if a force moves the device.
    feels = True

    def ticks(self, device, wrench=(0.0,) * 6, start=0.0, count=50):
        """Return the poses of `count` ticks of 1 ms under a wrench."""
        poses = []
        for number in range(count):
            poses.append(device.pose(start + 1e-3 * number))
            device.render(wrench)
        return poses

    def test_each_tick_has_a_pose(self, device):
        device.start()
        poses = self.ticks(device)
        device.stop()
        assert len(poses) == 50
        for pose in poses:
            assert pose is None or (isinstance(pose, Pose) and pose.is_finite)

    def test_a_force_moves_a_hand_and_leaves_a_motion_unchanged(self, device):
        other, poses = pickle.loads(pickle.dumps(device)), []
        for each, force in ((device, 0.0), (other, 1.0)):
            each.start()
            poses.append(self.ticks(each, (0.0, 0.0, force, 0.0, 0.0, 0.0))[-1])
            each.stop()
        free, pushed = poses
        assert (pushed.position[2] > free.position[2]) if self.feels else pushed == free
        assert pushed.position[:2] == free.position[:2]

    def test_restart_and_repeated_stop_work(self, device):
        for _ in range(2):
            device.start()
            self.ticks(device, count=5)
            device.stop()
            device.stop()

    def test_describe_returns_the_kind_of_device(self, device):
        device.start()
        described = device.describe()
        device.stop()
        assert described["device"] and all(isinstance(name, str) for name in described)

    def test_an_unstarted_device_can_be_pickled(self, device):
        poses = []
        for each in (pickle.loads(pickle.dumps(device)), device):
            each.start()
            poses.append(self.ticks(each, count=3))
            each.stop()
        assert poses[0] == poses[1]


class MotionContract(HapticDeviceContract):
    """Tests of a `Motion`: the pose depends on the time alone."""

    feels = False
