"""Emulator of a Pololu Tic on a pseudo-terminal. Its motor is a stage that moves at constant speed, without ramps.

Source: Pololu, Tic Stepper Motor Controller User's Guide (docs/0J71), sections 5.4 to 9. At power-on the stage is
homed; the ends of its travel are the limit switches.
"""

from __future__ import annotations

import time
from typing import Any

from haptics.devices.contracts import Bench
from haptics.devices.settings import parse_number_settings
from haptics.devices.virtual.faults import Faults
from haptics.emulators.emulator import SerialDeviceEmulator
from haptics.protocols import tic
from haptics.protocols.tic import (
    ErrorFlags,
    InputState,
    MiscFlags,
    OperationState,
    PlanningMode,
    ReceivedCommand,
    SettingOffset,
    TicCommand,
    VariableOffset,
)
from tissue_sim.errors import InputError

#: Time for which "exit safe start" is valid, s (section 5.4).
_SAFE_START_EXIT = 0.2
#: Commands that clear serial errors and the command timeout (section 5.4).
_KEEP_ALIVE = frozenset({TicCommand.SET_TARGET_POSITION, TicCommand.SET_TARGET_VELOCITY,
                         TicCommand.HALT_AND_SET_POSITION, TicCommand.HALT_AND_HOLD, TicCommand.ENERGIZE,
                         TicCommand.EXIT_SAFE_START, TicCommand.RESET, TicCommand.RESET_COMMAND_TIMEOUT})
#: Errors that put the Tic into the state RESET.
_RESET_ERRORS = ErrorFlags.DRIVER_ERROR | ErrorFlags.LOW_VIN
#: Input state of each requested motion.
_INPUT_STATES = {PlanningMode.OFF: InputState.HALT, PlanningMode.POSITION: InputState.POSITION,
                 PlanningMode.VELOCITY: InputState.VELOCITY}


