"""The ATI stand-alone controller on RS-232, against its emulator: the contract, and the message of each failure."""

import sys
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
from device_contracts import ForceSensorContract
from waiting import wait_until

if sys.platform == "win32":
    pytest.skip("the emulated controller uses a pseudo-terminal, and Windows has none",
                allow_module_level=True)

from haptics.devices import ati_serial
from haptics.devices.ati_serial import AtiSerialSensor
from haptics.devices.back_ends import make_sensor
from haptics.devices.contracts import Bench, DeviceError, SampleStatus
from haptics.devices.serial_line import SerialLine
from haptics.devices.virtual.faults import Faults
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.emulators import ati_serial as emulation
from haptics.emulators.ati_serial import AtiSerialEmulator
from haptics.emulators.emulator import SerialDeviceEmulator, make_emulator
from haptics.protocols.ati_serial import (
    AtiSerialRecord,
    decode_ascii_record_or_none,
    decode_binary_record_or_none,
    encode_ascii_record_without_ending,
)
from tissue_sim.errors import InputError

AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
LOAD = (1.0, -2.0, 3.0, 0.1, 0.2, -0.3)
#: `LOAD` in counts of the emulator: 100 per N, 4000 per N m.
COUNTS = (100, -200, 300, 400, 800, -1200)
#: Longest wait of a test, s; reached only if the test hangs.
LONG = 60.0
#: Time for which `start` observes the records, s: about three records of the slowest line.
SHORT = 0.15


def six(time):
    return LOAD


def bench(load=six, reach=500.0):
    return Bench(VirtualForceSensor(load, AXES, reach=reach), None)


def read_records(sensor, count=1):
    """Return at least `count` samples."""
    samples = []
    wait_until(lambda: samples.extend(sensor.read()) or len(samples) >= count)
    return samples


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """Long waits by default, because the emulator may pause for a second on a busy machine; ``patience(seconds)`` sets
    the wait of a test that expects it to end."""
    def patience(seconds):
        monkeypatch.setattr(ati_serial, "TIMING", replace(ati_serial.TIMING, patience=seconds, silence=seconds,
                                                          observation=SHORT))

    patience(LONG)
    return patience


@pytest.fixture
def emulator():
    with make_emulator("ati-serial:", bench()) as emulator:
        yield emulator


class OverASerialLine(ForceSensorContract):
    load = LOAD
    tolerance = 1e-9

    @pytest.fixture
    def sensor(self):
        with make_emulator(self.emulated, bench()) as emulator:
            self.sensor_here = make_sensor(emulator.address)
            yield self.sensor_here
            self.sensor_here.stop()

    def pass_time(self, seconds):
        """Wait for the number of records that the line transmits in this time."""
        receiver = self.sensor_here._receiver
        count = max(round(seconds * self.sensor_here.rate), 1)
        wait_until(lambda: len(receiver._waiting) >= count)

    def now(self):
        return time.monotonic()


class TestAscii(OverASerialLine):
    emulated = "ati-serial:"


class TestAsciiWithoutPadding(OverASerialLine):
    emulated = "ati-serial:padded=0"


class TestBinary(OverASerialLine):
    emulated = "ati-serial:mode=binary,baud=4800"


def test_describe_returns_the_settings(emulator):
    sensor = make_sensor(emulator.address)
    sensor.start()
    described = sensor.describe()
    assert described["verified"] == "against an emulator only" and described["mode"] == "ascii"
    assert described["resolution_N"] == 0.01 and described["range_Nm"] == pytest.approx(32767 / 4000)
    assert read_records(sensor)[0].counts == COUNTS
    sensor.stop()
    assert emulator.describe()["records"] > 0


