"""Frames of a session, and the interface of the viewers that display them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

import numpy as np

import tissue_sim as ts
from scenes.viewer.calibration_run import CalibrationState
from scenes.viewer.measurement import ForceResidualCurves, Measurement
from scenes.viewer.revolution import TriangulatedSurface
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace
from tissue_sim.snapshot import Snapshot


class Phase(Enum):
    """Phase of the simulation; the value is the word that the page shows."""

    STARTING = "starting"
    RUNNING = "running"
    PAUSED = "paused"
    DIED = "stopped"


@dataclass(frozen=True)
class FrameAndPlotRateSettings:
    """Rates of the frames of a session.

    Attributes:
        rate: Frames per second, Hz.
        frames_per_plot: Number of frames between two updates of the plots.
    """

    rate: float = 30.0
    frames_per_plot: int = 3


#: Rates of every session.
FRAMES = FrameAndPlotRateSettings()


@dataclass(frozen=True)
class SimulationReadouts:
    """Present numbers of the simulation.

    Attributes:
        time: Time of the loop, s.
        depth: Displacement of the tool along its axis, m.
        force: Force of the tissue on the tool along z, N.
        stiffness: Stiffness of the tissue along z, N/m.
        step_time: Wall time of a solver step, median over the last 0.5 s, s.
        iterations: Linear solves per tick, mean over the last 0.5 s.
        rate: Ticks per second of wall time, Hz.
        late: Fraction of all ticks that began late or were missed.
        status: Status of the newest force, in words.
        mesh: Resolution of the mesh and error of its force, in words.
        warning: Why the newest force is not an accurate equilibrium force, with a remedy; empty if it is.
        unconverged: Number of ticks in the last second whose force is not an accurate equilibrium force.
        across: Force of the tissue on the tool along x and y, N.
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
    unconverged: int = 0
    across: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class PlotCurves:
    """Curves for the plots; each change creates a new object.

    Attributes:
        model: Simulation of the whole test with the present material; None until it is computed.
        compared: Name and recording of a model curve that was kept for comparison; None if there is none.
        measurement: Measurement of the scene; None if there is none.
        residual: Model minus measurement; None if one of the two is missing.
        trace: Motion and force since the last reset.
        replayed: Time of the loop, s, and force, N, of the recording whose motion is repeated; None if none is.
        number: Number that changes with each change of the trace.
        has_hand_force: Whether a haptic device renders the force, so that the force on the hand is drawn too.
        computing: Whether `model` and `residual` still belong to an earlier material or test.
    """

    model: ts.Recording | None = None
    compared: tuple[str, ts.Recording] | None = None
    measurement: Measurement | None = None
    residual: ForceResidualCurves | None = None
    trace: Trace | None = None
    replayed: tuple[np.ndarray, np.ndarray] | None = None
    number: int = 0
    has_hand_force: bool = False
    computing: bool = False


@dataclass(frozen=True, eq=False)
class SessionFrame:
    """State of a session at one moment, for display.

    Attributes:
        phase: Phase of the simulation.
        message: Present activity, or why the simulation has stopped and the remedy.
        scene: The displayed scene.
        snapshot: State of the tissue; None before the first one.
        readouts: Present numbers; None before the first tick.
        curves: Curves for the plots.
        motion: ``"hand"``, ``"protocol"``, ``"recording"``, or ``"device"`` for a device or any other motion.
        target: Commanded displacement of the tool along its axis, m.
        surface: Surface of tissue whose snapshot has no fields to draw, in the frame of the scene, m; otherwise None.
        calibration: Uploaded recordings and their fit.
        across: Commanded x and y at which the tool's axis crosses the undeformed surface, m.
    """

    phase: Phase
    message: str
    scene: Scene
    snapshot: Snapshot | None
    readouts: SimulationReadouts | None
    curves: PlotCurves
    motion: str
    target: float
    surface: TriangulatedSurface | None = None
    calibration: CalibrationState = field(default_factory=CalibrationState)
    across: tuple[float, float] = (0.0, 0.0)


class CommandReceiver(Protocol):
    """Interface of an object that receives commands from a page, such as a `Session`."""

    def post(self, command: str, *, reply: Callable[[str | None], None] | None = None, **values: Any) -> None:
        """Queue a command.

        Args:
            command: Name of a command of `Session`.
            reply: Called with None after the execution, or with a sentence that states why the command was refused.
            values: Arguments of the command.
        """


class FrameViewer(Protocol):
    """Back-end that displays frames; a session calls `show` about 30 times per second, so `show` must not block."""

    def show(self, frame: SessionFrame) -> None:
        """Display a frame, or skip it."""

    def close(self) -> None:
        """Release all resources; no frame follows."""


class NullViewer:
    """Viewer that displays nothing, for runs without a screen.

    Attributes:
        frames: Number of frames received.
        latest: Last frame; None before the first one.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.latest: SessionFrame | None = None

    def show(self, frame: SessionFrame) -> None:
        """Count a frame and keep it as `latest`."""
        self.frames, self.latest = self.frames + 1, frame

    def close(self) -> None:
        """Do nothing: there is no window."""
        pass
