"""What a force sensor, a stage and a haptic device are to the rest of the house.

Making one touches no hardware, so that it can be sent to the process that uses it; `start` does. Each is used by one
thread, but for `Stage.halt`. A device that does not answer, or not as it should, raises `DeviceError`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.experiment.approach import Approach
from tissue_sim.pose import Pose, Screw


class DeviceError(RuntimeError):
    """A device that is not there, does not answer, or answers nonsense; one sentence, with what to do."""


class SampleStatus(IntFlag):
    """What is wrong with a sample; 0: nothing."""

    GOOD = 0
    #: A channel is at the end of its range: the true value may be larger.
    SATURATED = 1
    #: Samples before this one were lost; the sequence numbers say how many.
    GAP = 2
    #: The device itself reports a fault.
    FAULT = 4
    #: A stage stands at one of its limit switches.
    LIMIT = 8


@dataclass(frozen=True, slots=True)
class ForceSample:
    """What a force sensor has measured at one moment.

    Attributes:
        counts: as the device has sent them, one for each channel, before the tare.
        values: of the channels, less the tare, N and N m; positive as the sensor's data sheet says.
        sequence: number of the sample since the start; a number that is left out was lost.
        status: bits of `SampleStatus`.
        received: when this program received it, s on the clock of `time.monotonic`.
    """

    counts: tuple[int, ...]
    values: tuple[float, ...]
    sequence: int
    status: int
    received: float


class ForceSensor(ABC):
    """Measures one force or several, at a rate of its own.

    Attributes:
        channels: names of the values, such as ``("Fz",)`` or ``("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")``.
        rate: samples in a second, Hz.
    """

    channels: tuple[str, ...]
    rate: float

    @abstractmethod
    def start(self) -> None:
        """Connect, and begin to sample; nothing where it does already.

        Raises:
            DeviceError: it is not there.
        """

    @abstractmethod
    def read(self) -> tuple[ForceSample, ...]:
        """All samples that came since the last call, in their order; does not wait for more.

        Raises:
            DeviceError: it was not started, or does not answer.
        """

    @abstractmethod
    def tare(self) -> None:
        """Let what the sensor measures now count as zero; the counts stay as they are. Raises as `read`."""

    @abstractmethod
    def stop(self) -> None:
        """End sampling, and disconnect; nothing where it is stopped. It can be started again."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What a file of its samples should say of it: back-end, range, resolution; units in the keys, types of JSON.

        Of a sensor that tells such things itself, call it when it is started.
        """


@dataclass(frozen=True, slots=True)
class StageSample:
    """Where a stage is.

    Attributes:
        counts: of its encoder or motor.
        position: m, positive into the tissue, from where `Stage.home` has put the zero.
        moving: whether it is on its way.
        homed: whether the zero is known.
        sequence: number of the sample since the start.
        status: bits of `SampleStatus`.
        received: when this program received it, s on the clock of `time.monotonic`.
        requested: when this program requested it, s on the same clock; the position was read between `requested` and
            `received`. None: the position was read at `received`.
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
    def earliest(self) -> float:
        """The earliest time at which the position can have been read, s."""
        return self.received if self.requested is None else min(self.requested, self.received)


@dataclass(frozen=True)
class StageLimits:
    """What a stage can do: from `lowest` to `highest`, m, no faster than `speed`, m/s."""

    lowest: float
    highest: float
    speed: float

    @classmethod
    def of(cls, settings: Mapping[str, float]) -> StageLimits:
        """From the settings ``lowest_mm``, ``highest_mm`` and ``top_speed_mm_s``."""
        return cls(settings["lowest_mm"] * 1e-3, settings["highest_mm"] * 1e-3, settings["top_speed_mm_s"] * 1e-3)

    def require(self, position: float, speed: float, slowest: float = 0.0) -> None:
        """Refuse a motion that leaves them.

        Args:
            position: m. speed: m/s. slowest: m/s, that the stage can do.

        Raises:
            InputError: with the field ``position`` or ``speed``.
        """
        if not self.lowest <= position <= self.highest:
            raise InputError(f"{position:g} m is out of reach; give {self.lowest:g} to {self.highest:g} m",
                             field="position")
        if not (0 < speed <= self.speed and speed >= slowest):
            least = f"{slowest:.3g} m/s or more" if slowest else "a speed above zero"
            raise InputError(f"{speed:g} m/s; give {least} and up to {self.speed:g} m/s", field="speed")


