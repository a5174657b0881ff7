"""ATI sensors on a data acquisition board: the contract with artificial voltages, and errors of the user's function."""

import math
import sys

import numpy as np
import pytest
from device_contracts import ForceSensorContract

from haptics.devices import ati_daq
from haptics.devices.ati_daq import AtiDaqSensor
from haptics.devices.back_ends import make_sensor
from haptics.devices.contracts import DeviceError, SampleStatus
from haptics.protocols.ati_calibration import AtiVoltageCalibration, parse_ati_calibration
from tissue_sim.errors import InputError

MATRIX = ((0.5, 0.1, 0.0, -9.0, 0.2, 9.1), (0.0, 10.5, 0.1, -5.0, 0.2, -5.1), (16.0, -0.3, 16.5, -0.4, 16.2, -0.5),
          (0.01, 0.2, -0.7, -0.1, 0.7, -0.1), (0.8, 0.0, -0.4, 0.2, -0.4, -0.2), (0.0, -0.4, 0.0, -0.4, 0.0, -0.4))
CALIBRATION = AtiVoltageCalibration("FT00001", "SI-40-2", "1/2/2003", MATRIX, (40.0, 40.0, 120.0, 2.0, 2.0, 2.0),
                                    (-10.0, 10.0), "UserAxis")
LOAD = (1.0, -2.0, 3.0, 0.1, 0.2, -0.3)
FILE = ('<FTSensor Serial="FT7" NumGages="6"><Calibration PartNumber="SI-40-2" ForceUnits="N" TorqueUnits="N-m" '
        'OutputRange="20">' + "".join(
            f'<UserAxis Name="{axis}" values="{" ".join(map(str, row))}" max="{most}"/>'
            for axis, row, most in zip(("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"), MATRIX, CALIBRATION.reach, strict=True))
        + "</Calibration></FTSensor>")


class Board:
    """A board that samples six voltages at a rate, on a clock set by the test; can be pickled."""

    def __init__(self, volts, rate=1000.0):
        self.volts, self.rate, self.now, self.given = volts, rate, 0.0, 0

    def __call__(self):
        first, self.given = self.given, math.floor(self.now * self.rate + 1e-9)
        return np.tile(self.volts, (self.given - first, 1))


def volts_of(load):
    return np.linalg.solve(np.array(MATRIX), np.array(load))


class TestAtiDaq(ForceSensorContract):
    load = LOAD
    tolerance = 1e-9

    @pytest.fixture
    def sensor(self):
        self.board = Board(volts_of(LOAD))
        return AtiDaqSensor(CALIBRATION, self.board)

    def pass_time(self, seconds):
        self.board.now += seconds

    def now(self):
        return self.board.now


BOARD = Board(volts_of(LOAD), 500.0)


class TestByName(ForceSensorContract):
    """The function given by its import path."""

    load = LOAD
    tolerance = 1e-9

    @pytest.fixture
    def sensor(self, tmp_path, monkeypatch):
        (tmp_path / "FT7.cal").write_text(FILE, encoding="utf-8")
        BOARD.now, BOARD.given = 0.0, 0
        monkeypatch.setitem(sys.modules, "my_board", sys.modules[__name__])
        return make_sensor(f"ati-daq:{tmp_path / 'FT7.cal'},volts=my_board:BOARD,rate_hz=500")

    def pass_time(self, seconds):
        BOARD.now += seconds

    def now(self):
        return BOARD.now


def started(volts, range_of_volts=None):
    board = Board(np.asarray(volts, dtype=float))
    board.__name__ = "read_volts"
    sensor = AtiDaqSensor(CALIBRATION, board, volts=range_of_volts)
    sensor.start()
    return sensor, board


