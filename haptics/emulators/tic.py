"""A Pololu Tic on a pseudo-terminal, with a stage behind it: even speed instead of ramps.

Source: Pololu, Tic Stepper Motor Controller User's Guide (docs/0J71), sections 5.4 to 9. Motion is that of the stage
behind it, which is brought to its zero when the power comes; a limit switch is an end of its limits.
"""

from __future__ import annotations

import time
from typing import Any

from haptics.devices.contracts import Bench
from haptics.devices.settings import read_settings
from haptics.devices.virtual.faults import Faults
from haptics.emulators.terminal import TerminalEmulator
from haptics.protocols import tic
from haptics.protocols.tic import Command, Errors, Flags, Order, Planning, Setting, State
from tissue_sim.errors import InputError

#: How long "exit safe start" counts, s (5.4).
_SAFE_START = 0.2
#: Commands that clear the errors of serial and timeout (5.4).
_SIGNS_OF_LIFE = frozenset({Command.SET_TARGET_POSITION, Command.SET_TARGET_VELOCITY, Command.HALT_AND_SET_POSITION,
                            Command.HALT_AND_HOLD, Command.ENERGIZE, Command.EXIT_SAFE_START, Command.RESET,
                            Command.RESET_COMMAND_TIMEOUT})
_RESET_ERRORS = Errors.DRIVER_ERROR | Errors.LOW_VIN


