"""One axis of a Grbl, against the emulator: the contract, the queued motion, and the message of each failure."""

import math
import pickle
import threading
import time
from dataclasses import replace

import pytest
import serial
from device_contracts import StageContract
from stepper_benches import Clock, bench, port_that_answers
from waiting import wait_until

from haptics.devices import grbl as grbl_stage
from haptics.devices import grbl_connection
from haptics.devices.back_ends import make_stage
from haptics.devices.contracts import DeviceError, SampleStatus
from haptics.devices.grbl import make_grbl_stage
from haptics.devices.virtual.faults import Faults
from haptics.emulators.emulator import make_emulator
from haptics.emulators.grbl import GrblEmulator
from tissue_sim.errors import InputError

#: Step of the clock of the emulator's stage, s.
_TICK = 2e-3


def pass_time(emulator, stage, clock, seconds):
    """Advance the clock while jogs are queued, so that a busy machine takes longer but sees the same motion."""
    def may_continue():
        if stage._connection is not None:
            stage._last_call = time.monotonic()  # as a call of `position` would do
        goal = stage._goal
        if goal is not None and stage._sent != goal[0]:
            return emulator.queued_duration > 0.02
        return (goal is None and stage._homing_until is None) or emulator._stage.position().moving

    while seconds > 1e-9:
        wait_until(may_continue, "jogs in the queue")
        clock.now += min(_TICK, seconds)
        seconds -= _TICK


class TestGrbl(StageContract):
    tolerance = 1.5e-6
    settings = ""
    more = ""

    @pytest.fixture
    def stage(self):
        self.clock = Clock()
        with make_emulator("grbl:" + self.settings, bench(start_at=0.002, clock=self.clock)) as self.emulator:
            stage = self.stage = make_stage(self.emulator.address + self.more)
            yield stage
            stage.stop()
            assert self.emulator.most_queued <= 0.1 + 1e-3

    def pass_time(self, seconds):
        pass_time(self.emulator, self.stage, self.clock, seconds)


class TestGrblOfWorkCoordinates(TestGrbl):
    """Homing to the other end, and reports in work coordinates."""

    settings = "23=4,work_offset_mm=3.5"
    more = ",baud=57600"


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def emulator(clock):
    with GrblEmulator(bench(clock=clock), Faults()) as emulator:
        yield emulator


def home(stage, clock):
    stage.home()

    def there():
        clock.now += 0.01
        sample = stage.position()
        return sample.homed and not sample.moving

    wait_until(there, event="homing")


def homed(emulator, clock):
    stage = make_stage(emulator.address)
    stage.start()
    home(stage, clock)
    return stage


def test_at_most_a_tenth_of_a_second_of_motion_is_queued(emulator, clock):
    stage = homed(emulator, clock)
    for goal, speed in ((0.004, 0.004), (0.001, 0.001), (0.0015, 0.0005), (0.0, 0.004)):
        stage.move(goal, speed)
        pass_time(emulator, stage, clock, 0.4)
        assert 0.0 < emulator.most_queued <= 0.1 + 1e-3
    stage.stop()


def test_a_hung_program_sends_no_more_jogs(emulator, clock, monkeypatch):
    monkeypatch.setattr(grbl_stage, "JOGS", replace(grbl_stage.JOGS, silence=0.2))
    stage = homed(emulator, clock)
    stage.move(0.008, 0.004)
    wait_until(lambda: time.monotonic() - stage._last_call > 0.3, event="the silence")
    for _ in range(500):
        clock.now += 0.01
    stood = emulator._stage.position()
    assert not stood.moving and stood.position <= 0.004 * 5 and stood.position < 0.008
    sample = stage.position()
    assert sample.moving
    pass_time(emulator, stage, clock, 3.0)
    wait_until(lambda: not stage.position().moving, event="the end of the motion")
    assert stage.position().position == pytest.approx(0.008, abs=2e-6)
    stage.stop()


@pytest.mark.slow
def test_a_halt_while_homing_leaves_the_zero_unknown(clock):
    with GrblEmulator(bench(start_at=0.008, clock=clock), Faults()) as emulator:
        stage = make_stage(emulator.address)
        stage.start()
        stage.home()
        wait_until(lambda: emulator._homing, event="homing")
        clock.now += 0.5
        assert stage.position().moving
        stage.halt()
        wait_until(lambda: not stage.position().moving, event="the halt")
        clock.now += 10.0
        sample = stage.position()
        assert not sample.homed and not sample.moving and sample.status & SampleStatus.FAULT
        with pytest.raises(DeviceError, match="alarm 6: homing was interrupted"):
            stage.move(0.001, 0.001)
        home(stage, clock)
        stage.stop()


def test_a_halt_cancels_queued_motions(emulator, clock):
    stage = homed(emulator, clock)
    stage.move(0.008, 0.004)
    pass_time(emulator, stage, clock, 0.3)
    assert emulator.queued_duration > 0.0
    stage.halt()
    wait_until(lambda: emulator.queued_duration == 0.0, event="the end of the queue, on a clock that stands")
    stage.stop()


