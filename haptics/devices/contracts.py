"""Interfaces of force sensors, stages and haptic devices.

The constructor of a device opens no connection, so an unstarted device can be pickled and sent to the process that uses
it; `start` opens the connection. Each device is used by one thread; only `Stage.halt` may be called from any thread.
All methods raise `DeviceError` when the device does not answer or answers nonsense.
"""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, Screw
from tissue_sim.public_names import OldName, rename_old_members_of_subclass

if TYPE_CHECKING:
    # Imported for type checkers only: the help of commands that name devices imports no numpy.
    from tissue_sim.experiment.experiment import Approach

#: Signature of `HapticDevice.set_approach`.
_SetApproach = Callable[[Any, "Approach | None"], None]


class DeviceError(RuntimeError):
    """A device is missing, does not answer, or answers nonsense; the message names the cause and the remedy."""


class SampleStatus(IntFlag):
    """Faults of a sample as bits; 0 means no fault."""

    GOOD = 0
    #: A channel is at the end of its range: the true value may be larger.
    SATURATED = 1
    #: Samples before this one were lost; the gap in the sequence numbers gives their number.
    GAP = 2
    #: The device itself reports a fault.
    FAULT = 4
    #: The stage is at one of its limit switches.
    LIMIT = 8


#: Samples that most sensors keep until they are read; older ones are lost.
SAMPLE_BUFFER = 4096


@dataclass(frozen=True, slots=True)
class ForceSample:
    """One sample of a force sensor.

    Attributes:
        counts: Raw counts from the device, one per channel, before the tare.
        values: Forces, N, and torques, N m, one per channel, after the tare; signs follow the sensor's data sheet.
        sequence: Number of the sample since the start; a missing number is a lost sample.
        status: Bits of `SampleStatus`.
        received: Time of receipt by this program, s on the clock of `time.monotonic`.
    """

    counts: tuple[int, ...]
    values: tuple[float, ...]
    sequence: int
    status: int
    received: float


class ForceSensor(ABC):
    """A sensor that samples one or more forces and torques at its own rate.

    Attributes:
        channels: Names of the values, such as ``("Fz",)`` or ``("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")``.
        rate: Sampling rate, Hz.
    """

    channels: tuple[str, ...]
    rate: float

    @abstractmethod
    def start(self) -> None:
        """Connect and begin to sample; has no effect on a started sensor.

        Raises:
            DeviceError: The sensor does not answer.
        """

    @abstractmethod
    def read(self) -> tuple[ForceSample, ...]:
        """Return all samples received since the last call, oldest first, without waiting.

        Raises:
            DeviceError: The sensor is not started or does not answer.
        """

    @abstractmethod
    def tare(self) -> None:
        """Set the present load as zero for later `ForceSample.values`; counts do not change.

        Raises:
            DeviceError: The sensor is not started or does not answer.
        """

    @abstractmethod
    def stop(self) -> None:
        """End sampling and disconnect; has no effect on a stopped sensor. A stopped sensor can be started again."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return metadata for files of samples: back-end, range, resolution. Keys carry units, values have JSON types.

        A sensor that reports such data itself must be started before this call.
        """


@dataclass(frozen=True, slots=True)
class StageSample:
    """Sample of a stage: position, state of motion and homing, and time of the reading.

    Attributes:
        counts: Counts of the encoder or the motor.
        position: Position relative to the zero set by `Stage.home`, m, positive into the tissue.
        moving: True while the stage moves or homes.
        homed: True once the zero is known.
        sequence: Number of the sample since the start.
        status: Bits of `SampleStatus`.
        received: Time of receipt by this program, s on the clock of `time.monotonic`.
        requested: Time of the request by this program, s on the same clock; the position was read between `requested`
            and `received`. None: the position was read at `received`.
    """

    counts: int
    position: float
    moving: bool
    homed: bool
    sequence: int
    status: int
    received: float
    requested: float | None = None

    @property
    def earliest_reading_time(self) -> float:
        """The earliest time at which the position can have been read, s."""
        return self.received if self.requested is None else min(self.requested, self.received)

    earliest = OldName("earliest_reading_time")


