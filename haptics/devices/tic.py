"""A stage that a Pololu Tic drives, over its serial pins. Tried against emulators and foreign clients only.

Source: Pololu, Tic Stepper Motor Controller User's Guide (docs/0J71); the section is named where it matters.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.controller_identification import identify_controller
from haptics.devices.serial_line import SerialLine
from haptics.devices.settings import read_settings
from haptics.protocols import tic
from haptics.protocols.tic import Command, Errors, Flags, Planning, Setting, State, Variable
from tissue_sim.errors import InputError

#: Longest wait for an answer, s; 14 bytes at 9600 baud take 15 ms.
_ANSWER = 0.5
#: Longest time that a Tic may take from safe start to normal operation, s: "exit safe start" counts for 0.2 s (5.4).
_WAKE = 0.5
#: What homing may take beyond twice the time for the whole way, s.
_HOMING_MORE = 20.0
#: Longest command timeout that is accepted, s; what is assumed until it was read.
LONGEST_TIMEOUT = 1.0
#: What keeps the motor from moving whatever is sent, and what to do (section 5.4), the gravest first.
_REMEDIES = {
    Errors.LOW_VIN: "has too little voltage at VIN; switch the motor's supply on",
    Errors.DRIVER_ERROR: "reports an error of its motor driver; check motor, wiring and current limit, then switch its "
                         "supply off and on",
    Errors.KILL_SWITCH: "is held by its kill switch; release it",
    Errors.DEENERGIZED: "was de-energized on purpose; press Resume in the Tic Control Center, or switch its supply off "
                        "and on",
    Errors.INPUT_INVALID: "misses a required input; set its control mode to Serial / I2C / USB",
    Errors.ERR_LINE_HIGH: "is stopped by its ERR line; mend the device that drives it high",
}


class TicStage(Stage):
    """A stepper without encoder: `position` is where the motor was driven to, and a stalled motor is not seen there.

    The zero is at the reverse limit switch of the Tic, where `home` goes; positive is forward. A halt slows down within
    `ramp` instead of stopping dead: "halt and hold" would lose the zero (section 8).

    Args:
        port: serial port. A Tic's own USB socket is none: its pins RX and TX need an adapter.
        limits: m, m/s. steps_per_m: microsteps.
        baud: as set in the Tic. device: its number, on a line that several share; None: the compact protocol.
        crc: whether commands carry a check, as set in the Tic; response_crc: whether answers do (firmware 1.06 on).
        ramp: time in which it gains and loses the top speed, s.

    Raises:
        InputError: a number that makes no sense, or a speed that the Tic cannot make.
    """

    measures_position = False

    def __init__(self, port: str, limits: StageLimits, steps_per_m: float, baud: int = 9600, device: int | None = None,
                 crc: bool = False, response_crc: bool = False, ramp: float = 0.1):
        if not port:
            raise InputError("no port is named; give tic:/dev/ttyUSB0,steps_per_mm=800", field="port")
        if not -math.inf < limits.lowest <= 0.0 < limits.highest < math.inf:
            raise InputError(f"from {limits.lowest:g} to {limits.highest:g} m; give a range with the zero in it",
                             field="lowest_mm, highest_mm")
        for value, name in ((limits.speed, "top_speed_mm_s"), (steps_per_m, "steps_per_mm"), (baud, "baud")):
            if not 0 < value < math.inf:
                raise InputError("give a number above zero; of the motor that is microsteps a turn over the lead of "
                                 "the screw" if name == "steps_per_mm" else "give a number above zero", field=name)
        if not 0.01 <= ramp <= 1.0:
            raise InputError(f"{ramp * 1e3:g} ms; give 10 to 1000 ms", field="ramp_ms")
        if device is not None and not 0 <= device <= 127:
            raise InputError(f"{device} is no number of a Tic; give 0 to 127", field="device")
        if limits.speed * steps_per_m > tic.TOP_SPEED * tic.SPEED_UNIT:
            raise InputError(f"{limits.speed * 1e3:g} mm/s are {limits.speed * steps_per_m:.0f} microsteps/s; a Tic "
                             "makes 50000: lower the speed, or use larger steps", field="top_speed_mm_s")
        if max(-limits.lowest, limits.highest) * steps_per_m > 0x7FFFFFFF:
            raise InputError("so many microsteps do not fit into 32 bits", field="lowest_mm, highest_mm")
        self.limits, self._port, self._steps, self._baud = limits, port, steps_per_m, baud
        self._device, self._crc, self._response_crc, self._ramp = device, crc, response_crc, ramp
        #: The Tic's own timeout, and the ramp after it.
        self.runs_on = LONGEST_TIMEOUT + ramp
        self._line: SerialLine | None = None
        self._sequence, self._halts, self._homing_until = 0, 0, math.inf
        #: Where it was sent, microsteps, and whether home; whether the timeout has cut that short.
        self._goal: int | None = None
        self._homes = self._lapsed = False

    def __getstate__(self) -> dict[str, Any]:
        if self._line is not None:
            raise TypeError("a started stage cannot be sent to another process; stop it first")
        return self.__dict__ | {"_writing": None}

    #: Made by `start`: a lock cannot be sent to another process.
    _writing: threading.Lock | None = None

    def start(self) -> None:
        if self._line is not None:
            return
        line = SerialLine(self._port, self._baud, "the Tic")
        self._writing, self._line, self._sequence = threading.Lock(), line, 0
        self._goal, self._homes, self._lapsed = None, False, False
        try:
            self._meet(line)
        except BaseException:
            self._line = None
            line.close()
            raise

    def _meet(self, line: SerialLine) -> None:
        """Check that it is a Tic, and that it stops when nobody speaks."""
        try:
            self._status()
            answers = self._setting(Setting.CRC, 1)
            self._status()
        except DeviceError as error:
            other = identify_controller(line)
            raise DeviceError(f"{error}; baud, device, crc and response_crc must be as the Tic Control Center shows "
                              f"them{other}") from None
        if answers & tic.ANSWERS_OF_7_BITS or bool(answers & tic.ANSWERS_CHECKED) != self._response_crc:
            raise DeviceError(f"the Tic at {self._port} is set to answer in another form; switch 7-bit responses off "
                              "in the Tic Control Center, and give response_crc="
                              f"{bool(answers & tic.ANSWERS_CHECKED):d}")
        # A motion that another program has left goes no further.
        self._send(Command.SET_TARGET_VELOCITY, 0)
        mode = self._setting(Setting.CONTROL_MODE, 1)
        if mode != tic.SERIAL_CONTROL:
            raise DeviceError(f"the Tic at {self._port} is in control mode {mode} and ignores what is sent; set it to "
                              "Serial / I2C / USB in the Tic Control Center")
        timeout = 1e-3 * self._setting(Setting.COMMAND_TIMEOUT, 2)
        if not 0 < timeout <= LONGEST_TIMEOUT:
            state = f"{timeout:g} s" if timeout else "switched off"
            raise DeviceError(f"the command timeout of the Tic at {self._port} is {state}, and nothing would stop the "
                              f"motor when this program dies; set it to {LONGEST_TIMEOUT:g} s or less in the Tic "
                              "Control Center")
        if self._setting(Setting.SOFT_ERROR_RESPONSE, 1) == tic.GO_TO_POSITION:
            raise DeviceError(f"the Tic at {self._port} goes to a position when this program dies; set its soft error "
                              "response to Decelerate to hold in the Tic Control Center")
        self.runs_on = timeout + self._ramp
        change = round(self.limits.speed * self._steps / self._ramp / tic.ACCELERATION_UNIT)
        change = min(max(change, tic.LEAST_ACCELERATION), tic.TOP_ACCELERATION)
        for command, variable in ((Command.SET_MAX_ACCELERATION, Variable.MAX_ACCELERATION),
                                  (Command.SET_MAX_DECELERATION, Variable.MAX_DECELERATION)):
            self._set(command, change, variable)

    def home(self) -> None:
        halts = self._halts
        self._arm()
        steps = (self.limits.highest - self.limits.lowest) * self._steps
        speeds = [max(self._setting(setting, 4) * tic.SPEED_UNIT, 1.0)
                  for setting in (Setting.HOMING_SPEED_TOWARDS, Setting.HOMING_SPEED_AWAY)]
        self._homing_until = time.monotonic() + _HOMING_MORE + sum(2.0 * steps / speed for speed in speeds)
        self._send_unless_halted(Command.GO_HOME, 0, halts)
        end, status = time.monotonic() + _WAKE, self._status()
        while status.flags & Flags.POSITION_UNCERTAIN and not status.flags & Flags.HOMING and halts == self._halts:
            self._refuse(status.errors)
            if time.monotonic() > end:
                raise DeviceError(f"the Tic at {self._port} does not begin to home; assign a reverse limit switch in "
                                  "the Tic Control Center")
            status = self._status()

    def move(self, position: float, speed: float) -> None:
        halts = self._halts
        self._require_start()
        self.limits.require(position, speed)
        status = self._status()
        self._refuse(status.errors)
        if status.flags & (Flags.POSITION_UNCERTAIN | Flags.HOMING):
            raise DeviceError(f"the Tic at {self._port} does not know its zero; home it first, and wait until it is "
                              "there")
        self._arm()
        self._set(Command.SET_MAX_SPEED, max(round(speed * self._steps / tic.SPEED_UNIT), 1), Variable.MAX_SPEED)
        target = round(position * self._steps)
        self._send_unless_halted(Command.SET_TARGET_POSITION, target, halts)
        status = self._status()
        if status.target != target and halts == self._halts:
            raise DeviceError(f"the Tic at {self._port} did not take its target; check the cable, and crc")

    def position(self) -> StageSample:
        self._require_start()
        status = self._status()
        requested = time.monotonic()
        place = tic.parse_place(self._read(Command.GET_VARIABLE, Variable.CURRENT_POSITION, tic.PLACE_SIZE))
        now = time.monotonic()
        if place is None:
            raise self._nonsense()
        uncertain = bool(status.flags & Flags.POSITION_UNCERTAIN)
        self._homes = self._homes and (uncertain or bool(status.flags & Flags.HOMING))
        if status.errors & Errors.COMMAND_TIMEOUT:
            # Of a motor that stands it is no fault. To clear it as if nothing had been would let a Tic without safe
            # start go on by itself.
            self._lapsed = self._lapsed or self._homes or self._goal not in (None, place.position)
            self._send(Command.SET_TARGET_VELOCITY, 0)
        else:
            self._send(Command.RESET_COMMAND_TIMEOUT)
        homing = bool(status.flags & Flags.HOMING)
        if homing and now > self._homing_until:
            self.halt()
            raise DeviceError(f"the homing of the Tic at {self._port} does not end; check the reverse limit switch and "
                              "the homing speeds")
        on_its_way = (status.planning == Planning.POSITION and status.target != place.position
                      and status.state == State.NORMAL)
        bits = SampleStatus.GOOD
        if status.errors & ~(Errors.SAFE_START | Errors.COMMAND_TIMEOUT) or self._lapsed:
            bits |= SampleStatus.FAULT
        if status.flags & (Flags.FORWARD_LIMIT | Flags.REVERSE_LIMIT):
            bits |= SampleStatus.LIMIT
        self._sequence += 1
        homed = not homing and not uncertain
        return StageSample(place.position, place.position / self._steps, homing or place.velocity != 0 or on_its_way,
                           homed, self._sequence - 1, int(bits), now, requested)

    def halt(self) -> None:
        self._halts += 1
        self._goal, self._homes = None, False
        line, writing = self._line, self._writing
        if line is None or writing is None:
            return
        mine = writing.acquire(timeout=0.1)
        try:
            line.write(self._encode(Command.SET_TARGET_VELOCITY, 0))
        except Exception:
            # Who halts can do nothing about it: the Tic's timeout stops the motor, and `position` says what is wrong.
            return
        finally:
            if mine:
                writing.release()

    def stop(self) -> None:
        line = self._line
        if line is None:
            return
        self.halt()
        self._line = None
        line.close()

    def describe(self) -> dict[str, Any]:
        return {"stage": "Pololu Tic", "port": self._port, "steps_per_mm": self._steps * 1e-3,
                "resolution_mm": 1e3 / self._steps, "lowest_mm": self.limits.lowest * 1e3,
                "highest_mm": self.limits.highest * 1e3, "top_speed_mm_s": self.limits.speed * 1e3,
                "position": "commanded", "stalled_motor": "not detectable", "runs_on_s": self.runs_on,
                "ramp_ms": self._ramp * 1e3, "checked_with": "emulator and ticlib; unverified on hardware"}

    def _arm(self) -> None:
        """Bring it to normal operation, with nothing old to go to; raises what keeps it from moving."""
        self._require_start()
        status = self._status()
        self._refuse(status.errors)
        self._lapsed = False
        if status.state == State.NORMAL:
            self._send(Command.RESET_COMMAND_TIMEOUT)
            return
        self._send(Command.SET_TARGET_VELOCITY, 0)
        end = time.monotonic() + _WAKE
        while status.state != State.NORMAL:
            if time.monotonic() > end:
                self._refuse(status.errors)
                raise DeviceError(f"the Tic at {self._port} stays in the state {status.state.name} (error status "
                                  f"{status.errors.value:#x}); look at it in the Tic Control Center")
            self._send(Command.EXIT_SAFE_START)
            status = self._status()

    def _refuse(self, errors: Errors) -> None:
        for error, remedy in _REMEDIES.items():
            if errors & error:
                raise DeviceError(f"the Tic at {self._port} {remedy}")

    def _status(self) -> tic.Status:
        status = tic.parse_status(self._read(Command.GET_VARIABLE, Variable.STATUS, tic.STATUS_SIZE))
        if status is None:
            raise self._nonsense()
        return status

    def _nonsense(self) -> DeviceError:
        return DeviceError(f"what answers at {self._port} is no Tic, or is read at another baud rate than "
                           f"{self._baud}; check the baud rate and which device this is")

    def _setting(self, setting: Setting, size: int) -> int:
        return int.from_bytes(self._read(Command.GET_SETTING, setting, size), "little")

    def _set(self, command: Command, value: int, variable: Variable) -> None:
        """Send a number, and see that it was taken."""
        self._send(command, value)
        if int.from_bytes(self._read(Command.GET_VARIABLE, variable, 4), "little") != value:
            raise DeviceError(f"the Tic at {self._port} answers but does not take what it is sent; check crc")

    def _read(self, command: Command, offset: int, size: int) -> bytes:
        line = self._require_start()
        line.read()  # of an answer that came too late
        self._send(command, offset, size)
        message = line.read_some(size + self._response_crc, _ANSWER)
        if self._response_crc and tic.crc7(message[:-1]) != message[-1]:
            raise DeviceError(f"the check of an answer of the Tic at {self._port} is wrong; check the cable, and that "
                              "response_crc is switched on in the Tic Control Center")
        return message[:size]

    def _encode(self, command: Command, value: int = 0, length: int = 0) -> bytes:
        return tic.encode(command, value, length, self._device, self._crc)

    def _send(self, command: Command, value: int = 0, length: int = 0) -> None:
        line, writing = self._require_start(), self._writing
        assert writing is not None
        with writing:
            line.write(self._encode(command, value, length))

    def _send_unless_halted(self, command: Command, value: int, halts: int) -> None:
        """Send what moves, but for a halt that has come since the count was `halts`."""
        line, writing = self._require_start(), self._writing
        assert writing is not None
        with writing:
            if halts == self._halts:
                self._goal, self._homes = (None, True) if command == Command.GO_HOME else (value, False)
                line.write(self._encode(command, value))

    def _require_start(self) -> SerialLine:
        line = self._line
        if line is None:
            raise DeviceError("the Tic is not started; start it first")
        return line


def open_tic(text: str) -> TicStage:
    """``tic:/dev/ttyUSB0,steps_per_mm=800,lowest_mm=0,highest_mm=50,top_speed_mm_s=5,baud=9600,device=14,crc=0,``
    ``response_crc=0,ramp_ms=100``; the scale must be given; without ``device``: the compact protocol."""
    port, _, settings = text.partition(",")
    given = read_settings(settings, steps_per_mm=0.0, lowest_mm=0.0, highest_mm=50.0, top_speed_mm_s=5.0, baud=9600,
                          device=-1, crc=0, response_crc=0, ramp_ms=100.0)
    limits = StageLimits.from_settings(given)
    return TicStage(port.strip(), limits, given["steps_per_mm"] * 1e3, int(given["baud"]),
                    None if given["device"] == -1 else int(given["device"]), bool(given["crc"]),
                    bool(given["response_crc"]), given["ramp_ms"] * 1e-3)
