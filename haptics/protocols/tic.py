"""What is said to a Pololu Tic stepper controller over its serial pins: commands and blocks of variables.

Source: Pololu, Tic Stepper Motor Controller User's Guide (docs/0J71), sections 6 (settings), 7 (variables), 8
(commands) and 9 (serial encoding).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

#: First byte of a command of the Pololu protocol; the device number and the command less its top bit follow.
POLOLU = 0xAA
#: Most bytes that one command can ask for.
LONGEST_BLOCK = 15
#: Speeds are in 1/10000 microsteps/s, accelerations in 1/100 microsteps/s^2.
SPEED_UNIT, ACCELERATION_UNIT = 1e-4, 1e-2
#: Largest speed (50000 microsteps/s) and acceleration that it takes, in those units; smallest acceleration.
TOP_SPEED, TOP_ACCELERATION, LEAST_ACCELERATION = 500_000_000, 0x7FFFFFFF, 100


class Command(IntEnum):
    """First byte of a command of the compact protocol."""

    SET_TARGET_POSITION = 0xE0
    SET_TARGET_VELOCITY = 0xE3
    SET_STARTING_SPEED = 0xE5
    SET_MAX_SPEED = 0xE6
    SET_MAX_DECELERATION = 0xE9
    SET_MAX_ACCELERATION = 0xEA
    HALT_AND_SET_POSITION = 0xEC
    EXIT_SAFE_START = 0x83
    ENERGIZE = 0x85
    DEENERGIZE = 0x86
    HALT_AND_HOLD = 0x89
    CLEAR_DRIVER_ERROR = 0x8A
    RESET_COMMAND_TIMEOUT = 0x8C
    ENTER_SAFE_START = 0x8F
    SET_CURRENT_LIMIT = 0x91
    SET_DECAY_MODE = 0x92
    SET_STEP_MODE = 0x94
    GO_HOME = 0x97
    SET_AGC_OPTION = 0x98
    GET_VARIABLE = 0xA1
    GET_VARIABLE_AND_CLEAR = 0xA2
    GET_SETTING = 0xA8
    RESET = 0xB0


_WIDE = frozenset({Command.SET_TARGET_POSITION, Command.SET_TARGET_VELOCITY, Command.SET_STARTING_SPEED,
                   Command.SET_MAX_SPEED, Command.SET_MAX_DECELERATION, Command.SET_MAX_ACCELERATION,
                   Command.HALT_AND_SET_POSITION})
_NARROW = frozenset({Command.SET_CURRENT_LIMIT, Command.SET_DECAY_MODE, Command.SET_STEP_MODE, Command.GO_HOME,
                     Command.SET_AGC_OPTION})
_READS = frozenset({Command.GET_VARIABLE, Command.GET_VARIABLE_AND_CLEAR, Command.GET_SETTING})


class State(IntEnum):
    """The variable "operation state"."""

    RESET = 0
    DEENERGIZED = 2
    SOFT_ERROR = 4
    WAITING_FOR_ERR_LINE = 6
    STARTING_UP = 8
    NORMAL = 10


class Flags(IntFlag):
    """The variable "misc flags 1"."""

    ENERGIZED = 1
    POSITION_UNCERTAIN = 2
    FORWARD_LIMIT = 4
    REVERSE_LIMIT = 8
    HOMING = 16


class Errors(IntFlag):
    """The variable "error status": what stops the motor."""

    DEENERGIZED = 1
    DRIVER_ERROR = 2
    LOW_VIN = 4
    KILL_SWITCH = 8
    INPUT_INVALID = 16
    SERIAL_ERROR = 32
    COMMAND_TIMEOUT = 64
    SAFE_START = 128
    ERR_LINE_HIGH = 256


class Planning(IntEnum):
    """The variable "planning mode"."""

    OFF = 0
    POSITION = 1
    VELOCITY = 2


class Variable(IntEnum):
    """Where variables begin."""

    STATUS = 0x00
    TARGET_POSITION = 0x0A
    MAX_SPEED = 0x16
    MAX_DECELERATION = 0x1A
    MAX_ACCELERATION = 0x1E
    CURRENT_POSITION = 0x22


class Setting(IntEnum):
    """Where settings begin."""

    CONTROL_MODE = 0x01
    DISABLE_SAFE_START = 0x03
    COMMAND_TIMEOUT = 0x09
    CRC = 0x0B
    SOFT_ERROR_RESPONSE = 0x53
    HOMING_SPEED_TOWARDS = 0x61
    HOMING_SPEED_AWAY = 0x65


#: Of `Setting.CONTROL_MODE`: "Serial / I2C / USB". Of `Setting.SOFT_ERROR_RESPONSE`: "Go to position".
SERIAL_CONTROL, GO_TO_POSITION = 0, 3
#: Bits of `Setting.CRC` about answers: with a check; in bytes of 7 bits.
ANSWERS_CHECKED, ANSWERS_OF_7_BITS = 2, 4
#: Bytes of the two blocks below.
STATUS_SIZE, PLACE_SIZE = 14, 8


@dataclass(frozen=True, slots=True)
class Status:
    """The block from `Variable.STATUS`. `target`: microsteps; `occurred`: errors since they were last cleared."""

    state: State
    flags: Flags
    errors: Errors
    occurred: int
    planning: Planning
    target: int


@dataclass(frozen=True, slots=True)
class Place:
    """The block from `Variable.CURRENT_POSITION`: microsteps, and 1/10000 microsteps/s."""

    position: int
    velocity: int


def crc7(message: bytes) -> int:
    """The check of a message, 0 to 127: polynomial 0x91, least significant bit first (section 9)."""
    crc = 0
    for byte in message:
        crc ^= byte
        for _ in range(8):
            crc = (crc ^ 0x91) >> 1 if crc & 1 else crc >> 1
    return crc


def encode(command: Command, value: int = 0, length: int = 0, device: int | None = None, crc: bool = False) -> bytes:
    """A command as it goes over the line.

    Args:
        command: which. value: its number, or where a block begins. length: of a block, bytes.
        device: number of the Tic: the Pololu protocol; None: the compact one.
        crc: whether a check follows.

    Raises:
        ValueError: a number that does not fit.
    """
    head = bytes([command]) if device is None else bytes([POLOLU, device, command & 0x7F])
    if command in _WIDE:
        four = (value & 0xFFFFFFFF).to_bytes(4, "little")
        if not -0x80000000 <= value <= 0xFFFFFFFF:
            raise ValueError(f"{value} does not fit into 32 bits")
        body = bytes([sum((byte >> 7) << bit for bit, byte in enumerate(four)), *(byte & 0x7F for byte in four)])
    elif command in _READS:
        if not 1 <= length <= LONGEST_BLOCK:
            raise ValueError(f"a block of {length} bytes; 1 to {LONGEST_BLOCK} can be asked for")
        # Offsets from 128 on: less 128, and bit 6 of the length.
        body = bytes([value & 0x7F, length + (64 if value >= 128 else 0)])
    elif command in _NARROW:
        if not 0 <= value <= 127:
            raise ValueError(f"{value} does not fit into 7 bits")
        body = bytes([value])
    else:
        body = b""
    message = head + body
    return message + bytes([crc7(message)]) if crc else message


def _size(command: Command) -> int:
    """Bytes that follow it."""
    return 5 if command in _WIDE else 2 if command in _READS else 1 if command in _NARROW else 0


@dataclass(frozen=True, slots=True)
class Order:
    """A command that was received: its number (as sent, without sign), or the begin and length of a block."""

    command: Command
    value: int = 0
    length: int = 0


class Orders:
    """Commands out of the bytes that a Tic receives, in pieces as they come.

    Args:
        device: its number, for the Pololu protocol. crc: whether each command must bring its check.
    """

    def __init__(self, device: int = 14, crc: bool = False):
        self._device, self._crc, self._kept = device, crc, bytearray()
        #: Bytes that were no command, or whose check was wrong.
        self.bad = 0

    def feed(self, data: bytes) -> list[Order]:
        """The commands for this device that are complete now, in their order."""
        orders = []
        for byte in data:
            if byte & 0x80:
                # A command byte begins anew, whatever was there.
                self.bad += len(self._kept)
                self._kept = bytearray([byte])
            elif self._kept:
                self._kept.append(byte)
            else:
                self.bad += 1
            if self._kept and self._is_whole():
                message, self._kept = bytes(self._kept), bytearray()
                order = self._order(message)
                if order is not None:
                    orders.append(order)
        return orders

    def _command(self) -> tuple[Command | None, int]:
        """Which command has begun, and how many bytes stand before its numbers; None: not known yet, or none."""
        if self._kept[0] != POLOLU:
            code, head = self._kept[0], 1
        elif len(self._kept) < 3:
            return None, 3
        else:
            code, head = self._kept[2] | 0x80, 3
        try:
            return Command(code), head
        except ValueError:
            return None, head

    def _is_whole(self) -> bool:
        command, head = self._command()
        if command is None:
            return len(self._kept) >= head
        return len(self._kept) == head + _size(command) + self._crc

    def _order(self, message: bytes) -> Order | None:
        self._kept = bytearray(message)
        command, head = self._command()
        self._kept = bytearray()
        if command is None or (self._crc and crc7(message[:-1]) != message[-1]):
            self.bad += len(message)
            return None
        if head == 3 and message[1] != self._device:
            return None
        body = message[head:head + _size(command)]
        if command in _WIDE:
            four = bytes(byte | (body[0] >> bit & 1) << 7 for bit, byte in enumerate(body[1:]))
            return Order(command, int.from_bytes(four, "little"))
        if command in _READS:
            length, beyond = body[1] & 0x3F, bool(body[1] & 0x40)
            if not 1 <= length <= LONGEST_BLOCK:
                self.bad += len(message)
                return None
            return Order(command, body[0] + 128 * beyond, length)
        return Order(command, body[0] if body else 0)


def signed(value: int) -> int:
    """A 32-bit number with its sign."""
    return value - (1 << 32) if value & 0x80000000 else value


def parse_status(block: bytes) -> Status | None:
    """The block of `STATUS_SIZE` bytes; None where no Tic can have sent it: unknown states, or reserved bits set."""
    if len(block) != STATUS_SIZE:
        return None
    errors, occurred = int.from_bytes(block[2:4], "little"), int.from_bytes(block[4:8], "little")
    if block[1] >> 5 or errors >> 9 or occurred >> 21:
        return None
    try:
        state, planning = State(block[0]), Planning(block[9])
    except ValueError:
        return None
    return Status(state, Flags(block[1]), Errors(errors), occurred, planning,
                  signed(int.from_bytes(block[10:14], "little")))


def parse_place(block: bytes) -> Place | None:
    """The block of `PLACE_SIZE` bytes; None where the speed is beyond what a Tic can do."""
    if len(block) != PLACE_SIZE:
        return None
    velocity = signed(int.from_bytes(block[4:8], "little"))
    if abs(velocity) > TOP_SPEED:
        return None
    return Place(signed(int.from_bytes(block[:4], "little")), velocity)
