"""What a viewer shows and what it may ask for; no browser in it."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import tissue_sim as ts
from haptics.devices.contracts import HapticDevice, Motion
from haptics.devices.motions import HandMotion, ProtocolMotion
from haptics.loop.loop import LoopSettings
from scenes.viewer.calibration_commands import CALIBRATION_COMMANDS, take_result
from scenes.viewer.calibration_run import CalibrationRun
from scenes.viewer.frame import Curves, Frame, Phase, Viewer
from scenes.viewer.live_simulation import SETTINGS, LiveSimulation
from scenes.viewer.material_files import save_edited
from scenes.viewer.measurement import gap, motion, typical
from scenes.viewer.model_curve import ModelCurve
from scenes.viewer.reach import require_within_reach, within_reach
from scenes.viewer.requests import differ_in_parameters_only, superseded
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace
from tissue_sim.errors import InputError
from tissue_sim.live_material import require_tissue
from tissue_sim.parameters import parameter_values, with_values

#: Frames a second, and how many of them from one drawing of the plots to the next.
FRAME_RATE, PLOT_EVERY = 30.0, 3
#: How far the motion goes on in a single step, s.
STEP_TIME = 1.0 / FRAME_RATE
#: Largest speed of a tool that follows the mouse, m/s.
HAND_SPEED = 0.1
#: Points of a segment of a protocol.
_POINTS = 21


class Session:
    """Holds the simulation, the curve of the whole test and the trace of what was felt. Close it.

    Commands come from any thread through `post` and are obeyed, in their order, in the thread that asks for frames.

    Args:
        scene: what to look at first.
        resolution: of the loop's simulator.
        curve_resolution: of the whole test's curve.
        settings: of the loop.
        device: that each simulation follows from its beginning on; None: the tool waits for a command.
    """

    def __init__(self, scene: Scene, *, resolution: str = "realtime", curve_resolution: str = "fast",
                 settings: LoopSettings = SETTINGS, device: HapticDevice | None = None):
        self.scene, self._device = scene, device
        #: Whether the device is still to be followed, and why it was not.
        self._device_waits, self._refused = False, ""
        self._resolution, self._settings = resolution, settings
        self._requests: queue.SimpleQueue[tuple[str, Callable | None, dict[str, Any]]] = queue.SimpleQueue()
        self._curve, self.calibration = ModelCurve(curve_resolution, scene.solver, scene.reduced), CalibrationRun()
        self._curves, self._trace, self._frames = Curves(before=scene.compared), Trace(), 0
        #: Time from the beginning of a replay, and force, of the recording.
        self._replayed: tuple | None = None
        #: Grows with every point of the trace, and where the trace starts again.
        self._felt = 0
        self._motion, self._target, self._across = "hand", 0.0, (0.0, 0.0)
        #: Whether somebody's hand is at a device; a motion feels nothing.
        self._hand_feels = False
        #: Whether the material was changed while the simulation was starting, so that it still has the old one.
        self._material_is_late = False
        self._simulation = self._begin()

    @property
    def simulation(self) -> LiveSimulation:
        """The simulation that runs now."""
        return self._simulation

    def post(self, command: str, *, reply: Callable[[str | None], None] | None = None, **values: Any) -> None:
        """Ask for one of the commands below, from any thread.

        Args:
            command: one of `COMMANDS`.
            reply: called with None when it is done, or with a sentence that says why not.
            values: arguments of the command.
        """
        if command not in COMMANDS:
            raise ValueError(f"no command {command!r}")
        self._requests.put((command, reply, values))

    def frame(self) -> Frame:
        """Obey what was asked for and look at the simulation."""
        self._obey()
        take_result(self)
        simulation = self._simulation
        records = simulation.poll()
        if self._material_is_late and simulation.phase is Phase.RUNNING:
            self._material_is_late = False
            try:
                simulation.ask("set_parameters", **parameter_values(self.scene.material))
            except InputError:
                # A new simulation begins with that material, or says why it cannot.
                self._begin_anew()
                simulation, records = self._simulation, None
        if self._device_waits and simulation.phase is Phase.RUNNING:
            self._begin_to_follow()
            records = None
        if records is not None and len(records):
            self._felt += self._trace.append(records)
        self._curve.poll()
        if self._frames % PLOT_EVERY == 0:
            self._draw_curves()
        self._frames += 1
        message = simulation.message
        if simulation.phase is Phase.DIED:
            message = f"The simulation has stopped: {message}. Press Restart to begin again."
        elif self._refused:
            message = self._refused
        elif self._curve.problem:
            message = self._curve.problem
        return Frame(simulation.phase, message, self.scene, simulation.snapshot, simulation.readouts, self._curves,
                     self._motion, self._target, simulation.surface, self.calibration.state, self._across)

    def run(self, viewer: Viewer, stop: threading.Event, seconds: float | None = None) -> None:
        """Show frames until `stop` is set, or for so many seconds."""
        began = due = time.monotonic()
        while not stop.is_set() and (seconds is None or time.monotonic() - began < seconds):
            viewer.show(self.frame())
            # A frame that took too long is not caught up with.
            due = max(due + 1.0 / FRAME_RATE, time.monotonic())
            stop.wait(due - time.monotonic())

    def aim(self, depth: float | None = None, across: tuple[float, float] | None = None) -> None:
        """Let the tool go to a place, as a hand would.

        Args:
            depth: along its axis, m; None: as deep as it is.
            across: x and y where its axis meets the height of the touch, m, of tissue in space, kept within reach;
                None: where it is.

        Raises:
            InputError: it stands still in a pause, or is not running.
        """
        simulation = self._simulation
        if simulation.phase is Phase.PAUSED:
            raise InputError("the tool stands still while the motion is paused; press Play to go on, or Reset")
        if self._motion != "hand":
            # What is known here of the tool's place is a frame old: the tool would jump back.
            simulation.ask("follow", device=HandMotion(None, HAND_SPEED))
            self._motion, self._target, self._hand_feels = "hand", simulation.tool_depth, False
            self._across = simulation.tool_across or self._across
        depth = min(max(self._target if depth is None else depth, self.scene.highest), self.scene.deepest)
        place: dict[str, Any] = {"depth": depth}
        if across is not None and simulation.snapshot is not None and simulation.snapshot.in_space:
            place["across"] = within_reach(self.scene, simulation.snapshot, across)
        simulation.ask("aim", **place)
        self._target, self._across = depth, place.get("across", self._across)

    def play(self, text: str, speed: float = 5e-3, repeat: bool = False) -> None:
        """Play a protocol from its beginning, on undeformed tissue.

        Args:
            text: as in `tissue_sim.Protocol.parse`.
            speed: where the protocol states none, m/s.
            repeat: begin again at its end.

        Raises:
            InputError: a fault in the protocol, or one that goes deeper than the scene.
        """
        protocol = ts.Protocol.parse(text, _POINTS, speed)
        require_within_reach(self.scene, protocol, "protocol")
        self._follow("protocol", ProtocolMotion(protocol, repeat, self.scene.experiment.approach))

    def replay(self, speed: float = 1.0) -> None:
        """Repeat the measured motion, `speed` times as fast.

        Raises:
            InputError: nothing was measured in this scene, or it goes deeper than the scene.
        """
        if self.scene.measurement is None:
            raise InputError("nothing was measured in this scene; start the viewer with --measured FILE")
        measured, (recording, _) = motion(self.scene.measurement), typical(self.scene.measurement)
        require_within_reach(self.scene, measured, "recording")
        way = measured.displacement
        if self.scene.highest == 0.0:
            # What trembles about the touch lifts no tool that holds tissue.
            way = np.maximum(way, 0.0)
        self._follow("recording", ProtocolMotion(ts.Protocol(measured.time / speed, way),
                                                 approach=self.scene.experiment.approach))
        if "time" in recording:
            self._replayed = ((recording.time - measured.time[0]) / speed, recording.force)

    def follow(self, device: HapticDevice) -> None:
        """Follow a haptic device, or any motion, on undeformed tissue."""
        device.set_approach(self.scene.experiment.approach)
        self._follow("device", device)

    def pause(self) -> None:
        """Let the motion stand still."""
        self._simulation.ask("pause")

    def resume(self) -> None:
        """Let the motion go on."""
        self._simulation.ask("resume")

    def step(self) -> None:
        """Stand still, but go on for the time of one frame."""
        if self._simulation.phase is not Phase.PAUSED:
            self.pause()
        self._simulation.ask("advance", seconds=STEP_TIME)

    def reset(self) -> None:
        """Lift the tool to the touch, with undeformed tissue."""
        self._follow("hand", self._hand())
        self._target, self._across = 0.0, self._entrance

    def set_parameters(self, values: dict[str, float]) -> None:
        """Change the material while it is felt.

        Raises:
            InputError: what the material or the simulation refuses; nothing is changed.
        """
        self._take_material(with_values(self.scene.material, values), self.scene.source)

    def use_material(self, material: ts.Material, source: str) -> None:
        """Look at another material; one that differs in its parameters only is felt at once.

        Raises:
            InputError: what the simulation refuses; nothing is changed.
        """
        self._take_material(material, source)

    def _take_material(self, material: ts.Material, source: str) -> None:
        require_tissue(material)  # also where no simulation runs that would refuse it
        if (reduced := self.scene.reduced) is not None:
            reduced.require_material(material)
        scene = replace(self.scene, material=material, source=source)
        if not differ_in_parameters_only(self.scene.material, material):
            self._change(scene)
            return
        if self._simulation.phase in (Phase.RUNNING, Phase.PAUSED):
            self._simulation.ask("set_parameters", **parameter_values(material))
        # Another simulation would begin with it; one that is about to run gets it then.
        self._material_is_late = self._simulation.phase is Phase.STARTING
        self.scene = scene
        self._curve.ask(self._test())

    def save_material(self, folder: Path, name: str) -> None:
        """Write the material as it is now into a new file.

        Raises:
            InputError: a name that is taken, or none.
        """
        path = save_edited(self.scene.material, folder, name, source=self.scene.source)
        self.scene = replace(self.scene, source=path.name)

    def use_scene(self, name: str, tool: ts.Tool | None = None, friction: str | float | None = None) -> None:
        """Look at another scene, tool or interface.

        Raises:
            InputError: what does not fit.
        """
        self._change(self.scene.with_scene(name, tool=tool, friction=friction))

    def keep_curve(self, name: str = "") -> None:
        """Keep the model's curve as it is now, to compare later ones with it; without a name forget the one kept."""
        kept = (name, self._curve.recording) if name and self._curve.recording is not None else None
        self._curves = replace(self._curves, before=kept)

    def restart(self) -> None:
        """Begin again with a new process."""
        self._begin_anew()

    @property
    def waits_for_curve(self) -> bool:
        """Whether the curve of the newest model is still to come, or to be drawn."""
        return self._curve.busy or self._curve.recording is not self._curves.model

    def close(self) -> None:
        """End the processes."""
        if self._simulation is not None:
            self._simulation.close()
        self._curve.close()
        self.calibration.close()

    def _obey(self) -> None:
        requests = []
        while not self._requests.empty():
            requests.append(self._requests.get())
        for number, (command, reply, values) in enumerate(requests):
            problem = None
            try:
                if not superseded(command, values, requests[number + 1:]):
                    COMMANDS[command](self, **values)
            except InputError as error:
                problem = str(error)
            if reply is not None:
                reply(problem)

    def _change(self, scene: Scene) -> None:
        """Show another scene; `Scene` has refused a bad one before anything is changed."""
        other = scene.kind is not self.scene.kind
        self.scene = scene
        if other:
            self._curves = Curves()
            self._curve.forget()
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._simulation.close()
        self._simulation = self._begin()

    def _begin(self) -> LiveSimulation:
        self._motion, self._target, self._across, self._hand_feels = "hand", 0.0, self._entrance, False
        self._forget_trace()
        self._material_is_late = False
        self._device_waits = self._device is not None
        simulation = LiveSimulation(self.scene.model, self._hand(), solver=self.scene.solver,
                                    resolution=self._resolution, settings=self._settings, reduced=self.scene.reduced)
        self._curve.ask(self._test())
        return simulation

    def _hand(self) -> HandMotion:
        """At the touch."""
        return HandMotion(0.0, HAND_SPEED, approach=self.scene.experiment.approach)

    @property
    def _entrance(self) -> tuple[float, float]:
        """Where the tool first touches."""
        x, y, _ = self.scene.experiment.tool_pose(0.0).position
        return x, y

    def _follow(self, kind: str, device: HapticDevice) -> None:
        simulation = self._simulation
        if simulation.phase is Phase.PAUSED:
            simulation.ask("resume")
        # In one command: between two the tool would be drawn out of tissue that it is bonded to.
        simulation.ask("follow", device=device, anew=True)
        simulation.forget()
        self._forget_trace()
        self._motion, self._hand_feels = kind, not isinstance(device, Motion)

    def _begin_to_follow(self) -> None:
        self._device_waits, self._refused = False, ""
        if self._device is not None:
            try:
                self.follow(self._device)
            except InputError as error:
                self._refused = f"{error}. Press Restart to try again."

    def _forget_trace(self) -> None:
        self._trace.clear()
        self._replayed = None
        self._felt += 1

    def _test(self) -> ts.Model:
        """The whole test whose curve is computed: with the measured motion, where there is one."""
        model, measurement = replace(self.scene.model, rig=self.scene.rig), self.scene.measurement
        if measurement is None:
            return model
        return replace(model, experiment=replace(model.experiment, protocol=motion(measurement)))

    def _draw_curves(self) -> None:
        curves, trace, measurement = self._curves, self._trace, self.scene.measurement
        recording = self._curve.recording
        if recording is not curves.model or measurement is not curves.measurement:
            curves = replace(curves, model=recording, measurement=measurement, residual=gap(recording, measurement))
        if self._felt != curves.number or curves.trace is None:
            replayed = None
            if self._replayed is not None and len(trace):
                time, force = self._replayed
                replayed = (trace.time[0] + time, force)
            curves = replace(curves, trace=trace, replayed=replayed, number=self._felt)
        if (self._hand_feels, self._curve.busy) != (curves.felt, curves.computing):
            curves = replace(curves, felt=self._hand_feels, computing=self._curve.busy)
        self._curves = curves


#: What a viewer may ask a session for, by name; the values of a command are its arguments.
COMMANDS: dict[str, Callable[..., None]] = {
    "aim": Session.aim,
    "play": Session.play,
    "replay": Session.replay,
    "follow": Session.follow,
    "pause": Session.pause,
    "resume": Session.resume,
    "step": Session.step,
    "reset": Session.reset,
    "set_parameters": Session.set_parameters,
    "use_material": Session.use_material,
    "save_material": Session.save_material,
    "use_scene": Session.use_scene,
    "keep_curve": Session.keep_curve,
    "restart": Session.restart,
    **CALIBRATION_COMMANDS,
}
