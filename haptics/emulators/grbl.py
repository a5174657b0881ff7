"""A Grbl 1.1 on a pseudo-terminal, with a stage behind one of its axes: even speed instead of ramps.

It knows jogs, homing, settings, reports and alarms, and no G-code. Source: Grbl 1.1 documentation, doc/markdown of
github.com/gnea/grbl. Motion is that of the stage behind it, which is brought to its zero when the power comes.
"""

from __future__ import annotations

from typing import Any

from haptics.devices.contracts import Bench
from haptics.devices.settings import read_settings
from haptics.devices.virtual.faults import Faults
from haptics.emulators.terminal import TerminalEmulator
from haptics.protocols import grbl
from tissue_sim.errors import InputError

_VERSION = "1.1h.20190825"
_BANNER = "Grbl 1.1h ['$' for help]"
_LOCKED = "[MSG:'$H'|'$X' to unlock]"
#: Reports between two that tell the offset of the work coordinates.
_OFFSET_EACH = 10


class GrblEmulator(TerminalEmulator):
    """Plays Grbl.

    Args:
        bench: its stage is the axis. faults: on the line.
        axis: X, Y or Z.
        settings: numbers of ``$$`` that differ from the usual ones.
        work_offset: of the work coordinates, mm; not 0: it reports those instead of machine coordinates.
        version: that it tells.

    Attributes:
        most_queued: longest motion that was ever taken and not yet made, s.
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
            self._settings |= {grbl.STEPS_PER_MM + number: 800.0, grbl.MAX_RATE + number: limits.speed * 60e3,
                               grbl.ACCELERATION + number: 500.0, grbl.TRAVEL + number: limits.highest * 1e3 + 1.0}
        self._settings |= settings or {}
        self._imposed: int | None = None
        self.most_queued = 0.0
        self._power_up()

    def _power_up(self) -> None:
        self._text = bytearray()
        #: Lines that wait for their turn.
        self._waiting: list[str] = []
        self._alarm, self._critical = bool(self._settings[grbl.HOMING]), False
        self._homing = self._held = False
        #: Motions that were taken: to where, m of the stage; how fast, m/s. The first one goes on.
        self._legs: list[tuple[float, float]] = []
        self._begun = False
        self._reports = self.answered = 0

    @property
    def address(self) -> str:
        limits = self._stage.limits
        return (f"grbl:{self.path},axis={self._axis},highest_mm={limits.highest * 1e3:g},"
                f"top_speed_mm_s={limits.speed * 1e3:g}")

    def alarm(self, number: int) -> None:
        """Let an alarm happen, such as 1: a limit switch was hit; from any thread."""
        self._imposed = number

    def begin(self) -> None:
        self._power_up()
        self._stage.start()
        self._stage.home()

    def end(self) -> None:
        self._stage.stop()

    def describe(self) -> dict[str, Any]:
        return {"emulator": "grbl", "port": self.path, "axis": self._axis, "answered": self.answered,
                "most_queued_s": self.most_queued}

    @property
    def queued(self) -> float:
        """Motion that was taken and not yet made, s."""
        place, seconds = self._stage.position().position, 0.0
        for target, speed in list(self._legs):
            seconds += abs(target - place) / speed
            place = target
        return seconds

    def received(self, data: bytes) -> list[bytes]:
        said: list[str] = []
        for byte in data:
            character = bytes([byte])
            if character in (grbl.STATUS, grbl.HOLD, grbl.RESUME, grbl.RESET, grbl.JOG_CANCEL) or byte >= 0x80:
                said += self._at_once(character)
            elif character in b"\r\n":
                line, self._text = self._text.decode("ascii", "replace"), bytearray()
                self._waiting.append("".join(line.split()).upper())
                said += self._lines()
            else:
                self._text += character
        return self._messages(said)

    def due(self) -> list[bytes]:
        said: list[str] = []
        number, self._imposed = self._imposed, None
        if number is not None:
            self._stand()
            self._alarm, self._critical = True, number in (1, 2)
            said += [f"ALARM:{number}", *(["[MSG:Reset to continue]"] if self._critical else [])]
        if self._homing and not self._stage.position().moving:
            self._homing = self._alarm = False
            said += ["ok", *self._lines()]
        self._advance()
        return self._messages(said)

    def _messages(self, said: list[str]) -> list[bytes]:
        self.answered += len(said)
        return [line.encode() + b"\r\n" for line in said]

    def _stand(self) -> None:
        self._stage.halt()
        self._legs, self._begun, self._homing = [], False, False

    def _advance(self) -> None:
        """Begin the first motion, or go on to the next."""
        sample = self._stage.position()
        if self._begun and self._legs and not sample.moving:
            self._legs, self._begun = self._legs[1:], False
        if self._legs and not self._begun and sample.homed:
            self._stage.move(*self._legs[0])
            self._begun = True

    def _at_once(self, character: bytes) -> list[str]:
        """Real-time characters."""
        if character == grbl.STATUS:
            return [] if self._homing else [self._report()]
        if character == grbl.JOG_CANCEL or (character == grbl.HOLD and self._legs):
            if self._legs:
                self._stand()
        elif character == grbl.HOLD:
            self._held = not self._alarm and not self._homing
        elif character == grbl.RESUME:
            self._held = False
        elif character == grbl.RESET:
            moved = 6 if self._homing else 3 if self._legs else None
            self._stand()
            self._held, self._critical, self._text, self._waiting = False, False, bytearray(), []
            self._alarm = self._alarm or moved is not None
            return [*([f"ALARM:{moved}"] if moved else []), _BANNER, *([_LOCKED] if self._alarm else [])]
        return []

    def _lines(self) -> list[str]:
        """Answers to the lines that wait; while it homes they wait on."""
        said: list[str] = []
        while self._waiting and not self._homing and not self._critical:
            said += self._obey(self._waiting.pop(0))
        return said

    def _obey(self, line: str) -> list[str]:
        if line.startswith("$J="):
            return [self._jog(line)]
        if line == "$H":
            if not self._settings[grbl.HOMING]:
                return ["error:5"]
            if self._legs or self._held:
                return ["error:8"]
            self._homing = True
            self._stage.home()
            return []
        if line in ("$I", "$$", "$X") and (self._held or (self._legs and line != "$$")):
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
            places = (f"[{name}:{offset if name == 'G54' else '0.000,0.000,0.000'}]"
                      for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92"))
            return [*places, "[TLO:0.000]", "[PRB:0.000,0.000,0.000:0]", "ok"]
        if line == "":
            return ["ok"]
        if line.startswith("$"):
            return ["error:3"]
        return ["error:9" if self._alarm or self._legs else "error:20"]

    def _jog(self, line: str) -> str:
        if self._alarm or self._held:
            return "error:8"
        jog = grbl.parse_jog(line)
        if jog is None:
            return "error:16"
        place = self._stage.position().position
        start = self._legs[-1][0] if self._legs else place
        target = jog.targets.get(self._axis)
        if target is None:
            return "ok"  # of an axis with nothing behind it
        if jog.relative:
            target += self._machine(start)
        elif not jog.machine:
            target += self._work_offset
        number = grbl.AXES.index(self._axis)
        if self._settings[grbl.SOFT_LIMITS] and not -self._settings[grbl.TRAVEL + number] - 1e-6 <= target <= 1e-6:
            return "error:15"
        limits = self._stage.limits
        goal = min(max(self._of_stage(target), limits.lowest), limits.highest)
        feed = min(max(jog.feed, grbl.LEAST_FEED), self._settings[grbl.MAX_RATE + number])
        speed = min(feed / 60e3, limits.speed)
        if goal == start:
            return "ok"
        before = (self._legs[-2][0] if len(self._legs) > 1 else place) if self._legs else start
        if self._legs and self._legs[-1][1] == speed and (goal - start) * (start - before) > 0:
            # In the same direction at the same speed: Grbl does not stop between them.
            self._legs[-1] = goal, speed
            self._begun = self._begun and len(self._legs) > 1
        else:
            self._legs.append((goal, speed))
        self._advance()
        self.most_queued = max(self.most_queued, self.queued)
        return "ok"

    def _home_machine(self) -> tuple[float, float]:
        """Machine coordinate of the zero of the stage, mm, and the sign of the way from there."""
        number = grbl.AXES.index(self._axis)
        pull_off, travel = self._settings[grbl.PULL_OFF], self._settings[grbl.TRAVEL + number]
        if int(self._settings[grbl.HOMING_DIRECTION]) >> number & 1:
            return pull_off - travel, 1.0
        return -pull_off, -1.0

    def _machine(self, place: float) -> float:
        zero, sign = self._home_machine()
        return zero + sign * place * 1e3

    def _of_stage(self, machine: float) -> float:
        zero, sign = self._home_machine()
        return sign * (machine - zero) * 1e-3

    def _report(self) -> str:
        sample = self._stage.position()
        number = grbl.AXES.index(self._axis)
        machine = [0.0, 0.0, 0.0]
        machine[number] = self._machine(sample.position)
        offset = [0.0, 0.0, 0.0]
        offset[number] = self._work_offset
        state = "Alarm" if self._alarm else "Hold" if self._held else "Jog" if self._legs else "Idle"
        tell = self._reports % _OFFSET_EACH == 0
        self._reports += 1
        work = tuple(place - less for place, less in zip(machine, offset, strict=True))
        by_machine = bool(int(self._settings[10]) & 1)
        return grbl.format_report(grbl.Report(
            state, 0 if state == "Hold" else None, tuple(machine) if by_machine else None, None if by_machine else work,
            tuple(offset) if tell else None, self._axis if self._critical else "",
            self._legs[0][1] * 60e3 if self._legs else 0.0))


def emulate_grbl(bench: Bench, text: str, faults: Faults) -> GrblEmulator:
    """``grbl:work_offset_mm=0``, and settings by their number: ``grbl:110=300,23=4``."""
    own, numbers = [], {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        setting = grbl.parse_setting(f"${name.strip()}={value.strip()}")
        if setting is None:
            own.append(part)
        elif setting[1] < 0:
            raise InputError(f"{value} is below zero; Grbl answers error:4 to that", field=name)
        else:
            numbers[setting[0]] = setting[1]
    given = read_settings(",".join(own), work_offset_mm=0.0)
    return GrblEmulator(bench, faults, settings=numbers, work_offset=given["work_offset_mm"])
