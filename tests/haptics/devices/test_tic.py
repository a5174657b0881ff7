"""A Tic on its serial line, against the emulator: the contract, and the message of each failure."""

import itertools
import math
import pickle
import threading
from dataclasses import replace

import pytest
import serial
from device_contracts import StageContract
from stepper_benches import Clock, bench, port_that_answers
from waiting import wait_until

from haptics.devices import tic as tic_stage
from haptics.devices.back_ends import make_stage
from haptics.devices.contracts import DeviceError, SampleStatus, StageLimits
from haptics.devices.tic import TicStage, make_tic_stage
from haptics.devices.virtual.faults import Faults
from haptics.emulators.emulator import make_emulator
from haptics.emulators.tic import TicEmulator
from haptics.protocols.tic import ErrorFlags, InputState, TicCommand, VariableOffset
from tissue_sim.errors import InputError


class TestTic(StageContract):
    """Commands and answers with checksums."""

    tolerance = 1.5e-6
    settings = "steps_per_mm=800,crc=1,response_crc=1"
    more = ""

    @pytest.fixture
    def stage(self, patient):
        self.clock = Clock()
        with make_emulator("tic:" + self.settings, bench(start_at=0.002, clock=self.clock)) as emulator:
            stage = make_stage(emulator.address + self.more)
            yield stage
            stage.stop()

    def pass_time(self, seconds):
        self.clock.now += seconds


class TestTicOfANumber(TestTic):
    """The Pololu protocol, with a coarse scale and without checksums."""

    tolerance = 6e-6
    settings = "steps_per_mm=100,device=99"
    more = ",device=99,baud=115200"


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def patient(monkeypatch):
    """Let a stage wait long for an answer: the thread of the emulator may wait for a busy machine."""
    monkeypatch.setattr(tic_stage, "TIMING", replace(tic_stage.TIMING, answer=30.0))


@pytest.fixture
def emulator(clock, patient):
    with TicEmulator(bench(clock=clock), Faults()) as emulator:
        yield emulator


def homed(emulator, clock):
    stage = make_stage(emulator.address)
    stage.start()
    stage.home()
    for _ in range(1000):
        sample = stage.position()
        if sample.homed and not sample.moving:
            return stage
        clock.now += 0.01
    raise AssertionError("it does not home")


def test_runs_on_is_the_timeout_of_the_tic_plus_the_ramp(clock):
    with make_emulator("tic:timeout_ms=400", bench(clock=clock)) as emulator:
        stage = make_stage(emulator.address + ",ramp_ms=50")
        assert stage.runs_on == pytest.approx(1.05)
        stage.start()
        assert stage.runs_on == pytest.approx(0.45) == stage.describe()["runs_on_s"]
        stage.stop()


def test_describe_states_that_a_stalled_motor_is_not_detectable(emulator):
    stage = make_stage(emulator.address)
    assert stage.describe()["stalled_motor"] == "not detectable" and not stage.measures_position
    assert "unverified" in stage.describe()["checked_with"]


def test_a_silent_program_stops_the_motor_and_the_next_sample_has_a_fault(clock):
    with make_emulator("tic:timeout_ms=150", bench(clock=clock)) as emulator:
        stage = homed(emulator, clock)
        stage.move(0.008, 0.004)
        clock.now += 0.5
        wait_until(lambda: emulator._errors & ErrorFlags.COMMAND_TIMEOUT, event="the command timeout")
        clock.now += 10.0
        sample = stage.position()
        assert sample.status & SampleStatus.FAULT and sample.homed and not sample.moving
        assert sample.position == pytest.approx(0.002, abs=2e-6)
        clock.now += 10.0
        assert stage.position().position == pytest.approx(0.002, abs=2e-6)
        stage.move(0.003, 0.004)
        assert not stage.position().status
        stage.stop()


def test_a_timeout_that_ended_before_the_next_sample_is_a_fault(clock):
    """The command that restarts the timeout comes after it: the error is gone, and the motor has stopped."""
    with make_emulator("tic:timeout_ms=150", bench(clock=clock)) as emulator:
        stage = homed(emulator, clock)
        stage.move(0.008, 0.004)
        clock.now += 0.5
        wait_until(lambda: emulator._errors & ErrorFlags.SAFE_START, event="safe start after the command timeout")
        stage._send_command(TicCommand.RESET_COMMAND_TIMEOUT)
        wait_until(lambda: not emulator._errors & ErrorFlags.COMMAND_TIMEOUT, event="the end of the error")
        sample = stage.position()
        assert sample.status & SampleStatus.FAULT and not sample.moving
        assert sample.position == pytest.approx(0.002, abs=2e-6)
        stage.stop()


