"""What is said to Grbl 1.1, the firmware of small milling machines: lines, real-time characters and status reports.

Source: Grbl 1.1 documentation (github.com/gnea/grbl, doc/markdown): interface.md, commands.md, jogging.md,
realtime_cmds.md, settings.md and the tables under doc/csv.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

BAUD = 115200
#: Real-time characters: picked out of the line at once, whatever stands before them.
STATUS, HOLD, RESUME, RESET, JOG_CANCEL = b"?", b"!", b"~", b"\x18", b"\x85"
AXES = "XYZ"
STATES = ("Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep")
#: Feed rates below this are raised to it (config.h, MINIMUM_FEED_RATE), mm/min.
LEAST_FEED = 1.0

#: Settings of the axis X; those of Y and Z follow.
STEPS_PER_MM, MAX_RATE, ACCELERATION, TRAVEL = 100, 110, 120, 130
REPORT_INCHES, SOFT_LIMITS, HOMING, HOMING_DIRECTION = 13, 20, 22, 23
HOMING_FEED, HOMING_SEEK, PULL_OFF = 24, 25, 27

#: What the numbers mean, and what to do.
ERRORS = {
    1: "a word without its letter", 2: "a number that it cannot read", 3: "a '$' command that it does not know",
    4: "a negative value where none may stand", 5: "homing is switched off; set $22=1",
    6: "a step pulse below 3 microseconds; set $0 to 3 or more", 7: "its memory could not be read; check all of $$",
    8: "it is not idle; wait until it stands", 9: "it is locked by an alarm or a jog; home it",
    10: "soft limits need homing; set $22=1", 11: "a line that is too long",
    12: "a step rate above what it can do; lower the maximum rate ($110 to $112)",
    13: "its safety door is open; close it",
    14: "a line too long to be stored", 15: "the way ends beyond its travel ($130 to $132); home it, or go less far",
    16: "a jog that it does not understand", 17: "laser mode needs PWM; set $32=0",
}
ALARMS = {
    1: "a limit switch was hit, and the position is lost; free the axis, reset it and home it",
    2: "the way ended beyond its travel; reset it and home it",
    3: "it was reset while it moved, and the position is lost; home it",
    4: "the probe was not as it should be before probing; reset it and home it",
    5: "the probe met nothing; reset it and home it",
    6: "homing was broken off by a reset; home it again",
    7: "homing was broken off by the safety door; close it and home again",
    8: "homing did not free the limit switch; check its wiring or raise the pull-off ($27)",
    9: "homing found no limit switch; check its wiring, and the travel ($130 to $132)",
}

#: Without zeros before: a lost sign that became one is no number.
_NUMBER = r"-?(?:0|[1-9]\d{0,5})\.\d{3,4}"
_THREE = rf"{_NUMBER}(?:,{_NUMBER}){{2,5}}"
_REPORT = re.compile(rf"<({'|'.join(STATES)})(?::(\d))?\|([MW])Pos:({_THREE})((?:\|[A-Za-z]+:[^|<>]*)*)>")
_SETTING = re.compile(r"\$(\d{1,3})=(-?\d+(?:\.\d+)?)")
_ANSWER = re.compile(r"(error|ALARM):(\d{1,3})")
_VERSION = re.compile(r"\[VER:v?(\d+\.\d+)[A-Za-z]*\.(\d{8}[^:\]]*):([^\]]*)\]")
_BANNER = re.compile(r"Grbl (\d+\.\d+)[a-z]* \['\$' for help\]")
_JOG = re.compile(r"\$J=((?:[A-Z]-?(?:\d+\.?\d*|\.\d+))+)")
_WORD = re.compile(r"([A-Z])(-?(?:\d+\.?\d*|\.\d+))")


@dataclass(frozen=True, slots=True)
class Report:
    """A status report, mm.

    Attributes:
        state: of `STATES`. substate: of Hold and Door; None: none told.
        machine: place in machine coordinates; None: it told `work` instead.
        work: place in work coordinates, which is machine less offset.
        offset: of work coordinates; None: not told this time.
        pins: letters of the inputs that are active; of a limit switch that of its axis.
        feed: mm/min, None: not told.
    """

    state: str
    substate: int | None = None
    machine: tuple[float, ...] | None = None
    work: tuple[float, ...] | None = None
    offset: tuple[float, ...] | None = None
    pins: str = ""
    feed: float | None = None


@dataclass(frozen=True, slots=True)
class Jog:
    """A jog: millimetres, by axis, or inches where the line says so (converted); feed in mm/min.

    Attributes:
        targets: by letter of the axis.
        relative: G91. machine: G53, machine coordinates.
    """

    feed: float
    targets: dict[str, float] = field(default_factory=dict)
    relative: bool = False
    machine: bool = False


def jog_line(axis: str, target: float, feed: float) -> bytes:
    """A jog in machine coordinates: to a place, mm, at a feed rate, mm/min."""
    return f"$J=G53G21G90{axis}{target:.4f}F{feed:.3f}\n".encode()


def parse_jog(line: str) -> Jog | None:
    """The jog of a line, without its ending; None: no jog as Grbl wants it (then it answers error:16 or another)."""
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
    return Jog(feed * scale, {axis: value * scale for axis, value in targets.items()}, relative, machine)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(number) for number in text.split(","))


def parse_report(line: str) -> Report | None:
    """A status report of a line; None: it is none, or not whole."""
    found = _REPORT.fullmatch(line)
    if not found:
        return None
    state, substate, kind, place, rest = found.groups()
    pins, offset, feed = "", None, None
    for part in filter(None, rest.split("|")):
        name, _, value = part.partition(":")
        if name == "WCO":
            if not re.fullmatch(_THREE, value):
                return None
            offset = _numbers(value)
        elif name == "Pn":
            if not re.fullmatch("[XYZABPDHRS]+", value):
                return None
            pins = value
        elif name in ("F", "FS"):
            if not re.fullmatch(r"\d+(?:\.\d+)?(?:,\d+(?:\.\d+)?)?", value):
                return None
            feed = float(value.partition(",")[0])
    numbers = _numbers(place)
    if offset is not None and len(offset) != len(numbers):
        return None
    return Report(state, None if substate is None else int(substate), numbers if kind == "M" else None,
                  numbers if kind == "W" else None, offset, pins, feed)


def format_report(report: Report) -> str:
    """The line of a report; the feed with a spindle speed of 0."""
    def three(numbers: tuple[float, ...]) -> str:
        return ",".join(f"{number:.3f}" for number in numbers)

    parts = [report.state if report.substate is None else f"{report.state}:{report.substate}"]
    if report.machine is not None:
        parts.append("MPos:" + three(report.machine))
    elif report.work is not None:
        parts.append("WPos:" + three(report.work))
    if report.feed is not None:
        parts.append(f"FS:{report.feed:.0f},0")
    if report.pins:
        parts.append("Pn:" + report.pins)
    if report.offset is not None:
        parts.append("WCO:" + three(report.offset))
    return f"<{'|'.join(parts)}>"


def parse_setting(line: str) -> tuple[int, float] | None:
    """Number and value of a line of ``$$``; None: it is none."""
    found = _SETTING.fullmatch(line)
    return (int(found[1]), float(found[2])) if found else None


def parse_answer(line: str) -> tuple[str, int] | None:
    """``("ok", 0)``, ``("error", number)`` or ``("ALARM", number)``; None: none of these."""
    if line == "ok":
        return "ok", 0
    found = _ANSWER.fullmatch(line)
    return (found[1], int(found[2])) if found else None


def parse_version(line: str) -> tuple[str, str] | None:
    """Version such as ``"1.1"``, and date, of the answer to ``$I``; None: it is none."""
    found = _VERSION.fullmatch(line)
    return (found[1], found[2]) if found else None


def parse_banner(line: str) -> str | None:
    """Version of the line that it says after a reset; None: it is none."""
    found = _BANNER.fullmatch(line)
    return found[1] if found else None


def error_text(number: int) -> str:
    """What an error means."""
    return ERRORS.get(number, "a line of G-code that it cannot execute")


def alarm_text(number: int | None) -> str:
    """What an alarm means, and what to do; None: it was there before we listened."""
    if number is None:
        return "its cause was told before this program listened; home it"
    return ALARMS.get(number, "its cause is not in the tables of Grbl 1.1; reset it and home it")
