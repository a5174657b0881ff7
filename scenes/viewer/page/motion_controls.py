"""Motion tab of the page: move the tool by hand, play a protocol, repeat the measured motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import viser

from scenes.viewer.frame import CommandReceiver, Phase, SessionFrame
from scenes.viewer.page.readouts import assign_control_value, make_browser_reply_function
from scenes.viewer.page.solid import DRAGS
from scenes.viewer.scene import Scene

#: Example protocols by their label; ``{depth}`` is the largest depth of the scene, mm.
PROTOCOLS = {
    "press and release": "approach 2mm; ramp {depth}mm; hold 1s; unload; retract 2mm",
    "three cycles": "repeat 3 (ramp {depth}mm; unload)",
    "step and hold": "ramp {depth}mm @100mm/s; hold 5s; unload",
    "study, 0.248 mm/s": "ramp {depth}mm @0.248mm/s; hold 10s; unload @0.248mm/s",
}


def _make_example_protocol_text(name: str, scene: Scene) -> str:
    """Return the text of an example protocol, without segments that lift the tool if the scene forbids lifting."""
    parts = PROTOCOLS[name].format(depth=f"{scene.max_tool_displacement * 1e3:g}").split("; ")
    may_lift = scene.min_tool_displacement < 0.0
    return "; ".join(part for part in parts if may_lift or not part.startswith(("approach", "retract")))


def _convert_limits_to_mm_rounding_inwards(limits: tuple[float, float]) -> tuple[float, float]:
    """Round a range in m inwards to steps of 0.01 mm; return it in mm, as one step if the range is narrower."""
    low, high = math.ceil(1e5 * limits[0] - 1e-6) / 100, math.floor(1e5 * limits[1] + 1e-6) / 100
    return min(low, high), max(low, high)


class PositionSlider:
    """Slider for a coordinate of the tool, mm: users move the tool with it, and it displays the tool's coordinate.

    Args:
        slider: The slider of viser.

    Attributes:
        slider: The slider of viser.
    """

    def __init__(self, slider: viser.GuiSliderHandle[float]):
        self.slider = slider
        #: Value that was last entered or written, mm. viser stores a new value before it calls the callbacks: if the
        #: slider has another value, its callback is still to come.
        self._last_value = slider.value

    def register_entry_event_callback(self, callback: Callable[[viser.GuiEvent], None]) -> None:
        """Register a callback for values that users enter; values that the program writes do not call it."""

        @self.slider.on_update
        async def forward_user_entry_event(event: viser.GuiEvent) -> None:
            # viser runs a coroutine before it writes another value.
            if event.client is not None:
                self._last_value = self.slider.value
                callback(event)

    def clip_to_slider_range(self, value: float) -> float:
        """Limit a value to the range of the slider, mm."""
        return min(max(value, self.slider.min), self.slider.max)

    def display_mm_unless_entry_pending(self, value: float) -> None:
        """Set the slider to a coordinate of the tool, mm, unless a new entry is being processed.

        A typed number outside of the range is not overwritten if the tool stands at the nearest limit, because the
        user may still be typing.
        """
        if self.slider.value == self._last_value and abs(value - self.clip_to_slider_range(self._last_value)) >= 0.01:
            self._last_value = value
            assign_control_value(self.slider, value)


class MotionControls:
    """Tab with the position sliders, the buttons Play, Pause, Step and Reset, and the protocol.

    Args:
        server: Server of the page.
        session: Receives the commands.
        frame: First frame.

    Attributes:
        on_drag_mode: Called with the chosen key of `scenes.viewer.page.solid.DRAGS`.
    """

    def __init__(self, server: viser.ViserServer, session: CommandReceiver, frame: SessionFrame):
        gui, deepest = server.gui, frame.scene.max_tool_displacement
        examples = {name: _make_example_protocol_text(name, frame.scene) for name in PROTOCOLS}
        self._session, self._paused, self._plays = session, False, False
        #: Number of positions that users have entered, and number of them that the session has answered.
        self._entered = self._answered = 0
        #: Depth from which the keys step, mm.
        self._aimed = 0.0
        self._depth = PositionSlider(gui.add_slider(
            "depth [mm]", min=frame.scene.min_tool_displacement * 1e3, max=deepest * 1e3, step=0.01, initial_value=0.0,
            hint="depth of the tool. You can also drag the tool, or press PageDown and PageUp (0.1 mm; with Shift "
                 "1 mm)"))
        #: Sliders for x and y, visible for tissue in 3D only.
        self._across = [PositionSlider(gui.add_slider(
            f"{name} [mm]", min=low, max=high, step=0.01, initial_value=min(max(round(1e3 * value, 2), low), high),
            visible=False, hint=f"{name} coordinate at which the tool's axis crosses the undeformed surface"))
            for name, value, (low, high) in zip("xy", frame.across,
                                                map(_convert_limits_to_mm_rounding_inwards,
                                                    frame.scene.allowed_tool_xy_ranges),
                                                strict=True)]
        self._drags = gui.add_dropdown("mouse moves it", tuple(DRAGS), visible=False,
                                       hint="directions in which the mouse drags the tool")
        self.on_drag_mode: Callable[[str], None] = lambda _: None
        self._buttons = gui.add_button_group("run", ("Play", "Pause", "Step", "Reset"),
                                             hint="keys: P plays or pauses, N steps one frame, R resets; Ctrl+K lists "
                                             "all keys")
        self._source = gui.add_dropdown("motion", self._list_playable_motions(frame), initial_value="protocol")
        self._named = gui.add_dropdown("example", tuple(PROTOCOLS), initial_value="press and release")
        self._text = gui.add_text("protocol", examples["press and release"],
                                  hint="approach 2mm; ramp 10mm @5mm/s; hold 60s; unload; repeat 3 (ramp 5mm; unload)")
        self._speed = gui.add_number("speed [mm/s]", 5.0, min=0.01, max=200.0, step=0.01,
                                     hint="speed of segments for which the protocol states no speed")
        self._repeat = gui.add_checkbox("repeat", False)
        self._speed_factor = gui.add_number("speed factor", 10.0, min=0.1, max=1000.0, step=0.1, visible=False,
                                            hint="speed relative to the measurement. The force of viscoelastic tissue "
                                            "depends on the speed")

        #: Last refusal that was shown, so that dragging a slider does not show the same refusal many times.
        self._refusal: str | None = None

        self._depth.register_entry_event_callback(
            lambda event: self._move_to_clipped_depth_mm(self._depth.slider.value, event))
        for coordinate in self._across:
            coordinate.register_entry_event_callback(self._move_to_lateral_slider_position)

        @self._drags.on_update
        def change_drag_direction_on_update(_: viser.GuiEvent) -> None:
            self.on_drag_mode(self._drags.value)

        for key, step, words in (("pagedown", 0.1, "deeper"), ("pageup", -0.1, "up")):
            self._bind_key(gui, f"0.1 mm {words}", key, partial(self._move_by_axial_step_mm, step))
            self._bind_key(gui, f"1 mm {words}", key, partial(self._move_by_axial_step_mm, 10 * step), modifier="shift")
        self._bind_key(gui, "Play or pause", "P",
                       lambda event: self._post_button_command("Pause" if self._plays else "Play", event))
        self._bind_key(gui, "Step", "N", lambda event: self._post_button_command("Step", event))
        self._bind_key(gui, "Reset", "R", lambda event: self._post_button_command("Reset", event))

        @self._buttons.on_click
        def post_button_command_on_click(event: viser.GuiEvent) -> None:
            self._post_button_command(self._buttons.value, event)

        @self._named.on_update
        def insert_example_protocol_on_update(event: viser.GuiEvent) -> None:
            if event.client is not None:
                assign_control_value(self._text, examples[self._named.value])

        @self._source.on_update
        def show_inputs_of_motion_on_update(_: viser.GuiEvent) -> None:
            measured = self._source.value != "protocol"
            for handle in (self._named, self._text, self._speed, self._repeat):
                handle.visible = not measured
            self._speed_factor.visible = measured

    @staticmethod
    def _bind_key(gui: viser.GuiApi, label: str, key: Any, callback: Callable[[Any], None],
                  modifier: Any = None) -> None:
        """Bind a key of the keyboard; the key is also listed by its label when the user presses Ctrl+K."""
        gui.add_command(label, hotkey=key, modifier=modifier).on_trigger(callback)

    def _move_by_axial_step_mm(self, step: float, event: Any) -> None:
        """Move the tool by a step along its axis from the last aimed depth, mm, positive into the tissue."""
        self._move_to_clipped_depth_mm(self._aimed + step, event)

    def _move_to_clipped_depth_mm(self, depth: float, event: Any) -> None:
        """Move the tool to a depth, mm, limited to the range of the slider."""
        self._aimed = self._depth.clip_to_slider_range(depth)
        self._post_aim_command(event, depth=self._aimed * 1e-3)

    def _move_to_lateral_slider_position(self, event: Any) -> None:
        """Move the tool to the x and y of the sliders."""
        x, y = (coordinate.clip_to_slider_range(coordinate.slider.value) * 1e-3 for coordinate in self._across)
        self._post_aim_command(event, across=(x, y))

    def _post_aim_command(self, event: Any, **position: Any) -> None:
        """Post the command "aim", `Session.set_hand_target`, with its arguments; show each refusal once."""
        notify_problem = make_browser_reply_function(event)

        def count_answer_and_show_refusal(problem: str | None) -> None:
            self._answered += 1
            if problem is not None and problem != self._refusal:
                notify_problem(problem)
            self._refusal = problem

        self._entered += 1
        self._session.post("aim", reply=count_answer_and_show_refusal, **position)

    @staticmethod
    def _list_playable_motions(frame: SessionFrame) -> tuple[str, ...]:
        """Return the motions that Play can start: the protocol, and the measured motion if there is a measurement."""
        return ("protocol",) if frame.scene.measurement is None else ("protocol", "measured motion")

    def _post_button_command(self, button: str, event: viser.GuiEvent) -> None:
        """Post the command of a button; Play resumes a paused motion, or starts the chosen motion."""
        reply = make_browser_reply_function(event)
        if button == "Play" and self._paused:
            self._session.post("resume", reply=reply)
        elif button == "Play" and self._source.value == "protocol":
            self._session.post("play", reply=reply, text=self._text.value, speed=self._speed.value * 1e-3,
                               repeat=self._repeat.value)
        elif button == "Play":
            self._session.post("replay", reply=reply, speed=self._speed_factor.value)
        else:
            self._session.post(button.lower(), reply=reply)

    def update_controls(self, frame: SessionFrame) -> None:
        """Update the sliders, the list of motions and the state of Play; others may have moved or paused the tool."""
        self._paused = frame.phase is Phase.PAUSED
        self._plays = not self._paused and frame.motion in ("protocol", "recording")
        sources = self._list_playable_motions(frame)
        if self._source.options != sources:
            self._source.options = sources
        depth = frame.target if frame.motion == "hand" or frame.readouts is None else frame.readouts.depth
        depth = round(depth * 1e3, 2)
        in_space = (frame.snapshot is not None and frame.snapshot.is_three_dimensional
                    and frame.scene.allowed_tool_xy_ranges[0][0] < frame.scene.allowed_tool_xy_ranges[0][1])
        for handle in (*(coordinate.slider for coordinate in self._across), self._drags):
            if handle.visible != in_space:
                handle.visible = in_space
        if self._entered == self._answered:  # An entry that is not answered yet is newer than the frame.
            self._aimed = depth
            self._depth.display_mm_unless_entry_pending(depth)
            for coordinate, value in zip(self._across, frame.across, strict=True):
                coordinate.display_mm_unless_entry_pending(round(value * 1e3, 2))