@dataclass(frozen=True)
class StageLimits:
    """Travel range, `lowest` to `highest` in m, and top `speed` of a stage in m/s."""

    lowest: float
    highest: float
    speed: float

    @classmethod
    def from_settings(cls, settings: Mapping[str, float]) -> StageLimits:
        """Return limits from the settings ``lowest_mm``, ``highest_mm`` and ``top_speed_mm_s``."""
        return cls(settings["lowest_mm"] * 1e-3, settings["highest_mm"] * 1e-3, settings["top_speed_mm_s"] * 1e-3)

    def require_within_limits(self, position: float, speed: float, slowest: float = 0.0) -> None:
        """Raise an error for a target or a speed outside the limits.

        Args:
            position: Target, m.
            speed: Speed, m/s.
            slowest: Lowest speed of the stage, m/s.

        Raises:
            InputError: The position or the speed is outside the limits; its field is ``position`` or ``speed``.
        """
        if not self.lowest <= position <= self.highest:
            raise InputError(f"the target position must be {self.lowest:g} to {self.highest:g} m; got {position:g} m",
                             field="position")
        if not (0 < speed <= self.speed and speed >= slowest):
            least = f"{slowest:.3g} m/s or more" if slowest else "above zero"
            raise InputError(f"the speed of the stage must be {least} and at most {self.speed:g} m/s; got {speed:g} "
                             "m/s", field="speed")

    require = OldName("require_within_limits")


class Stage(ABC):
    """A linear stage that moves a tool along one axis.

    Attributes:
        limits: Travel range and top speed.
        measures_position: True if `position` returns an encoder's reading; False if it returns the commanded position,
            in which a stalled motor is invisible.
        runs_on: Longest time that the stage keeps moving after this program stops communicating, s; `math.inf`: it
            moves to its target. A call of `position` counts as communication.
        supports_force_control: whether `move` may be called at each poll, so that a recorder can control the force.
    """

    limits: StageLimits
    measures_position: bool
    runs_on: float
    supports_force_control: bool = False

    @abstractmethod
    def start(self) -> None:
        """Connect without moving; has no effect on a started stage.

        Raises:
            DeviceError: The stage does not answer.
        """

    @abstractmethod
    def home(self) -> None:
        """Begin the search for the zero of the position and return at once.

        Raises:
            DeviceError: The stage is not started or does not answer.
        """

    @abstractmethod
    def move(self, position: float, speed: float) -> None:
        """Begin a motion to a position, m, at a speed, m/s, and return at once; replaces a motion in progress.

        Raises:
            InputError: The position is outside `limits`, or the speed is zero, negative or too high.
            DeviceError: The stage is not started, is not homed, or does not answer.
        """

    @abstractmethod
    def position(self) -> StageSample:
        """Return the present position as a sample, with its time and the state of the stage.

        Raises:
            DeviceError: The stage is not started or does not answer.
        """

    @abstractmethod
    def halt(self) -> None:
        """Stop the motion at once. May be called from any thread at any time, also before `start` and after `stop`."""

    @abstractmethod
    def stop(self) -> None:
        """Halt and disconnect; has no effect on a stopped stage. A stopped stage can be started again."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return metadata for files of motions: back-end, resolution. Keys carry units, values have JSON types.

        A stage that reports such data itself must be started before this call.
        """


@dataclass(frozen=True)
class Bench:
    """The two devices of an indentation test: a force sensor and the stage that moves the tool."""

    sensor: ForceSensor
    stage: Stage