def test_a_halt_from_another_thread_stops_the_motion(emulator, clock):
    stage = homed(emulator, clock)
    stage.move(0.008, 0.004)
    pass_time(emulator, stage, clock, 0.5)
    thread = threading.Thread(target=stage.halt)
    thread.start()
    thread.join()
    wait_until(lambda: not stage.position().moving, event="the halt")
    stood = stage.position().position
    for _ in range(20):
        clock.now += 0.1
        assert stage.position().position == stood
    assert 0.0 < stood < 0.004
    stage.stop()


@pytest.mark.parametrize(("number", "words"), [(1, r"alarm 1: a limit switch was hit.*free the axis, reset it and"),
                                               (3, "alarm 3: the machine was reset during a motion.*home it")])
def test_an_alarm_sets_the_status_and_motions_raise(emulator, clock, number, words):
    stage = homed(emulator, clock)
    stage.move(0.008, 0.004)
    pass_time(emulator, stage, clock, 0.3)
    emulator.request_alarm(number)
    wait_until(lambda: stage.position().status & SampleStatus.FAULT, event="the alarm")
    sample = stage.position()
    assert not sample.homed and not sample.moving
    assert bool(sample.status & SampleStatus.LIMIT) == (number == 1)
    with pytest.raises(DeviceError, match=words):
        stage.move(0.001, 0.004)
    home(stage, clock)
    assert not stage.position().status
    stage.stop()


def test_failed_homing_raises(clock):
    with GrblEmulator(bench(start_at=0.008, clock=clock), Faults()) as emulator:
        stage = make_stage(emulator.address)
        stage.start()
        stage.home()
        wait_until(lambda: emulator._homing, event="homing")
        emulator.request_alarm(9)
        with pytest.raises(DeviceError, match="did not home: homing found no limit switch; check its wiring"):
            wait_until(lambda: not stage.position().moving)
        assert not stage.position().homed
        stage.stop()


def test_endless_homing_raises(clock):
    with GrblEmulator(bench(start_at=0.008, clock=clock), Faults()) as emulator:
        stage = make_stage(emulator.address)
        stage.start()
        stage._longest_homing = 0.2
        stage.home()
        with pytest.raises(DeviceError, match=r"homing of the Grbl at .* does not end; check the limit switch of Z"):
            wait_until(lambda: not stage.position().moving)
        stage.stop()


def test_a_refused_jog_raises_once_and_ends_the_motion(emulator, clock):
    stage = homed(emulator, clock)
    emulator._settings[132] = 3.0  # the travel was changed after the start
    stage.move(0.008, 0.004)
    with pytest.raises(DeviceError, match="refused a motion with error 15: the target is outside the travel"):
        while True:
            pass_time(emulator, stage, clock, 0.02)
            stage.position()
    wait_until(lambda: not stage.position().moving)
    stage.stop()


def test_a_restart_of_the_controller_raises(emulator, clock):
    stage = homed(emulator, clock)
    emulator.advance_and_get_messages_to_send, due = lambda: [
        b"Grbl 1.1h ['$' for help]\r\n"], emulator.advance_and_get_messages_to_send
    with pytest.raises(DeviceError, match="has restarted and lost its zero; check its supply, and home it again"):
        wait_until(lambda: not stage.position())
    emulator.advance_and_get_messages_to_send = due
    wait_until(lambda: not stage.position().homed)
    with pytest.raises(DeviceError, match="home it first"):
        stage.move(0.001, 0.001)
    stage.stop()


def test_a_machine_on_hold_refuses_motions(emulator, clock):
    stage = homed(emulator, clock)
    emulator._held = True
    with pytest.raises(DeviceError, match="is on hold; send ~ or reset it"):
        stage.move(0.001, 0.001)
    with pytest.raises(DeviceError, match="is on hold"):
        stage.home()
    stage.stop()


def test_a_jog_left_by_another_program_is_cancelled(emulator, clock):
    stage = homed(emulator, clock)
    stage.move(0.008, 0.004)
    wait_until(lambda: emulator.queued_duration > 0.05)
    connection, stage._connection = stage._connection, None
    connection.close()  # like the death of the program
    again = make_stage(emulator.address)
    again.start()
    wait_until(lambda: not again.position().moving)
    assert not emulator._motions
    again.stop()


@pytest.mark.parametrize(("settings", "words"), [
    ("13=1", "reports inches; set .13=0"), ("22=0", "cannot home.*set .22=1"),
    ("132=8", "is 7 mm, less than 10 mm; lower highest_mm, or correct .132"),
    ("112=60", "is 1 mm/s, less than 4 mm/s; lower top_speed_mm_s, or raise .112"),
    ("122=10", "is 0.8 mm/s, less than 4 mm/s; lower top_speed_mm_s, or raise .122"),
])
def test_limits_beyond_those_of_the_machine_are_refused(clock, settings, words):
    with make_emulator("grbl:" + settings, bench(clock=clock)) as emulator:
        stage = make_stage(emulator.address)
        for _ in range(2):
            with pytest.raises(DeviceError, match=words):
                stage.start()
        with pytest.raises(DeviceError, match="start"):
            stage.position()