def test_the_baud_rate_limits_the_rate_of_the_records(monkeypatch):
    """In one second at 9600 baud: 21 padded records, 32 records without padding, 73 binary records."""
    clock = [1000.0]
    monkeypatch.setattr(emulation, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    for padded, mode, wanted in ((True, b"CD A", 21), (False, b"CD A", 32), (True, b"CD B", 73)):
        sensor = VirtualForceSensor(six, AXES, clock=lambda: clock[0])
        emulator = AtiSerialEmulator(sensor, padded=padded)
        emulator.power_on_with_backing_device()
        clock[0] += 0.1
        monkeypatch.setattr(emulator, "_has_matching_baud", lambda: True)
        emulator.execute_bytes_and_get_answers(mode + b"\rQS\r")
        sent = []
        for _ in range(200):
            clock[0] += 1e-3
            sent += emulator.advance_and_get_messages_to_send()
        records = []
        for _ in range(1000):
            clock[0] += 1e-3
            records += emulator.advance_and_get_messages_to_send()
        assert len(records) == pytest.approx(wanted, abs=1)
        decode = (decode_binary_record_or_none if mode == b"CD B"
                  else lambda line: decode_ascii_record_or_none(line.removesuffix(b"\r\n")))
        assert {decode(record) for record in records} == {AtiSerialRecord(0, COUNTS)}


def test_a_load_beyond_the_range_is_saturated():
    with make_emulator("ati-serial:", bench(reach=2.5)) as emulator:
        sensor = make_sensor(emulator.address)
        sensor.start()
        sample = read_records(sensor)[0]
        sensor.stop()
    assert sample.counts[2] == 250 and sample.status == SampleStatus.SATURATED | SampleStatus.FAULT


def test_a_count_at_the_end_of_its_range_is_saturated(emulator, monkeypatch):
    """A count at the end of its range is saturated even if the controller does not set its flag."""
    sensor = make_sensor(emulator.address)
    sensor.start()
    monkeypatch.setattr(emulator, "_encode_next_record", lambda: b"0,  -102,-32768,  -225,   -20,    39,   -39\r\n")
    sample = wait_until(lambda: [each for each in sensor.read() if each.counts != COUNTS])[0]
    sensor.stop()
    assert sample.counts[1] == -32768 and sample.status == SampleStatus.SATURATED


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_a_truncated_record_is_a_gap(emulator, monkeypatch, mode):
    sensor = make_sensor(emulator.address.replace("ascii", mode))
    sensor.start()
    read_records(sensor)
    whole, turn = emulator._encode_next_record, iter(range(10**6))
    # Every third record lacks one byte, each time at another position.
    monkeypatch.setattr(emulator, "_encode_next_record", lambda: (
        lambda record, number: record if number % 3 else record[:number % 11] + record[number % 11 + 1:])(
            whole(), next(turn)))
    samples = read_records(sensor, 20)
    garbled = sensor.describe()["garbled_records"]
    sensor.stop()
    assert garbled >= 5 and {sample.counts for sample in samples} == {COUNTS}
    missing = [after.sequence - before.sequence - 1 for before, after in pairwise(samples)]
    assert sum(missing) >= 5
    assert [bool(count) for count in missing] == [sample.status == SampleStatus.GAP for sample in samples[1:]]


@pytest.mark.slow
def test_garbled_records_are_counted_and_undetected_ones_differ_by_a_digit():
    """Without a checksum, accepted records are only known to be numbers in the right form."""
    # With this seed the first messages, which `start` requires, are intact.
    sound = next(seed for seed in range(1000) if first_garbled(seed) > 12)
    with make_emulator("ati-serial:", bench(), Faults(garble=0.3, seed=sound)) as emulator:
        sensor = make_sensor(emulator.address)
        sensor.start()
        samples = read_records(sensor, 60)
        garbled = sensor.describe()["garbled_records"]
        sensor.stop()
    assert garbled > 0
    assert sum(sample.counts == COUNTS for sample in samples) > len(samples) / 2
    true = encode_ascii_record_without_ending(AtiSerialRecord(0, COUNTS))
    for sample in samples:
        line = encode_ascii_record_without_ending(AtiSerialRecord(0, sample.counts))
        assert sum(a != b for a, b in zip(line, true, strict=True)) <= 1


def first_garbled(seed):
    """Return the number of the first message that `FaultyMessageQueue` garbles with this seed."""
    from haptics.devices.virtual.faults import FaultyMessageQueue

    line = FaultyMessageQueue(Faults(garble=0.3, seed=seed), 0.0)
    for number in range(100):
        line.put_message(b"x" * 45, 0.0)
        if line.take_due_messages(0.0) != [b"x" * 45]:
            return number
    return 100


def test_commands_of_the_manual(emulator):
    """Biases in three levels, one record, averaging and reset, sent directly on the line."""
    line = SerialLine(emulator.path, 9600, "the test")

    def ask(command, end=b">"):
        line.write(command)
        answer = b""

        def whole():
            nonlocal answer
            answer += line.read()
            return answer.endswith(end)

        wait_until(whole)
        return answer

    assert ask(b"\r") == b"\r\n\r\n>"
    assert ask(b"QR\r").splitlines()[1] == b"0,   100,  -200,   300,   400,   800, -1200"
    ask(b"SB\r")
    assert ask(b"qr\r").splitlines()[1] == b"0,     0,     0,     0,     0,     0,     0"
    ask(b"SU\r")
    assert decode_ascii_record_or_none(ask(b"QR\r").splitlines()[1]) == AtiSerialRecord(0, COUNTS)
    for _ in range(5):
        ask(b"SB\r")
    ask(b"SZ\r")
    for silent in (b"SA 16\r", b"CD R\r", b"CD E\r", b"CD U\r"):
        assert ask(silent) == silent + b"\n\r\n>"
    assert decode_ascii_record_or_none(ask(b"\x14", b"\n").removesuffix(b"\r\n")) == AtiSerialRecord(0, COUNTS)
    ask(b"CD B\r")
    line.write(b"\x14")
    assert decode_binary_record_or_none(line.read_exactly(13, LONG)) == AtiSerialRecord(0, COUNTS)
    assert b"ERROR" in ask(b"XX\r")
    assert ask(b"\x17").startswith(b"ATI")
    assert decode_ascii_record_or_none(ask(b"QR\r").splitlines()[1]) == AtiSerialRecord(0, COUNTS)
    line.close()


@pytest.mark.slow
def test_a_stream_left_by_another_program_is_ended(emulator):
    for mode in (b"CD A\r", b"CD B\r"):
        line = SerialLine(emulator.path, 9600, "the test")
        line.write(mode + b"QS\r")
        line.read_exactly(60, LONG)
        line.close()
        sensor = make_sensor(emulator.address)
        sensor.start()
        assert read_records(sensor)[0].counts == COUNTS
        sensor.stop()


# Failures at the port.

def sensor_at(path, **options):
    return AtiSerialSensor(path, 100.0, 4000.0, **options)


def test_a_missing_port_raises():
    with pytest.raises(DeviceError, match=r"^there is no port /dev/ttyNOT for the ATI controller; "):
        sensor_at("/dev/ttyNOT").start()


def test_a_busy_port_raises_with_the_remedy(emulator):
    other = SerialLine(emulator.path, 9600, "the other")
    with pytest.raises(DeviceError, match=r"is in use by another program; close that one, then start the ATI "
                       r"controller"):
        sensor_at(emulator.path).start()
    other.close()
    sensor = sensor_at(emulator.path)
    sensor.start()
    sensor.stop()


@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_a_wrong_baud_rate_raises(emulator, mode):
    with pytest.raises(DeviceError, match=r"^the bytes from \S+ are no text at 38400 baud; give the baud rate of the "
                       "ATI controller, which its display shows at power on, as in baud=38400$"):
        sensor_at(emulator.path, baud=38400, mode=mode).start()


class Talker(SerialDeviceEmulator):
    """Another device: sends the same answer to each carriage return."""

    name = "other device"

    def __init__(self, answer, unasked=()):
        super().__init__(Faults())
        self._answer, self._unasked = answer, list(unasked)

    @property
    def address(self):
        return self.path

    def power_on_with_backing_device(self):
        return

    def stop_backing_device(self):
        return

    def execute_bytes_and_get_answers(self, data):
        return [self._answer] * data.count(b"\r") if self._answer else []

    def advance_and_get_messages_to_send(self):
        unasked, self._unasked = self._unasked, []
        return unasked

    def describe(self):
        return {}


@pytest.mark.slow
@pytest.mark.parametrize(("answer", "unasked", "sentence"), [
    (b"", (), r"^nothing answers at \S+; check that the ATI controller has power, the cable, and the baud rate \(here "
     r"9600"),
    (b"ok\r\n", (b"\r\nGrbl 1.1h ['$' for help]\r\n",),
     r"^the device at \S+ is not an ATI controller \(it sent '.*ok' and no prompt '>'\); give the port of the "
     r"controller$"),
    (b"?\r\r>", (), r"^the ATI controller at \S+ sends no records of a flag and six counts \('\?'\); select all six"),
    (b"0,1,2,3,4\r\n>", (), r"sends no records of a flag and six counts \(.*0,1,2,3,4'\); select all six components "
     r"\(CV 3F"),
])
@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_another_device_at_the_port_raises(answer, unasked, sentence, mode, patience):
    """No answer (as of a Tic); a Grbl; a device with the same prompt; a controller that sends four components."""
    patience(1.0)
    with Talker(answer, unasked) as other:
        sensor = sensor_at(other.path, mode=mode)
        if mode == "binary" and b">" in answer:
            sentence = "sends no records of a flag and six counts"
        with pytest.raises(DeviceError, match=sentence):
            sensor.start()
        # Checks that the port was closed.
        SerialLine(other.path, 9600, "the test").close()


@pytest.mark.slow
def test_an_answer_without_a_prompt_raises(emulator, monkeypatch, patience):
    patience(1.0)
    answer = emulator._execute_command
    monkeypatch.setattr(emulator, "_execute_command", lambda command: None if command == b"CD R" else answer(command))
    with pytest.raises(DeviceError, match=r"did not end its answer to 'CD R' \(nothing arrived\) with its prompt '>'; "
                       r"switch it off and on"):
        sensor_at(emulator.path).start()


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["ascii", "binary"])
def test_a_silent_controller_raises(emulator, monkeypatch, mode):
    sensor = make_sensor(emulator.address.replace("ascii", mode))
    sensor.start()
    assert read_records(sensor)
    sensor._receiver._silence = 1.0
    monkeypatch.setattr(emulator, "advance_and_get_messages_to_send", lambda: [])
    with pytest.raises(DeviceError, match=r"has sent nothing for 1 s; check its power, its sensor and the cable, and"):
        wait_until(lambda: sensor.read() and None)
    with pytest.raises(DeviceError, match="has sent nothing"):
        sensor.tare()
    sensor.stop()


