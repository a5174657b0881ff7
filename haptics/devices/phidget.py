"""The stepper of a Phidget, by the maker's own library; the extra ``phidget``.

Source: the documentation in the package phidget22 (Stepper, Failsafe, ErrorCode). Only run against a stand-in for that
package: unverified on hardware.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import Any

from haptics.devices.contracts import DeviceError, SampleStatus, Stage, StageLimits, StageSample
from haptics.devices.settings import read_settings, split_target
from tissue_sim.errors import InputError

#: How long the controller may take to answer at the start, ms (the library advises at least 1000).
_ATTACH_MS = 2000
#: After so long without a sign of life the controller lets the motor go, ms.
_FAILSAFE_MS = 500
#: Codes of `Phidget22.ErrorCode`.
_TIMEOUT, _UNSUPPORTED, _NOT_ATTACHED, _FAILSAFE = 3, 20, 52, 59
_EXAMPLE = "phidget:123456,steps_per_mm=25"


class PhidgetStage(Stage):
    """Goes where it is sent; its position is the commanded one, so a motor that stands is not seen.

    There is no switch to look for: `home` makes the place where it stands the zero, without a motion, and gives the
    motor its current. The controller's failsafe is set to half a second: when nobody asks for `position` for so long,
    it takes the current away, and the zero is lost. An old one that has no failsafe goes on to where it was sent, and
    `runs_on` says so. `halt` brakes with the acceleration, and the motor holds; `stop` takes its current away.

    Args:
        serial: number of the controller; None: the first that is found.
        steps_per_mm: full steps of the motor, in a mm of travel; negative where it turns the other way.
        limits: m, m/s.
        acceleration: m/s2.
        microsteps: of the controller, in a full step (16 in most).
        current: limit of the motor, A; None: as the controller has it.

    Raises:
        InputError: numbers or limits that make no sense.
    """

    measures_position = False
    runs_on = 1e-3 * _FAILSAFE_MS

    def __init__(self, serial: int | None, steps_per_mm: float, limits: StageLimits, acceleration: float = 0.05,
                 microsteps: int = 16, current: float | None = None):
        if not limits.lowest <= 0.0 < limits.highest < float("inf") or limits.lowest == -float("inf"):
            raise InputError(f"from {limits.lowest:g} to {limits.highest:g} m; give a range with the zero in it",
                             field="limits")
        for field, value in (("top_speed_mm_s", limits.speed), ("acceleration_mm_s2", acceleration),
                             ("steps_per_mm", abs(steps_per_mm)), ("microsteps", microsteps)):
            if not 0 < value < float("inf"):
                raise InputError(f"{value:g}; give a number that is not zero, as in {_EXAMPLE}", field=field)
        self.limits, self._serial, self._steps_per_mm = limits, serial, steps_per_mm
        self._acceleration, self._microsteps, self._current = acceleration, microsteps, current
        #: m of the stage in one of its smallest steps, with the sign of the motor.
        self._per_count = 1e-3 / (steps_per_mm * microsteps)
        self._motor: Any = None
        self._homed, self._sequence = False, 0
        #: Where it is sent, m; None: it was halted.
        self._goal: float | None = None
        #: How often it was halted: a motion that is being sent meanwhile is over.
        self._halts = 0

    def start(self) -> None:
        if self._motor is not None:
            return
        motor = self._attached()
        try:
            self._set_up(motor)
        except BaseException:
            with contextlib.suppress(Exception):
                motor.close()
            raise
        self._motor, self._homed, self._sequence, self._goal = motor, False, 0, None

    def _attached(self) -> Any:
        """The controller, which has answered."""
        try:
            from Phidget22.Devices.Stepper import Stepper
            from Phidget22.Phidget import Phidget
        except ImportError:
            raise DeviceError("the package phidget22 is missing, which a Phidget needs; install it with pip install "
                              "'tissue-sim[phidget]'") from None
        try:
            # Loads the maker's library: where that fails, a Stepper would also complain while it is thrown away.
            Phidget.getLibraryVersion()
            motor = Stepper()
        except OSError as error:
            if "libusb" in str(error):
                raise DeviceError("the library libusb-1.0 is missing, which a Phidget needs; install it, on Debian and "
                                  "Ubuntu with sudo apt install libusb-1.0-0") from None
            raise DeviceError(f"the library of the package phidget22 cannot be loaded ({error}); install that package "
                              "again, or the library from phidgets.com") from None
        try:
            if self._serial is not None:
                motor.setDeviceSerialNumber(self._serial)
            motor.openWaitForAttachment(_ATTACH_MS)
        except Exception as error:
            with contextlib.suppress(Exception):
                motor.close()
            if getattr(error, "code", None) == _TIMEOUT:
                which = "no Phidget stepper" if self._serial is None else f"no Phidget stepper {self._serial}"
                raise DeviceError(f"{which} answers within {_ATTACH_MS / 1000:g} s; check its power, the cable and the "
                                  "serial number, close the Phidget Control Panel, and on Linux let your user open it "
                                  "(udev rule 99-libphidget22.rules)") from None
            raise self._trouble(error) from None
        return motor

    def _set_up(self, motor: Any) -> None:
        """Its units are counts; no speed and no current, so that nothing moves."""
        try:
            motor.setRescaleFactor(1.0)
            motor.setVelocityLimit(0.0)
            self._require_speed(motor)
            motor.setAcceleration(min(max(self._counts(self._acceleration), motor.getMinAcceleration()),
                                      motor.getMaxAcceleration()))
            if self._current is not None:
                motor.setCurrentLimit(self._current)
            self._enable_failsafe(motor)
        except DeviceError:
            raise
        except Exception as error:
            raise self._trouble(error) from None

    def _enable_failsafe(self, motor: Any) -> None:
        try:
            motor.enableFailsafe(_FAILSAFE_MS)
        except Exception as error:
            if getattr(error, "code", None) != _UNSUPPORTED:
                raise
            self.runs_on = math.inf
        else:
            self.runs_on = 1e-3 * _FAILSAFE_MS

    def _require_speed(self, motor: Any) -> None:
        most = motor.getMaxVelocityLimit() * abs(self._per_count)
        if self.limits.speed > most:
            raise DeviceError(f"the Phidget stepper reaches {most * 1e3:g} mm/s at {self._steps_per_mm:g} steps per "
                              f"mm; give top_speed_mm_s={most * 1e3:.4g} or less")

    def _counts(self, way: float) -> float:
        """The size of a way, m, a speed or an acceleration, in counts."""
        return abs(way / self._per_count)

    def home(self) -> None:
        motor = self._started()
        try:
            motor.setVelocityLimit(0.0)
            motor.addPositionOffset(-motor.getPosition())
            motor.setTargetPosition(0.0)
            motor.setEngaged(True)
        except Exception as error:
            raise self._trouble(error) from None
        self._homed, self._goal = True, None

    def move(self, position: float, speed: float) -> None:
        motor = self._started()
        self.limits.require(position, speed)
        if not self._homed:
            raise DeviceError("the Phidget stepper does not know its zero; home it first")
        # The controller takes whole counts in a second, and rounds down: a speed below one would be none.
        if self._counts(speed) < 1.0:
            raise InputError(f"{speed:g} m/s is less than the slowest speed, {abs(self._per_count):.3g} m/s",
                             field="speed")
        halts = self._halts
        try:
            # Not at the speed of the motion before.
            motor.setVelocityLimit(0.0)
            motor.setTargetPosition(float(round(position / self._per_count)))
            if self._halts == halts:
                motor.setVelocityLimit(float(round(self._counts(speed))))
            if self._halts != halts:  # somebody halted while this was sent
                motor.setVelocityLimit(0.0)
                return
        except Exception as error:
            raise self._trouble(error) from None
        self._goal = position

    def position(self) -> StageSample:
        motor = self._started()
        try:
            if self.runs_on < math.inf:
                motor.resetFailsafe()
            steps, turning = motor.getPosition(), bool(motor.getIsMoving())
        except Exception as error:
            raise self._trouble(error) from None
        now, place = time.monotonic(), steps * self._per_count
        goal = self._goal
        # The controller tells that it moves a little after it was sent off.
        moving = turning or (goal is not None and abs(place - goal) > abs(self._per_count))
        self._sequence += 1
        return StageSample(round(steps), place, moving, self._homed, self._sequence - 1, int(SampleStatus.GOOD), now)

    def halt(self) -> None:
        self._halts += 1
        motor, self._goal = self._motor, None
        if motor is not None:
            try:
                motor.setVelocityLimit(0.0)
            except Exception:
                # Without an answer there is one more thing to try: no current. Whoever asks for the position learns
                # why.
                with contextlib.suppress(Exception):
                    motor.setEngaged(False)

    def stop(self) -> None:
        self.halt()
        motor, self._motor, self._homed = self._motor, None, False
        if motor is not None:
            with contextlib.suppress(Exception):
                motor.setEngaged(False)
            with contextlib.suppress(Exception):
                motor.close()

    def describe(self) -> dict[str, Any]:
        return {"stage": "Phidget stepper", "serial": self._serial, "steps_per_mm": self._steps_per_mm,
                "microsteps": self._microsteps, "resolution_mm": abs(self._per_count) * 1e3,
                "lowest_mm": self.limits.lowest * 1e3, "highest_mm": self.limits.highest * 1e3,
                "top_speed_mm_s": self.limits.speed * 1e3, "acceleration_mm_s2": self._acceleration * 1e3,
                "speed_step_mm_s": abs(self._per_count) * 1e3,
                "stall": "not detectable", "failsafe_s": self.runs_on if self.runs_on < math.inf else None,
                "zero": "where it stood when it was homed",
                "verified": "against a stand-in for its library only"}

    def _started(self) -> Any:
        if self._motor is None:
            raise DeviceError("the Phidget stepper is not started; start it first")
        return self._motor

    def _trouble(self, error: Exception) -> DeviceError:
        """The sentence for an error of the library."""
        code = getattr(error, "code", None)
        if code == _FAILSAFE:
            self._homed = False
            return DeviceError(f"the Phidget stepper has let its motor go, because this program was silent for "
                               f"{self.runs_on:g} s; stop it, start it and home it again")
        if code == _NOT_ATTACHED:
            self._homed = False
            return DeviceError("the Phidget stepper is gone; check its power and the cable, and start it again")
        said = " ".join((getattr(error, "details", "") or str(error)).split()).rstrip(".")
        return DeviceError(f"the Phidget stepper refuses ({said}); check its power, and start it again")


def open_phidget(text: str) -> PhidgetStage:
    """``phidget:SERIAL,steps_per_mm=...,lowest_mm=0,highest_mm=50,top_speed_mm_s=5,acceleration_mm_s2=50,microsteps=16,
    current_A=0``.

    The serial number may be ``any``; ``steps_per_mm`` has to be given; a ``current_A`` of 0 is as the controller has
    it.
    """
    place, rest = split_target(text, "the serial number of the controller, or 'any',", _EXAMPLE)
    if place != "any" and not (place.isascii() and place.isdigit()):
        raise InputError(f"{place!r} is no serial number; give that of the controller, or 'any', as in {_EXAMPLE}",
                         field="serial")
    given = read_settings(rest, steps_per_mm=0.0, lowest_mm=0.0, highest_mm=50.0, top_speed_mm_s=5.0,
                          acceleration_mm_s2=50.0, microsteps=16, current_A=0.0)
    limits = StageLimits.from_settings(given)
    return PhidgetStage(None if place == "any" else int(place), given["steps_per_mm"], limits,
                        given["acceleration_mm_s2"] * 1e-3, int(given["microsteps"]), given["current_A"] or None)