class TicEmulator(SerialDeviceEmulator):
    """Emulate a Tic whose motor is a stage.

    Args:
        bench: Devices of the rig; the stage is the motor.
        faults: Faults of the connection.
        steps_per_m: Microsteps per metre.
        timeout: Command timeout, s; 0: none.
        device: Device number, see `haptics.devices.tic.TicStage`.
        crc: True if commands carry a checksum.
        response_crc: True if answers carry a checksum.
        control_mode: Value of the setting "control mode" (section 6).
        soft_error_response: Value of the setting "soft error response" (section 6).
        safe_start: True if safe start is enabled.

    Attributes:
        imposed: Errors with an external cause, such as `ErrorFlags.LOW_VIN`; may be set from any thread.
        has_limit_switch: True if a limit switch is assigned; without one the Tic does not home.
        answered: Number of answers sent.
    """

    name = "tic"

    def __init__(self, bench: Bench, faults: Faults, steps_per_m: float = 800e3, timeout: float = 1.0, device: int = 14,
                 crc: bool = False, response_crc: bool = False, control_mode: int = 0, soft_error_response: int = 2,
                 safe_start: bool = True):
        super().__init__(faults)
        self._stage, self._steps, self._timeout = bench.stage, steps_per_m, timeout
        self._device, self._crc, self._response_crc = device, crc, response_crc
        self._safe_start = safe_start
        self._settings = bytearray(256)
        self._settings[SettingOffset.CONTROL_MODE] = control_mode
        self._settings[SettingOffset.DISABLE_SAFE_START] = not safe_start
        timeout_offset = SettingOffset.COMMAND_TIMEOUT
        self._settings[timeout_offset:timeout_offset + 2] = round(timeout * 1e3).to_bytes(2, "little")
        self._settings[SettingOffset.CRC] = crc | response_crc << 1
        self._settings[SettingOffset.SOFT_ERROR_RESPONSE] = soft_error_response
        for setting in (SettingOffset.HOMING_SPEED_TOWARDS, SettingOffset.HOMING_SPEED_AWAY):
            self._settings[setting:setting + 4] = (1_000_000).to_bytes(4, "little")
        self.imposed = ErrorFlags(0)
        self.has_limit_switch = True
        self._set_power_on_state()

    def _set_power_on_state(self) -> None:
        """Set all variables of the emulated controller to their values after power-on."""
        self._commands = tic.CommandParser(self._device, self._crc)
        #: Times of power-on and of the last command that clears the timeout, s.
        self._began = self._alive = time.monotonic()
        #: Time until which safe start stays off, s.
        self._safe_start_off_until = 0.0
        self._state, self._errors, self._occurred = OperationState.SOFT_ERROR, ErrorFlags(0), 0
        self._uncertain, self._homing, self._deenergized = True, False, False
        #: Requested motion: off, a position, microsteps, or a velocity, in `tic.MOTION.speed_unit`.
        self._input, self._target = PlanningMode.OFF, 0
        #: Motion in progress: kind, target and top speed; None: none.
        self._motion: tuple[PlanningMode, int, int] | None = None
        #: Count of the Tic minus count of the stage, microsteps; set by "halt and set position".
        self._offset = 0
        #: Speed in `tic.MOTION.speed_unit`, accelerations in `tic.MOTION.acceleration_unit`.
        self._max_speed, self._max_acceleration, self._max_deceleration = 2_000_000, 40_000, 0
        self.answered = 0

    @property
    def address(self) -> str:
        """Name for `make_stage` that connects to this emulator: terminal, steps, travel, top speed and checksums."""
        limits, extra = self._stage.limits, ""
        if self._crc or self._response_crc:
            extra = f",crc={self._crc:d},response_crc={self._response_crc:d}"
        return (f"tic:{self.path},steps_per_mm={self._steps * 1e-3:g},lowest_mm={limits.lowest * 1e3:g},"
                f"highest_mm={limits.highest * 1e3:g},top_speed_mm_s={limits.speed * 1e3:g}{extra}")

    def power_on_with_backing_device(self) -> None:
        """Set the state of the emulated controller after power-on, start the stage, and begin to home it."""
        self._set_power_on_state()
        self._stage.start()
        self._stage.home()

    def stop_backing_device(self) -> None:
        """Stop the stage that serves as the motor."""
        self._stage.stop()

    def describe(self) -> dict[str, Any]:
        """Return terminal, steps, command timeout and counts of answers and of bad bytes."""
        return {"emulator": "tic", "port": self.path, "steps_per_mm": self._steps * 1e-3,
                "command_timeout_s": self._timeout, "answered": self.answered, "bad_bytes": self._commands.bad_bytes}

    def execute_bytes_and_get_answers(self, data: bytes) -> list[bytes]:
        """Execute the received commands, and return the answers of those that read variables or settings."""
        answers = []
        self._update_state_and_start_motion()
        for received in self._commands.extract_commands(data):
            answer = self._execute_and_get_answer_or_none(received)
            self._update_state_and_start_motion()
            if answer is not None:
                self.answered += 1
                answers.append(answer + bytes([tic.compute_crc7(answer)]) if self._response_crc else answer)
        return answers

    def advance_and_get_messages_to_send(self) -> list[bytes]:
        """Update the state to now, such as the command timeout; return no messages: a Tic only answers."""
        self._update_state_and_start_motion()
        return []

    def _execute_and_get_answer_or_none(self, received: ReceivedCommand) -> bytes | None:
        """Execute a command; return the bytes of a command that reads variables or settings, otherwise None."""
        command, now = received.command, time.monotonic()
        if command in _KEEP_ALIVE:
            self._alive = now
        if command in (TicCommand.GET_VARIABLE, TicCommand.GET_VARIABLE_AND_CLEAR):
            block = self._pack_variables()[received.value:received.value + received.length]
            if command == TicCommand.GET_VARIABLE_AND_CLEAR:
                self._occurred = 0
            return block
        if command == TicCommand.GET_SETTING:
            return bytes(self._settings[received.value:received.value + received.length])
        if command == TicCommand.SET_MAX_SPEED:
            self._max_speed = received.value
        elif command == TicCommand.SET_MAX_ACCELERATION:
            self._max_acceleration = received.value
        elif command == TicCommand.SET_MAX_DECELERATION:
            self._max_deceleration = received.value
        elif command == TicCommand.DEENERGIZE:
            self._deenergized = True
        elif command == TicCommand.ENERGIZE:
            self._deenergized = False
        elif command == TicCommand.EXIT_SAFE_START:
            self._safe_start_off_until = now + _SAFE_START_EXIT
        elif command == TicCommand.ENTER_SAFE_START:
            self._safe_start_off_until, self._errors = 0.0, self._errors | ErrorFlags.SAFE_START
            self._enter_error_state(OperationState.SOFT_ERROR)
        elif self._settings[SettingOffset.CONTROL_MODE] == tic.ControlMode.SERIAL:
            self._execute_motion_command(received)
        return None

    def _execute_motion_command(self, received: ReceivedCommand) -> None:
        """Execute a command that sets the target, halts, resets or homes; ignores other commands."""
        command = received.command
        if self._homing and command in _KEEP_ALIVE and command != TicCommand.RESET_COMMAND_TIMEOUT:
            self._halt_stage_and_end_homing()
        if command == TicCommand.SET_TARGET_POSITION:
            self._input, self._target = PlanningMode.POSITION, tic.to_signed_32_bit(received.value)
        elif command == TicCommand.SET_TARGET_VELOCITY:
            self._input, self._target = PlanningMode.VELOCITY, tic.to_signed_32_bit(received.value)
        elif command in (TicCommand.HALT_AND_HOLD, TicCommand.HALT_AND_SET_POSITION, TicCommand.RESET):
            self._halt_stage_and_end_homing()
            self._input, self._target, self._uncertain = PlanningMode.OFF, 0, True
            if command == TicCommand.HALT_AND_SET_POSITION:
                self._offset += tic.to_signed_32_bit(received.value) - self._get_motor_steps_and_is_moving()[0]
                self._uncertain = False
            elif command == TicCommand.RESET:
                self._errors, self._occurred, self._state = ErrorFlags(0), 0, OperationState.RESET
        elif command == TicCommand.GO_HOME and self._state == OperationState.NORMAL and self.has_limit_switch:
            self._halt_stage_and_end_homing()
            self._input, self._homing, self._uncertain, self._offset = PlanningMode.OFF, True, True, 0
            self._stage.home()

    def _halt_stage_and_end_homing(self) -> None:
        """Halt the stage, and end homing and the motion in progress; the requested target stays."""
        self._stage.halt()
        self._homing, self._motion = False, None

    def _enter_error_state(self, state: OperationState) -> None:
        """Halt if in normal operation, and enter an error state; `RESET` and `DEENERGIZED` lose the position."""
        if self._state == OperationState.NORMAL:
            self._halt_stage_and_end_homing()
        if state in (OperationState.RESET, OperationState.DEENERGIZED):
            self._uncertain = True
        self._state = state

    def _update_state_and_start_motion(self) -> None:
        """Update errors, operation state and homing to now, and start the requested motion if it has changed."""
        now = time.monotonic()
        errors = self.imposed | (ErrorFlags.DEENERGIZED if self._deenergized else ErrorFlags(0))
        accepts_serial = self._settings[SettingOffset.CONTROL_MODE] == tic.ControlMode.SERIAL
        if accepts_serial and self._timeout and now - self._alive > self._timeout:
            errors |= ErrorFlags.COMMAND_TIMEOUT
        stopped = errors or self._state != OperationState.NORMAL
        if stopped and self._safe_start and now >= self._safe_start_off_until:
            errors |= ErrorFlags.SAFE_START
        self._errors, self._occurred = errors, self._occurred | errors.value
        if not errors:
            self._state = OperationState.NORMAL
        else:
            self._enter_error_state(
                OperationState.RESET if errors & _RESET_ERRORS
                else OperationState.DEENERGIZED if errors & ErrorFlags.DEENERGIZED
                else OperationState.WAITING_FOR_ERR_LINE if errors == ErrorFlags.ERR_LINE_HIGH
                else OperationState.SOFT_ERROR)
        if self._homing and not self._stage.position().moving:
            # After homing the input is "halt" (section 5.6).
            self._homing, self._uncertain, self._motion = False, False, None
        self._start_requested_motion_if_changed()

    def _start_requested_motion_if_changed(self) -> None:
        """Start the requested motion if it differs from the present one and the state permits a motion."""
        request = self._input, self._target, self._max_speed
        if (self._state != OperationState.NORMAL or self._homing or request == self._motion
                or self._input == PlanningMode.OFF):
            return
        stage = self._stage
        if not stage.position().homed:
            return  # the stage still homes after power-on
        limits, least = stage.limits, tic.MOTION.speed_unit / self._steps
        if self._input == PlanningMode.VELOCITY and self._target == 0:
            stage.halt()
        elif self._input == PlanningMode.VELOCITY:
            speed = min(abs(self._target), self._max_speed) * tic.MOTION.speed_unit / self._steps
            stage.move(limits.highest if self._target > 0 else limits.lowest, min(max(speed, least), limits.speed))
        else:
            goal = (self._target - self._offset) / self._steps
            speed = min(max(self._max_speed * tic.MOTION.speed_unit / self._steps, least), limits.speed)
            stage.move(min(max(goal, limits.lowest), limits.highest), speed)
        self._motion = request

    def _get_motor_steps_and_is_moving(self) -> tuple[int, bool]:
        """Return the position of the motor, microsteps, and whether the motor moves."""
        sample = self._stage.position()
        return round(sample.position * self._steps) + self._offset, sample.moving

    def _pack_variables(self) -> bytes:
        """Return the memory of all variables, 256 bytes at their offsets, for the present time (section 7)."""
        count, moving = self._get_motor_steps_and_is_moving()
        position = (count - self._offset) / self._steps
        limits, velocity = self._stage.limits, 0
        if moving and self._motion is not None:
            planning, requested, top = self._motion
            velocity = (min(max(requested, -top), top) if planning == PlanningMode.VELOCITY else
                        top if requested > count else -top)
        elif moving and self._homing:
            velocity = -self._max_speed
        if not moving and self._motion is not None and self._motion[0] == PlanningMode.POSITION:
            goal = self._motion[1]
            if limits.lowest <= (goal - self._offset) / self._steps <= limits.highest:
                count = goal  # the stage rounds to its own resolution
        flags = MiscFlags(0)
        if self._state in (OperationState.NORMAL, OperationState.SOFT_ERROR, OperationState.STARTING_UP,
                           OperationState.WAITING_FOR_ERR_LINE):
            flags |= MiscFlags.ENERGIZED
        for flag, holds in ((MiscFlags.POSITION_UNCERTAIN, self._uncertain), (MiscFlags.HOMING, self._homing),
                            (MiscFlags.FORWARD_LIMIT, position >= limits.highest and limits.highest > 0),
                            (MiscFlags.REVERSE_LIMIT, position <= limits.lowest and limits.lowest < 0)):
            flags |= flag if holds else MiscFlags(0)
        planning = self._input if self._state == OperationState.NORMAL and not self._homing else (
            PlanningMode.VELOCITY if self._homing else PlanningMode.OFF)
        target = self._target if planning == PlanningMode.POSITION else 0
        target_velocity = self._target if planning == PlanningMode.VELOCITY and not self._homing else 0
        uptime = round((time.monotonic() - self._began) * 1e3)
        block = bytearray(256)
        for variable, value, size in (
                (VariableOffset.OPERATION_STATE, self._state, 1), (VariableOffset.MISC_FLAGS, flags, 1),
                (VariableOffset.ERROR_STATUS, self._errors, 2), (VariableOffset.ERRORS_OCCURRED, self._occurred, 4),
                (VariableOffset.PLANNING_MODE, planning, 1), (VariableOffset.TARGET_POSITION, target, 4),
                (VariableOffset.TARGET_VELOCITY, target_velocity, 4), (VariableOffset.MAX_SPEED, self._max_speed, 4),
                (VariableOffset.MAX_DECELERATION, self._max_deceleration, 4),
                (VariableOffset.MAX_ACCELERATION, self._max_acceleration, 4),
                (VariableOffset.CURRENT_POSITION, count, 4), (VariableOffset.CURRENT_VELOCITY, velocity, 4),
                (VariableOffset.ACTING_TARGET_POSITION, target, 4),
                (VariableOffset.VIN_VOLTAGE, 12_000, 2), (VariableOffset.UP_TIME, uptime, 4),
                (VariableOffset.INPUT_STATE, _INPUT_STATES[self._input], 1)):
            # Negative numbers are sent in two's complement.
            block[variable:variable + size] = (int(value) & ((1 << 8 * size) - 1)).to_bytes(size, "little")
        return bytes(block)


