"""Our Tic emulator, driven by ticlib, a client that is not ours (PyPI, BSD-2-Clause)."""

import time

import pytest
import serial
import ticlib
from waiting import wait_until

from haptics.devices.contracts import Bench, StageLimits
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.devices.virtual.stage import VirtualStage
from haptics.emulators.emulator import make_emulator

COMMAND_TIMEOUT = 1 << 6
SAFE_START = 1 << 7


def no_load(now):
    return (0.0,)


@pytest.fixture(params=[("", {}), (",device=77", {"device_number": 77}),
                        (",crc=1,response_crc=1", {"crc_for_commands": True, "crc_for_responses": True})])
def rig(request):
    """The emulator, its stage and the foreign client."""
    settings, options = request.param
    stage = VirtualStage(StageLimits(-0.01, 0.01, 0.01))
    bench = Bench(VirtualForceSensor(no_load), stage)
    with make_emulator(f"tic:steps_per_mm=1000,timeout_ms=600{settings}", bench) as emulator, serial.Serial(
            emulator.path, 9600, timeout=5.0, write_timeout=5.0) as port:
        yield emulator, stage, ticlib.TicSerial(port, **options)


def errors(tic):
    return int.from_bytes(tic.get_error_status(), "little")


def test_the_flow_of_its_readme_moves_the_motor(rig):
    _, stage, tic = rig
    tic.halt_and_set_position(0)
    tic.energize()
    tic.exit_safe_start()
    wait_until(lambda: tic.get_operation_state() == 10)
    tic.set_max_speed(5000 * 10000)
    for target in (500, -300, 0):
        tic.set_target_position(target)
        assert tic.get_target_position() == target
        while tic.get_current_position() != tic.get_target_position():
            tic.reset_command_timeout()
        assert stage.compute_tool_position_with_stall(time.monotonic()) == pytest.approx(target * 1e-6, abs=1.1e-6)
    tic.deenergize()
    assert errors(tic) & 1 and tic.get_misc_flags()[0] & 2


def test_halt_stops_it_and_the_position_is_uncertain(rig):
    _, _, tic = rig
    tic.halt_and_set_position(0)
    tic.exit_safe_start()
    tic.set_max_speed(1000 * 10000)
    tic.set_target_position(9000)
    wait_until(lambda: tic.get_current_position() > 100)
    assert tic.get_current_velocity() == 1000 * 10000 and not tic.get_misc_flags()[0] & 2
    tic.halt_and_hold()
    stood = tic.get_current_position()
    assert 100 < stood < 9000 and tic.get_current_velocity() == 0 and tic.get_misc_flags()[0] & 2
    assert tic.get_current_position() == stood


def test_the_command_timeout_stops_it_and_its_position_stays_certain(rig):
    _, _, tic = rig
    tic.halt_and_set_position(0)
    tic.exit_safe_start()
    tic.set_max_speed(1000 * 10000)
    tic.set_target_position(9000)
    wait_until(lambda: errors(tic) & COMMAND_TIMEOUT)  # questions are no sign of life
    stood = tic.get_current_position()
    assert 0 < stood < 9000 and tic.get_operation_state() == 4 and not tic.get_misc_flags()[0] & 2
    assert errors(tic) == COMMAND_TIMEOUT | SAFE_START
    tic.reset_command_timeout()
    assert errors(tic) == SAFE_START and tic.get_current_position() == stood
    tic.exit_safe_start()
    wait_until(lambda: tic.get_current_position() > stood)  # what is wanted outlives an error (5.4)


def test_it_goes_home(rig):
    _, stage, tic = rig
    tic.halt_and_set_position(700)
    tic.exit_safe_start()
    wait_until(lambda: tic.get_operation_state() == 10)
    assert tic.get_current_position() == 700
    tic.go_home(0)
    wait_until(lambda: not tic.get_misc_flags()[0] & 16)
    assert tic.get_current_position() == 0 and not tic.get_misc_flags()[0] & 2
    assert stage.compute_tool_position_with_stall(time.monotonic()) == 0.0


def test_variables_and_settings_are_those_that_it_knows(rig):
    _, _, tic = rig
    tic.set_max_acceleration(123456)
    tic.set_max_deceleration(654321)
    assert tic.get_max_acceleration() == 123456 and tic.get_max_deceleration() == 654321
    assert tic.get_vin_voltage() == 12000 and tic.get_planning_mode() == 0 and tic.get_uptime() >= 0
    settings = tic.settings
    assert settings.get_serial_command_timeout() == 600 and settings.get_control_mode() == 0
    assert settings.get_soft_error_response() == 2 and settings.get_disable_safe_start() is False
    assert settings.get_serial_crc_for_commands() is tic.crc_for_commands
    assert settings.get_serial_crc_for_responses() is tic.crc_for_responses


def test_commands_with_a_wrong_check_or_for_another_are_ignored():
    stage = VirtualStage(StageLimits(-0.01, 0.01, 0.01))
    with make_emulator("tic:crc=1", Bench(VirtualForceSensor(no_load), stage)) as emulator, serial.Serial(
            emulator.path, 9600, timeout=0.3) as port:
        with pytest.raises(RuntimeError):
            ticlib.TicSerial(port).get_operation_state()
        port.reset_input_buffer()
        with pytest.raises(RuntimeError):
            ticlib.TicSerial(port, device_number=15, crc_for_commands=True).get_operation_state()
        assert ticlib.TicSerial(port, device_number=14, crc_for_commands=True).get_operation_state() == 4