@pytest.mark.slow
def test_text_instead_of_records_raises_and_is_quoted(emulator, monkeypatch):
    """Some controllers report a saturated or disconnected sensor in words."""
    sensor = make_sensor(emulator.address)
    sensor.start()
    assert read_records(sensor)
    sensor._receiver._silence = 1.0
    monkeypatch.setattr(emulator, "_encode_next_record", lambda: b"saturation error\r\n")
    with pytest.raises(DeviceError, match=r"has sent no complete record \('saturation error'\) for 1 s; check its "
                       r"power"):
        wait_until(lambda: sensor.read() and None)
    assert sensor.describe()["garbled_records"] > 0
    sensor.stop()


def test_a_disconnected_cable_raises_and_a_new_start_works(emulator):
    sensor = make_sensor(emulator.address)
    sensor.start()
    emulator.stop()
    with pytest.raises(DeviceError, match=r"the ATI controller at \S+ is gone .*; plug it in again and start again"):
        wait_until(lambda: sensor.read() and None)
    sensor.stop()
    emulator.start()
    again = make_sensor(emulator.address)
    again.start()
    assert read_records(again)[0].sequence == 0
    again.stop()


def test_unread_records_are_lost_and_marked_as_a_gap(emulator, monkeypatch):
    sensor = make_sensor(emulator.address)
    sensor.start()
    read_records(sensor)
    waiting = sensor._receiver._waiting
    wait_until(lambda: len(waiting) >= 3)
    waiting.popleft()  # like a full queue
    first, *others = sensor.read()
    sensor.stop()
    assert first.status == SampleStatus.GAP and all(sample.status == SampleStatus.GOOD for sample in others)