class Stage(ABC):
    """Moves a tool along one axis.

    Attributes:
        limits: see there.
        measures_position: whether `position` tells what an encoder says; otherwise what was commanded, and a motor that
            stands although it is driven is not seen there.
        runs_on: how long the stage may move on when this program falls silent, s; `math.inf`: to where it was sent.
            `position` counts as a sign of life.
    """

    limits: StageLimits
    measures_position: bool
    runs_on: float

    @abstractmethod
    def start(self) -> None:
        """Connect; nothing moves.

        Raises:
            DeviceError: it is not there.
        """

    @abstractmethod
    def home(self) -> None:
        """Begin to look for the zero of its position; returns at once.

        Raises:
            DeviceError: it was not started, or does not answer.
        """

    @abstractmethod
    def move(self, position: float, speed: float) -> None:
        """Begin to move to a position, m, at a speed, m/s; returns at once. A motion that goes on is given up.

        Raises:
            InputError: outside of `limits`, or a speed that is not positive.
            DeviceError: it was not started, is not homed, or does not answer.
        """

    @abstractmethod
    def position(self) -> StageSample:
        """Where it is now.

        Raises:
            DeviceError: it was not started, or does not answer.
        """

    @abstractmethod
    def halt(self) -> None:
        """Stand still at once; from any thread, at any time, also before `start` and after `stop`."""

    @abstractmethod
    def stop(self) -> None:
        """Halt, and disconnect; nothing where it is stopped. It can be started again."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What a file of its motion should say of it: back-end, resolution; units in the keys, types of JSON.

        Of a stage that tells such things itself, call it when it is started.
        """


@dataclass(frozen=True)
class Bench:
    """What measures a specimen: a sensor, and the stage that moves the tool."""

    sensor: ForceSensor
    stage: Stage


class HapticDevice(ABC):
    """Gives a pose and takes a wrench, tick after tick; the loop renders to it.

    Attributes:
        largest_force: that it can give, or is allowed to, N; the limits of a loop should not be above it.
    """

    largest_force: float = math.inf

    def start(self) -> None:
        """Connect, with no force.

        Raises:
            DeviceError: it is not there.
        """
        return

    @abstractmethod
    def pose(self, time: float) -> Pose | None:
        """Where the tool is.

        Args:
            time: s since the loop, or the motion, began; it stands still while the loop is paused.

        Returns:
            In the frame of the scene; None: not known.
        """

    @abstractmethod
    def render(self, wrench: Screw) -> None:
        """Give this force, N, and torque about the tool's deepest point, N m, to the hand, until the next tick."""

    def stop(self) -> None:
        """No force, and disconnect; nothing where it is stopped. It can be started again."""
        return

    def take_over(self, pose: Pose) -> None:
        """Go on from here, where another source has left the tool: of motions that can begin anywhere."""
        return

    def go_along(self, approach: Approach | None) -> None:
        """Let the way be told from this approach of a tool: of motions that were made for none."""
        return

    def aim(self, depth: float, across: tuple[float, float] | None = None) -> None:
        """Go to a depth, m: of motions that are steered by somebody.

        Args:
            depth: along the tool's own axis, from the height of the touch on, m.
            across: x and y where the tool's axis meets that height, m; None: where it is aimed at already.

        Raises:
            InputError: this one is not, or no depth.
        """
        raise InputError(f"a {type(self).__name__} goes where it likes and cannot be steered; follow a HandMotion "
                         "first", field="aim")

    def describe(self) -> dict[str, Any]:
        """What a report should say of it: back-end, largest force; units in the keys, types of JSON."""
        return {"device": type(self).__name__}


class Motion(HapticDevice):
    """A device that ignores the force: the same poses for the same times.

    Attributes:
        approach: of the tool whose way it tells: where its axis is, and how it leans; None: it is that of the scene.
    """

    approach: Approach | None = None

    def render(self, wrench: Screw) -> None:
        return

    def go_along(self, approach: Approach | None) -> None:
        if self.approach is None:
            self.approach = approach


class AxialMotion(Motion):
    """A motion along the tool's own axis."""

    @abstractmethod
    def depth(self, time: float) -> float | None:
        """How far the tool has gone at a time since the motion began, s; m, positive into the tissue. None: the pose is
        not known."""

    def pose(self, time: float) -> Pose | None:
        depth = self.depth(time)
        if depth is None:
            return None
        return Pose((0.0, 0.0, -depth)) if self.approach is None else self.approach.pose(depth)
