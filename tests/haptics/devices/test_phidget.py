"""The stage of a Phidget stepper, with a simulated library that follows the documentation of phidget22."""

import ctypes.util
import importlib.util
import math
import sys
from dataclasses import replace
from types import ModuleType

import pytest
from device_contracts import StageContract

from haptics.devices import phidget
from haptics.devices.back_ends import make_stage
from haptics.devices.contracts import DeviceError
from tissue_sim.errors import InputError


class PhidgetException(Exception):  # noqa: N818 (the Phidget22 library exports this name, and the driver imports it)
    """Like the exception of the library: a code of `ErrorCode`, and a description."""

    def __init__(self, code, details=""):
        super().__init__(f"PhidgetException 0x{code:02x}\n{details}")
        self.code, self.details = code, details


class Stepper:
    """A controller with a motor; positions in counts of 1/16 step. Every speed is reached at once."""

    #: Clock, s, advanced by the test; True if the controller is attached; all instances.
    now = 0.0
    attached = True
    made = []

    def __init__(self):
        Stepper.made.append(self)
        self.calls, self.serial, self.open, self.engaged = [], None, False, False
        self.factor, self.limit, self.target, self.current = 1.0, 10000.0, None, None
        self._place, self._since, self._failsafe, self._alive, self._tripped = 700.0, 0.0, math.inf, 0.0, False

    def _check(self, name):
        self.calls.append(name)
        if not self.open or not Stepper.attached:
            raise PhidgetException(52, "Device not Attached.")
        self._run()
        if self._tripped:
            raise PhidgetException(59, "Failsafe Triggered on this channel.")

    def _run(self):
        """Advance the motion to now, or to the time at which the failsafe acts."""
        end = min(Stepper.now, self._alive + self._failsafe)
        if self.engaged and self.target is not None and end > self._since:
            way = self.target - self._place
            self._place += math.copysign(min(abs(way), self.limit * (end - self._since)), way)
        self._since = Stepper.now
        if Stepper.now > self._alive + self._failsafe:
            self._tripped, self.engaged = True, False

    def _moves(self):
        return self.engaged and self.target is not None and self._place != self.target and self.limit > 0

    def setDeviceSerialNumber(self, serial):
        self.serial = serial

    def openWaitForAttachment(self, timeout):
        if not Stepper.attached or self.serial not in (None, 123):
            raise PhidgetException(3, "No Phidgets were detected at all. Make sure your device is attached.")
        self.open, self._since = True, Stepper.now

    def close(self):
        self.open, self.engaged = False, False

    def setRescaleFactor(self, factor):
        self._check("setRescaleFactor")
        self.factor = factor

    def getMaxVelocityLimit(self):
        return 250000.0

    def setVelocityLimit(self, limit):
        self._check("setVelocityLimit")
        if not 0 <= limit <= 250000:
            raise PhidgetException(21, "Value must be in range.")
        self.limit, self._alive = math.floor(limit), Stepper.now

    def getMinAcceleration(self):
        return 2.0

    def getMaxAcceleration(self):
        return 1e7

    def setAcceleration(self, acceleration):
        self._check("setAcceleration")
        assert 2.0 <= acceleration <= 1e7
        self._alive = Stepper.now

    def setCurrentLimit(self, current):
        self._check("setCurrentLimit")
        self.current, self._alive = current, Stepper.now

    def enableFailsafe(self, milliseconds):
        self._check("enableFailsafe")
        self._failsafe, self._alive = 1e-3 * milliseconds, Stepper.now

    def resetFailsafe(self):
        self._check("resetFailsafe")
        self._alive = Stepper.now

    def setEngaged(self, engaged):
        self._check("setEngaged")
        self.engaged, self._alive = engaged, Stepper.now

    def addPositionOffset(self, offset):
        self._check("addPositionOffset")
        self._place += offset
        self.target = None if self.target is None else self.target + offset

    def setTargetPosition(self, target):
        self._check("setTargetPosition")
        self.target = target

    def getPosition(self):
        self._check("getPosition")
        return self._place

    def getIsMoving(self):
        self._check("getIsMoving")
        return self._moves()


@pytest.fixture
def library(monkeypatch):
    """The simulated library, installed as the package phidget22."""
    names = ("Phidget22", "Phidget22.Devices", "Phidget22.Devices.Stepper", "Phidget22.Phidget")
    modules = {name: ModuleType(name) for name in names}
    modules["Phidget22.Devices.Stepper"].Stepper = Stepper
    modules["Phidget22.Phidget"].Phidget = type("Phidget", (), {"getLibraryVersion": staticmethod(lambda: "made up")})
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    for name, value in (("now", 0.0), ("attached", True), ("made", [])):
        monkeypatch.setattr(Stepper, name, value)
    return modules