def test_a_timeout_at_rest_is_no_fault(clock):
    with make_emulator("tic:timeout_ms=150", bench(clock=clock)) as emulator:
        stage = homed(emulator, clock)
        stage.move(0.002, 0.004)
        clock.now += 10.0
        assert not stage.position().moving
        for _ in range(2):
            wait_until(lambda: emulator._errors & ErrorFlags.COMMAND_TIMEOUT, event="the command timeout")
            assert stage.position().status == SampleStatus.GOOD
        stage.move(0.003, 0.004)
        clock.now += 10.0
        assert stage.position().position == pytest.approx(0.003, abs=2e-6)
        stage.stop()


def test_a_timeout_during_homing_is_a_fault(clock):
    with make_emulator("tic:timeout_ms=150", bench(start_at=0.008, clock=clock)) as emulator:
        stage = make_stage(emulator.address)
        stage.start()
        stage.home()
        wait_until(lambda: emulator._errors & ErrorFlags.COMMAND_TIMEOUT, event="the command timeout")
        sample = stage.position()
        assert sample.status & SampleStatus.FAULT and not sample.homed and not sample.moving
        stage.stop()


def test_a_tic_without_safe_start_does_not_resume_by_itself(clock):
    with make_emulator("tic:timeout_ms=150,safe_start=0", bench(clock=clock)) as emulator:
        stage = homed(emulator, clock)
        stage.move(0.008, 0.004)
        clock.now += 0.5
        wait_until(lambda: emulator._errors & ErrorFlags.COMMAND_TIMEOUT, event="the command timeout")
        stage.position()
        stage.position()
        clock.now += 10.0
        assert stage.position().position == pytest.approx(0.002, abs=2e-6)
        stage.stop()


@pytest.mark.parametrize(("error", "words"), [
    (ErrorFlags.LOW_VIN, "VIN.*switch the motor's supply on"), (ErrorFlags.DRIVER_ERROR, "motor driver.*check motor"),
    (ErrorFlags.KILL_SWITCH, "kill switch; release"), (ErrorFlags.DEENERGIZED, "de-energized.*Resume"),
    (ErrorFlags.INPUT_INVALID, "control mode"), (ErrorFlags.ERR_LINE_HIGH, "ERR line"),
])
def test_errors_of_the_motor_set_the_status_and_motions_raise(emulator, clock, error, words):
    stage = homed(emulator, clock)
    stage.move(0.008, 0.004)
    clock.now += 0.5
    emulator.imposed = error
    wait_until(lambda: emulator._errors & error, event="the error")
    assert stage.position().status & SampleStatus.FAULT
    clock.now += 10.0
    with pytest.raises(DeviceError, match=words):
        stage.move(0.001, 0.004)
    with pytest.raises(DeviceError, match=words):
        stage.home()
    assert not stage.position().moving
    emulator.imposed = ErrorFlags(0)
    stage.home()
    assert stage.position().moving
    stage.stop()


def test_a_motor_without_power_loses_its_zero(emulator, clock):
    stage = homed(emulator, clock)
    emulator.imposed = ErrorFlags.LOW_VIN
    wait_until(lambda: not stage.position().homed, event="the loss of the zero")
    emulator.imposed = ErrorFlags(0)
    with pytest.raises(DeviceError, match="home it first"):
        stage.move(0.001, 0.004)
    stage.stop()


def test_a_limit_switch_sets_the_status(emulator, clock):
    stage = homed(emulator, clock)
    stage.move(0.01, 0.004)
    clock.now += 10.0
    assert stage.position().status == SampleStatus.LIMIT
    stage.stop()


def test_a_halt_while_homing_leaves_the_zero_unknown(clock):
    with TicEmulator(bench(start_at=0.008, clock=clock), Faults()) as emulator:
        stage = make_stage(emulator.address)
        stage.start()
        stage.home()
        clock.now += 0.5
        assert stage.position().moving
        stage.halt()
        stage.position()
        clock.now += 10.0
        sample = stage.position()
        assert not sample.homed and not sample.moving and sample.position == pytest.approx(0.006, abs=2e-6)
        stage.stop()


def test_homing_without_a_limit_switch_raises(emulator, clock):
    emulator.has_limit_switch = False
    stage = make_stage(emulator.address)
    stage.start()
    with pytest.raises(DeviceError, match="does not begin to home; assign a reverse limit switch"):
        stage.home()
    stage.stop()


@pytest.mark.parametrize(("request_motion", "state"), [
    (lambda stage: stage.move(0.004, 0.001), InputState.POSITION), (lambda stage: stage.halt(), InputState.VELOCITY)])
