"""A stage driven by Grbl 1.1: one axis of a small machine. Checked against an emulator only.

Grbl finishes the jogs in its queue even if the sending program dies. Therefore a thread sends short jogs, and never
more than `JogSettings.queue` of motion beyond the last reported position.

Source: Grbl 1.1 documentation, doc/markdown of github.com/gnea/grbl: interface.md, jogging.md,
realtime_cmds.md, settings.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.grbl_connection import AxisReportInMillimetres, GrblConnection
from haptics.devices.settings import parse_number_settings
from haptics.protocols import grbl
from haptics.protocols.grbl import GrblSetting
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class JogSettings:
    """Division of motions into jogs by a `GrblStage`, and its waiting times."""

    #: Longest motion in Grbl's queue, s; also the time for which the stage moves on after this program dies.
    queue: float = 0.1
    #: Duration of one jog, s; several fit into the queue, so that the motion does not pause between two reports.
    jog: float = 0.025
    #: Time without a call of `GrblStage.position` or `GrblStage.move` after which no more jogs are sent, s.
    silence: float = 1.0
    #: Longest wait for a status report, s; Grbl's documentation states 5 to 20 ms.
    report: float = 1.0
    #: Largest stopping distance, as a fraction of the distance at top speed in `queue`: Grbl plans each queue to end at
    #: rest, so the last part of the queue is the deceleration.
    stopping_fraction: float = 0.4


#: Settings of all stages of this process.
JOGS = JogSettings()
#: States that forbid a motion, with the remedy.
_BLOCKED = {"Hold": "is on hold; send ~ or reset it", "Door": "has its safety door open; close it and reset it",
            "Check": "is in check mode, which moves nothing; send $C", "Sleep": "sleeps; reset it and home it"}


class GrblStage(Stage):
    """One axis of a machine with Grbl 1.1. `position` is the commanded position; a stalled motor is invisible.

    The zero is the position at the end of Grbl's homing cycle, a pull-off distance from the limit switch; positive is
    away from the switch. A homing cycle runs to its end even if this program dies.

    Args:
        port: Serial port.
        limits: Travel and top speed; the travel must begin at 0, the end with the switch.
        axis: X, Y or Z.
        baud: Baud rate of the port.

    Raises:
        InputError: An argument is outside its range.
    """

    measures_position = False
    #: After this program dies, the axis moves by at most the speed times this. `JogSettings.silence` covers a hang.
    runs_on = JOGS.queue

    def __init__(self, port: str, limits: StageLimits, axis: str = "Z", baud: int = grbl.BAUD):
        if not port:
            raise InputError("the serial port must be given, as in grbl:/dev/ttyUSB0,axis=Z; got none", field="port")
        if limits.lowest != 0.0 or not 0.0 < limits.highest < math.inf:
            raise InputError(f"the travel must begin at 0 m, where the limit switch is; got {limits.lowest:g} to "
                             f"{limits.highest:g} m", field="lowest_mm, highest_mm")
        if not grbl.LEAST_FEED / 60e3 <= limits.speed < math.inf:
            raise InputError(f"the top speed must be at least {grbl.LEAST_FEED / 60:.4f} mm/s; got "
                             f"{limits.speed * 1e3:g} mm/s", field="top_speed_mm_s")
        if len(axis) != 1 or axis not in grbl.AXES:
            raise InputError(f"the axis must be X, Y or Z; got {axis!r}", field="axis")
        if baud <= 0:
            raise InputError(f"the baud rate must be above 0; got {baud}", field="baud")
        self.limits, self._port, self._axis, self._baud = limits, port, axis, baud
        self._name = f"the Grbl at {port}"
        self._connection: GrblConnection | None = None
        self._set_unstarted_state()

    def _set_unstarted_state(self) -> None:
        """Set the state of a stage that has not been started."""
        self._sequence = 0
        #: Machine coordinate of the zero, mm; None: not homed.
        self._zero: float | None = None
        #: Direction of positive positions in machine coordinates, 1 or -1.
        self._sign = -1.0
        #: Target in machine coordinates, mm, and speed, mm/s; None: no motion.
        self._goal: tuple[float, float] | None = None
        #: Target of the last jog sent, mm; None: the axis must be at rest before the next jog.
        self._sent: float | None = None
        #: Time at which homing fails, s; None: not homing. A homing cycle may take `_longest_homing`, s.
        self._homing_until: float | None = None
        #: True if the homing command was sent.
        self._homing_sent = False
        #: Message that the next call raises; empty: none.
        self._trouble = ""
        self._steps_per_mm = math.nan
        #: Time of the last call of `position` or `move`, s.
        self._last_call = -math.inf
        #: Number of calls of `halt`, which reveals a halt during a `move`.
        self._halts = 0

    def __getstate__(self) -> dict[str, Any]:
        if self._connection is not None:
            raise TypeError("a started stage cannot be sent to another process; stop it first")
        return self.__dict__

    def start(self) -> None:
        """Open the port, check the settings of Grbl and start the thread that sends jogs and reads reports."""
        if self._connection is not None:
            return
        self._set_unstarted_state()
        connection = GrblConnection(self._port, self._baud, grbl.AXES.index(self._axis))
        try:
            self._check_settings_and_derive_motion_data(connection.check_version_and_read_settings())
            connection.start_thread(self._send_next_commands_and_get_is_moving)
        except BaseException:
            connection.close()
            raise
        self._connection = connection

    def _check_settings_and_derive_motion_data(self, settings: dict[int, float]) -> None:
        """Raise an error if ``$$`` does not permit the limits of this stage; store steps, direction and homing time."""
        number = grbl.AXES.index(self._axis)

        def read_setting(setting: int) -> float:
            """Return the value of a setting of this machine; raises a DeviceError if Grbl does not report it."""
            if setting not in settings:
                raise DeviceError(f"{self._name} does not report its setting ${setting}; install Grbl 1.1")
            return settings[setting]

        top, pull_off = read_setting(GrblSetting.MAX_RATE + number) / 60.0, read_setting(GrblSetting.PULL_OFF)
        acceleration = read_setting(GrblSetting.ACCELERATION + number)
        travel = read_setting(GrblSetting.TRAVEL + number) - pull_off
        self._steps_per_mm = read_setting(GrblSetting.STEPS_PER_MM + number)
        speed, highest = self.limits.speed * 1e3, self.limits.highest * 1e3
        if read_setting(GrblSetting.REPORT_INCHES):
            raise DeviceError(f"{self._name} reports inches; set $13=0")
        if not read_setting(GrblSetting.HOMING):
            raise DeviceError(f"{self._name} cannot home, so its zero is undefined; fit limit switches and set $22=1")
        if highest > travel:
            raise DeviceError(f"the travel of axis {self._axis} of {self._name} is {travel:g} mm, less than "
                              f"{highest:g} mm; lower highest_mm, or correct ${GrblSetting.TRAVEL + number}")
        if speed > top:
            raise DeviceError(f"the top speed of axis {self._axis} of {self._name} is {top:g} mm/s, less than "
                              f"{speed:g} mm/s; lower top_speed_mm_s, or raise ${GrblSetting.MAX_RATE + number}")
        most = 2.0 * acceleration * JOGS.stopping_fraction * JOGS.queue
        if speed > most:
            raise DeviceError(f"with {JOGS.queue * 1e3:g} ms of queued motion and {acceleration:g} mm/s^2 the top "
                              f"speed of axis {self._axis} of {self._name} is {most:g} mm/s, less than {speed:g} "
                              f"mm/s; lower top_speed_mm_s, or raise ${GrblSetting.ACCELERATION + number}")
        homes_to_negative_end = int(read_setting(GrblSetting.HOMING_DIRECTION)) >> number & 1
        self._sign = 1.0 if homes_to_negative_end else -1.0
        seek, feed = (max(read_setting(speed), 1.0) for speed in (GrblSetting.HOMING_SEEK, GrblSetting.HOMING_FEED))
        seek_distance = 1.5 * read_setting(GrblSetting.TRAVEL + number)
        self._longest_homing = 20.0 + 120.0 * (seek_distance / seek + 10.0 * pull_off / feed)

    def home(self) -> None:
        """Request Grbl's homing cycle and return at once; the thread sends it, and `position` shows its end."""
        connection = self._get_connection_or_raise()
        with connection.lock:
            self._raise_thread_error_if_any(connection)
            if self._homing_until is not None:
                return
            report = self._wait_for_new_report(connection)
            if report.state in _BLOCKED:
                raise DeviceError(f"{self._name} {_BLOCKED[report.state]}")
            if report.critical:
                # A critical alarm accepts only a reset. The axis is at rest, so the reset loses no position.
                connection.reset_and_wait_for_banner()
            self._goal = self._sent = self._zero = None
            self._homing_until = time.monotonic() + self._longest_homing
            self._homing_sent, connection.alarm, connection.error = False, None, None
            connection.wake_thread()

    def move(self, position: float, speed: float) -> None:
        """Set the target, m, and the speed, m/s, and return at once; the thread then sends the jogs."""
        halts, connection = self._halts, self._get_connection_or_raise()
        self.limits.require_within_limits(position, speed, slowest=grbl.LEAST_FEED / 60e3)
        with connection.lock:
            self._raise_thread_error_if_any(connection)
            report = connection.latest if self._homing_until is not None else self._wait_for_new_report(connection)
            self._require_report_allows_motion(report, connection)
            zero = self._zero
            if zero is None:
                raise DeviceError(f"{self._name} does not know its zero; home it first, and wait until it is homed")
            if halts == self._halts:
                self._last_call = time.monotonic()
                self._goal = zero + self._sign * position * 1e3, speed * 1e3
                connection.wake_thread()

    def position(self) -> StageSample:
        """Return a sample with the commanded position, m, of a new report; during homing, of the latest report."""
        connection = self._get_connection_or_raise()
        with connection.lock:
            self._last_call = time.monotonic()
            self._raise_thread_error_if_any(connection)
            report = connection.latest if self._homing_until is not None else self._wait_for_new_report(connection)
            homing = self._homing_until is not None
            moving = (homing or self._goal is not None or connection.unanswered > 0
                      or report.state in ("Jog", "Run", "Home"))
            bits = SampleStatus.GOOD
            if report.state in ("Alarm", *_BLOCKED) and (connection.alarm is not None or report.state != "Alarm"):
                bits |= SampleStatus.FAULT
            if self._axis in report.pins:
                bits |= SampleStatus.LIMIT
            zero = 0.0 if self._zero is None else self._zero
            position = self._sign * (report.position - zero)
            self._sequence += 1
            return StageSample(round(position * self._steps_per_mm), position * 1e-3, moving, self._zero is not None,
                               self._sequence - 1, int(bits), report.received, report.requested or None)

    def halt(self) -> None:
        """Discard the goal and cancel the jogs; during homing, reset Grbl."""
        self._halts += 1
        self._goal = None
        connection = self._connection
        if connection is None:
            return
        homing = self._homing_until is not None and self._homing_sent
        has_lock = connection.lock.acquire(timeout=0.1)
        try:
            self._goal = self._sent = None
            # Only a reset ends a homing cycle. The reset loses the zero, which is unknown during homing anyway.
            connection.send_bytes(grbl.RESET if homing else grbl.JOG_CANCEL)
            self._homing_until = None
            if homing:
                connection.unanswered = 0
            # A jog may still be in transmission; the thread sends cancels until the axis is at rest.
            connection.wake_thread()
        except Exception:
            # A halt must not raise: the queue ends within `runs_on`, and `position` reports the error.
            return
        finally:
            if has_lock:
                connection.lock.release()

    def stop(self) -> None:
        """Halt the axis, end the thread and close the port."""
        connection = self._connection
        if connection is None:
            return
        self.halt()
        self._connection = None
        connection.close()

    def describe(self) -> dict[str, Any]:
        """Return port, axis, steps, travel range and top speed; keys carry units."""
        steps = self._steps_per_mm
        scale = {} if math.isnan(steps) else {"steps_per_mm": steps, "resolution_mm": max(1.0 / steps, 1e-3)}
        return {"stage": "Grbl 1.1", "port": self._port, "axis": self._axis, **scale,
                "lowest_mm": self.limits.lowest * 1e3, "highest_mm": self.limits.highest * 1e3,
                "top_speed_mm_s": self.limits.speed * 1e3, "position": "commanded", "stalled_motor": "not detectable",
                "runs_on_s": self.runs_on, "homing_runs_on": "to its end",
                "checked_with": "emulator; unverified on hardware"}

    def _send_next_commands_and_get_is_moving(self, connection: GrblConnection) -> bool:
        """Send the next commands, in the connection's thread with the lock held; return True during a motion."""
        if connection.lost:
            self._goal = None
        elif self._homing_until is not None:
            self._continue_homing(connection)
        elif connection.latest.state == "Alarm" or connection.was_reset:
            if connection.was_reset and self._zero is not None and connection.alarm is None:
                self._trouble = f"{self._name} has restarted and lost its zero; check its supply, and home it again"
            self._goal = self._sent = self._zero = None
            connection.was_reset = False
        else:
            self._continue_motion(connection)
        return self._goal is not None or self._homing_until is not None

    def _continue_motion(self, connection: GrblConnection) -> None:
        """Send the next jogs toward the goal, or cancel the jogs of a motion that was replaced or halted."""
        report = connection.latest
        if connection.error is not None:
            self._trouble = (f"{self._name} has refused a motion with error {connection.error}: "
                             f"{grbl.describe_error(connection.error)}")
            self._goal, connection.error = None, None
        if report.number == connection.handled:
            return  # one action per report
        connection.handled = report.number
        motion = self._goal
        if motion is None:
            self._sent = None
            if report.state == "Jog":
                connection.send_bytes(grbl.JOG_CANCEL)
            return
        if time.monotonic() - self._last_call > JOGS.silence:
            return
        goal, speed = motion
        if self._sent is None:
            if not connection.has_report_after_last_answer:
                return
            if report.state != "Idle":
                connection.send_bytes(grbl.JOG_CANCEL)
                return
            self._sent = report.position
        elif self._sent == goal:
            if report.state == "Idle" and connection.has_report_after_last_answer:
                self._goal = self._sent = None
            return
        if (goal - self._sent) * (self._sent - report.position) < 0:
            # A reversal: the old motion is cancelled, and the new one begins at rest.
            connection.send_bytes(grbl.JOG_CANCEL)
            self._sent = None
            return
        for target in self._iterate_jog_targets(report.position, self._sent, goal, speed):
            connection.send_line(grbl.encode_jog_in_machine_coordinates(self._axis, target, speed * 60.0))
            self._sent = target

    @staticmethod
    def _iterate_jog_targets(position: float, sent: float, goal: float, speed: float) -> Iterator[float]:
        """Yield the targets, mm, in machine coordinates, of the next jogs that fit into the queue of Grbl.

        Args:
            position: Last reported position, mm.
            sent: Target of the last jog sent, mm.
            goal: Target of the motion, mm.
            speed: Speed, mm/s.
        """
        while sent != goal:
            step = min(speed * JOGS.jog, abs(goal - sent))
            if abs(sent - position) + step > speed * JOGS.queue * (1.0 + 1e-9):
                return
            sent = goal if step == abs(goal - sent) else sent + math.copysign(step, goal - sent)
            yield sent

    def _continue_homing(self, connection: GrblConnection) -> None:
        """Send the homing command once the axis is at rest, and detect the end or the failure of homing."""
        report = connection.latest
        if connection.error is not None or connection.alarm is not None:
            cause = (grbl.describe_error(connection.error) if connection.error is not None else
                     grbl.describe_alarm(connection.alarm))
            self._trouble = f"{self._name} did not home: {cause}"
            connection.error, self._homing_until = None, None
        elif self._homing_until is not None and time.monotonic() > self._homing_until:
            self._trouble = (f"the homing of {self._name} does not end; check the limit switch of {self._axis}, "
                             "power and cable")
            self._homing_until = None
            connection.send_bytes(grbl.RESET)
        elif not self._homing_sent:
            if connection.has_report_after_last_answer and report.state in ("Idle", "Alarm"):
                self._homing_sent, connection.was_reset = True, False
                connection.send_line(b"$H\n")
            elif report.state == "Jog" and report.number != connection.handled:
                connection.handled = report.number
                connection.send_bytes(grbl.JOG_CANCEL)
        elif connection.has_report_after_last_answer and report.state == "Idle":
            self._zero, self._homing_until, connection.was_reset = report.position, None, False

    def _wait_for_new_report(self, connection: GrblConnection) -> AxisReportInMillimetres:
        """Wait for a report requested after this call and return it; DeviceError if none. Requires the lock."""
        report = connection.wait_for_new_report_or_none(JOGS.report)
        if report is None:
            self._raise_thread_error_if_any(connection)
            raise DeviceError(f"{self._name} has sent no report for {JOGS.report:g} s; check that it has power, the "
                              "cable and the baud rate")
        return report

    def _require_report_allows_motion(self, report: AxisReportInMillimetres, connection: GrblConnection) -> None:
        """Raise a DeviceError with the remedy if the reported state of Grbl forbids a motion."""
        if report.state == "Alarm" and connection.alarm is not None:
            raise DeviceError(f"{self._name} is in alarm {connection.alarm}: {grbl.describe_alarm(connection.alarm)}")
        if report.state in _BLOCKED:
            raise DeviceError(f"{self._name} {_BLOCKED[report.state]}")

    def _raise_thread_error_if_any(self, connection: GrblConnection) -> None:
        """Raise a DeviceError with the message that the thread has stored, if any; clear it unless the port is lost."""
        if connection.lost:
            raise DeviceError(connection.lost)
        trouble, self._trouble = self._trouble, ""
        if trouble:
            raise DeviceError(trouble)

    def _get_connection_or_raise(self) -> GrblConnection:
        """Return the connection; raises a DeviceError if the stage is not started."""
        connection = self._connection
        if connection is None:
            raise DeviceError("the Grbl stage is not started; start it first")
        return connection


def make_grbl_stage(text: str) -> GrblStage:
    """Make a stage from ``grbl:/dev/ttyUSB0,axis=Z,highest_mm=50,top_speed_mm_s=0.5,baud=115200``."""
    port, _, settings = text.partition(",")
    parts = [part.strip() for part in settings.split(",")]
    axis = next((part.partition("=")[2].strip() for part in parts if part.partition("=")[0].strip() == "axis"), "Z")
    rest = ",".join(part for part in parts if part.partition("=")[0].strip() != "axis")
    given = parse_number_settings(rest, lowest_mm=0.0, highest_mm=50.0, top_speed_mm_s=0.5, baud=grbl.BAUD)
    limits = StageLimits.from_settings(given)
    return GrblStage(port.strip(), limits, axis.upper(), int(given["baud"]))