class HapticDevice(ABC):
    """A haptic device: supplies the pose of the tool and applies a wrench to the hand in every tick of a loop.

    Attributes:
        largest_force: Largest force that the device can apply or is allowed to apply, N. The force limits of a loop
            should not exceed it.
    """

    largest_force: float = math.inf

    def start(self) -> None:
        """Connect and apply zero force.

        Raises:
            DeviceError: The device does not answer.
        """
        return

    @abstractmethod
    def pose(self, time: float) -> Pose | None:
        """Return the pose of the tool.

        Args:
            time: Time since the loop, or the motion, began, s; it is constant while the loop is paused.

        Returns:
            The pose in the frame of the scene, or None if the pose is unknown.
        """

    @abstractmethod
    def render(self, wrench: Screw) -> None:
        """Apply a force, N, and a torque about the tool's deepest point, N m, to the hand until the next tick."""

    def stop(self) -> None:
        """Apply zero force and disconnect; has no effect on a stopped device. A stopped device can be started again."""
        return

    def continue_from_pose(self, pose: Pose) -> None:
        """Continue from the last pose of the previous device, without a jump; devices with a fixed start ignore it."""
        return

    take_over = OldName("continue_from_pose")

    def set_approach(self, approach: Approach | None) -> None:
        """Set the approach (axis and contact height of a tool) by which depths become poses.

        Devices that have an approach already, and devices without depths, ignore the call.
        """
        return

    def go_along(self, approach: Approach | None) -> None:
        """Do nothing. Deprecated name of `set_approach`."""
        warnings.warn("HapticDevice.go_along is deprecated; use set_approach", DeprecationWarning, stacklevel=2)

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Keep the old names ``go_along`` of `set_approach` and ``take_over`` for one release, with a warning."""
        super().__init_subclass__(**keywords)
        rename_old_members_of_subclass(cls, {"take_over": "continue_from_pose"})
        own = vars(cls)
        if "go_along" in own and "set_approach" not in own:
            warnings.warn(f"{cls.__name__}.go_along is deprecated; name the method set_approach", DeprecationWarning,
                          stacklevel=2)
            cls.set_approach = own["go_along"]  # type: ignore[method-assign]
        elif "set_approach" in own and "go_along" not in own:
            method = _make_deprecated_go_along_method(own["set_approach"])
            cls.go_along = method  # type: ignore[method-assign,assignment]

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Begin to move the tool to a depth, if the device is a steerable motion such as `TargetFollowingMotion`.

        Args:
            depth: Target along the tool's axis, measured from the height of first contact, m.
            across: Coordinates x and y, m, where the tool's axis meets the height of first contact; None: unchanged.

        Raises:
            InputError: The device cannot be steered, or the depth is not a finite number.
        """
        raise InputError(f"a target requires a steerable motion; got a {type(self).__name__}. Switch to a "
                         "TargetFollowingMotion first", field="aim")

    def describe(self) -> dict[str, Any]:
        """Return metadata for reports: back-end, largest force. Keys carry units, values have JSON types."""
        return {"device": type(self).__name__}


def _make_deprecated_go_along_method(set_approach: _SetApproach) -> _SetApproach:
    """Return the method ``go_along``, which warns and calls `set_approach` of the same class."""

    def go_along(self: Any, approach: Approach | None) -> None:
        """Call `set_approach` of the same class, with a deprecation warning."""
        warnings.warn("HapticDevice.go_along is deprecated; use set_approach", DeprecationWarning, stacklevel=2)
        set_approach(self, approach)

    return go_along


class Motion(HapticDevice):
    """A haptic device that ignores the force: its pose is a function of time alone.

    Attributes:
        approach: Axis and contact height of the tool whose depths the motion gives; None: the approach of the scene.
    """

    approach: Approach | None = None

    def render(self, wrench: Screw) -> None:
        """Ignore the wrench: a motion has no actuator."""
        return

    def set_approach(self, approach: Approach | None) -> None:
        """Set the approach of a tool, unless an approach was set before."""
        if self.approach is None:
            self.approach = approach


class AxialMotion(Motion):
    """A motion along the tool's axis, given as depth against time."""

    @abstractmethod
    def depth(self, time: float) -> float | None:
        """Return the depth of the tool, m, positive into the tissue, at a time in s since the motion began.

        None if the pose is unknown.
        """

    def pose(self, time: float) -> Pose | None:
        """Return the pose at `depth` on the approach of the tool, or on the z axis without an approach."""
        depth = self.depth(time)
        if depth is None:
            return None
        return Pose((0.0, 0.0, -depth)) if self.approach is None else self.approach.pose(depth)