def test_the_input_state_is_that_of_the_requested_motion(emulator, clock, request_motion, state):
    """Values of the variable at 0x4C: 2 halt, 3 target position, 4 target velocity (section 7)."""
    assert emulator._pack_variables()[VariableOffset.INPUT_STATE] == InputState.HALT == 2
    stage = homed(emulator, clock)
    request_motion(stage)
    wait_until(lambda: emulator._pack_variables()[VariableOffset.INPUT_STATE] == state, event="the requested motion")
    stage.stop()


def test_endless_homing_raises_and_stops(clock, monkeypatch):
    monkeypatch.setattr(tic_stage, "TIMING", replace(tic_stage.TIMING, homing_margin=-1e6))
    with TicEmulator(bench(start_at=0.008, clock=clock), Faults()) as emulator:
        stage = make_stage(emulator.address)
        stage.start()
        stage.home()
        with pytest.raises(DeviceError, match="does not end; check the reverse limit switch"):
            stage.position()
        sample = stage.position()
        assert not sample.moving and not sample.homed
        stage.stop()


def test_a_halt_from_another_thread_stops_a_move_during_transmission(emulator, clock, monkeypatch):
    stage = homed(emulator, clock)
    set_number = stage._send_and_verify_variable

    def halted_meanwhile(*arguments):
        set_number(*arguments)
        thread = threading.Thread(target=stage.halt)
        thread.start()
        thread.join()

    monkeypatch.setattr(stage, "_send_and_verify_variable", halted_meanwhile)
    stage.move(0.008, 0.004)
    clock.now += 1.0
    assert stage.position().position == pytest.approx(0.0, abs=2e-6)
    stage.stop()


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "words"), [
    ("timeout_ms=0", "command timeout.*switched off.*set it to 1 s or less"),
    ("timeout_ms=1500", "command timeout.*is 1.5 s.*set it to 1 s or less"),
    ("control_mode=1", "control mode 1.*Serial / I2C / USB"),
    ("soft_error_response=3", "move to a position.*Decelerate to hold"),
    ("crc=1", "answered 0 of 14 bytes.*crc"),
    ("response_crc=1", "another form of answers|no Tic, or its baud rate is not.*response_crc"),
])
def test_unsuitable_settings_of_the_tic_raise_at_the_start(clock, settings, words):
    with make_emulator("tic:" + settings, bench(clock=clock)) as emulator:
        port = f"{emulator.path},steps_per_mm=800,highest_mm=10,top_speed_mm_s=4"
        stage = make_tic_stage(port)
        for _ in range(2):
            with pytest.raises(DeviceError, match=words):
                stage.start()
        with pytest.raises(DeviceError, match="start"):
            stage.position()


@pytest.mark.slow
def test_a_wrong_device_number_or_checksum_setting_raises(emulator, monkeypatch):
    # The answer never comes: the long wait for a busy machine would only delay the error.
    monkeypatch.setattr(tic_stage, "TIMING", replace(tic_stage.TIMING, answer=2.0))
    for extra, words in ((",device=15", "answered 0 of 14 bytes.*device"), (",response_crc=1", "answered 14 of 15")):
        with pytest.raises(DeviceError, match=words):
            make_stage(emulator.address + extra).start()


def test_a_missing_port_raises():
    with pytest.raises(DeviceError, match="there is no port /dev/ttyNOWHERE for the Tic"):
        make_tic_stage("/dev/ttyNOWHERE,steps_per_mm=800").start()


def test_a_busy_port_raises_with_the_remedy(emulator):
    first = make_stage(emulator.address)
    first.start()
    with pytest.raises(DeviceError, match="in use by another program; close that one"):
        make_stage(emulator.address).start()
    first.stop()
    second = make_stage(emulator.address)
    second.start()
    second.stop()


