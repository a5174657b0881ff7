"""Emulator of Grbl 1.1 on a pseudo-terminal. One axis is a stage that moves at constant speed, without ramps.

Supports jogs, homing, settings, reports and alarms; no G-code. Source: Grbl 1.1 documentation, doc/markdown of
github.com/gnea/grbl. At power-on the stage is homed.
"""

from __future__ import annotations

from typing import Any

from haptics.devices.contracts import Bench
from haptics.devices.settings import parse_number_settings
from haptics.devices.virtual.faults import Faults
from haptics.emulators.emulator import SerialDeviceEmulator
from haptics.protocols import grbl
from haptics.protocols.grbl import GrblSetting
from tissue_sim.errors import InputError

#: Version and date reported by ``$I``.
_VERSION = "1.1h.20190825"
#: Line sent after a reset.
_BANNER = "Grbl 1.1h ['$' for help]"
#: Line sent after a reset in an alarm.
_LOCKED = "[MSG:'$H'|'$X' to unlock]"
#: Every tenth report includes the offset of the work coordinates.
_OFFSET_INTERVAL = 10


class GrblEmulator(SerialDeviceEmulator):
    """Emulate a Grbl whose axis is a stage.

    Args:
        bench: Devices of the rig; the stage is the axis.
        faults: Faults of the connection.
        axis: X, Y or Z.
        settings: Values of ``$$`` by number that differ from the defaults.
        work_offset: Offset of the work coordinates, mm; if it is not 0, reports are in work coordinates.
        version: Version and date reported by ``$I``.

    Attributes:
        most_queued: Longest motion that was ever queued, s.
        answered: Number of lines sent.
    """

    name = "grbl"

    def __init__(self, bench: Bench, faults: Faults, axis: str = "Z", settings: dict[int, float] | None = None,
                 work_offset: float = 0.0, version: str = _VERSION):
        super().__init__(faults)
        self._stage, self._axis, self._work_offset, self._version = bench.stage, axis, work_offset, version
        limits = bench.stage.limits
        self._settings: dict[int, float] = {0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 0 if work_offset else 1,
                                            11: 0.01, 12: 0.002, 13: 0, 20: 1, 21: 1, 22: 1, 23: 0, 24: 25.0, 25: 500.0,
                                            26: 250, 27: 1.0, 30: 1000, 31: 0, 32: 0}
        for number in range(3):
            self._settings |= {GrblSetting.STEPS_PER_MM + number: 800.0,
                               GrblSetting.MAX_RATE + number: limits.speed * 60e3,
                               GrblSetting.ACCELERATION + number: 500.0,
                               GrblSetting.TRAVEL + number: limits.highest * 1e3 + 1.0}
        self._settings |= settings or {}
        #: Alarm requested by `request_alarm`; None: none.
        self._pending_alarm: int | None = None
        self.most_queued = 0.0
        self._set_power_on_state()

    def _set_power_on_state(self) -> None:
        """Set all variables of the emulated controller to their values after power-on."""
        #: Received characters of an incomplete line.
        self._text = bytearray()
        #: Complete lines that wait for the end of homing or of a critical alarm.
        self._waiting: list[str] = []
        self._alarm, self._critical = bool(self._settings[GrblSetting.HOMING]), False
        self._homing = self._held = False
        #: Queued motions: target of the stage, m, and speed, m/s. The first one is in progress if `_begun` is True.
        self._motions: list[tuple[float, float]] = []
        self._begun = False
        self._reports = self.answered = 0

    @property
    def address(self) -> str:
        """Name for `make_stage` that connects to this emulator: terminal, axis, travel and top speed."""
        limits = self._stage.limits
        return (f"grbl:{self.path},axis={self._axis},highest_mm={limits.highest * 1e3:g},"
                f"top_speed_mm_s={limits.speed * 1e3:g}")

    def request_alarm(self, number: int) -> None:
        """Request an alarm, such as 1 for a limit switch, which the thread then raises; callable from any thread."""
        self._pending_alarm = number

    def power_on_with_backing_device(self) -> None:
        """Set the state of the emulated controller after power-on, start the stage, and begin to home it."""
        self._set_power_on_state()
        self._stage.start()
        self._stage.home()

    def stop_backing_device(self) -> None:
        """Stop the stage that serves as the axis."""
        self._stage.stop()

    def describe(self) -> dict[str, Any]:
        """Return terminal, axis, number of answers and longest queue of jogs, s."""
        return {"emulator": "grbl", "port": self.path, "axis": self._axis, "answered": self.answered,
                "most_queued_s": self.most_queued}

    @property
    def queued_duration(self) -> float:
        """Duration of all queued jogs, including the remaining part of the present one, s."""
        position, seconds = self._stage.position().position, 0.0
        for target, speed in list(self._motions):
            seconds += abs(target - position) / speed
            position = target
        return seconds

    def execute_bytes_and_get_answers(self, data: bytes) -> list[bytes]:
        """Execute received bytes, real-time characters at once and lines in order; return the lines to answer."""
        lines: list[str] = []
        for byte in data:
            character = bytes([byte])
            if character in (grbl.STATUS, grbl.HOLD, grbl.RESUME, grbl.RESET, grbl.JOG_CANCEL) or byte >= 0x80:
                lines += self._execute_real_time_character(character)
            elif character in b"\r\n":
                line, self._text = self._text.decode("ascii", "replace"), bytearray()
                self._waiting.append("".join(line.split()).upper())
                lines += self._execute_deferred_lines_and_get_answers()
            else:
                self._text += character
        return self._count_and_encode_lines(lines)

    def advance_and_get_messages_to_send(self) -> list[bytes]:
        """Update the motion, and return the lines of a requested alarm and the answer to a homing that has ended."""
        lines: list[str] = []
        number, self._pending_alarm = self._pending_alarm, None
        if number is not None:
            self._stop_motion()
            self._alarm, self._critical = True, number in (1, 2)
            lines += [f"ALARM:{number}", *(["[MSG:Reset to continue]"] if self._critical else [])]
        if self._homing and not self._stage.position().moving:
            self._homing = self._alarm = False
            lines += ["ok", *self._execute_deferred_lines_and_get_answers()]
        self._start_next_queued_jog_if_due()
        return self._count_and_encode_lines(lines)

    def _count_and_encode_lines(self, lines: list[str]) -> list[bytes]:
        """Return the bytes of each line with its ending, and add their number to `answered`."""
        self.answered += len(lines)
        return [line.encode() + b"\r\n" for line in lines]

    def _stop_motion(self) -> None:
        """Halt the stage, clear the queue and end homing."""
        self._stage.halt()
        self._motions, self._begun, self._homing = [], False, False

    def _start_next_queued_jog_if_due(self) -> None:
        """Start the first queued jog, or remove it and start the next one if it has ended."""
        sample = self._stage.position()
        if self._begun and self._motions and not sample.moving:
            self._motions, self._begun = self._motions[1:], False
        if self._motions and not self._begun and sample.homed:
            self._stage.move(*self._motions[0])
            self._begun = True

    def _execute_real_time_character(self, character: bytes) -> list[str]:
        """Execute a real-time character and return the answer."""
        """Real-time characters."""
        if character == grbl.STATUS:
            return [] if self._homing else [self._make_status_report()]
        if character == grbl.JOG_CANCEL or (character == grbl.HOLD and self._motions):
            if self._motions:
                self._stop_motion()
        elif character == grbl.HOLD:
            self._held = not self._alarm and not self._homing
        elif character == grbl.RESUME:
            self._held = False
        elif character == grbl.RESET:
            alarm = 6 if self._homing else 3 if self._motions else None
            self._stop_motion()
            self._held, self._critical, self._text, self._waiting = False, False, bytearray(), []
            self._alarm = self._alarm or alarm is not None
            return [*([f"ALARM:{alarm}"] if alarm else []), _BANNER, *([_LOCKED] if self._alarm else [])]
        return []

    def _execute_deferred_lines_and_get_answers(self) -> list[str]:
        """Execute the waiting lines and return the answers; none during homing and after a critical alarm."""
        answers: list[str] = []
        while self._waiting and not self._homing and not self._critical:
            answers += self._execute_line(self._waiting.pop(0))
        return answers

    def _execute_line(self, line: str) -> list[str]:
        """Execute one line, in capitals and without spaces, and return its answer lines; none yet for homing."""
        if line.startswith("$J="):
            return [self._queue_jog(line)]
        if line == "$H":
            if not self._settings[GrblSetting.HOMING]:
                return ["error:5"]
            if self._motions or self._held:
                return ["error:8"]
            self._homing = True
            self._stage.home()
            return []
        if line in ("$I", "$$", "$X") and (self._held or (self._motions and line != "$$")):
            return ["error:8"]
        if line == "$I":
            return [f"[VER:{self._version}:]", "[OPT:V,15,128]", "ok"]
        if line == "$$":
            return [*(f"${number}={value:.3f}" if value % 1 or number >= 100 else f"${number}={value:.0f}"
                      for number, value in sorted(self._settings.items())), "ok"]
        if line == "$X":
            unlocked, self._alarm = self._alarm, False
            return [*(["[MSG:Caution: Unlocked]"] if unlocked else []), "ok"]
        if line == "$G":
            return ["[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", "ok"]
        if line == "$#":
            offset = ",".join(f"{self._work_offset if axis == self._axis else 0.0:.3f}" for axis in grbl.AXES)
            coordinates = (f"[{name}:{offset if name == 'G54' else '0.000,0.000,0.000'}]"
                           for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92"))
            return [*coordinates, "[TLO:0.000]", "[PRB:0.000,0.000,0.000:0]", "ok"]
        if line == "":
            return ["ok"]
        if line.startswith("$"):
            return ["error:3"]
        return ["error:9" if self._alarm or self._motions else "error:20"]

    def _queue_jog(self, line: str) -> str:
        """Queue the jog of a line, join it to the previous one if possible, and return ``ok`` or ``error:NUMBER``."""
        if self._alarm or self._held:
            return "error:8"
        jog = grbl.parse_jog_or_none(line)
        if jog is None:
            return "error:16"
        position = self._stage.position().position
        start = self._motions[-1][0] if self._motions else position
        target = jog.targets.get(self._axis)
        if target is None:
            return "ok"  # a jog of an axis without a stage
        if jog.relative:
            target += self._to_machine_coordinate(start)
        elif not jog.machine:
            target += self._work_offset
        number = grbl.AXES.index(self._axis)
        travel = self._settings[GrblSetting.TRAVEL + number]
        if self._settings[GrblSetting.SOFT_LIMITS] and not -travel - 1e-6 <= target <= 1e-6:
            return "error:15"
        limits = self._stage.limits
        goal = min(max(self._to_stage_position(target), limits.lowest), limits.highest)
        feed = min(max(jog.feed, grbl.LEAST_FEED), self._settings[GrblSetting.MAX_RATE + number])
        speed = min(feed / 60e3, limits.speed)
        if goal == start:
            return "ok"
        before = (self._motions[-2][0] if len(self._motions) > 1 else position) if self._motions else start
        if self._motions and self._motions[-1][1] == speed and (goal - start) * (start - before) > 0:
            # Grbl does not stop between motions of equal direction and speed.
            self._motions[-1] = goal, speed
            self._begun = self._begun and len(self._motions) > 1
        else:
            self._motions.append((goal, speed))
        self._start_next_queued_jog_if_due()
        self.most_queued = max(self.most_queued, self.queued_duration)
        return "ok"

    def _get_zero_and_direction(self) -> tuple[float, float]:
        """Return the machine coordinate of the stage's zero, mm, and the direction of its positive end, 1 or -1."""
        number = grbl.AXES.index(self._axis)
        pull_off, travel = self._settings[GrblSetting.PULL_OFF], self._settings[GrblSetting.TRAVEL + number]
        if int(self._settings[GrblSetting.HOMING_DIRECTION]) >> number & 1:
            return pull_off - travel, 1.0
        return -pull_off, -1.0

    def _to_machine_coordinate(self, position: float) -> float:
        """Convert a position of the stage, m, to a machine coordinate, mm."""
        zero, sign = self._get_zero_and_direction()
        return zero + sign * position * 1e3

    def _to_stage_position(self, coordinate: float) -> float:
        """Convert a machine coordinate, mm, to a position of the stage, m."""
        zero, sign = self._get_zero_and_direction()
        return sign * (coordinate - zero) * 1e-3

    def _make_status_report(self) -> str:
        """Return the text of a status report of the present state; every tenth report includes the offset."""
        sample = self._stage.position()
        number = grbl.AXES.index(self._axis)
        machine = [0.0, 0.0, 0.0]
        machine[number] = self._to_machine_coordinate(sample.position)
        offset = [0.0, 0.0, 0.0]
        offset[number] = self._work_offset
        state = "Alarm" if self._alarm else "Hold" if self._held else "Jog" if self._motions else "Idle"
        has_offset = self._reports % _OFFSET_INTERVAL == 0
        self._reports += 1
        work = tuple(coordinate - shift for coordinate, shift in zip(machine, offset, strict=True))
        in_machine_coordinates = bool(int(self._settings[10]) & 1)
        return grbl.format_report(grbl.StatusReport(
            state, 0 if state == "Hold" else None, tuple(machine) if in_machine_coordinates else None,
            None if in_machine_coordinates else work, tuple(offset) if has_offset else None,
            self._axis if self._critical else "", self._motions[0][1] * 60e3 if self._motions else 0.0))


def make_grbl_emulator(bench: Bench, text: str, faults: Faults) -> GrblEmulator:
    """Make an emulator from settings: ``work_offset_mm=0`` and values of ``$$`` by number, as ``110=300,23=4``."""
    own, numbers = [], {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        setting = grbl.parse_setting_or_none(f"${name.strip()}={value.strip()}")
        if setting is None:
            own.append(part)
        elif setting[1] < 0:
            raise InputError(f"a setting of Grbl must be 0 or more; got {value}. Grbl answers error:4 to negative "
                             "values", field=name)

        else:
            numbers[setting[0]] = setting[1]
    given = parse_number_settings(",".join(own), work_offset_mm=0.0)
    return GrblEmulator(bench, faults, settings=numbers, work_offset=given["work_offset_mm"])
