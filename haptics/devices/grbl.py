"""A stage that Grbl 1.1 drives: one axis of a small machine. Tried against an emulator only.

A jog that Grbl has taken outlives the program that sent it. So a thread sends short jogs, and never more than
`_QUEUED` of motion beyond the place that Grbl has last reported.

Source: Grbl 1.1 documentation, doc/markdown of github.com/gnea/grbl: interface.md, jogging.md,
realtime_cmds.md, settings.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.grbl_talk import GrblTalk, Seen
from haptics.devices.settings import read_settings
from haptics.protocols import grbl
from tissue_sim.errors import InputError

#: Most motion that Grbl has taken and not made, s; length of a jog, s.
_QUEUED, _JOG = 0.1, 0.025
#: Without a question for the position for so long, no more jogs are sent, s.
_SILENCE = 1.0
#: Longest wait for a status report, s; Grbl promises 5 to 20 ms.
_ANSWER = 1.0
#: Way that the axis needs to stop from its top speed, as a share of `_QUEUED`: Grbl plans every queue to end at rest,
#: and so much is always there.
_STOPPED_WITHIN = 0.4
#: States in which nothing moves by itself, and what to do about those in which nothing can.
_HELD = {"Hold": "is on hold; send ~ or reset it", "Door": "has its safety door open; close it and reset it",
         "Check": "is in check mode and moves nothing; send $C", "Sleep": "sleeps; reset it and home it"}


class GrblStage(Stage):
    """One axis of a machine with Grbl 1.1; `position` is where the motor was driven to, and a stalled one is not seen.

    The zero is where the homing of Grbl ends, a pull-off away from its switch, and positive is away from the switch.
    Its homing runs to its end also without this program.

    Args:
        port: serial port. limits: m, m/s; from 0, since the switch is there.
        axis: X, Y or Z. baud: of the port.

    Raises:
        InputError: a number that makes no sense.
    """

    measures_position = False
    #: Of a program that has died; the way is at most the speed times this. See `_SILENCE` for one that hangs.
    runs_on = _QUEUED

    def __init__(self, port: str, limits: StageLimits, axis: str = "Z", baud: int = grbl.BAUD):
        if not port:
            raise InputError("no port is named; give grbl:/dev/ttyUSB0,axis=Z", field="port")
        if limits.lowest != 0.0 or not 0.0 < limits.highest < math.inf:
            raise InputError(f"from {limits.lowest:g} to {limits.highest:g} m; give a range that begins at 0: the "
                             "switch is below it", field="lowest_mm, highest_mm")
        if not grbl.LEAST_FEED / 60e3 <= limits.speed < math.inf:
            raise InputError(f"{limits.speed * 1e3:g} mm/s; give {grbl.LEAST_FEED / 60:.4f} mm/s or more",
                             field="top_speed_mm_s")
        if len(axis) != 1 or axis not in grbl.AXES:
            raise InputError(f"{axis!r} is no axis; give X, Y or Z", field="axis")
        if baud <= 0:
            raise InputError(f"{baud} baud; give a number above zero", field="baud")
        self.limits, self._port, self._axis, self._baud = limits, port, axis, baud
        self._name = f"the Grbl at {port}"
        self._talk: GrblTalk | None = None
        self._forget()

    def _forget(self) -> None:
        self._sequence = 0
        #: Machine coordinate of the zero, mm; None: not homed. 1: positive as the machine, -1: against it.
        self._zero: float | None = None
        self._sign = -1.0
        #: Where to, mm in machine coordinates, and how fast, mm/s; None: nowhere.
        self._goal: tuple[float, float] | None = None
        #: Up to where jogs were sent, mm; None: it must come to rest first.
        self._sent: float | None = None
        #: Until when homing must be over, s; None: it does not home. Whether Grbl was told.
        self._homing_until: float | None = None
        self._homing_sent = False
        self._trouble = ""
        self._steps_per_mm = math.nan
        self._asked_for = -math.inf
        self._halts = 0

    def __getstate__(self) -> dict[str, Any]:
        if self._talk is not None:
            raise TypeError("a started stage cannot be sent to another process; stop it first")
        return self.__dict__

    def start(self) -> None:
        if self._talk is not None:
            return
        self._forget()
        talk = GrblTalk(self._port, self._baud, grbl.AXES.index(self._axis))
        try:
            self._check(talk.meet())
            talk.run(self._feed)
        except BaseException:
            talk.close()
            raise
        self._talk = talk

    def _check(self, settings: dict[int, float]) -> None:
        """Hold the limits against the settings of the machine."""
        number = grbl.AXES.index(self._axis)

        def of(setting: int) -> float:
            if setting not in settings:
                raise DeviceError(f"{self._name} does not tell its setting ${setting}; install Grbl 1.1")
            return settings[setting]

        top, change = of(grbl.MAX_RATE + number) / 60.0, of(grbl.ACCELERATION + number)
        room = of(grbl.TRAVEL + number) - of(grbl.PULL_OFF)
        self._steps_per_mm = of(grbl.STEPS_PER_MM + number)
        speed, highest = self.limits.speed * 1e3, self.limits.highest * 1e3
        if of(grbl.REPORT_INCHES):
            raise DeviceError(f"{self._name} reports inches; set $13=0")
        if not of(grbl.HOMING):
            raise DeviceError(f"{self._name} cannot home, and its zero would be anywhere; fit limit switches "
                              "and set $22=1")
        if highest > room:
            raise DeviceError(f"the axis {self._axis} of {self._name} reaches {room:g} mm, not {highest:g}; "
                              f"lower highest_mm, or correct ${grbl.TRAVEL + number}")
        if speed > top:
            raise DeviceError(f"the axis {self._axis} of {self._name} makes {top:g} mm/s, not {speed:g}; lower "
                              f"top_speed_mm_s, or raise ${grbl.MAX_RATE + number}")
        most = 2.0 * change * _STOPPED_WITHIN * _QUEUED
        if speed > most:
            raise DeviceError(f"with {_QUEUED * 1e3:g} ms of motion queued and {change:g} mm/s^2 the axis {self._axis} "
                              f"of {self._name} reaches {most:g} mm/s, not {speed:g}; lower top_speed_mm_s, or raise "
                              f"${grbl.ACCELERATION + number}")
        positive_end = not int(of(grbl.HOMING_DIRECTION)) >> number & 1
        self._sign = -1.0 if positive_end else 1.0
        way = 1.5 * of(grbl.TRAVEL + number)
        #: Longest time that homing may take, s.
        self._longest_homing = 20.0 + 120.0 * (way / max(of(grbl.HOMING_SEEK), 1.0)
                                               + 10.0 * of(grbl.PULL_OFF) / max(of(grbl.HOMING_FEED), 1.0))

    def home(self) -> None:
        talk = self._require_start()
        with talk.lock:
            self._raise_trouble(talk)
            if self._homing_until is not None:
                return
            seen = self._fresh(talk)
            if seen.state in _HELD:
                raise DeviceError(f"{self._name} {_HELD[seen.state]}")
            if seen.critical:
                # Grbl takes nothing but a reset now, and nothing moves.
                talk.reset()
            self._goal = self._sent = self._zero = None
            self._homing_until = time.monotonic() + self._longest_homing
            self._homing_sent, talk.alarm, talk.refused = False, None, None
            talk.wake()

    def move(self, position: float, speed: float) -> None:
        halts, talk = self._halts, self._require_start()
        self.limits.require(position, speed, slowest=grbl.LEAST_FEED / 60e3)
        with talk.lock:
            self._raise_trouble(talk)
            seen = talk.seen if self._homing_until is not None else self._fresh(talk)
            self._refuse(seen, talk)
            zero = self._zero
            if zero is None:
                raise DeviceError(f"{self._name} does not know its zero; home it first, and wait until it is "
                                  "there")
            if halts == self._halts:
                self._asked_for = time.monotonic()
                self._goal = zero + self._sign * position * 1e3, speed * 1e3
                talk.wake()

    def position(self) -> StageSample:
        talk = self._require_start()
        with talk.lock:
            self._asked_for = time.monotonic()
            self._raise_trouble(talk)
            seen = talk.seen if self._homing_until is not None else self._fresh(talk)
            homing = self._homing_until is not None
            moving = homing or self._goal is not None or talk.unanswered > 0 or seen.state in ("Jog", "Run", "Home")
            bits = SampleStatus.GOOD
            if seen.state in ("Alarm", *_HELD) and (talk.alarm is not None or seen.state != "Alarm"):
                bits |= SampleStatus.FAULT
            if self._axis in seen.pins:
                bits |= SampleStatus.LIMIT
            zero = 0.0 if self._zero is None else self._zero
            place = self._sign * (seen.place - zero)
            self._sequence += 1
            return StageSample(round(place * self._steps_per_mm), place * 1e-3, moving, self._zero is not None,
                               self._sequence - 1, int(bits), seen.received, seen.asked or None)

    def halt(self) -> None:
        self._halts += 1
        self._goal = None
        talk = self._talk
        if talk is None:
            return
        homing = self._homing_until is not None and self._homing_sent
        mine = talk.lock.acquire(timeout=0.1)
        try:
            self._goal = self._sent = None
            # Homing heeds nothing but a reset; it loses the zero, which is not known yet.
            talk.send(grbl.RESET if homing else grbl.JOG_CANCEL)
            self._homing_until = None
            if homing:
                talk.unanswered = 0
            # A jog that is still on the line comes after this: the thread cancels until nothing moves.
            talk.wake()
        except Exception:
            # Who halts can do nothing about it: the queue ends within `runs_on`, and `position` says what is wrong.
            return
        finally:
            if mine:
                talk.lock.release()

    def stop(self) -> None:
        talk = self._talk
        if talk is None:
            return
        self.halt()
        self._talk = None
        talk.close()

    def describe(self) -> dict[str, Any]:
        told = {} if math.isnan(self._steps_per_mm) else {"steps_per_mm": self._steps_per_mm,
                                                          "resolution_mm": max(1.0 / self._steps_per_mm, 1e-3)}
        return {"stage": "Grbl 1.1", "port": self._port, "axis": self._axis, **told,
                "lowest_mm": self.limits.lowest * 1e3, "highest_mm": self.limits.highest * 1e3,
                "top_speed_mm_s": self.limits.speed * 1e3, "position": "commanded", "stalled_motor": "not detectable",
                "runs_on_s": self.runs_on, "homing_runs_on": "to its end",
                "checked_with": "emulator; unverified on hardware"}

    def _feed(self, talk: GrblTalk) -> bool:
        """Do what is to be done now; by the thread, which holds the lock, every few ms. Whether there is a motion."""
        if talk.lost:
            self._goal = None
        elif self._homing_until is not None:
            self._watch_homing(talk)
        elif talk.seen.state == "Alarm" or talk.was_reset:
            if talk.was_reset and self._zero is not None and talk.alarm is None:
                self._trouble = f"{self._name} has restarted and lost its zero; check its supply, and home it again"
            self._goal = self._sent = self._zero = None
            talk.was_reset = False
        else:
            self._jog(talk)
        return self._goal is not None or self._homing_until is not None

    def _jog(self, talk: GrblTalk) -> None:
        """Send the next jogs, or cancel those that nobody wants."""
        seen = talk.seen
        if talk.refused is not None:
            self._trouble = (f"{self._name} has refused a motion with error {talk.refused}: "
                             f"{grbl.error_text(talk.refused)}")
            self._goal, talk.refused = None, None
        if seen.number == talk.fed:
            return  # one step for each report
        talk.fed = seen.number
        wanted = self._goal
        if wanted is None:
            self._sent = None
            if seen.state == "Jog":
                talk.send(grbl.JOG_CANCEL)
            return
        if time.monotonic() - self._asked_for > _SILENCE:
            return
        goal, speed = wanted
        if self._sent is None:
            if not talk.is_settled:
                return
            if seen.state != "Idle":
                talk.send(grbl.JOG_CANCEL)
                return
            self._sent = seen.place
        elif self._sent == goal:
            if seen.state == "Idle" and talk.is_settled:
                self._goal = self._sent = None
            return
        if (goal - self._sent) * (self._sent - seen.place) < 0:
            # It turns: the old way is given up, the new one begins at rest.
            talk.send(grbl.JOG_CANCEL)
            self._sent = None
            return
        for target in self._jogs(seen.place, self._sent, goal, speed):
            talk.ask(grbl.jog_line(self._axis, target, speed * 60.0))
            self._sent = target

    @staticmethod
    def _jogs(place: float, sent: float, goal: float, speed: float) -> Iterator[float]:
        """Where the next jogs go, mm: as many as fit between the place that was reported and `_QUEUED` beyond it."""
        while sent != goal:
            step = min(speed * _JOG, abs(goal - sent))
            if abs(sent - place) + step > speed * _QUEUED * (1.0 + 1e-9):
                return
            sent = goal if step == abs(goal - sent) else sent + math.copysign(step, goal - sent)
            yield sent

    def _watch_homing(self, talk: GrblTalk) -> None:
        seen = talk.seen
        if talk.refused is not None or talk.alarm is not None:
            why = (grbl.error_text(talk.refused) if talk.refused is not None else grbl.alarm_text(talk.alarm))
            self._trouble = f"{self._name} did not home: {why}"
            talk.refused, self._homing_until = None, None
        elif self._homing_until is not None and time.monotonic() > self._homing_until:
            self._trouble = (f"the homing of {self._name} does not end; check the limit switch of {self._axis}, "
                             "power and cable")
            self._homing_until = None
            talk.send(grbl.RESET)
        elif not self._homing_sent:
            if talk.is_settled and seen.state in ("Idle", "Alarm"):
                self._homing_sent, talk.was_reset = True, False
                talk.ask(b"$H\n")
            elif seen.state == "Jog" and seen.number != talk.fed:
                talk.fed = seen.number
                talk.send(grbl.JOG_CANCEL)
        elif talk.is_settled and seen.state == "Idle":
            self._zero, self._homing_until, talk.was_reset = seen.place, None, False

    def _fresh(self, talk: GrblTalk) -> Seen:
        """A report that was asked for just now; holds the lock, but while it waits."""
        seen = talk.fresh(_ANSWER)
        if seen is None:
            self._raise_trouble(talk)
            raise DeviceError(f"{self._name} reports nothing for {_ANSWER:g} s; check that it has power, the "
                              "cable and the baud rate")
        return seen

    def _refuse(self, seen: Seen, talk: GrblTalk) -> None:
        if seen.state == "Alarm" and talk.alarm is not None:
            raise DeviceError(f"{self._name} is in alarm {talk.alarm}: {grbl.alarm_text(talk.alarm)}")
        if seen.state in _HELD:
            raise DeviceError(f"{self._name} {_HELD[seen.state]}")

    def _raise_trouble(self, talk: GrblTalk) -> None:
        if talk.lost:
            raise DeviceError(talk.lost)
        trouble, self._trouble = self._trouble, ""
        if trouble:
            raise DeviceError(trouble)

    def _require_start(self) -> GrblTalk:
        talk = self._talk
        if talk is None:
            raise DeviceError("the Grbl stage is not started; start it first")
        return talk


def open_grbl(text: str) -> GrblStage:
    """``grbl:/dev/ttyUSB0,axis=Z,highest_mm=50,top_speed_mm_s=0.5,baud=115200``."""
    port, _, settings = text.partition(",")
    parts = [part.strip() for part in settings.split(",")]
    axis = next((part.partition("=")[2].strip() for part in parts if part.partition("=")[0].strip() == "axis"), "Z")
    rest = ",".join(part for part in parts if part.partition("=")[0].strip() != "axis")
    given = read_settings(rest, lowest_mm=0.0, highest_mm=50.0, top_speed_mm_s=0.5, baud=grbl.BAUD)
    limits = StageLimits.of(given)
    return GrblStage(port.strip(), limits, axis.upper(), int(given["baud"]))
