"""What a viewer shows, and what a viewer is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

import numpy as np

import tissue_sim as ts
from scenes.viewer.calibration_run import CalibrationState
from scenes.viewer.measurement import Measurement, Residual
from scenes.viewer.revolution import Surface
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace
from tissue_sim.snapshot import Snapshot


class Phase(Enum):
    """What the simulation is doing; the value is the word for it."""

    STARTING = "starting"
    RUNNING = "running"
    PAUSED = "paused"
    DIED = "stopped"


@dataclass(frozen=True)
class Readouts:
    """Numbers of the moment; SI.

    Attributes:
        time: of the loop, s.
        depth, force, stiffness: of the tool along its axis, m; along z, N, N/m.
        step_time: median of the last half second, s.
        iterations: linear solves a tick, the mean of the same time.
        rate: ticks a second of wall time.
        late: share of the ticks so far that began late or were missed.
        status: of the tissue's newest answer, in words.
        warning: why its force is not that of an equilibrium, with what to do; empty where it is.
        doubtful: answers of the last second that were none of an equilibrium.
        mesh: of the tissue, in words.
        across: force along x and y, N.
    """

    time: float
    depth: float
    force: float
    stiffness: float
    step_time: float
    iterations: float
    rate: float
    late: float
    status: str
    mesh: str = ""
    warning: str = ""
    doubtful: int = 0
    across: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Curves:
    """What the plots show. A new object where something in it is new.

    Attributes:
        model: the whole test with the material as it is; None until it is computed.
        before: another curve to compare with, and its name.
        measurement: None where nothing was measured in this scene.
        residual: model minus measurement.
        trace: what was felt since the last reset.
        replayed: time of the loop (s) and force (N) of the recording whose motion is repeated; None where none is.
        number: grows with the trace.
        felt: whether a hand is at a device, so that the force on it is drawn beside that of the tissue.
        computing: whether `model` and `residual` are still those of an earlier material or test.
    """

    model: ts.Recording | None = None
    before: tuple[str, ts.Recording] | None = None
    measurement: Measurement | None = None
    residual: Residual | None = None
    trace: Trace | None = None
    replayed: tuple[np.ndarray, np.ndarray] | None = None
    number: int = 0
    felt: bool = False
    computing: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment.

    Attributes:
        phase: of the simulation.
        message: what it does, or why it ended and what to do.
        scene: what is looked at.
        snapshot: the tissue; None before the first.
        readouts: None before the first tick.
        curves: for the plots.
        motion: ``"hand"``, ``"protocol"``, ``"recording"``, or ``"device"`` for a device or any other motion.
        target: where a hand points, along the tool's axis, m.
        surface: of the tissue where its snapshot has no fields to draw, m, in the frame of the scene; else None.
        calibration: recordings that were uploaded, and their fit.
        across: x and y where the axis of the tool that a hand points meets the height of the touch, m.
    """

    phase: Phase
    message: str
    scene: Scene
    snapshot: Snapshot | None
    readouts: Readouts | None
    curves: Curves
    motion: str
    target: float
    surface: Surface | None = None
    calibration: CalibrationState = field(default_factory=CalibrationState)
    across: tuple[float, float] = (0.0, 0.0)


class Commands(Protocol):
    """What a viewer may ask for: a name of a command of `Session` with its values."""

    def post(self, command: str, *, reply: Callable[[str | None], None] | None = None, **values: Any) -> None:
        """Ask; `reply` gets None when it is done, or a sentence that says why not."""


class Viewer(Protocol):
    """A back-end that shows frames. `show` is called about 30 times a second and must not block."""

    def show(self, frame: Frame) -> None:
        """Show a frame, or skip it."""

    def close(self) -> None:
        """Nothing more comes."""


class NullViewer:
    """Shows nothing, for runs without a screen.

    Attributes:
        frames: how many frames came; latest: the last of them.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.latest: Frame | None = None

    def show(self, frame: Frame) -> None:
        self.frames, self.latest = self.frames + 1, frame

    def close(self) -> None:
        pass
