"""Messages of Grbl 1.1, the firmware of small milling machines: lines, real-time characters and status reports.

Source: Grbl 1.1 documentation (github.com/gnea/grbl, doc/markdown): interface.md, commands.md, jogging.md,
realtime_cmds.md, settings.md and the tables under doc/csv.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from enum import IntEnum

#: Default baud rate.
BAUD = 115200
#: Real-time characters, which Grbl executes at once, before the characters received earlier. Request a status report:
STATUS = b"?"
#: Pause the motion.
HOLD = b"!"
#: Resume a paused motion.
RESUME = b"~"
#: Soft reset.
RESET = b"\x18"
#: Cancel all jogs.
JOG_CANCEL = b"\x85"
#: Letters of the linear axes.
AXES = "XYZ"
#: States of the machine.
STATES = ("Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep")
#: Lowest feed rate; Grbl raises lower ones to it (config.h, MINIMUM_FEED_RATE), mm/min.
LEAST_FEED = 1.0


class GrblSetting(IntEnum):
    """Numbers of settings ``$$``. For settings of an axis this is the number of X; those of Y and Z follow."""

    #: 1: reports are in inches.
    REPORT_INCHES = 13
    #: 1: motions beyond the travel are refused.
    SOFT_LIMITS = 20
    #: 1: homing is enabled.
    HOMING = 22
    #: One bit per axis; set: the axis homes to its negative end.
    HOMING_DIRECTION = 23
    #: Feed rate of the slow approach to the switch, mm/min.
    HOMING_FEED = 24
    #: Feed rate of the search for the switch, mm/min.
    HOMING_SEEK = 25
    #: Distance from the switch at the end of homing, mm.
    PULL_OFF = 27
    #: Motor steps per millimetre.
    STEPS_PER_MM = 100
    #: Largest feed rate, mm/min.
    MAX_RATE = 110
    #: Acceleration, mm/s^2.
    ACCELERATION = 120
    #: Length of travel, mm.
    TRAVEL = 130


#: Errors by number: cause, and remedy where there is one.
ERRORS = {
    1: "a word has no letter", 2: "a number is malformed", 3: "the '$' command is unknown",
    4: "a value must not be negative", 5: "homing is disabled; set $22=1",
    6: "the step pulse is shorter than 3 microseconds; set $0 to 3 or more",
    7: "the stored settings could not be read; check all of $$",
    8: "the machine is not idle; wait until it is at rest",
    9: "the machine is locked by an alarm or a jog; home it",
    10: "soft limits require homing; set $22=1", 11: "the line is too long",
    12: "the step rate is too high; lower the maximum rate ($110 to $112)",
    13: "the safety door is open; close it",
    14: "the line is too long to be stored",
    15: "the target is outside the travel ($130 to $132); home the machine, or use a nearer target",
    16: "the jog command is malformed", 17: "laser mode requires PWM; set $32=0",
}
#: Alarms by number: cause and remedy.
ALARMS = {
    1: "a limit switch was hit, and the position is lost; free the axis, reset it and home it",
    2: "the target was outside the travel; reset the machine and home it",
    3: "the machine was reset during a motion, and the position is lost; home it",
    4: "the probe was in the wrong state before probing; reset the machine and home it",
    5: "the probe made no contact; reset the machine and home it",
    6: "homing was interrupted by a reset; home it again",
    7: "homing was interrupted by the safety door; close it and home again",
    8: "homing did not free the limit switch; check its wiring or raise the pull-off ($27)",
    9: "homing found no limit switch; check its wiring, and the travel ($130 to $132)",
}

#: A coordinate. Leading zeros are refused: a garbled sign must not read as a digit.
_NUMBER = r"-?(?:0|[1-9]\d{0,5})\.\d{3,4}"
#: Coordinates of three to six axes.
_COORDINATES = rf"{_NUMBER}(?:,{_NUMBER}){{2,5}}"
_REPORT = re.compile(rf"<({'|'.join(STATES)})(?::(\d))?\|([MW])Pos:({_COORDINATES})((?:\|[A-Za-z]+:[^|<>]*)*)>")

_SETTING = re.compile(r"\$(\d{1,3})=(-?\d+(?:\.\d+)?)")
_ANSWER = re.compile(r"(error|ALARM):(\d{1,3})")
_VERSION = re.compile(r"\[VER:v?(\d+\.\d+)[A-Za-z]*\.(\d{8}[^:\]]*):([^\]]*)\]")
_BANNER = re.compile(r"Grbl (\d+\.\d+)[a-z]* \['\$' for help\]")
_JOG = re.compile(r"\$J=((?:[A-Z]-?(?:\d+\.?\d*|\.\d+))+)")
_WORD = re.compile(r"([A-Z])(-?(?:\d+\.?\d*|\.\d+))")


@dataclass(frozen=True, slots=True)
class StatusReport:
    """A status report; lengths in mm.

    Attributes:
        state: One of `STATES`.
        substate: Substate of Hold and Door; None: not reported.
        machine: Position in machine coordinates; None: the report has `work` instead.
        work: Position in work coordinates, which is machine position minus offset.
        offset: Offset of the work coordinates; None: not in this report.
        pins: Letters of the active inputs; a limit switch has the letter of its axis.
        feed: Feed rate, mm/min; None: not reported.
    """

    state: str
    substate: int | None = None
    machine: tuple[float, ...] | None = None
    work: tuple[float, ...] | None = None
    offset: tuple[float, ...] | None = None
    pins: str = ""
    feed: float | None = None


@dataclass(frozen=True, slots=True)
class JogCommand:
    """A jog command, in millimetres; inches were converted.

    Attributes:
        feed: Feed rate, mm/min.
        targets: Target by letter of the axis, mm.
        relative: True: targets are relative to the present position (G91).
        machine: True: targets are machine coordinates (G53).
    """

    feed: float
    targets: dict[str, float] = field(default_factory=dict)
    relative: bool = False
    machine: bool = False


def encode_jog_in_machine_coordinates(axis: str, target: float, feed: float) -> bytes:
    """Return the bytes of a jog line with its ending: one axis, target in machine coordinates, mm, feed in mm/min."""
    return f"$J=G53G21G90{axis}{target:.4f}F{feed:.3f}\n".encode()


def parse_jog_or_none(line: str) -> JogCommand | None:
    """Return the jog command in a line ``$J=...`` without its ending; None: Grbl would refuse the line."""
    found = _JOG.fullmatch(line.replace(" ", "").upper())
    if not found:
        return None
    targets: dict[str, float] = {}
    feed, scale, relative, machine = math.nan, 1.0, False, False
    for letter, number in _WORD.findall(found[1]):
        value = float(number)
        if letter == "G" and value in (20, 21):
            scale = 25.4 if value == 20 else 1.0
        elif letter == "G" and value in (90, 91):
            relative = value == 91
        elif letter == "G" and value == 53:
            machine = True
        elif letter == "F" and math.isnan(feed):
            feed = value
        elif letter in AXES and letter not in targets:
            targets[letter] = value
        else:
            return None
    if not targets or not feed > 0:
        return None
    return JogCommand(feed * scale, {axis: value * scale for axis, value in targets.items()}, relative, machine)


def _parse_numbers(text: str) -> tuple[float, ...]:
    """Return the numbers of a text such as ``0.000,1.500,0.000``."""
    return tuple(float(number) for number in text.split(","))


def parse_report_or_none(line: str) -> StatusReport | None:
    """Return the status report in a line ``<...>``; None: the line is no complete and valid report."""
    found = _REPORT.fullmatch(line)
    if not found:
        return None
    state, substate, kind, coordinates, rest = found.groups()
    pins, offset, feed = "", None, None
    for part in filter(None, rest.split("|")):
        name, _, value = part.partition(":")
        if name == "WCO":
            if not re.fullmatch(_COORDINATES, value):
                return None
            offset = _parse_numbers(value)
        elif name == "Pn":
            if not re.fullmatch("[XYZABPDHRS]+", value):
                return None
            pins = value
        elif name in ("F", "FS"):
            if not re.fullmatch(r"\d+(?:\.\d+)?(?:,\d+(?:\.\d+)?)?", value):
                return None
            feed = float(value.partition(",")[0])
    numbers = _parse_numbers(coordinates)
    if offset is not None and len(offset) != len(numbers):
        return None
    return StatusReport(state, None if substate is None else int(substate), numbers if kind == "M" else None,
                        numbers if kind == "W" else None, offset, pins, feed)


def format_report(report: StatusReport) -> str:
    """Return the line ``<...>`` of a report; a feed rate is followed by a spindle speed of 0."""
    def join_numbers(numbers: tuple[float, ...]) -> str:
        """Return the numbers with three decimals, separated by commas."""
        return ",".join(f"{number:.3f}" for number in numbers)

    parts = [report.state if report.substate is None else f"{report.state}:{report.substate}"]
    if report.machine is not None:
        parts.append("MPos:" + join_numbers(report.machine))
    elif report.work is not None:
        parts.append("WPos:" + join_numbers(report.work))
    if report.feed is not None:
        parts.append(f"FS:{report.feed:.0f},0")
    if report.pins:
        parts.append("Pn:" + report.pins)
    if report.offset is not None:
        parts.append("WCO:" + join_numbers(report.offset))
    return f"<{'|'.join(parts)}>"


def parse_setting_or_none(line: str) -> tuple[int, float] | None:
    """Return (number, value) of a line ``$NUMBER=VALUE``; None: the line is no setting."""
    found = _SETTING.fullmatch(line)
    return (int(found[1]), float(found[2])) if found else None


def parse_answer_kind_and_number_or_none(line: str) -> tuple[str, int] | None:
    """Return ``("ok", 0)``, ``("error", number)`` or ``("ALARM", number)``; None: the line is no answer."""
    if line == "ok":
        return "ok", 0
    found = _ANSWER.fullmatch(line)
    return (found[1], int(found[2])) if found else None


def parse_version_and_date_or_none(line: str) -> tuple[str, str] | None:
    """Return (version, date), such as ``("1.1", "20190825")``, of a line ``[VER:...]``; None: no such line."""
    found = _VERSION.fullmatch(line)
    return (found[1], found[2]) if found else None


def parse_banner_version_or_none(line: str) -> str | None:
    """Return the version in the banner that Grbl sends after a reset; None: the line is no banner."""
    found = _BANNER.fullmatch(line)
    return found[1] if found else None


def describe_error(number: int) -> str:
    """Return cause and remedy of an error of Grbl by its number; a general text for an unknown number."""
    return ERRORS.get(number, "the line of G-code cannot be executed")


def describe_alarm(number: int | None) -> str:
    """Return cause and remedy of an alarm by its number; None: the alarm occurred before the connection."""
    if number is None:
        return "its cause was reported before this program connected; home it"
    return ALARMS.get(number, "its cause is not in the tables of Grbl 1.1; reset it and home it")

