"""A stage driven by a Pololu Tic on its serial pins. Checked against an emulator and other clients only.

Source: Pololu, Tic Stepper Motor Controller User's Guide (docs/0J71); comments name the sections.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Any

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.serial_line import SerialLine, probe_controller_and_get_hint
from haptics.devices.settings import parse_number_settings
from haptics.protocols import tic
from haptics.protocols.tic import (
    ErrorFlags,
    MiscFlags,
    OperationState,
    PlanningMode,
    SettingOffset,
    TicCommand,
    VariableOffset,
)
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class TicTiming:
    """Waiting times of a `TicStage`, s."""

    #: Longest wait for an answer; 14 bytes at 9600 baud take 15 ms.
    answer: float = 0.5
    #: Longest time from safe start to normal operation; one "exit safe start" is valid for 0.2 s (section 5.4).
    wake: float = 0.5
    #: Time allowed for homing, in addition to twice the time for the whole travel.
    homing_margin: float = 20.0
    #: Longest command timeout accepted; also assumed until the Tic's own timeout has been read.
    longest_timeout: float = 1.0


#: Settings of all stages of this process.
TIMING = TicTiming()

#: Errors that keep the motor from moving, with the remedy (section 5.4); the most serious first.
_REMEDIES = {
    ErrorFlags.LOW_VIN: "has too little voltage at VIN; switch the motor's supply on",
    ErrorFlags.DRIVER_ERROR: "reports an error of its motor driver; check motor, wiring and current limit, then switch "
                             "its supply off and on",
    ErrorFlags.KILL_SWITCH: "is stopped by its kill switch; release it",
    ErrorFlags.DEENERGIZED: "was de-energized on purpose; press Resume in the Tic Control Center, or switch its supply "
                            "off and on",
    ErrorFlags.INPUT_INVALID: "lacks a required input; set its control mode to Serial / I2C / USB",
    ErrorFlags.ERR_LINE_HIGH: "is stopped by its ERR line; repair the device that drives it high",
}


class TicStage(Stage):
    """A stepper motor without encoder. `position` is the commanded position; a stalled motor is invisible.

    The zero is at the reverse limit switch of the Tic, where `home` ends; positive is forward. A halt decelerates
    within `ramp`, because the command "halt and hold" would lose the zero (section 8).

    Args:
        port: Serial port of an adapter at the pins RX and TX; the USB socket of the Tic is no serial port.
        limits: Travel and top speed.
        steps_per_m: Microsteps per metre.
        baud: Baud rate, as set in the Tic.
        device: Device number, on a line with several Tics; None: the compact protocol.
        crc: True if commands carry a checksum, as set in the Tic.
        response_crc: True if answers carry a checksum, as set in the Tic (firmware 1.06 or later).
        ramp: Time to reach the top speed and to stop from it, s.

    Raises:
        InputError: An argument is outside its range, or the top speed exceeds that of a Tic.
    """

    measures_position = False

    def __init__(self, port: str, limits: StageLimits, steps_per_m: float, baud: int = 9600, device: int | None = None,
                 crc: bool = False, response_crc: bool = False, ramp: float = 0.1):
        if not port:
            raise InputError("the serial port must be given, as in tic:/dev/ttyUSB0,steps_per_mm=800; got none",
                             field="port")
        if not -math.inf < limits.lowest <= 0.0 < limits.highest < math.inf:
            raise InputError("lowest must be 0 or less and highest above 0; got "
                             f"{limits.lowest:g} to {limits.highest:g} m", field="lowest_mm, highest_mm")
        for value, name in ((limits.speed, "top_speed_mm_s"), (steps_per_m, "steps_per_mm"), (baud, "baud")):
            if not 0 < value < math.inf:
                remedy = (". Give the microsteps per turn of the motor divided by the lead of the screw"
                          if name == "steps_per_mm" else "")
                raise InputError(f"top speed, steps and baud rate must be above 0; got {value:g}{remedy}", field=name)
        if not 0.01 <= ramp <= 1.0:
            raise InputError(f"the time of the speed ramp must be 10 to 1000 ms; got {ramp * 1e3:g} ms",
                             field="ramp_ms")
        if device is not None and not 0 <= device <= 127:
            raise InputError(f"the device number must be 0 to 127; got {device}", field="device")
        if limits.speed * steps_per_m > tic.MOTION.top_speed * tic.MOTION.speed_unit:
            raise InputError("the top speed must be at most 50000 microsteps/s; got "
                             f"{limits.speed * 1e3:g} mm/s = {limits.speed * steps_per_m:.0f} microsteps/s. Lower the "
                             "speed, or use larger steps", field="top_speed_mm_s")
        if max(-limits.lowest, limits.highest) * steps_per_m > 0x7FFFFFFF:
            raise InputError("the travel must fit into 32 bits as a number of microsteps. Use a shorter travel, or "
                             "larger steps",
                             field="lowest_mm, highest_mm")
        self.limits, self._port, self._steps, self._baud = limits, port, steps_per_m, baud
        self._device, self._crc, self._response_crc, self._ramp = device, crc, response_crc, ramp
        #: Timeout of the Tic plus the ramp.
        self.runs_on = TIMING.longest_timeout + ramp
        self._line: SerialLine | None = None
        #: Number of positions read, and number of calls of `halt`, which reveals a halt during a `move`.
        self._sequence, self._halts = 0, 0
        #: Time at which homing fails, s.
        self._homing_until = math.inf
        #: Target of the motion, microsteps; None: no motion to a position.
        self._goal: int | None = None
        #: True while homing; and True if the command timeout has ended a motion.
        self._is_homing = self._timed_out = False

    def __getstate__(self) -> dict[str, Any]:
        if self._line is not None:
            raise TypeError("a started stage cannot be sent to another process; stop it first")
        return self.__dict__ | {"_writing": None}

    #: Lock for writing; made by `start`, because a lock cannot be pickled.
    _writing: threading.Lock | None = None

    def start(self) -> None:
        """Open the port and check the settings of the Tic."""
        if self._line is not None:
            return
        line = SerialLine(self._port, self._baud, "the Tic")
        self._writing, self._line, self._sequence = threading.Lock(), line, 0
        self._goal, self._is_homing, self._timed_out = None, False, False
        try:
            self._check_settings_and_set_ramps(line)
        except BaseException:
            self._line = None
            line.close()
            raise

    def _check_settings_and_set_ramps(self, line: SerialLine) -> None:
        """Check that a Tic answers and stops after a silence; stop its motion, set its ramps and `runs_on`."""
        try:
            self._read_status()
            answers = self._read_setting(SettingOffset.CRC, 1)
            self._read_status()
        except DeviceError as error:
            other = probe_controller_and_get_hint(line)
            raise DeviceError(f"{error}; baud, device, crc and response_crc must be as the Tic Control Center shows "
                              f"them{other}") from None
        if answers & tic.AnswerFormatFlags.SEVEN_BIT or bool(answers & tic.AnswerFormatFlags.CHECKED) \
            != self._response_crc:
            raise DeviceError(f"the Tic at {self._port} is set to another form of answers; switch 7-bit responses off "
                              "in the Tic Control Center, and give response_crc="
                              f"{bool(answers & tic.AnswerFormatFlags.CHECKED):d}")
        # Ends a motion that another program has left.
        self._send_command(TicCommand.SET_TARGET_VELOCITY, 0)
        mode = self._read_setting(SettingOffset.CONTROL_MODE, 1)
        if mode != tic.ControlMode.SERIAL:
            raise DeviceError(f"the Tic at {self._port} is in control mode {mode}, which ignores serial commands; set "
                              "it to Serial / I2C / USB in the Tic Control Center")
        timeout = 1e-3 * self._read_setting(SettingOffset.COMMAND_TIMEOUT, 2)
        if not 0 < timeout <= TIMING.longest_timeout:
            state = f"{timeout:g} s" if timeout else "switched off"
            raise DeviceError(f"the command timeout of the Tic at {self._port} is {state}, so the motor would not stop "
                              f"if this program died; set it to {TIMING.longest_timeout:g} s or less in the Tic "
                              "Control Center")
        if self._read_setting(SettingOffset.SOFT_ERROR_RESPONSE, 1) == tic.SoftErrorResponse.GO_TO_POSITION:
            raise DeviceError(f"the Tic at {self._port} would move to a position if this program died; set its soft "
                              "error response to Decelerate to hold in the Tic Control Center")
        self.runs_on = timeout + self._ramp
        acceleration = round(self.limits.speed * self._steps / self._ramp / tic.MOTION.acceleration_unit)
        acceleration = min(max(acceleration, tic.MOTION.least_acceleration), tic.MOTION.top_acceleration)
        for command, variable in ((TicCommand.SET_MAX_ACCELERATION, VariableOffset.MAX_ACCELERATION),
                                  (TicCommand.SET_MAX_DECELERATION, VariableOffset.MAX_DECELERATION)):
            self._send_and_verify_variable(command, acceleration, variable)

    def home(self) -> None:
        """Send the command to home, and return when homing has begun; `position` shows its end."""
        halts = self._halts
        self._enter_normal_operation()
        steps = (self.limits.highest - self.limits.lowest) * self._steps
        speeds = [max(self._read_setting(setting, 4) * tic.MOTION.speed_unit, 1.0)
                  for setting in (SettingOffset.HOMING_SPEED_TOWARDS, SettingOffset.HOMING_SPEED_AWAY)]
        self._homing_until = time.monotonic() + TIMING.homing_margin + sum(2.0 * steps / speed for speed in speeds)
        self._send_unless_halted(TicCommand.GO_HOME, 0, halts)
        end, status = time.monotonic() + TIMING.wake, self._read_status()
        while (status.flags & MiscFlags.POSITION_UNCERTAIN and not status.flags & MiscFlags.HOMING
               and halts == self._halts):
            self._require_no_blocking_motor_error(status.errors)
            if time.monotonic() > end:
                raise DeviceError(f"the Tic at {self._port} does not begin to home; assign a reverse limit switch in "
                                  "the Tic Control Center")
            status = self._read_status()

    def move(self, position: float, speed: float) -> None:
        """Set maximum speed, m/s, and target, m; return when the Tic has accepted both, before the motion ends."""
        halts = self._halts
        self._get_serial_line_or_raise()
        self.limits.require_within_limits(position, speed)
        status = self._read_status()
        self._require_no_blocking_motor_error(status.errors)
        if status.flags & (MiscFlags.POSITION_UNCERTAIN | MiscFlags.HOMING):
            raise DeviceError(f"the Tic at {self._port} does not know its zero; home it first, and wait until it is "
                              "homed")
        self._enter_normal_operation()
        units = max(round(speed * self._steps / tic.MOTION.speed_unit), 1)
        self._send_and_verify_variable(TicCommand.SET_MAX_SPEED, units, VariableOffset.MAX_SPEED)
        target = round(position * self._steps)
        self._send_unless_halted(TicCommand.SET_TARGET_POSITION, target, halts)
        status = self._read_status()
        if status.target != target and halts == self._halts:
            raise DeviceError(f"the Tic at {self._port} did not accept its target; check the cable, and crc")

    def position(self) -> StageSample:
        """Return a sample with the commanded position, m, and restart the command timeout of the Tic."""
        self._get_serial_line_or_raise()
        status = self._read_status()
        requested = time.monotonic()
        motion = tic.parse_position_and_velocity_or_none(self._read_block(TicCommand.GET_VARIABLE,
                                                                          VariableOffset.CURRENT_POSITION,
                                                                          tic.BlockLength.MOTION_STATE))
        now = time.monotonic()
        if motion is None:
            raise self._make_invalid_answer_error()
        uncertain = bool(status.flags & MiscFlags.POSITION_UNCERTAIN)
        self._is_homing = self._is_homing and (uncertain or bool(status.flags & MiscFlags.HOMING))
        is_stopped_early = self._is_homing or self._goal not in (None, motion.position)
        if status.errors & (ErrorFlags.COMMAND_TIMEOUT | ErrorFlags.SAFE_START):
            # The timeout is no fault of a motor at rest. If the command that restarts the timeout came too late, the
            # error is gone, and safe start alone shows that the motor was stopped.
            self._timed_out = self._timed_out or is_stopped_early
        if status.errors & ErrorFlags.COMMAND_TIMEOUT:
            # Clearing the error while a target is set would let a Tic without safe start resume its motion; a target
            # velocity of 0 prevents that.
            self._send_command(TicCommand.SET_TARGET_VELOCITY, 0)
        else:
            self._send_command(TicCommand.RESET_COMMAND_TIMEOUT)
        homing = bool(status.flags & MiscFlags.HOMING)
        if homing and now > self._homing_until:
            self.halt()
            raise DeviceError(f"the homing of the Tic at {self._port} does not end; check the reverse limit switch and "
                              "the homing speeds")
        is_approaching_target = (status.planning == PlanningMode.POSITION and status.target != motion.position
                                 and status.state == OperationState.NORMAL)
        bits = SampleStatus.GOOD
        if status.errors & ~(ErrorFlags.SAFE_START | ErrorFlags.COMMAND_TIMEOUT) or self._timed_out:
            bits |= SampleStatus.FAULT
        if status.flags & (MiscFlags.FORWARD_LIMIT | MiscFlags.REVERSE_LIMIT):
            bits |= SampleStatus.LIMIT
        self._sequence += 1
        homed = not homing and not uncertain
        return StageSample(motion.position, motion.position / self._steps,
                           homing or motion.velocity != 0 or is_approaching_target, homed, self._sequence - 1,
                           int(bits), now, requested)

    def halt(self) -> None:
        """Set the target velocity to zero, so that the motor decelerates to rest. Never raises."""
        self._halts += 1
        self._goal, self._is_homing = None, False
        line, writing = self._line, self._writing
        if line is None or writing is None:
            return
        has_lock = writing.acquire(timeout=0.1)
        try:
            line.write(self._encode_command(TicCommand.SET_TARGET_VELOCITY, 0))
        except Exception:
            # A halt must not raise: the Tic's timeout stops the motor, and `position` reports the error.
            return
        finally:
            if has_lock:
                writing.release()

    def stop(self) -> None:
        """Halt the motor and close the port."""
        line = self._line
        if line is None:
            return
        self.halt()
        self._line = None
        line.close()

    def describe(self) -> dict[str, Any]:
        """Return port, steps, travel range, top speed and ramp; keys carry units."""
        return {"stage": "Pololu Tic", "port": self._port, "steps_per_mm": self._steps * 1e-3,
                "resolution_mm": 1e3 / self._steps, "lowest_mm": self.limits.lowest * 1e3,
                "highest_mm": self.limits.highest * 1e3, "top_speed_mm_s": self.limits.speed * 1e3,
                "position": "commanded", "stalled_motor": "not detectable", "runs_on_s": self.runs_on,
                "ramp_ms": self._ramp * 1e3, "checked_with": "emulator and ticlib; unverified on hardware"}

    def _enter_normal_operation(self) -> None:
        """Bring the Tic to normal operation with the motor at rest; DeviceError if an error prevents this."""
        self._get_serial_line_or_raise()
        status = self._read_status()
        self._require_no_blocking_motor_error(status.errors)
        self._timed_out = False
        if status.state == OperationState.NORMAL:
            self._send_command(TicCommand.RESET_COMMAND_TIMEOUT)
            return
        self._send_command(TicCommand.SET_TARGET_VELOCITY, 0)
        end = time.monotonic() + TIMING.wake
        while status.state != OperationState.NORMAL:
            if time.monotonic() > end:
                self._require_no_blocking_motor_error(status.errors)
                raise DeviceError(f"the Tic at {self._port} stays in the state {status.state.name} (error status "
                                  f"{status.errors.value:#x}); check it in the Tic Control Center")
            self._send_command(TicCommand.EXIT_SAFE_START)
            status = self._read_status()

    def _require_no_blocking_motor_error(self, errors: ErrorFlags) -> None:
        """Raise a DeviceError with the remedy for the most serious of the `errors` that prevents motion, if any."""
        for error, remedy in _REMEDIES.items():
            if errors & error:
                raise DeviceError(f"the Tic at {self._port} {remedy}")

    def _read_status(self) -> tic.TicStatus:
        """Read the status variables of the Tic and return them; raises a DeviceError for an invalid answer."""
        block = self._read_block(TicCommand.GET_VARIABLE, VariableOffset.STATUS, tic.BlockLength.STATUS)
        status = tic.parse_status_or_none(block)
        if status is None:
            raise self._make_invalid_answer_error()
        return status

    def _make_invalid_answer_error(self) -> DeviceError:
        """Return the DeviceError for an answer that no Tic can give."""
        return DeviceError(f"the device at {self._port} is no Tic, or its baud rate is not {self._baud}; check the "
                           "baud rate and the device")

    def _read_setting(self, setting: SettingOffset, size: int) -> int:
        """Read a setting of the Tic and return it, an unsigned number of `size` bytes."""
        return int.from_bytes(self._read_block(TicCommand.GET_SETTING, setting, size), "little")

    def _send_and_verify_variable(self, command: TicCommand, value: int, variable: VariableOffset) -> None:
        """Send a command with a number, read the variable that it sets, and raise a DeviceError if it differs."""
        self._send_command(command, value)
        if int.from_bytes(self._read_block(TicCommand.GET_VARIABLE, variable, 4), "little") != value:
            raise DeviceError(f"the Tic at {self._port} answers but does not accept commands; check crc")

    def _read_block(self, command: TicCommand, offset: int, size: int) -> bytes:
        """Request and return `size` bytes of variables or settings; DeviceError for a wrong checksum or no answer."""
        line = self._get_serial_line_or_raise()
        line.read()  # discards an answer that arrived after its timeout
        self._send_command(command, offset, size)
        message = line.read_exactly(size + self._response_crc, TIMING.answer)
        if self._response_crc and tic.compute_crc7(message[:-1]) != message[-1]:
            raise DeviceError(f"an answer of the Tic at {self._port} has a wrong checksum; check the cable, and that "
                              "response_crc is switched on in the Tic Control Center")
        return message[:size]

    def _encode_command(self, command: TicCommand, value: int = 0, length: int = 0) -> bytes:
        """Return the bytes of a command, with device number and checksum as this Tic is set."""
        return tic.encode_command(command, value, length, self._device, self._crc)

    def _send_command(self, command: TicCommand, value: int = 0, length: int = 0) -> None:
        """Send a command, under the lock for writing, without waiting for an answer."""
        line, writing = self._get_serial_line_or_raise(), self._writing
        assert writing is not None
        with writing:
            line.write(self._encode_command(command, value, length))

    def _send_unless_halted(self, command: TicCommand, value: int, halts: int) -> None:
        """Send a motion command and store its target, unless `halt` was called since `_halts` was `halts`."""
        line, writing = self._get_serial_line_or_raise(), self._writing
        assert writing is not None
        with writing:
            if halts == self._halts:
                self._goal, self._is_homing = (None, True) if command == TicCommand.GO_HOME else (value, False)
                line.write(self._encode_command(command, value))

    def _get_serial_line_or_raise(self) -> SerialLine:
        """Return the serial line; raises a DeviceError if the stage is not started."""
        line = self._line
        if line is None:
            raise DeviceError("the Tic is not started; start it first")
        return line


def make_tic_stage(text: str) -> TicStage:
    """Make a stage from its port and settings; `steps_per_mm` is required.

    Defaults: ``tic:/dev/ttyUSB0,steps_per_mm=800,lowest_mm=0,highest_mm=50,top_speed_mm_s=5,baud=9600,crc=0,
    response_crc=0,ramp_ms=100``; ``device=14`` selects the Pololu protocol, otherwise the compact one is used.
    """
    port, _, settings = text.partition(",")
    given = parse_number_settings(settings, steps_per_mm=0.0, lowest_mm=0.0, highest_mm=50.0, top_speed_mm_s=5.0,
                                  baud=9600,
                                  device=-1, crc=0, response_crc=0, ramp_ms=100.0)
    limits = StageLimits.from_settings(given)
    return TicStage(port.strip(), limits, given["steps_per_mm"] * 1e3, int(given["baud"]),
                    None if given["device"] == -1 else int(given["device"]), bool(given["crc"]),
                    bool(given["response_crc"]), given["ramp_ms"] * 1e-3)