def test_counts_have_16_bits_and_ignore_the_tare():
    sensor, board = started((1.0, -1.0, 0.5, 0.0, 0.001, -2.0))
    board.now = 0.1
    before = sensor.read()[-1]
    assert before.counts == (3277, -3277, 1638, 0, 3, -6554)  # in steps of 20 V / 65536
    assert sensor.describe()["count_V"] == 20.0 / 65536
    sensor.tare()
    board.now = 0.2
    after = sensor.read()[-1]
    assert after.counts == before.counts and after.values == pytest.approx((0.0,) * 6, abs=1e-12)


def test_a_tare_removes_the_voltages_without_load():
    sensor, board = started((1.0, -1.0, 0.5, 0.0, 0.3, -2.0))
    board.now = 0.1
    sensor.tare()
    board.volts = board.volts + volts_of(LOAD)
    sensor.read()
    board.now = 0.2
    assert sensor.read()[-1].values == pytest.approx(LOAD)


def test_a_tare_is_the_mean_of_a_tenth_of_a_second():
    sensor, board = started((1.0,) * 6)
    board.now = 0.05
    sensor.read()
    board.volts = np.full(6, 1.2)
    board.now = 0.1
    sensor.tare()
    samples = sensor.read()
    assert len(samples) == 50  # the samples that the tare has read
    assert samples[-1].values == pytest.approx(CALIBRATION.compute_wrench_from_voltage_changes((0.1,) * 6))


def test_a_tare_waits_for_the_first_sample(monkeypatch):
    sensor, board = started((1.0,) * 6)
    monkeypatch.setattr(ati_daq.time, "sleep", lambda seconds: setattr(board, "now", board.now + seconds))
    sensor.tare()
    assert sensor.read()[0].values == pytest.approx((0.0,) * 6, abs=1e-12)


@pytest.mark.parametrize(("volts", "options", "status"), [
    ((9.9, 0.0, 0.0, 0.0, 0.0, 0.0), {}, SampleStatus.SATURATED),          # Fz is 158 N, above 120 N
    ((0.0, 0.0, 0.0, 10.0, 0.0, 10.0), {}, SampleStatus.SATURATED),        # voltages at the end of their range
    ((0.0, 0.0, 0.0, -10.0, 0.0, -10.0), {}, SampleStatus.SATURATED),
    ((0.0, 0.0, 0.0, 2.0, 0.0, 2.0), {}, SampleStatus.GOOD),
    ((0.0, 0.0, 0.0, 2.0, 0.0, 2.0), {"range_of_volts": (-2.0, 2.0)}, SampleStatus.SATURATED),
    ((0.0,) * 6, {"range_of_volts": (0.0, 10.0)}, SampleStatus.GOOD),    # 0 V is not at an end of the range
])
def test_samples_at_the_end_of_the_range_are_saturated(volts, options, status):
    sensor, board = started(volts, **options)
    board.now = 1e-3
    sample, = sensor.read()
    assert sample.status == status


def test_unread_samples_are_lost_and_marked_as_a_gap():
    sensor, board = started((0.0,) * 6)
    board.now = 10.0
    samples = sensor.read()
    assert len(samples) == ati_daq.SAMPLE_BUFFER and samples[0].sequence == 10_000 - ati_daq.SAMPLE_BUFFER
    assert [sample.status for sample in samples[:2]] == [SampleStatus.GAP, SampleStatus.GOOD]


def broken():
    raise OSError("the board was unplugged")


@pytest.mark.parametrize(("read_volts", "sentence"), [
    (broken, r"^broken, which reads the voltages, failed \(OSError: the board was unplugged\); check the board, and "
     r"start"),
    (lambda: None, r"must return an array \(n, 6\) of volts; got a NoneType"),
    (lambda: [1.0] * 6, r"must return an array \(n, 6\) of volts; got a list\. Return the samples since the last call"),
    (lambda: np.zeros((6, 3)), r"must return an array \(n, 6\) of volts; got shape \(6, 3\)"),
    (lambda: [["a"] * 6], r"must return an array \(n, 6\) of volts; got a list"),
    (lambda: [[0.0] * 6, [0.0] * 5], r"must return an array \(n, 6\) of volts; got a list"),
    (lambda: [[0.0] * 5 + [math.nan]], r"must return finite voltages; got NaN or infinity\. Check the board"),
])
def test_an_invalid_result_of_the_function_raises(read_volts, sentence):
    sensor = AtiDaqSensor(CALIBRATION, read_volts)
    sensor.start()
    with pytest.raises(DeviceError, match=sentence):
        sensor.read()