def test_another_version_is_refused(clock):
    with GrblEmulator(bench(clock=clock), Faults(), version="0.9j.20160303") as emulator, pytest.raises(
            DeviceError, match=r"reports 0\.9; install Grbl 1.1"):
        make_stage(emulator.address).start()


def test_a_machine_used_by_another_program_is_refused(clock):
    with GrblEmulator(bench(clock=clock), Faults()) as emulator:
        emulator._alarm, emulator._held = False, True
        with pytest.raises(DeviceError, match="in the state Hold because of another program; end that"):
            make_stage(emulator.address).start()


def test_a_missing_port_raises():
    with pytest.raises(DeviceError, match="there is no port /dev/ttyNOWHERE for the Grbl"):
        make_grbl_stage("/dev/ttyNOWHERE").start()


def test_a_busy_port_raises_with_the_remedy(emulator):
    first = make_stage(emulator.address)
    first.start()
    with pytest.raises(DeviceError, match="in use by another program; close that one"):
        make_stage(emulator.address).start()
    first.stop()


def test_a_port_without_permission_raises_with_the_remedy(emulator, monkeypatch):
    def refuse(*arguments, **options):
        raise serial.SerialException(13, "Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(DeviceError, match=r"no permission to open .* for the Grbl.*usermod"):
        make_stage(emulator.address).start()


@pytest.mark.slow
@pytest.mark.parametrize(("answer", "words"), [
    (lambda data: b"\xf8\x3c\x1f\x80\xe0", "no Grbl, or its baud rate is not 115200.*check the baud rate"),
    (lambda data: b"\r\n>" if data.endswith(b"\r") else b"", "an ATI controller answers there: name it ati-serial:"),
    (lambda data: b"", r"nothing answers .* check that the Grbl has power, the cable and the baud rate"),
])
def test_garbage_another_device_or_silence_raises(answer, words, monkeypatch):
    monkeypatch.setattr(grbl_connection, "TIMING", replace(grbl_connection.TIMING, boot=0.5))
    with port_that_answers(answer) as port, pytest.raises(DeviceError, match=words):
        make_grbl_stage(port).start()


def test_a_tic_in_place_of_a_grbl_is_identified(clock, monkeypatch):
    monkeypatch.setattr(grbl_connection, "TIMING", replace(grbl_connection.TIMING, boot=0.5))
    with make_emulator("tic:", bench(clock=clock)) as emulator, pytest.raises(DeviceError, match="name it tic:"):
        make_grbl_stage(emulator.path).start()


@pytest.mark.slow
def test_a_silent_line_raises_and_ends_queueing(clock):
    with GrblEmulator(bench(clock=clock), Faults(disconnect_after=1.0)) as emulator:
        stage = homed(emulator, clock)
        stage.move(0.008, 0.004)
        with pytest.raises(DeviceError, match="has sent no report for 1 s; check that it has power, the cable"):
            while True:
                stage.position()
        assert emulator.most_queued <= 0.1 + 1e-3
        stage.halt()
        stage.stop()


def test_an_unplugged_controller_raises(emulator, clock):
    stage = homed(emulator, clock)
    stage.move(0.008, 0.004)
    emulator.stop()
    with pytest.raises(DeviceError, match=r"is gone .* plug it in again"):
        wait_until(lambda: not stage.position())
    stage.halt()
    stage.stop()


@pytest.mark.parametrize(("settings", "field"), [
    ("lowest_mm=-1", "lowest_mm, highest_mm"), ("highest_mm=0", "lowest_mm, highest_mm"), ("axis=A", "axis"),
    ("axis=", "axis"), ("top_speed_mm_s=0.01", "top_speed_mm_s"), ("baud=-1", "baud"), ("speed=1", "speed"),
])
def test_invalid_settings_are_refused(settings, field):
    with pytest.raises(InputError) as caught:
        make_grbl_stage("/dev/ttyUSB0," + settings)
    assert caught.value.field == field


def test_speeds_below_the_lowest_feed_rate_are_refused(emulator, clock):
    stage = homed(emulator, clock)
    with pytest.raises(InputError) as caught:
        stage.move(0.001, 0.9e-3 / 60)
    assert caught.value.field == "speed"
    stage.stop()


def test_describe_states_what_is_not_detectable_and_not_verified(emulator, clock):
    stage = homed(emulator, clock)
    described = stage.describe()
    assert described["stalled_motor"] == "not detectable" and not stage.measures_position
    assert "unverified" in described["checked_with"] and described["resolution_mm"] == 1 / 800
    with pytest.raises(TypeError, match="stop it first"):
        pickle.dumps(stage)
    stage.stop()
    assert math.isclose(pickle.loads(pickle.dumps(stage)).runs_on, 0.1)
