"""A stage driven by a Phidget stepper controller through the maker's library; requires the extra ``phidget``.

Source: the documentation in the package phidget22 (Stepper, Failsafe, ErrorCode). Checked with a stand-in for that
package only; unverified on hardware.
"""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.settings import parse_number_settings, split_address_and_settings_text
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class PhidgetTimesInMilliseconds:
    """Times that the controller is given, in the unit of its library.

    Attributes:
        attach_ms: longest wait for the controller at the start, ms; the library's documentation advises at least 1000.
        failsafe_ms: time without communication after which the controller switches the motor's current off, ms. A
            longer time tolerates longer pauses of the program and stops a motor later after a crash.
    """

    attach_ms: int = 2000
    failsafe_ms: int = 500


_TIMES = PhidgetTimesInMilliseconds()
#: A complete name, for messages.
_EXAMPLE = "phidget:123456,steps_per_mm=25"


class _PhidgetErrorCode(IntEnum):
    """Error codes of the library of the maker, `Phidget22.ErrorCode`, that have their own message here."""

    TIMEOUT = 3
    UNSUPPORTED = 20
    NOT_ATTACHED = 52
    FAILSAFE = 59


class PhidgetStage(Stage):
    """A stepper motor without encoder. `position` is the commanded position; a stalled motor is invisible.

    There is no limit switch: `home` sets the present position as zero without a motion, and switches the motor's
    current on. The controller's failsafe is set to half a second: without a call of `position` for this time the
    controller switches the current off, and the zero is lost. An old controller without failsafe moves on to its
    target; `runs_on` is then infinite. `halt` decelerates and holds the position; `stop` switches the current off.

    Args:
        serial: Serial number of the controller; None: the first one found.
        steps_per_mm: Full steps of the motor per millimetre of travel; negative values reverse the direction.
        limits: Travel and top speed.
        acceleration: Acceleration, m/s^2.
        microsteps: Microsteps per full step of the controller, 16 for most.
        current: Current limit of the motor, A; None: unchanged.

    Raises:
        InputError: A number is outside its range.
    """

    measures_position = False
    runs_on = 1e-3 * _TIMES.failsafe_ms

    def __init__(self, serial: int | None, steps_per_mm: float, limits: StageLimits, acceleration: float = 0.05,
                 microsteps: int = 16, current: float | None = None):
        if not limits.lowest <= 0.0 < limits.highest < float("inf") or limits.lowest == -float("inf"):
            raise InputError("lowest must be 0 or less and highest above 0; got "
                             f"{limits.lowest:g} to {limits.highest:g} m", field="limits")
        for field, value in (("top_speed_mm_s", limits.speed), ("acceleration_mm_s2", acceleration),
                             ("steps_per_mm", abs(steps_per_mm)), ("microsteps", microsteps)):
            if not 0 < value < float("inf"):
                condition = "finite and not 0" if field == "steps_per_mm" else "finite and above 0"
                raise InputError(f"a setting of the motor must be {condition}, as in {_EXAMPLE}; got {value:g}",
                                 field=field)
        self.limits, self._serial, self._steps_per_mm = limits, serial, steps_per_mm
        self._acceleration, self._microsteps, self._current = acceleration, microsteps, current
        #: Length of one microstep, m, with the sign of the direction.
        self._length_per_count = 1e-3 / (steps_per_mm * microsteps)
        self._motor: Any = None
        self._homed, self._sequence = False, 0
        #: Target, m; None: halted.
        self._goal: float | None = None
        #: Number of calls of `halt`, which reveals a halt during a `move`.
        self._halts = 0

    def start(self) -> None:
        """Attach the controller and set current, acceleration and failsafe."""
        if self._motor is not None:
            return
        motor = self._attach_controller()
        try:
            self._configure_motor(motor)
        except BaseException:
            with contextlib.suppress(Exception):
                motor.close()
            raise
        self._motor, self._homed, self._sequence, self._goal = motor, False, 0, None

    def _attach_controller(self) -> Any:
        """Connect to the controller, and return its `Stepper` object once it has answered; DeviceError if not."""
        try:
            from Phidget22.Devices.Stepper import Stepper
            from Phidget22.Phidget import Phidget
        except ImportError:
            raise DeviceError("a Phidget requires the package phidget22, which is missing; install it with pip install "
                              "'tissue-sim[phidget]'") from None
        try:
            # Loads the maker's library. If loading failed in Stepper(), its destructor would print another error.
            Phidget.getLibraryVersion()
            motor = Stepper()
        except OSError as error:
            if "libusb" in str(error):
                raise DeviceError("a Phidget requires the library libusb-1.0, which is missing; install it, on Debian "
                                  "and Ubuntu with sudo apt install libusb-1.0-0") from None
            raise DeviceError(f"the library of the package phidget22 cannot be loaded ({error}); install the package "
                              "again, or the library from phidgets.com") from None
        try:
            if self._serial is not None:
                motor.setDeviceSerialNumber(self._serial)
            motor.openWaitForAttachment(_TIMES.attach_ms)
        except Exception as error:
            with contextlib.suppress(Exception):
                motor.close()
            if getattr(error, "code", None) == _PhidgetErrorCode.TIMEOUT:
                which = "no Phidget stepper" if self._serial is None else f"no Phidget stepper {self._serial}"
                raise DeviceError(f"{which} answers within {_TIMES.attach_ms / 1000:g} s; check its power, the cable "
                                  "and the serial number, close the Phidget Control Panel, and on Linux let your user "
                                  "open it (udev rule 99-libphidget22.rules)") from None
            raise self._make_error_and_unset_zero_if_lost(error) from None
        return motor

    def _configure_motor(self, motor: Any) -> None:
        """Set counts as unit, acceleration, current limit and failsafe, and the velocity limit to 0: no motion yet."""
        try:
            motor.setRescaleFactor(1.0)
            motor.setVelocityLimit(0.0)
            self._require_reachable_top_speed(motor)
            motor.setAcceleration(
                min(max(self._convert_to_unsigned_counts(self._acceleration), motor.getMinAcceleration()),
                    motor.getMaxAcceleration()))
            if self._current is not None:
                motor.setCurrentLimit(self._current)
            self._enable_failsafe_and_set_runs_on(motor)
        except DeviceError:
            raise
        except Exception as error:
            raise self._make_error_and_unset_zero_if_lost(error) from None

    def _enable_failsafe_and_set_runs_on(self, motor: Any) -> None:
        """Enable the failsafe, and set `runs_on` to its time, s; infinite if the controller has no failsafe."""
        try:
            motor.enableFailsafe(_TIMES.failsafe_ms)
        except Exception as error:
            if getattr(error, "code", None) != _PhidgetErrorCode.UNSUPPORTED:
                raise
            self.runs_on = math.inf
        else:
            self.runs_on = 1e-3 * _TIMES.failsafe_ms

    def _require_reachable_top_speed(self, motor: Any) -> None:
        """Raise a DeviceError if the top speed in `limits` exceeds the largest speed of the controller."""
        most = motor.getMaxVelocityLimit() * abs(self._length_per_count)
        if self.limits.speed > most:
            raise DeviceError(f"the top speed of the Phidget stepper is {most * 1e3:g} mm/s at {self._steps_per_mm:g} "
                              f"steps per mm; give top_speed_mm_s={most * 1e3:.4g} or less")

    def _convert_to_unsigned_counts(self, length: float) -> float:
        """Convert a length, m, speed, m/s, or acceleration, m/s^2, to a number of counts, always positive or zero."""
        return abs(length / self._length_per_count)

    def home(self) -> None:
        """Set the present position as zero, without a motion, and switch the current of the motor on."""
        motor = self._get_motor_or_raise()
        try:
            motor.setVelocityLimit(0.0)
            motor.addPositionOffset(-motor.getPosition())
            motor.setTargetPosition(0.0)
            motor.setEngaged(True)
        except Exception as error:
            raise self._make_error_and_unset_zero_if_lost(error) from None
        self._homed, self._goal = True, None

    def move(self, position: float, speed: float) -> None:
        """Begin a motion to a position, m, at a speed, m/s, and return at once."""
        motor = self._get_motor_or_raise()
        self.limits.require_within_limits(position, speed)
        if not self._homed:
            raise DeviceError("the Phidget stepper does not know its zero; home it first")
        # The controller rounds down to whole counts per second, so a speed below 1 would become 0.
        if self._convert_to_unsigned_counts(speed) < 1.0:
            raise InputError(f"the speed must be at least {abs(self._length_per_count):.3g} m/s; got {speed:g} m/s",
                             field="speed")
        halts = self._halts
        try:
            # The velocity limit of 0 prevents a motion to the new target at the old speed.
            motor.setVelocityLimit(0.0)
            motor.setTargetPosition(float(round(position / self._length_per_count)))
            if self._halts == halts:
                motor.setVelocityLimit(float(round(self._convert_to_unsigned_counts(speed))))
            if self._halts != halts:  # another thread halted in between
                motor.setVelocityLimit(0.0)
                return
        except Exception as error:
            raise self._make_error_and_unset_zero_if_lost(error) from None
        self._goal = position

    def position(self) -> StageSample:
        """Return a sample with the commanded position, m, and restart the failsafe timer of the controller."""
        motor = self._get_motor_or_raise()
        try:
            if self.runs_on < math.inf:
                motor.resetFailsafe()
            steps, turning = motor.getPosition(), bool(motor.getIsMoving())
        except Exception as error:
            raise self._make_error_and_unset_zero_if_lost(error) from None
        now, position = time.monotonic(), steps * self._length_per_count
        goal = self._goal
        # The controller reports a motion shortly after its beginning, hence the comparison with the target.
        moving = turning or (goal is not None and abs(position - goal) > abs(self._length_per_count))
        self._sequence += 1
        return StageSample(round(steps), position, moving, self._homed, self._sequence - 1, int(SampleStatus.GOOD),
                           now)

    def halt(self) -> None:
        """Decelerate the motor to rest; if the controller refuses, switch its current off. Never raises."""
        self._halts += 1
        motor, self._goal = self._motor, None
        if motor is not None:
            try:
                motor.setVelocityLimit(0.0)
            except Exception:
                # The last resort is to switch the current off. The next call of `position` reports the error.
                with contextlib.suppress(Exception):
                    motor.setEngaged(False)

    def stop(self) -> None:
        """Halt the motor, switch its current off and close the controller."""
        self.halt()
        motor, self._motor, self._homed = self._motor, None, False
        if motor is not None:
            with contextlib.suppress(Exception):
                motor.setEngaged(False)
            with contextlib.suppress(Exception):
                motor.close()

    def describe(self) -> dict[str, Any]:
        """Return serial number, steps, travel range, top speed and failsafe time; keys carry units."""
        return {"stage": "Phidget stepper", "serial": self._serial, "steps_per_mm": self._steps_per_mm,
                "microsteps": self._microsteps, "resolution_mm": abs(self._length_per_count) * 1e3,
                "lowest_mm": self.limits.lowest * 1e3, "highest_mm": self.limits.highest * 1e3,
                "top_speed_mm_s": self.limits.speed * 1e3, "acceleration_mm_s2": self._acceleration * 1e3,
                "speed_step_mm_s": abs(self._length_per_count) * 1e3,
                "stall": "not detectable", "failsafe_s": self.runs_on if self.runs_on < math.inf else None,
                "zero": "where it stood when it was homed",
                "verified": "against a stand-in for its library only"}

    def _get_motor_or_raise(self) -> Any:
        """Return the `Stepper` object of the library; raises a DeviceError if the stage is not started."""
        if self._motor is None:
            raise DeviceError("the Phidget stepper is not started; start it first")
        return self._motor

    def _make_error_and_unset_zero_if_lost(self, error: Exception) -> DeviceError:
        """Return a DeviceError with the remedy for an error of the library; marks the zero as unknown if it is lost."""
        code = getattr(error, "code", None)
        if code == _PhidgetErrorCode.FAILSAFE:
            self._homed = False
            return DeviceError("the Phidget stepper has switched its motor off, because this program did not "
                               f"communicate for {self.runs_on:g} s; stop it, start it and home it again")
        if code == _PhidgetErrorCode.NOT_ATTACHED:
            self._homed = False
            return DeviceError("the Phidget stepper is gone; check its power and the cable, and start it again")
        details = " ".join((getattr(error, "details", "") or str(error)).split()).rstrip(".")
        return DeviceError(f"the Phidget stepper reports an error ({details}); check its power, and start it again")


def make_phidget_stage(text: str) -> PhidgetStage:
    """Make a stage from its serial number, or ``any``, and settings; ``steps_per_mm`` is required.

    Defaults: ``phidget:SERIAL,steps_per_mm=...,lowest_mm=0,highest_mm=50,top_speed_mm_s=5,acceleration_mm_s2=50,
    microsteps=16,current_A=0``; ``current_A=0`` leaves the current limit unchanged.
    """
    serial, rest = split_address_and_settings_text(text, "the serial number of the controller, or 'any',", _EXAMPLE)
    if serial != "any" and not (serial.isascii() and serial.isdigit()):
        raise InputError(f"the name must begin with the serial number of the controller or 'any', as in {_EXAMPLE}; "
                         f"got {serial!r}",
                         field="serial")
    given = parse_number_settings(rest, steps_per_mm=0.0, lowest_mm=0.0, highest_mm=50.0, top_speed_mm_s=5.0,
                                  acceleration_mm_s2=50.0, microsteps=16, current_A=0.0)
    limits = StageLimits.from_settings(given)
    return PhidgetStage(None if serial == "any" else int(serial), given["steps_per_mm"], limits,

                        given["acceleration_mm_s2"] * 1e-3, int(given["microsteps"]), given["current_A"] or None)