class OverTheStandIn(StageContract):
    tolerance = 0.6 * 1e-3 / (25 * 16)

    @pytest.fixture
    def stage(self, library):
        self.stage_here = make_stage(self.name)
        yield self.stage_here
        self.stage_here.stop()

    def pass_time(self, seconds):
        """Advance the clock with regular calls of `position`, as in a loop; each call uses a sequence number."""
        end = Stepper.now + seconds
        while Stepper.now < end - 1e-9:
            Stepper.now = min(Stepper.now + 0.4, end)
            Stepper.made[-1].resetFailsafe()


class TestPhidget(OverTheStandIn):
    name = "phidget:123,steps_per_mm=25,lowest_mm=-5,highest_mm=20,top_speed_mm_s=10"


class TestTheOtherWayRound(OverTheStandIn):
    """A motor with reversed direction, on the first controller found."""

    name = "phidget:any,steps_per_mm=-25,lowest_mm=-5,highest_mm=20,top_speed_mm_s=10,current_A=0.6"


@pytest.fixture
def stage(library):
    stage = make_stage("phidget:123,steps_per_mm=25")
    stage.start()
    yield stage
    stage.stop()


def test_a_start_moves_nothing_and_sets_the_failsafe(stage):
    motor, = Stepper.made
    assert motor.serial == 123 and motor.limit == 0.0 and not motor.engaged
    assert "setTargetPosition" not in motor.calls and motor.calls[-1] == "enableFailsafe"
    assert stage.runs_on == 0.5 and motor._failsafe == 0.5 and not stage.measures_position


def test_home_sets_the_present_position_as_zero(stage):
    assert stage.position().counts == 700
    stage.home()
    motor, = Stepper.made
    sample = stage.position()
    assert (sample.counts, sample.homed, sample.moving, motor.engaged) == (0, True, False, True)


def test_counts_and_speed_are_in_motor_steps(stage):
    stage.home()
    stage.move(0.010, 0.005)
    motor, = Stepper.made
    assert motor.target == 10 * 25 * 16 and motor.limit == 5 * 25 * 16
    Stepper.now += 0.4
    sample = stage.position()
    assert sample.counts == 800 and sample.position == pytest.approx(0.002) and sample.moving


def test_silence_for_half_a_second_switches_the_motor_off_and_loses_the_zero(stage):
    stage.home()
    stage.move(0.010, 0.005)
    Stepper.now += 0.6
    with pytest.raises(DeviceError, match=r"^the Phidget stepper has switched its motor off, because this program did "
                                          r"not communicate for 0\.5 s; stop it, start it and home it again$"):
        stage.position()
    motor, = Stepper.made
    assert motor._place == pytest.approx(0.5 * 5 * 25 * 16) and not motor.engaged
    stage.stop()
    stage.start()
    assert not stage.position().homed
    with pytest.raises(DeviceError, match="does not know its zero; home it first"):
        stage.move(0.0, 0.001)


def test_without_a_failsafe_runs_on_is_infinite(library, monkeypatch):
    def refuse(*_):
        raise PhidgetException(20, "This API call is not supported.")

    monkeypatch.setattr(Stepper, "enableFailsafe", refuse)
    monkeypatch.setattr(Stepper, "resetFailsafe", refuse)
    stage = make_stage("phidget:123,steps_per_mm=25")
    stage.start()
    stage.home()
    stage.move(0.010, 0.005)
    Stepper.now += 1.0
    assert stage.position().position == pytest.approx(0.005)
    assert stage.runs_on == math.inf and stage.describe()["failsafe_s"] is None
    stage.stop()


def test_an_unplugged_controller_raises(stage, monkeypatch):
    stage.home()
    monkeypatch.setattr(Stepper, "attached", False)
    for ask in (stage.position, stage.home, lambda: stage.move(0.0, 0.001)):
        with pytest.raises(DeviceError, match=r"^the Phidget stepper is gone; check its power and the cable, and start "
                                              r"it"):
            ask()
        stage._homed = True
    stage.halt()


def test_errors_of_the_library_are_quoted(stage, monkeypatch):
    def refuse(*_):
        raise PhidgetException(62, "The power supply of your device is outside the\nacceptable range.")

    stage.home()
    monkeypatch.setattr(Stepper, "setTargetPosition", refuse)
    with pytest.raises(DeviceError, match=r"reports an error \(The power supply of your device is outside the "
                                          r"acceptable range\); check its power"):
        stage.move(0.001, 0.001)


def test_a_failing_halt_switches_the_current_off(stage, monkeypatch):
    def refuse(*_):
        raise PhidgetException(28)

    stage.home()
    stage.move(0.010, 0.005)
    monkeypatch.setattr(Stepper, "setVelocityLimit", refuse)
    stage.halt()
    motor, = Stepper.made
    assert not motor.engaged


def test_a_speed_below_one_count_per_second_is_refused(stage):
    stage.home()
    with pytest.raises(InputError, match=r"speed: the speed must be at least 2\.5e-06 m/s; got 1e-06 m/s"):
        stage.move(0.001, 1e-6)