@pytest.mark.parametrize(("name", "sentence"), [
    ("ati-serial:", r"^ati-serial\.name: the port of the controller is missing; give it first, as in ati-serial:/dev"),
    ("ati-serial:baud=9600", "the port of the controller is missing"),
    ("ati-serial:/dev/ttyUSB0", r"counts_per_N: the counts per unit must be above 0; got 0\. Give the counts per unit "
     r"of the sensor's "
     r"calibration sheet"),
    ("ati-serial:/dev/ttyUSB0,counts_per_N=100", "counts_per_Nm: the counts per unit must be above 0; got 0"),
    ("ati-serial:/dev/ttyUSB0,counts_per_N=1,counts_per_Nm=1,mode=binry",
     "mode: the value must be one of ascii, binary; got "
     "'binry'; did you mean 'binary'"),
    ("ati-serial:/dev/ttyUSB0,counts_per_N=1,counts_per_Nm=1,bawd=1", "bawd: unknown setting; did you mean 'baud'"),
    ("ati-serial:/dev/ttyUSB0,counts_per_N=1,counts_per_Nm=1,baud=-1", "baud: the baud rate must be above 0; got -1"),
    ("ati-serial:/dev/ttyUSB0,counts_per_N=1,counts_per_Nm=1,rate_hz=-1",
     "rate_hz: the sampling rate must be above 0; got -1 Hz"),
    ("ati-serial:/dev/ttyUSB0,counts_per_N=1,counts_per_Nm=1,average=300",
     "average: the number of averaged samples must be 0 to 255; got "
     "300"),
])
def test_invalid_settings_are_refused(name, sentence):
    with pytest.raises(InputError, match=sentence):
        make_sensor(name)


def test_invalid_settings_of_the_emulator_are_refused():
    for name, sentence in (("ati-serial:mode=hex", "mode: the value must be one of ascii, binary; got 'hex'"),
                           ("ati-serial:baud=0", "baud: counts per unit and baud rate must be above 0; got 0"),
                           ("ati-serial:counts_per_N=-1", "counts_per_N: counts per unit and baud rate must be above "
                            "0; got -1")):
        with pytest.raises(InputError, match=sentence):
            make_emulator(name, bench())
    with pytest.raises(InputError, match="mode: the mode of the records must be ascii or binary; got 'hex'"):
        AtiSerialSensor("/dev/ttyUSB0", 1.0, 1.0, mode="hex")
