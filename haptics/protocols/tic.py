"""Messages of a Pololu Tic stepper controller on its serial pins: commands and blocks of variables.

Source: Pololu, Tic Stepper Motor Controller User's Guide (docs/0J71), sections 6 (settings), 7 (variables), 8
(commands) and 9 (serial encoding).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

#: First byte of a command of the Pololu protocol; the device number and the lower 7 bits of the command follow.
POLOLU_PREFIX = 0xAA


class BlockLength(IntEnum):
    """Lengths, bytes, of the blocks of variables that this program reads, and the largest length of a block."""

    STATUS = 14        #: read by `parse_status_or_none`
    MOTION_STATE = 8   #: read by `parse_position_and_velocity_or_none`
    LONGEST = 15       #: largest block that one command can read


@dataclass(frozen=True)
class MotionUnitsAndLimits:
    """Units and limits of speeds and accelerations in commands, variables and settings of a Tic.

    Attributes:
        speed_unit: Unit of speeds, microsteps/s.
        acceleration_unit: Unit of accelerations, microsteps/s^2.
        top_speed: Largest speed, in units of `speed_unit`.
        top_acceleration: Largest acceleration, in units of `acceleration_unit`.
        least_acceleration: Smallest acceleration, in units of `acceleration_unit`.
    """

    speed_unit: float = 1e-4
    acceleration_unit: float = 1e-2
    top_speed: int = 500_000_000
    top_acceleration: int = 0x7FFFFFFF
    least_acceleration: int = 100


#: Units and limits of every Tic.
MOTION = MotionUnitsAndLimits()


class TicCommand(IntEnum):
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


#: Commands with a 32-bit argument, sent as 5 bytes of 7 bits.
_WITH_32_BITS = frozenset({TicCommand.SET_TARGET_POSITION, TicCommand.SET_TARGET_VELOCITY,
                           TicCommand.SET_STARTING_SPEED, TicCommand.SET_MAX_SPEED, TicCommand.SET_MAX_DECELERATION,
                           TicCommand.SET_MAX_ACCELERATION, TicCommand.HALT_AND_SET_POSITION})
#: Commands with a 7-bit argument.
_WITH_7_BITS = frozenset({TicCommand.SET_CURRENT_LIMIT, TicCommand.SET_DECAY_MODE, TicCommand.SET_STEP_MODE,
                          TicCommand.GO_HOME, TicCommand.SET_AGC_OPTION})
#: Commands that read a block; the arguments are offset and length.
_READS = frozenset({TicCommand.GET_VARIABLE, TicCommand.GET_VARIABLE_AND_CLEAR, TicCommand.GET_SETTING})


class OperationState(IntEnum):
    """Operation state of a Tic: values of the variable "operation state" (section 7)."""

    RESET = 0
    DEENERGIZED = 2
    SOFT_ERROR = 4
    WAITING_FOR_ERR_LINE = 6
    STARTING_UP = 8
    NORMAL = 10


class MiscFlags(IntFlag):
    """Flags of motor, homing and limit switches: bits of the variable "misc flags 1" (section 7)."""

    ENERGIZED = 1
    POSITION_UNCERTAIN = 2
    FORWARD_LIMIT = 4
    REVERSE_LIMIT = 8
    HOMING = 16


class ErrorFlags(IntFlag):
    """Bits of the variable "error status": errors that stop the motor."""

    DEENERGIZED = 1
    DRIVER_ERROR = 2
    LOW_VIN = 4
    KILL_SWITCH = 8
    INPUT_INVALID = 16
    SERIAL_ERROR = 32
    COMMAND_TIMEOUT = 64
    SAFE_START = 128
    ERR_LINE_HIGH = 256


class PlanningMode(IntEnum):
    """Quantity that the motor follows, position or velocity: values of the variable "planning mode" (section 7)."""

    OFF = 0
    POSITION = 1
    VELOCITY = 2


class InputState(IntEnum):
    """Values of the variable "input state" of a Tic that is controlled by a serial line (section 7)."""

    HALT = 2
    POSITION = 3
    VELOCITY = 4


class VariableOffset(IntEnum):
    """Offsets of variables (section 7). The block of `TicStatus` begins at `STATUS`."""

    STATUS = 0x00
    OPERATION_STATE = 0x00
    MISC_FLAGS = 0x01
    ERROR_STATUS = 0x02
    ERRORS_OCCURRED = 0x04
    PLANNING_MODE = 0x09
    TARGET_POSITION = 0x0A
    TARGET_VELOCITY = 0x0E
    MAX_SPEED = 0x16
    MAX_DECELERATION = 0x1A
    MAX_ACCELERATION = 0x1E
    CURRENT_POSITION = 0x22
    CURRENT_VELOCITY = 0x26
    ACTING_TARGET_POSITION = 0x2A
    VIN_VOLTAGE = 0x33
    UP_TIME = 0x35
    INPUT_STATE = 0x4C


class SettingOffset(IntEnum):
    """Offsets of settings in the memory of a Tic, bytes (section 6)."""

    CONTROL_MODE = 0x01
    DISABLE_SAFE_START = 0x03
    COMMAND_TIMEOUT = 0x09
    CRC = 0x0B
    SOFT_ERROR_RESPONSE = 0x53
    HOMING_SPEED_TOWARDS = 0x61
    HOMING_SPEED_AWAY = 0x65


class ControlMode(IntEnum):
    """Values of the setting at `SettingOffset.CONTROL_MODE`; only the one that the stage requires."""

    SERIAL = 0  #: "Serial / I2C / USB": the motor follows commands


class SoftErrorResponse(IntEnum):
    """Values of the setting at `SettingOffset.SOFT_ERROR_RESPONSE`; only the one that the stage refuses."""

    GO_TO_POSITION = 3  #: "Go to position": the motor moves after an error


class AnswerFormatFlags(IntFlag):
    """Bits of the setting at `SettingOffset.CRC` that determine the format of the answers."""

    CHECKED = 2    #: answers carry a checksum
    SEVEN_BIT = 4  #: answers consist of 7-bit bytes


@dataclass(frozen=True, slots=True)
class TicStatus:
    """The variables of a Tic from `VariableOffset.STATUS` on: state, errors and target.

    Attributes:
        state: Operation state.
        flags: Misc flags 1.
        errors: Errors that stop the motor now.
        occurred: Bits of the errors since they were last cleared.
        planning: Planning mode.
        target: Target position, microsteps.
    """

    state: OperationState
    flags: MiscFlags
    errors: ErrorFlags
    occurred: int
    planning: PlanningMode
    target: int


@dataclass(frozen=True, slots=True)
class TicPositionAndVelocity:
    """The variables of a Tic from `VariableOffset.CURRENT_POSITION` on: position and velocity.

    Attributes:
        position: Commanded position, microsteps.
        velocity: Velocity, in `MotionUnitsAndLimits.speed_unit`.
    """

    position: int
    velocity: int


def compute_crc7(message: bytes) -> int:
    """Return the checksum of a message, 0 to 127: polynomial 0x91, least significant bit first (section 9)."""
    crc = 0
    for byte in message:
        crc ^= byte
        for _ in range(8):
            crc = (crc ^ 0x91) >> 1 if crc & 1 else crc >> 1
    return crc


def encode_command(command: TicCommand, value: int = 0, length: int = 0, device: int | None = None,
                   crc: bool = False) -> bytes:
    """Return the bytes of a command as sent on the serial line.

    Args:
        command: Command.
        value: Argument of the command, or offset of the block to read.
        length: Length of the block to read, bytes.
        device: Device number, for the Pololu protocol; None: the compact protocol.
        crc: True: append a checksum.

    Raises:
        ValueError: `value` or `length` is outside the range of the command.
    """
    head = bytes([command]) if device is None else bytes([POLOLU_PREFIX, device, command & 0x7F])
    if command in _WITH_32_BITS:
        four = (value & 0xFFFFFFFF).to_bytes(4, "little")
        if not -0x80000000 <= value <= 0xFFFFFFFF:
            raise ValueError(f"value must fit into 32 bits; got {value}.")
        # The first byte holds the top bits of the other four.
        body = bytes([sum((byte >> 7) << bit for bit, byte in enumerate(four)), *(byte & 0x7F for byte in four)])
    elif command in _READS:
        if not 1 <= length <= BlockLength.LONGEST:
            raise ValueError(f"length of the block must be 1 to {BlockLength.LONGEST} bytes; got {length}.")
        # Bit 6 of the length is bit 7 of the offset.
        body = bytes([value & 0x7F, length + (64 if value >= 128 else 0)])
    elif command in _WITH_7_BITS:
        if not 0 <= value <= 127:
            raise ValueError(f"value must fit into 7 bits; got {value}.")
        body = bytes([value])
    else:
        body = b""
    message = head + body
    return message + bytes([compute_crc7(message)]) if crc else message


def _count_argument_bytes(command: TicCommand) -> int:
    """Return the number of bytes after the command byte, without the checksum."""
    return 5 if command in _WITH_32_BITS else 2 if command in _READS else 1 if command in _WITH_7_BITS else 0


@dataclass(frozen=True, slots=True)
class ReceivedCommand:
    """A command that a Tic has received.

    Attributes:
        command: Command.
        value: Argument as an unsigned number, or offset of the block to read.
        length: Length of the block to read, bytes; 0 for other commands.
    """

    command: TicCommand
    value: int = 0
    length: int = 0


class CommandParser:
    """Parser of the byte stream that a Tic receives.

    Args:
        device: Device number, for the Pololu protocol.
        crc: True: commands without a correct checksum are refused.

    Attributes:
        bad_bytes: Number of bytes that belong to no command, or to a command with a wrong checksum.
    """

    def __init__(self, device: int = 14, crc: bool = False):
        self._device, self._crc, self._partial = device, crc, bytearray()
        self.bad_bytes = 0

    def extract_commands(self, data: bytes) -> list[ReceivedCommand]:
        """Add received bytes, and return the commands for this device that they complete; keeps an incomplete one."""
        commands = []
        for byte in data:
            if byte & 0x80:
                # A byte with its top bit set begins a command and discards an incomplete one.
                self.bad_bytes += len(self._partial)
                self._partial = bytearray([byte])
            elif self._partial:
                self._partial.append(byte)
            else:
                self.bad_bytes += 1
            if self._partial and self._is_message_complete():
                message, self._partial = bytes(self._partial), bytearray()
                command = self._decode_command(message)
                if command is not None:
                    commands.append(command)
        return commands

    def _parse_command_head(self) -> tuple[TicCommand | None, int]:
        """Return (command, bytes before its arguments) of the buffer; None: the command is unknown or incomplete."""
        if self._partial[0] != POLOLU_PREFIX:
            code, head = self._partial[0], 1
        elif len(self._partial) < 3:
            return None, 3
        else:
            code, head = self._partial[2] | 0x80, 3
        try:
            return TicCommand(code), head
        except ValueError:
            return None, head

    def _is_message_complete(self) -> bool:
        """Return True if the buffer has all bytes of its command, or begins with an unknown command."""
        command, head = self._parse_command_head()
        if command is None:
            return len(self._partial) >= head
        return len(self._partial) == head + _count_argument_bytes(command) + self._crc

    def _decode_command(self, message: bytes) -> ReceivedCommand | None:
        """Return the command of a complete message; None: invalid, counted in `bad_bytes`, or for another device."""
        self._partial = bytearray(message)
        command, head = self._parse_command_head()
        self._partial = bytearray()
        if command is None or (self._crc and compute_crc7(message[:-1]) != message[-1]):
            self.bad_bytes += len(message)
            return None
        if head == 3 and message[1] != self._device:
            return None
        body = message[head:head + _count_argument_bytes(command)]
        if command in _WITH_32_BITS:
            four = bytes(byte | (body[0] >> bit & 1) << 7 for bit, byte in enumerate(body[1:]))
            return ReceivedCommand(command, int.from_bytes(four, "little"))
        if command in _READS:
            length, has_high_offset = body[1] & 0x3F, bool(body[1] & 0x40)
            if not 1 <= length <= BlockLength.LONGEST:
                self.bad_bytes += len(message)
                return None
            return ReceivedCommand(command, body[0] + 128 * has_high_offset, length)
        return ReceivedCommand(command, body[0] if body else 0)


def to_signed_32_bit(value: int) -> int:
    """Convert an unsigned 32-bit number to the signed number with the same bits (two's complement)."""
    return value - (1 << 32) if value & 0x80000000 else value


def parse_status_or_none(block: bytes) -> TicStatus | None:
    """Return the status in a block of `BlockLength.STATUS` bytes; None: no Tic can have sent the block.

    Impossible blocks have another length, an unknown state or planning mode, or reserved bits set.
    """
    if len(block) != BlockLength.STATUS:
        return None
    errors, occurred = int.from_bytes(block[2:4], "little"), int.from_bytes(block[4:8], "little")
    if block[1] >> 5 or errors >> 9 or occurred >> 21:
        return None
    try:
        state, planning = OperationState(block[0]), PlanningMode(block[9])
    except ValueError:
        return None
    return TicStatus(state, MiscFlags(block[1]), ErrorFlags(errors), occurred, planning,
                     to_signed_32_bit(int.from_bytes(block[10:14], "little")))


def parse_position_and_velocity_or_none(block: bytes) -> TicPositionAndVelocity | None:
    """Return position and velocity in a block of `BlockLength.MOTION_STATE` bytes.

    None: the block has another length, or its speed is impossible.
    """
    if len(block) != BlockLength.MOTION_STATE:
        return None
    velocity = to_signed_32_bit(int.from_bytes(block[4:8], "little"))
    if abs(velocity) > MOTION.top_speed:
        return None
    return TicPositionAndVelocity(to_signed_32_bit(int.from_bytes(block[:4], "little")), velocity)