def test_a_failed_start_closes_the_controller(library, monkeypatch):
    def refuse(*_):
        raise PhidgetException(21, "Out of range.")

    monkeypatch.setattr(Stepper, "setAcceleration", refuse)
    stage = make_stage("phidget:123,steps_per_mm=25")
    with pytest.raises(DeviceError, match=r"reports an error \(Out of range\)"):
        stage.start()
    assert not Stepper.made[0].open
    with pytest.raises(DeviceError, match="not started"):
        stage.position()


def test_a_missing_controller_raises(library):
    for name, which in (("124", "no Phidget stepper 124"), ("any", "no Phidget stepper")):
        if name == "any":
            Stepper.attached = False
        with pytest.raises(DeviceError, match=rf"^{which} answers within 2 s; check its power, the cable and the "
                                              r"serial number, close the Phidget Control Panel, and on Linux .*udev"):
            make_stage(f"phidget:{name},steps_per_mm=25").start()


def test_a_top_speed_beyond_the_motor_raises(library):
    with pytest.raises(DeviceError, match=r"is 625 mm/s at 25 steps per mm; give top_speed_mm_s=625 or less"):
        make_stage("phidget:123,steps_per_mm=25,top_speed_mm_s=700").start()


def test_a_missing_package_raises_with_the_remedy(library, monkeypatch):
    for name in library:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(DeviceError, match=r"^a Phidget requires the package phidget22, which is missing; install it "
                                          r"with pip install 'tissue-sim\[phidget\]'$"):
        make_stage("phidget:123,steps_per_mm=25").start()


@pytest.mark.parametrize(("error", "sentence"), [
    ("libusb-1.0.so.0: cannot open shared object file: No such file or directory",
     r"^a Phidget requires the library libusb-1\.0, which is missing; install it, .* sudo apt install libusb-1\.0-0$"),
    ("wrong ELF class",
     r"^the library of the package phidget22 cannot be loaded \(wrong ELF class\); install the package again"),
])
def test_a_missing_library_raises_with_the_remedy(library, monkeypatch, error, sentence):
    def refuse():
        raise OSError(error)

    monkeypatch.setattr(library["Phidget22.Phidget"].Phidget, "getLibraryVersion", staticmethod(refuse))
    with pytest.raises(DeviceError, match=sentence):
        make_stage("phidget:123,steps_per_mm=25").start()
    assert not Stepper.made


@pytest.mark.skipif(importlib.util.find_spec("Phidget22") is None, reason="starts the maker's own library, "
                    "which comes with the extra 'phidget', and is not installed")
def test_the_real_package_without_a_controller(capfd, monkeypatch):
    """Without a controller, `start` raises one message, and prints nothing."""
    monkeypatch.setattr(phidget, "_TIMES", replace(phidget._TIMES, attach_ms=100))
    with pytest.raises(DeviceError) as caught:
        make_stage("phidget:1,steps_per_mm=25").start()
    there = ctypes.util.find_library("usb-1.0")
    wanted = "no Phidget stepper 1 answers" if there else "a Phidget requires the library libusb-1.0"
    assert str(caught.value).startswith(wanted)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("name", "sentence"), [
    ("phidget:", r"phidget\.name: the serial number of the controller, or 'any', is missing; give it first, as in "
                 r"phidget:1"),
    ("phidget:steps_per_mm=25", "the serial number of the controller, or 'any', is missing"),
    ("phidget:mine,steps_per_mm=25", "serial: the name must begin with the serial number of the controller or 'any', "
     ".*; got 'mine'"),
    ("phidget:123", "steps_per_mm: a setting of the motor must be finite and not 0, as in "
     "phidget:123456,steps_per_mm=25; got 0"),
    ("phidget:123,steps_per_mm=25,microsteps=0", "microsteps: a setting of the motor must be finite and above 0, .*; "
     "got 0"),
    ("phidget:123,steps_per_mm=25,top_speed_mm_s=-1", r"top_speed_mm_s: a setting of the motor must be finite and "
     r"above 0, .*; got -0\.001"),
    ("phidget:123,steps_per_mm=25,highest_mm=-1",
     r"limits: lowest must be 0 or less and highest above 0; got 0 to -0\.001 m"),
    ("phidget:123,steps_per_m=25", "steps_per_m: unknown setting; did you mean 'steps_per_mm'"),
])
def test_invalid_settings_are_refused(name, sentence):
    with pytest.raises(InputError, match=sentence):
        make_stage(name)


def test_describe_states_what_is_not_detectable():
    described = make_stage("phidget:123,steps_per_mm=25").describe()
    assert described["stall"] == "not detectable" and described["resolution_mm"] == pytest.approx(0.0025)
    assert described["verified"] == "against a stand-in for its library only"
