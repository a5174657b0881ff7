"""Bytes of the Pololu Tic: examples of its manual, commands of another client, and arbitrary bytes."""

import os

import pytest
import ticlib
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.protocols import tic
from haptics.protocols.tic import (
    CommandParser,
    ErrorFlags,
    MiscFlags,
    OperationState,
    PlanningMode,
    ReceivedCommand,
    TicCommand,
    VariableOffset,
)

CASES = int(os.environ.get("TISSUE_SIM_FUZZ_CASES", "500"))
WIDE = [command for command in TicCommand if 0xE0 <= command <= 0xEC]


@pytest.mark.parametrize(("message", "wanted"), [
    # Tic user's guide (docs/0J71), section 9, "Quick": halt and hold.
    (tic.encode_command(TicCommand.HALT_AND_HOLD), "89"),
    # "7-bit write": set step mode to 1/8 step; the same in the Pololu protocol, device 14.
    (tic.encode_command(TicCommand.SET_STEP_MODE, 3), "94 03"),
    (tic.encode_command(TicCommand.SET_STEP_MODE, 3, device=14), "AA 0E 14 03"),
    # "32-bit write": set target position to 1,234,567,890. Editions until 2018 print 0A for the second byte, against
    # their own rule; the later ones print this.
    (tic.encode_command(TicCommand.SET_TARGET_POSITION, 1234567890), "E0 05 52 02 16 49"),
    # "Block read": get variable "target position".
    (tic.encode_command(TicCommand.GET_VARIABLE, VariableOffset.TARGET_POSITION, 4), "A1 0A 04"),
])
def test_commands_equal_the_manual(message, wanted):
    assert message == bytes.fromhex(wanted)


def test_the_checksum_equals_the_manual():
    # Section 9, "Cyclic Redundancy Check (CRC) Error Detection": the packet 0x83, 0x01 ends in 0x17.
    assert tic.compute_crc7(bytes([0x83, 0x01])) == 0x17


def test_the_answer_of_the_manual_is_read():
    # Section 9, "Block read": D2 02 96 49 is 1,234,567,890.
    block = bytes([OperationState.NORMAL, 1, 0, 0, 0, 0, 0, 0, 0, PlanningMode.POSITION]) + bytes.fromhex("D2029649")
    assert tic.parse_status_or_none(block) \
        == tic.TicStatus(OperationState.NORMAL, MiscFlags.ENERGIZED, ErrorFlags(0), 0,
                         PlanningMode.POSITION,
                         1234567890)


@pytest.mark.slow
@given(st.sampled_from(WIDE), st.integers(-0x80000000, 0x7FFFFFFF), st.sampled_from([None, 0, 14, 127]), st.booleans())
@settings(max_examples=CASES, deadline=None)
def test_commands_equal_those_of_ticlib_and_are_parsed_back(command, value, device, crc):
    sent = bytearray()

    class Port:
        def write(self, data):
            sent.extend(data)

    foreign = ticlib.TicSerial(Port(), device_number=device, crc_for_commands=crc)
    name = {code: name for name, code, _ in ticlib.ticlib.COMMANDS}[command]
    getattr(foreign, name)(value)
    message = tic.encode_command(command, value, device=device, crc=crc)
    assert message == bytes(sent)
    parser = CommandParser(14 if device is None else device, crc)
    assert parser.extract_commands(message) == [ReceivedCommand(command, value & 0xFFFFFFFF)] and parser.bad_bytes == 0
    assert tic.to_signed_32_bit(value & 0xFFFFFFFF) == value


@given(st.sampled_from(list(TicCommand)), st.integers(0, 255), st.integers(1, 15), st.booleans(), st.data())
@settings(max_examples=CASES, deadline=None)
def test_every_command_is_parsed_from_any_two_pieces(command, value, length, crc, data):
    number = value if 0xE0 <= command <= 0xEC or command in (0xA1, 0xA2, 0xA8) else value & 0x7F
    message = tic.encode_command(command, number, length, crc=crc)
    cut = data.draw(st.integers(0, len(message)))
    parser = CommandParser(crc=crc)
    got = parser.extract_commands(message[:cut]) + parser.extract_commands(message[cut:])
    assert len(got) == 1 and got[0].command == command and parser.bad_bytes == 0
    if len(message) - crc > 1:
        assert got[0].value == number


@given(st.binary(max_size=60), st.booleans())
@settings(max_examples=CASES, deadline=None)
def test_any_bytes_leave_the_parser_alive(data, crc):
    parser = CommandParser(crc=crc)
    for received in parser.extract_commands(data):
        assert received.command in set(TicCommand) and 0 <= received.value <= 0xFFFFFFFF and 0 <= received.length <= 15
    parser.extract_commands(tic.encode_command(TicCommand.HALT_AND_HOLD, crc=crc))  # discards an incomplete command
    message = tic.encode_command(TicCommand.GO_HOME, 1, crc=crc)
    assert parser.extract_commands(message) == [ReceivedCommand(TicCommand.GO_HOME, 1)]


@given(st.sampled_from(WIDE), st.integers(0, 0xFFFFFFFF), st.integers(0, 6), st.integers(1, 127))
@settings(max_examples=CASES, deadline=None)
def test_a_wrong_byte_never_passes_the_checksum(command, value, at, flip):
    message = bytearray(tic.encode_command(command, value, crc=True))
    message[at] ^= flip
    assert ReceivedCommand(command, value) not in CommandParser(crc=True).extract_commands(bytes(message))
    # One wrong byte is a burst of at most 7 bits, which a checksum of 7 bits always detects.
    assert CommandParser(crc=True).extract_commands(bytes(message)) == [] or at == 0


@given(st.binary(min_size=0, max_size=20))
@settings(max_examples=CASES, deadline=None)
def test_a_status_is_complete_and_possible_or_none(block):
    status, motion = tic.parse_status_or_none(block), tic.parse_position_and_velocity_or_none(block)
    if status is not None:
        assert len(block) == tic.BlockLength.STATUS and block[0] in set(OperationState) and not block[3] & 0xFE
    if motion is not None:
        assert len(block) == tic.BlockLength.MOTION_STATE and abs(motion.velocity) <= tic.MOTION.top_speed


@given(st.sampled_from(list(OperationState)), st.integers(0, 31), st.integers(0, 0x1FF), st.integers(0, 0x1FFFFF),
       st.sampled_from(list(PlanningMode)), st.integers(-0x80000000, 0x7FFFFFFF), st.integers(0, 255))
@settings(max_examples=CASES, deadline=None)
def test_every_possible_status_is_read(state, flags, errors, occurred, planning, target, unused):
    block = (bytes([state, flags]) + errors.to_bytes(2, "little") + occurred.to_bytes(4, "little")
             + bytes([unused, planning]) + (target & 0xFFFFFFFF).to_bytes(4, "little"))
    assert tic.parse_status_or_none(block) \
        == tic.TicStatus(state, MiscFlags(flags), ErrorFlags(errors), occurred, planning,
                         target)


@pytest.mark.parametrize(("command", "value", "length"), [
    (TicCommand.SET_TARGET_POSITION, 1 << 32, 0), (TicCommand.GO_HOME, 128, 0), (TicCommand.GET_VARIABLE, 0, 16),
    (TicCommand.GET_VARIABLE, 0, 0),
])
def test_arguments_out_of_range_are_refused(command, value, length):
    with pytest.raises(ValueError, match=r"fit|block"):
        tic.encode_command(command, value, length)