def make_tic_emulator(bench: Bench, text: str, faults: Faults) -> TicEmulator:
    """Make an emulator from its settings.

    Defaults: ``tic:steps_per_mm=800,timeout_ms=1000,device=14,crc=0,response_crc=0,control_mode=0,
    soft_error_response=2,safe_start=1``.
    """
    given = parse_number_settings(text, steps_per_mm=800.0, timeout_ms=1000, device=14, crc=0, response_crc=0,
                                  control_mode=0,
                                  soft_error_response=2, safe_start=1)
    if not given["steps_per_mm"] > 0:
        raise InputError(f"the number of steps per mm must be above 0; got {given['steps_per_mm']:g}",
                         field="steps_per_mm")
    for name, most in (("timeout_ms", 60_000), ("device", 127), ("control_mode", 7), ("soft_error_response", 3)):
        if not 0 <= given[name] <= most:
            raise InputError(f"a setting of the Tic must be 0 to {most}; got {given[name]}", field=name)

    return TicEmulator(bench, faults, given["steps_per_mm"] * 1e3, given["timeout_ms"] * 1e-3, int(given["device"]),
                       bool(given["crc"]), bool(given["response_crc"]), int(given["control_mode"]),
                       int(given["soft_error_response"]), bool(given["safe_start"]))
