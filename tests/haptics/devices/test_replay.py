"""The sensor that replays a recording: the contract, its times, its channels and its end."""

import math

import numpy as np
import pytest
from device_contracts import ForceSensorContract

from haptics.devices.back_ends import make_sensor
from haptics.devices.contracts import DeviceError
from haptics.devices.replay import ReplaySensor
from tissue_sim.errors import InputError
from tissue_sim.recording.file import write_recording
from tissue_sim.recording.recording import Recording


class Clock:
    """Clock in s, advanced by the test."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def recording(time=None, **channels):
    time = np.arange(5000) / 1000.0 if time is None else np.asarray(time)
    channels = {name: np.broadcast_to(value, time.shape) for name, value in channels.items()}
    return Recording({"time": time, **channels}, metadata={"name": "needle_1"})


class TestReplay(ForceSensorContract):
    load = (0.1, -0.2, 3.0, 0.01, 0.02, -0.03)
    tolerance = 1e-12

    @pytest.fixture
    def sensor(self):
        self.clock = Clock()
        return ReplaySensor(recording(Fx=0.1, Fy=-0.2, Fz=3.0, Tx=0.01, Ty=0.02, Tz=-0.03, force=9.0), clock=self.clock)

    def pass_time(self, seconds):
        self.clock.now += seconds

    def now(self):
        return self.clock.now


class TestByName(ForceSensorContract):
    """A file, replayed at double speed."""

    load = (2.5,)
    tolerance = 1e-12

    @pytest.fixture
    def sensor(self, tmp_path):
        write_recording(recording(force=2.5, displacement=0.001), tmp_path / "needle_1.csv")
        sensor = make_sensor(f"replay:{tmp_path / 'needle_1.csv'},speed=2,resolution_N=0.01")
        assert sensor.channels == ("Fz",) and sensor.rate == pytest.approx(2000.0)
        self.clock = sensor._clock = Clock()
        return sensor

    def pass_time(self, seconds):
        self.clock.now += seconds

    def now(self):
        return self.clock.now


def test_samples_are_replayed_at_their_times():
    """Samples keep their uneven times, from the first one on."""
    clock = Clock()
    sensor = ReplaySensor(recording([7.0, 7.1, 7.15, 8.0, 8.0, 9.0], force=[0.0, 0.101, 0.2, 0.3, 0.4, -0.5]),
                          resolution=0.01, clock=clock)
    sensor.start()
    assert [sample.values for sample in sensor.read()] == [(0.0,)]
    clock.now += 0.12
    sample, = sensor.read()
    assert (sample.values, sample.counts, sample.sequence, sample.received) == ((0.101,), (10,), 1, 100.12)
    assert sensor.read() == ()
    clock.now += 0.9
    assert [sample.sequence for sample in sensor.read()] == [2, 3, 4]
    clock.now += 1.0
    assert [sample.counts for sample in sensor.read()] == [(-50,)]


def test_read_after_the_last_sample_raises_and_a_new_start_replays():
    clock = Clock()
    sensor = ReplaySensor(recording([0.0, 0.5, 1.0], force=[1.0, 2.0, 3.0]), speed=0.5, clock=clock)
    for _ in range(2):
        sensor.start()
        clock.now += 60.0
        assert [sample.values for sample in sensor.read()] == [(1.0,), (2.0,), (3.0,)]
        for _ in range(2):
            with pytest.raises(DeviceError, match=r"^the recording 'needle_1' is at its end, after 3 samples in 2 s; "
                                                  r"start the sensor again to replay it$"):
                sensor.read()
        sensor.stop()


def test_the_tare_is_the_present_sample():
    clock = Clock()
    sensor = ReplaySensor(recording([0.0, 0.5, 1.0], force=[1.0, 2.0, 3.5]), clock=clock)
    sensor.start()
    clock.now += 0.6
    sensor.tare()
    clock.now += 1.0
    assert [sample.values for sample in sensor.read()] == [(-1.0,), (0.0,), (1.5,)]
    assert sensor.describe()["duration_s"] == 1.0


@pytest.mark.parametrize(("made_of", "options", "sentence"), [
    (recording(force=1.0), {"speed": 0.0}, "speed: replay speed and resolution must be finite numbers above 0; got 0"),
    (recording(force=1.0), {"resolution": math.nan}, "resolution: replay speed and resolution must be finite numbers "
     "above 0; got nan"),
    (recording([1.0], force=1.0), {}, "time: the recording must have two different times for a replay"),
    (recording([1.0, 1.0], force=1.0), {}, "time: the recording must have two different times for a replay"),
    (Recording({"force": [1.0, 2.0]}), {}, "time: the times must be recorded for a replay"),
    (recording(displacement=1.0), {}, "this recording has no 'force'; it has time, displacement"),
])
def test_unusable_recordings_are_refused(made_of, options, sentence):
    with pytest.raises(InputError, match=sentence):
        ReplaySensor(made_of, **options)


def test_invalid_names_are_refused(tmp_path):
    for name, sentence in (("replay:", "the recording is missing; give it first, as in replay:needle_1.csv"),
                           (f"replay:{tmp_path / 'no.csv'}", "no such file"),
                           ("replay:x.csv,sped=2", "sped: unknown setting; did you mean 'speed'")):
        with pytest.raises(InputError, match=sentence):
            make_sensor(name)