def test_a_port_without_permission_raises_with_the_remedy(emulator, monkeypatch):
    def refuse(*arguments, **options):
        raise serial.SerialException(13, "Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(DeviceError, match=r"no permission to open .* for the Tic.*usermod"):
        make_stage(emulator.address).start()


def test_garbage_of_a_wrong_baud_rate_raises():
    rows = itertools.cycle([bytes([0xF8, 0x3C, 0x80, 0x1F] * 8)])
    with port_that_answers(lambda data: next(rows)) as port, pytest.raises(
            DeviceError, match="no Tic, or its baud rate is not 9600; check the baud rate"):
        make_tic_stage(port + ",steps_per_mm=800").start()


@pytest.mark.slow
@pytest.mark.parametrize(("answer", "words"), [
    (lambda data: b"ok\r\n" if data.endswith(b"\r") else b"", "a Grbl answers there: name it grbl:"),
    (lambda data: b"\r\n>" if data.endswith(b"\r") else b"", "an ATI controller answers there: name it ati-serial:"),
    (lambda data: b"", "answered 0 of 14 bytes.*check that it has power, the cable and the baud rate"),
])
def test_another_device_or_none_raises_with_a_hint(answer, words):
    with port_that_answers(answer) as port, pytest.raises(DeviceError, match=words):
        make_tic_stage(port + ",steps_per_mm=800").start()


def test_a_grbl_in_place_of_a_tic_is_identified(clock):
    with make_emulator("grbl:", bench(clock=clock)) as emulator, pytest.raises(DeviceError, match="name it grbl:"):
        make_tic_stage(emulator.path + ",steps_per_mm=800").start()


@pytest.mark.slow
def test_a_silent_line_raises_and_stops_the_motor(clock):
    with TicEmulator(bench(clock=clock), Faults(disconnect_after=0.5), timeout=0.3) as emulator:
        stage = homed(emulator, clock)
        with pytest.raises(DeviceError, match=r"answered \d+ of \d+ bytes within .* check that it has power"):
            # On a busy machine the line may be silent before the motion begins.
            stage.move(0.008, 0.004)
            while True:
                stage.position()
        wait_until(lambda: emulator._errors & ErrorFlags.COMMAND_TIMEOUT, event="the command timeout")
        stood = emulator._stage.position().position
        clock.now += 10.0
        assert emulator._stage.position().position == stood
        stage.halt()
        stage.stop()


def test_an_unplugged_controller_raises(emulator, clock):
    stage = homed(emulator, clock)
    emulator.stop()
    with pytest.raises(DeviceError, match=r"is gone .* plug it in again"):
        stage.position()
    stage.halt()
    stage.stop()


def test_garbled_answers_never_pass_the_checksum(clock):
    """One byte is wrong in a third of the answers: these are refused, and the others give the position."""
    with TicEmulator(bench(clock=clock), Faults(), crc=True, response_crc=True) as emulator:
        stage = homed(emulator, clock)
        stage.move(0.005, 0.004)
        clock.now += 10.0
        answer, number = emulator.execute_bytes_and_get_answers, itertools.count()

        def garbled(data):
            return [bytes([part[0] ^ 0x10]) + part[1:] if next(number) % 3 == 2 else part for part in answer(data)]

        emulator.execute_bytes_and_get_answers = garbled
        refused = 0
        for _ in range(30):
            try:
                assert stage.position().position == pytest.approx(0.005, abs=1e-9)
            except DeviceError as error:
                assert "has a wrong checksum" in str(error)
                refused += 1
        assert 5 < refused < 25
        stage.stop()


@pytest.mark.parametrize(("settings", "field"), [
    ("", "steps_per_mm"), ("steps_per_mm=0", "steps_per_mm"), ("steps_per_mm=800,lowest_mm=1", "lowest_mm, highest_mm"),
    ("steps_per_mm=800,top_speed_mm_s=100", "top_speed_mm_s"), ("steps_per_mm=800,device=200", "device"),
    ("steps_per_mm=800,ramp_ms=0", "ramp_ms"), ("steps_per_mm=800,highest_mm=1e7", "lowest_mm, highest_mm"),
    ("steps_per_mm=800,speed=3", "speed"), ("steps_per_mm=800,baud=0", "baud"),
])
def test_invalid_settings_are_refused(settings, field):
    with pytest.raises(InputError) as caught:
        make_tic_stage("/dev/ttyUSB0," + settings)
    assert caught.value.field == field


def test_a_missing_port_is_refused():
    with pytest.raises(InputError) as caught:
        make_stage("tic:")
    assert caught.value.field == "tic.port"


def test_a_started_stage_stays_in_its_process(emulator, clock):
    stage = homed(emulator, clock)
    with pytest.raises(TypeError, match="stop it first"):
        pickle.dumps(stage)
    stage.stop()
    assert math.isclose(pickle.loads(pickle.dumps(stage)).runs_on, 1.1)


def test_invalid_settings_of_the_emulator_are_refused():
    for text, field in (("steps_per_mm=0", "steps_per_mm"), ("timeout_ms=70000", "timeout_ms"),
                        ("device=128", "device")):
        with pytest.raises(InputError) as caught:
            make_emulator("tic:" + text, bench())
        assert caught.value.field == field
    assert TicStage("/dev/null", StageLimits(0.0, 0.01, 0.001), 8e5).limits.highest == 0.01
