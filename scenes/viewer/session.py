"""Session of the viewer: runs the simulation, executes commands and produces frames, independently of a browser.

A queue holds the requests, with rules for superseded requests and for changes of the material. The tool moves by hand,
along a protocol, or as measured.
"""

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
from haptics.devices.motions import ProtocolMotion, TargetFollowingMotion
from haptics.loop.loop import LoopSettings
from scenes.viewer.background_simulation import ModelCurveWorker
from scenes.viewer.calibration_run import (
    CALIBRATION_COMMANDS,
    SessionCalibrations,
    use_finished_calibration_in_scene,
)
from scenes.viewer.frame import FRAMES, FrameViewer, Phase, PlotCurves, SessionFrame
from scenes.viewer.live_simulation import SETTINGS, LiveSimulation
from scenes.viewer.material_files import save_edited_material
from scenes.viewer.measurement import (
    compute_force_residual_if_possible,
    find_typical_replicate_and_branches,
    make_first_cycle_motion_protocol,
)
from scenes.viewer.scene import Scene, limit_lateral_position_to_top_and_range, require_depths_within_scene
from scenes.viewer.trace import Trace
from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter_values, with_values
from tissue_sim.realtime.tissue import require_moduli_in_range


class CommandQueue:
    """Thread-safe queue of commands with their arguments and reply functions."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[str, Callable | None, dict[str, Any]]] = queue.SimpleQueue()

    def append_command_thread_safely(self, command: str, reply: Callable[[str | None], None] | None,
                                     values: dict[str, Any]) -> None:
        """Queue a command; any thread may call this method."""
        self._queue.put((command, reply, values))

    def execute_commands_except_superseded(self, run: Callable[[str, dict[str, Any]], None]) -> None:
        """Execute the queued commands in order, except superseded ones; call all reply functions.

        A reply function receives None, or the text of the InputError of `run`.

        Args:
            run: Executes a command with its arguments. Its InputError becomes the reply.
        """
        requests = []
        while not self._queue.empty():
            requests.append(self._queue.get())
        for number, (command, reply, values) in enumerate(requests):
            problem = None
            try:
                if not is_command_superseded(command, values, requests[number + 1:]):
                    run(command, values)
            except InputError as error:
                problem = str(error)
            if reply is not None:
                reply(problem)


def is_command_superseded(command: str, values: dict[str, Any],
                          later: list[tuple[str, Callable | None, dict[str, Any]]]) -> bool:
    """Return whether a later request makes a request unnecessary.

    A later ``aim`` with the same arguments replaces an ``aim``; a directly following ``set_parameters`` of the same
    parameters replaces a ``set_parameters``.

    Args:
        command: Command of the request.
        values: Arguments of the request.
        later: Later requests as command, reply and arguments.
    """
    if command == "aim":
        return any(other == "aim" and values.keys() <= named.keys() for other, _, named in later)
    return (command == "set_parameters" and bool(later) and later[0][0] == command
            and later[0][2]["values"].keys() == values["values"].keys())


def differ_at_most_in_parameter_values(a: ts.Material, b: ts.Material) -> bool:
    """Return whether two materials differ at most in the values of their parameters and in their name."""
    values = parameter_values(b)
    if parameter_values(a).keys() != values.keys():
        return False
    try:
        return replace(with_values(a, values), name=b.name) == b
    except InputError:  # the mixture of both is invalid
        return False


#: Largest speed of a tool that is moved with the mouse, m/s.
HAND_SPEED = 0.1
#: Number of points of each segment of a protocol.
_POINTS = 21


def make_hand_motion(scene: Scene) -> TargetFollowingMotion:
    """Return a motion by hand that starts at the undeformed surface."""
    return TargetFollowingMotion(0.0, HAND_SPEED, approach=scene.experiment.approach)


def make_protocol_motion(scene: Scene, text: str, speed: float, repeat: bool) -> ProtocolMotion:
    """Return the motion of a protocol; arguments and errors as `Session.play_protocol_on_reset_tissue`."""
    protocol = ts.Protocol.parse(text, _POINTS, speed)
    require_depths_within_scene(scene, protocol, "protocol")
    return ProtocolMotion(protocol, repeat, scene.experiment.approach)


def make_replay_motion_and_force_curve(scene: Scene,
                                       speed: float) -> tuple[ProtocolMotion, tuple[np.ndarray, np.ndarray] | None]:
    """Return the measured motion of a scene.

    Args:
        scene: Scene with a measurement.
        speed: Speed relative to the measurement.

    Returns:
        The motion, and the time since its start, s, and force, N, of the recording; None for a recording without time.

    Raises:
        InputError: The scene has no measurement, or the measured motion is deeper than the scene.
    """
    if scene.measurement is None:
        raise InputError("This scene has no measurement. Start the viewer with --measured FILE.")
    measured, (recording,
               _) = make_first_cycle_motion_protocol(scene.measurement), find_typical_replicate_and_branches(
                   scene.measurement)
    require_depths_within_scene(scene, measured, "recording")
    displacement = measured.displacement
    if scene.min_tool_displacement == 0.0:
        # Noise around zero displacement must not lift a tool that is attached to the tissue.
        displacement = np.maximum(displacement, 0.0)
    replayed = None
    if "time" in recording:
        replayed = (recording.time - measured.time[0]) / speed, recording.force
    protocol = ts.Protocol(measured.time / speed, displacement)
    return ProtocolMotion(protocol, approach=scene.experiment.approach), replayed


#: Duration of a single step of a paused motion, s.
STEP_TIME = 1.0 / FRAMES.rate


class Session:
    """Runs the live simulation, the model curve and calibrations of a scene; call `close` at the end.

    Any thread may post commands. The thread that calls `update_and_make_frame` executes them in the order of posting.

    Args:
        scene: First scene.
        resolution: Resolution of the live simulation.
        curve_resolution: Resolution of the model curve.
        settings: Settings of the haptic loop.
        device: Haptic device or motion that moves the tool from the start of each simulation; None: none.

    Attributes:
        scene: Present scene.
        calibration: Uploaded recordings and their fit.
    """

    def __init__(self, scene: Scene, *, resolution: str = "realtime", curve_resolution: str = "fast",
                 settings: LoopSettings = SETTINGS, device: HapticDevice | None = None):
        self.scene, self._device = scene, device
        #: Whether the device has not been connected yet, and why the connection failed.
        self._device_waits, self._refused = False, ""
        self._resolution, self._settings = resolution, settings
        self._requests = CommandQueue()
        self._curve = ModelCurveWorker(curve_resolution, scene.solver, scene.reduced)
        self.calibration = SessionCalibrations()
        self._curves, self._trace, self._frames = PlotCurves(compared=scene.compared), Trace(), 0
        #: Time since the start of the replay, s, and force, N, of the repeated recording.
        self._replayed: tuple | None = None
        #: Version of the trace: increases with each new point and with each clearing.
        self._trace_version = 0
        self._motion, self._target, self._across = "hand", 0.0, (0.0, 0.0)
        #: Whether a haptic device renders the force; a motion renders none.
        self._has_hand_force = False
        #: Whether the material was changed during the start of the simulation, which still has the old material.
        self._material_pending = False
        self._simulation = self._reset_state_and_make_simulation()

    @property
    def simulation(self) -> LiveSimulation:
        """The present simulation."""
        return self._simulation

    def post(self, command: str, *, reply: Callable[[str | None], None] | None = None, **values: Any) -> None:
        """Queue a command; any thread may call this method.

        Args:
            command: A key of `COMMANDS`.
            reply: Called with None after the execution, or with a sentence that states why the command was refused.
            values: Arguments of the command.

        Raises:
            ValueError: The command does not exist.
        """
        if command not in COMMANDS:
            raise ValueError(f"command must be one of {', '.join(COMMANDS)}; got {command!r}.")
        self._requests.append_command_thread_safely(command, reply, values)

    def update_and_make_frame(self) -> SessionFrame:
        """Execute the queued commands, poll all processes, and return the new state for display."""
        self._requests.execute_commands_except_superseded(lambda command, values: COMMANDS[command](self, **values))
        use_finished_calibration_in_scene(self)
        simulation = self._simulation
        records = simulation.poll_loop_process()
        if self._material_pending and simulation.phase is Phase.RUNNING:
            self._material_pending = False
            try:
                simulation.send_command_and_wait("set_parameters", **parameter_values(self.scene.material))
            except InputError:
                # A new simulation starts with the new material, or reports the reason.
                self.restart_simulation()
                simulation, records = self._simulation, None
        if self._device_waits and simulation.phase is Phase.RUNNING:
            self._connect_initial_device()
            records = None
        if records is not None and len(records):
            self._trace_version += self._trace.append_ticks_and_count_new_points(records)
        self._curve.store_result_and_start_next()
        if self._frames % FRAMES.frames_per_plot == 0:
            self._update_plot_curves()
        self._frames += 1
        text = simulation.message
        if simulation.phase is Phase.DIED:
            text = f"The simulation has stopped: {text.removesuffix('.')}. Press Restart to begin again."
        elif self._refused:
            text = self._refused
        elif self._curve.problem:
            text = self._curve.problem
        return SessionFrame(simulation.phase, text, self.scene, simulation.snapshot, simulation.readouts, self._curves,
                            self._motion, self._target, simulation.surface, self.calibration.state, self._across)

    def run(self, viewer: FrameViewer, stop: threading.Event, seconds: float | None = None) -> None:
        """Display frames until `stop` is set.

        Args:
            viewer: Displays the frames.
            stop: Ends the run.
            seconds: Time after which the run ends, s; None: no limit.
        """
        began = due = time.monotonic()
        while not stop.is_set() and (seconds is None or time.monotonic() - began < seconds):
            viewer.show(self.update_and_make_frame())
            # After a slow frame, the following frames keep their distance instead of catching up.
            due = max(due + 1.0 / FRAMES.rate, time.monotonic())
            stop.wait(due - time.monotonic())

    def set_hand_target(self, depth: float | None = None, across: tuple[float, float] | None = None) -> None:
        """Move the tool by hand, at most with `HAND_SPEED`.

        Args:
            depth: Target displacement along the tool's axis, m, limited to the range of the scene; None: keep it.
            across: Target x and y at which the tool's axis crosses the undeformed surface, m, limited to the reach of
                the scene; used for tissue in 3D only; None: keep them.

        Raises:
            InputError: The motion is paused, or the simulation is not running.
        """
        simulation = self._simulation
        if simulation.phase is Phase.PAUSED:
            raise InputError("The tool cannot move while the motion is paused. Press Play to continue, or Reset.")
        if self._motion != "hand":
            # TargetFollowingMotion(None) starts at the tool's present position; the position known here is one frame
            # old.
            simulation.send_command_and_wait("switch_device", device=TargetFollowingMotion(None, HAND_SPEED))
            self._motion, self._target, self._has_hand_force = "hand", simulation.tool_displacement, False
            self._across = simulation.tool_axis_surface_crossing_or_none or self._across
        depth = max(self._target if depth is None else depth, self.scene.min_tool_displacement)
        depth = min(depth, self.scene.max_tool_displacement)
        target: dict[str, Any] = {"depth": depth}
        if across is not None and simulation.snapshot is not None and simulation.snapshot.is_three_dimensional:
            target["across"] = limit_lateral_position_to_top_and_range(self.scene, simulation.snapshot, across)
        simulation.send_command_and_wait("aim", **target)
        self._target, self._across = depth, target.get("across", self._across)

    def play_protocol_on_reset_tissue(self, text: str, speed: float = 5e-3, repeat: bool = False) -> None:
        """Play a protocol from its beginning on undeformed tissue.

        Args:
            text: Protocol in the notation of `tissue_sim.Protocol.parse`.
            speed: Speed of segments for which the protocol states none, m/s.
            repeat: Whether to repeat the protocol without end.

        Raises:
            InputError: The protocol is invalid, or deeper than the scene.
        """
        self._reset_tissue_and_switch_device("protocol", make_protocol_motion(self.scene, text, speed, repeat))

    def replay_measured_motion_on_reset_tissue(self, speed: float = 1.0) -> None:
        """Repeat the measured motion on undeformed tissue; `speed` is relative to the speed of the measurement.

        Raises:
            InputError: The scene has no measurement, or the measured motion is deeper than the scene.
        """
        measured_motion, force = make_replay_motion_and_force_curve(self.scene, speed)
        self._reset_tissue_and_switch_device("recording", measured_motion)
        self._replayed = force

    def move_with_device_on_reset_tissue(self, device: HapticDevice) -> None:
        """Move the tool with a haptic device or a motion, on undeformed tissue."""
        device.set_approach(self.scene.experiment.approach)
        self._reset_tissue_and_switch_device("device", device)

    def pause_motion(self) -> None:
        """Pause the motion of the tool."""
        self._simulation.send_command_and_wait("pause")

    def resume_motion(self) -> None:
        """Continue a paused motion."""
        self._simulation.send_command_and_wait("resume")

    def pause_and_advance_one_frame_time(self) -> None:
        """Pause the motion, and advance it by the time of one frame."""
        if self._simulation.phase is not Phase.PAUSED:
            self.pause_motion()
        self._simulation.send_command_and_wait("advance", seconds=STEP_TIME)

    def reset_tool_and_tissue(self) -> None:
        """Move the tool to the undeformed surface, and reset the tissue to its undeformed state."""
        self._reset_tissue_and_switch_device("hand", make_hand_motion(self.scene))
        self._target, self._across = 0.0, self._first_contact_xy

    def set_material_parameters(self, values: dict[str, float]) -> None:
        """Change parameters of the material in the running simulation.

        Args:
            values: Path of a parameter -> new value, SI.

        Raises:
            InputError: The material or the simulation refuses the values; nothing is changed.
        """
        self._apply_material(with_values(self.scene.material, values), self.scene.source)

    def replace_material_restart_if_needed(self, material: ts.Material, source: str) -> None:
        """Replace the material of the scene.

        New parameter values of the same law are set in the running simulation; otherwise, a new simulation starts.

        Args:
            material: New material.
            source: Origin of the material for display, such as a file name.

        Raises:
            InputError: The simulation refuses the material; nothing is changed.
        """
        self._apply_material(material, source)

    def _apply_material(self, material: ts.Material, source: str) -> None:
        require_moduli_in_range(material)  # there may be no running simulation that refuses the material
        if (reduced := self.scene.reduced) is not None:
            reduced.require_supported_material(material)
        scene = replace(self.scene, material=material, source=source)
        if not differ_at_most_in_parameter_values(self.scene.material, material):
            self._set_scene_and_restart(scene)
            return
        if self._simulation.phase in (Phase.RUNNING, Phase.PAUSED):
            self._simulation.send_command_and_wait("set_parameters", **parameter_values(material))
        # A starting simulation has the old material; `update_and_make_frame` sets the new one when the simulation runs.
        self._material_pending = self._simulation.phase is Phase.STARTING
        self.scene = scene
        self._curve.store_curve_request(self._make_whole_test_model())

    def save_new_material_file_in_folder(self, folder: Path, name: str) -> None:
        """Write the present material into a new file, which becomes its source.

        Args:
            folder: Folder of the file.
            name: Name of the file without ``.material.json``.

        Raises:
            InputError: The name is empty or invalid, or the file exists already.
        """
        path = save_edited_material(self.scene.material, folder, name, source=self.scene.source)
        self.scene = replace(self.scene, source=path.name)

    def change_test_and_tool(self, name: str, tool: ts.Tool | None = None, friction: str | float | None = None) -> None:
        """Change the scene, the tool or the interface; arguments as `Scene.with_test_and_tool`.

        Raises:
            InputError: The scene does not exist, or the tool does not fit it.
        """
        self._set_scene_and_restart(self.scene.with_test_and_tool(name, tool=tool, friction=friction))

    def keep_or_remove_comparison_curve(self, name: str = "") -> None:
        """Keep the present model curve for comparison, `name` in the legend; empty: remove the curve that was kept."""
        kept = (name, self._curve.recording) if name and self._curve.recording is not None else None
        self._curves = replace(self._curves, compared=kept)

    def restart_simulation(self) -> None:
        """End the simulation process and start a new one with the present scene."""
        self._simulation.close()
        self._simulation = self._reset_state_and_make_simulation()

    @property
    def is_waiting_for_curve(self) -> bool:
        """Whether the curve of the newest model is not computed, or not part of a frame, yet."""
        return self._curve.is_busy or self._curve.recording is not self._curves.model

    def close(self) -> None:
        """Stop all processes."""
        if self._simulation is not None:
            self._simulation.close()
        self._curve.close()
        self.calibration.close()

    def _set_scene_and_restart(self, scene: Scene) -> None:
        """Make a valid scene the present one, and restart the simulation with it."""
        kind_changed = scene.kind is not self.scene.kind
        self.scene = scene
        if kind_changed:
            self._curves = PlotCurves()
            self._curve.discard_curve_and_requests()
        self.restart_simulation()

    def _reset_state_and_make_simulation(self) -> LiveSimulation:
        """Return a new simulation with the tool at the undeformed surface; clear the trace, request its model curve."""
        self._motion, self._has_hand_force = "hand", False
        self._target, self._across = 0.0, self._first_contact_xy
        self._clear_trace()
        self._material_pending = False
        self._device_waits = self._device is not None
        simulation = LiveSimulation(self.scene.model, make_hand_motion(self.scene), solver=self.scene.solver,
                                    resolution=self._resolution, settings=self._settings, reduced=self.scene.reduced)
        self._curve.store_curve_request(self._make_whole_test_model())
        return simulation

    @property
    def _first_contact_xy(self) -> tuple[float, float]:
        """Position (x, y) at which the tool first touches the undeformed surface, m."""
        x, y, _ = self.scene.experiment.tool_pose(0.0).position
        return x, y

    def _reset_tissue_and_switch_device(self, kind: str, device: HapticDevice) -> None:
        """Reset the tissue and move the tool with a device or motion; `kind` is the value of `SessionFrame.motion`."""
        simulation = self._simulation
        if simulation.phase is Phase.PAUSED:
            simulation.send_command_and_wait("resume")
        # Reset and new device in one command: with two, the tool would pull at tissue to which it is bonded.
        simulation.send_command_and_wait("switch_device", device=device, restart=True)
        simulation.skip_unread_ticks()
        self._clear_trace()
        self._motion, self._has_hand_force = kind, not isinstance(device, Motion)

    def _connect_initial_device(self) -> None:
        self._device_waits, self._refused = False, ""
        if self._device is not None:
            try:
                self.move_with_device_on_reset_tissue(self._device)
            except InputError as error:
                self._refused = f"{str(error).removesuffix('.')}. Press Restart to try again."

    def _clear_trace(self) -> None:
        self._trace.delete_all_points()
        self._replayed = None
        self._trace_version += 1

    def _make_whole_test_model(self) -> ts.Model:
        """Return the model of the whole test, with the measured motion if there is a measurement."""
        model, measurement = replace(self.scene.model, rig=self.scene.rig), self.scene.measurement
        if measurement is None:
            return model
        protocol = make_first_cycle_motion_protocol(measurement)
        return replace(model, experiment=replace(model.experiment, protocol=protocol))

    def _update_plot_curves(self) -> None:
        curves, trace, measurement = self._curves, self._trace, self.scene.measurement
        recording = self._curve.recording
        if recording is not curves.model or measurement is not curves.measurement:
            curves = replace(curves, model=recording, measurement=measurement,
                             residual=compute_force_residual_if_possible(recording, measurement))
        if self._trace_version != curves.number or curves.trace is None:
            replayed = None
            if self._replayed is not None and len(trace):
                time, force = self._replayed
                replayed = (trace.time[0] + time, force)
            curves = replace(curves, trace=trace, replayed=replayed, number=self._trace_version)
        if (self._has_hand_force, self._curve.is_busy) != (curves.has_hand_force, curves.computing):
            curves = replace(curves, has_hand_force=self._has_hand_force, computing=self._curve.is_busy)
        self._curves = curves


#: Commands of a session by name.
COMMANDS: dict[str, Callable[..., None]] = {
    "aim": Session.set_hand_target,
    "play": Session.play_protocol_on_reset_tissue,
    "replay": Session.replay_measured_motion_on_reset_tissue,
    "follow": Session.move_with_device_on_reset_tissue,
    "pause": Session.pause_motion,
    "resume": Session.resume_motion,
    "step": Session.pause_and_advance_one_frame_time,
    "reset": Session.reset_tool_and_tissue,
    "set_parameters": Session.set_material_parameters,
    "use_material": Session.replace_material_restart_if_needed,
    "save_material": Session.save_new_material_file_in_folder,
    "use_scene": Session.change_test_and_tool,
    "keep_curve": Session.keep_or_remove_comparison_curve,
    "restart": Session.restart_simulation,
    **CALIBRATION_COMMANDS,
}