def test_a_silent_board_raises(monkeypatch):
    clock = [50.0]
    monkeypatch.setattr(ati_daq.time, "monotonic", lambda: clock[0])
    sensor, board = started((0.0,) * 6)
    board.now = 0.1
    assert sensor.read()
    clock[0] += 0.9
    assert sensor.read() == ()
    clock[0] += 0.2
    with pytest.raises(DeviceError, match=r"^read_volts has returned no sample for 1\.1 s; check that the board is "
                       r"sampling"):
        sensor.read()


def test_a_missing_function_raises_with_instructions(tmp_path):
    (tmp_path / "FT7.cal").write_text(FILE, encoding="utf-8")
    sensor = make_sensor(f"ati-daq:{tmp_path / 'FT7.cal'}")
    with pytest.raises(DeviceError, match=r"^the ATI sensor FT7 has no function that reads its voltages; give one that "
                       r"returns the new samples as an array \(n, 6\) of volts, as in "
                       r"ati-daq:FT01234\.cal,volts=my_board:read_volts$"):
        sensor.start()


@pytest.mark.parametrize(("place", "sentence"), [
    ("no_such_module_here:read", "no_such_module_here:read, which reads the voltages, cannot be imported .No module "
     "named"),
    ("math:read_volts", "math:read_volts, which reads the voltages, cannot be imported .module 'math' has no "
     "attribute"),
    ("math:pi", r"math:pi must be a function; got a float\. Give a function that returns an array"),
])
def test_a_missing_function_raises(place, sentence):
    with pytest.raises(DeviceError, match=sentence):
        AtiDaqSensor(CALIBRATION, place).start()


@pytest.mark.parametrize(("settings", "sentence"), [
    (",volts=reader", r"volts: the function that reads the voltages must be package\.module:function, .*; got "
     r"'reader'"),
    (",rate_hz=0", r"rate_hz: the sampling rate must be above 0; got 0 Hz\. Give the sampling rate of the board"),
    (",range_V=-5", "range_V: the lowest voltage must be below the highest; got 5 to -5 V"),
    (",range=5", "range: unknown setting; did you mean 'range_V'"),
])
def test_invalid_settings_are_refused(tmp_path, settings, sentence):
    (tmp_path / "FT7.cal").write_text(FILE, encoding="utf-8")
    with pytest.raises(InputError, match=sentence):
        make_sensor(f"ati-daq:{tmp_path / 'FT7.cal'}{settings}")


def test_a_missing_or_truncated_file_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"ati-daq.*no such file, expected the \.cal file of an ATI sensor; check the "
                       r"name"):
        make_sensor(f"ati-daq:{tmp_path / 'FT8.cal'}")
    (tmp_path / "FT7.cal").write_text(FILE[:-40], encoding="utf-8")
    with pytest.raises(InputError, match=r"FT7\.cal: .*is not valid XML .*incomplete or damaged; copy the \.cal file"):
        make_sensor(f"ati-daq:{tmp_path / 'FT7.cal'}")
    with pytest.raises(InputError, match=r"the calibration file is missing; give it first, as in ati-daq:FT01234"):
        make_sensor("ati-daq:volts=a:b")


def test_describe_returns_the_calibration():
    described = AtiDaqSensor(parse_ati_calibration(FILE), volts=(-5.0, 5.0)).describe()
    assert (described["serial"], described["part"], described["volts_V"]) == ("FT7", "SI-40-2", [-5.0, 5.0])
    assert described["verified"] == "with made-up voltages only" and described["calibration_rows"] == "UserAxis"