class TicEmulator(TerminalEmulator):
    """Plays a Tic.

    Args:
        bench: its stage is the motor.
        faults: on the line.
        steps_per_m: microsteps. timeout: command timeout, s; 0: none.
        device, crc, response_crc: as of `haptics.devices.tic.TicStage`.
        control_mode, soft_error_response: settings that it tells (section 6).
        safe_start: whether it has one.
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
        self._settings[Setting.CONTROL_MODE] = control_mode
        self._settings[Setting.DISABLE_SAFE_START] = not safe_start
        self._settings[Setting.COMMAND_TIMEOUT:Setting.COMMAND_TIMEOUT + 2] = round(timeout * 1e3).to_bytes(2, "little")
        self._settings[Setting.CRC] = crc | response_crc << 1
        self._settings[Setting.SOFT_ERROR_RESPONSE] = soft_error_response
        for setting in (Setting.HOMING_SPEED_TOWARDS, Setting.HOMING_SPEED_AWAY):
            self._settings[setting:setting + 4] = (1_000_000).to_bytes(4, "little")
        #: Errors that something outside causes, such as `Errors.LOW_VIN`; may be set from any thread.
        self.imposed = Errors(0)
        #: Whether a limit switch is assigned, without which it does not home.
        self.has_limit_switch = True
        self._power_up()

    def _power_up(self) -> None:
        self._orders = tic.Orders(self._device, self._crc)
        self._began = self._alive = time.monotonic()
        self._safe_until = 0.0
        self._state, self._errors, self._occurred = State.SOFT_ERROR, Errors(0), 0
        self._uncertain, self._homing, self._deenergized = True, False, False
        #: What it is told to do: off, a position, microsteps, or a velocity, 1/10000 microsteps/s.
        self._input, self._wanted = Planning.OFF, 0
        #: What it does: the same; None: nothing begun yet.
        self._doing: tuple[Planning, int, int] | None = None
        #: Microsteps that "halt and set position" has put between its count and the stage behind it.
        self._offset = 0
        self._max_speed, self._max_acceleration, self._max_deceleration = 2_000_000, 40_000, 0
        self.answered = 0

    @property
    def address(self) -> str:
        limits, extra = self._stage.limits, ""
        if self._crc or self._response_crc:
            extra = f",crc={self._crc:d},response_crc={self._response_crc:d}"
        return (f"tic:{self.path},steps_per_mm={self._steps * 1e-3:g},lowest_mm={limits.lowest * 1e3:g},"
                f"highest_mm={limits.highest * 1e3:g},top_speed_mm_s={limits.speed * 1e3:g}{extra}")

    def begin(self) -> None:
        self._power_up()
        self._stage.start()
        self._stage.home()

    def end(self) -> None:
        self._stage.stop()

    def describe(self) -> dict[str, Any]:
        return {"emulator": "tic", "port": self.path, "steps_per_mm": self._steps * 1e-3,
                "command_timeout_s": self._timeout, "answered": self.answered, "bad_bytes": self._orders.bad}

    def received(self, data: bytes) -> list[bytes]:
        answers = []
        self._evaluate()
        for order in self._orders.feed(data):
            answer = self._obey(order)
            self._evaluate()
            if answer is not None:
                self.answered += 1
                answers.append(answer + bytes([tic.crc7(answer)]) if self._response_crc else answer)
        return answers

    def due(self) -> list[bytes]:
        self._evaluate()
        return []

    def _obey(self, order: Order) -> bytes | None:
        command, now = order.command, time.monotonic()
        if command in _SIGNS_OF_LIFE:
            self._alive = now
        if command in (Command.GET_VARIABLE, Command.GET_VARIABLE_AND_CLEAR):
            block = self._variables()[order.value:order.value + order.length]
            if command == Command.GET_VARIABLE_AND_CLEAR:
                self._occurred = 0
            return block
        if command == Command.GET_SETTING:
            return bytes(self._settings[order.value:order.value + order.length])
        if command == Command.SET_MAX_SPEED:
            self._max_speed = order.value
        elif command == Command.SET_MAX_ACCELERATION:
            self._max_acceleration = order.value
        elif command == Command.SET_MAX_DECELERATION:
            self._max_deceleration = order.value
        elif command == Command.DEENERGIZE:
            self._deenergized = True
        elif command == Command.ENERGIZE:
            self._deenergized = False
        elif command == Command.EXIT_SAFE_START:
            self._safe_until = now + _SAFE_START
        elif command == Command.ENTER_SAFE_START:
            self._safe_until, self._errors = 0.0, self._errors | Errors.SAFE_START
            self._stand(State.SOFT_ERROR)
        elif self._settings[Setting.CONTROL_MODE] == tic.SERIAL_CONTROL:
            self._steer(order)
        return None

    def _steer(self, order: Order) -> None:
        """Commands that move the motor or stop it."""
        command = order.command
        if self._homing and command in _SIGNS_OF_LIFE and command != Command.RESET_COMMAND_TIMEOUT:
            self._halt()
        if command == Command.SET_TARGET_POSITION:
            self._input, self._wanted = Planning.POSITION, tic.signed(order.value)
        elif command == Command.SET_TARGET_VELOCITY:
            self._input, self._wanted = Planning.VELOCITY, tic.signed(order.value)
        elif command in (Command.HALT_AND_HOLD, Command.HALT_AND_SET_POSITION, Command.RESET):
            self._halt()
            self._input, self._wanted, self._uncertain = Planning.OFF, 0, True
            if command == Command.HALT_AND_SET_POSITION:
                self._offset += tic.signed(order.value) - self._count()[0]
                self._uncertain = False
            elif command == Command.RESET:
                self._errors, self._occurred, self._state = Errors(0), 0, State.RESET
        elif command == Command.GO_HOME and self._state == State.NORMAL and self.has_limit_switch:
            self._halt()
            self._input, self._homing, self._uncertain, self._offset = Planning.OFF, True, True, 0
            self._stage.home()

    def _halt(self) -> None:
        self._stage.halt()
        self._homing, self._doing = False, None

    def _stand(self, state: State) -> None:
        """Leave normal operation: it stands, and keeps its position only with power on the motor."""
        if self._state == State.NORMAL:
            self._halt()
        if state in (State.RESET, State.DEENERGIZED):
            self._uncertain = True
        self._state = state

    def _evaluate(self) -> None:
        """Errors, state and motion, as a Tic works them out all the time."""
        now = time.monotonic()
        errors = self.imposed | (Errors.DEENERGIZED if self._deenergized else Errors(0))
        obeys = self._settings[Setting.CONTROL_MODE] == tic.SERIAL_CONTROL
        if obeys and self._timeout and now - self._alive > self._timeout:
            errors |= Errors.COMMAND_TIMEOUT
        stopped = errors or self._state != State.NORMAL
        if stopped and self._safe_start and now >= self._safe_until:
            errors |= Errors.SAFE_START
        self._errors, self._occurred = errors, self._occurred | errors.value
        if not errors:
            self._state = State.NORMAL
        else:
            self._stand(State.RESET if errors & _RESET_ERRORS else State.DEENERGIZED if errors & Errors.DEENERGIZED
                        else State.WAITING_FOR_ERR_LINE if errors == Errors.ERR_LINE_HIGH else State.SOFT_ERROR)
        if self._homing and not self._stage.position().moving:
            # Homing ends in "halt": nothing is wanted then (5.6).
            self._homing, self._uncertain, self._doing = False, False, None
        self._follow()

    def _follow(self) -> None:
        """Obey the input, where that is new."""
        wanted = self._input, self._wanted, self._max_speed
        if self._state != State.NORMAL or self._homing or wanted == self._doing or self._input == Planning.OFF:
            return
        stage = self._stage
        if not stage.position().homed:
            return  # still on the way to where the power came
        limits, least = stage.limits, tic.SPEED_UNIT / self._steps
        if self._input == Planning.VELOCITY and self._wanted == 0:
            stage.halt()
        elif self._input == Planning.VELOCITY:
            speed = min(abs(self._wanted), self._max_speed) * tic.SPEED_UNIT / self._steps
            stage.move(limits.highest if self._wanted > 0 else limits.lowest, min(max(speed, least), limits.speed))
        else:
            goal = (self._wanted - self._offset) / self._steps
            speed = min(max(self._max_speed * tic.SPEED_UNIT / self._steps, least), limits.speed)
            stage.move(min(max(goal, limits.lowest), limits.highest), speed)
        self._doing = wanted

    def _count(self) -> tuple[int, bool]:
        """Its current position, microsteps, and whether the motor turns."""
        sample = self._stage.position()
        return round(sample.position * self._steps) + self._offset, sample.moving

    def _variables(self) -> bytes:
        """The block of all variables (section 7)."""
        count, moving = self._count()
        place = (count - self._offset) / self._steps
        limits, velocity = self._stage.limits, 0
        if moving and self._doing is not None:
            planning, wanted, top = self._doing
            velocity = min(max(wanted, -top), top) if planning == Planning.VELOCITY else top if wanted > count else -top
        elif moving and self._homing:
            velocity = -self._max_speed
        if not moving and self._doing is not None and self._doing[0] == Planning.POSITION:
            goal = self._doing[1]
            if limits.lowest <= (goal - self._offset) / self._steps <= limits.highest:
                count = goal  # the stage behind it has steps of its own
        flags = Flags(0)
        if self._state in (State.NORMAL, State.SOFT_ERROR, State.STARTING_UP, State.WAITING_FOR_ERR_LINE):
            flags |= Flags.ENERGIZED
        for flag, holds in ((Flags.POSITION_UNCERTAIN, self._uncertain), (Flags.HOMING, self._homing),
                            (Flags.FORWARD_LIMIT, place >= limits.highest and limits.highest > 0),
                            (Flags.REVERSE_LIMIT, place <= limits.lowest and limits.lowest < 0)):
            flags |= flag if holds else Flags(0)
        planning = self._input if self._state == State.NORMAL and not self._homing else (
            Planning.VELOCITY if self._homing else Planning.OFF)
        target = self._wanted if planning == Planning.POSITION else 0
        speed_wanted = self._wanted if planning == Planning.VELOCITY and not self._homing else 0
        block = bytearray(256)

        def put(at: int, value: int, size: int) -> None:
            block[at:at + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")

        uptime = round((time.monotonic() - self._began) * 1e3)
        for at, value, size in (
                (0x00, self._state, 1), (0x01, flags, 1), (0x02, self._errors, 2), (0x04, self._occurred, 4),
                (0x09, planning, 1), (0x0A, target, 4), (0x0E, speed_wanted, 4), (0x16, self._max_speed, 4),
                (0x1A, self._max_deceleration, 4), (0x1E, self._max_acceleration, 4), (0x22, count, 4),
                (0x26, velocity, 4), (0x2A, target, 4), (0x33, 12_000, 2), (0x35, uptime, 4), (0x4C, self._input, 1)):
            put(at, int(value), size)
        return bytes(block)


def emulate_tic(bench: Bench, text: str, faults: Faults) -> TicEmulator:
    """``tic:steps_per_mm=800,timeout_ms=1000,device=14,crc=0,response_crc=0,control_mode=0,soft_error_response=2,``
    ``safe_start=1``."""
    given = read_settings(text, steps_per_mm=800.0, timeout_ms=1000, device=14, crc=0, response_crc=0, control_mode=0,
                          soft_error_response=2, safe_start=1)
    if not given["steps_per_mm"] > 0:
        raise InputError("give a number above zero", field="steps_per_mm")
    for name, most in (("timeout_ms", 60_000), ("device", 127), ("control_mode", 7), ("soft_error_response", 3)):
        if not 0 <= given[name] <= most:
            raise InputError(f"{given[name]}; give 0 to {most}", field=name)
    return TicEmulator(bench, faults, given["steps_per_mm"] * 1e3, given["timeout_ms"] * 1e-3, int(given["device"]),
                       bool(given["crc"]), bool(given["response_crc"]), int(given["control_mode"]),
                       int(given["soft_error_response"]), bool(given["safe_start"]))
